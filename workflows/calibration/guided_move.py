"""A move of walkers that also proposes places from a density like the posterior, whatever the walkers' own places."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from neusee.workflows.calibration.posterior_mixture import Density

if TYPE_CHECKING:
    from neusee.workflows.calibration.log_posterior import FloatArray

_SHARE = 0.8  #: of the proposals that come from the density


class GuidedMove:
    """A move of emcee that proposes some of the new places from a density, by which walkers also change modes.

    Each proposal has the factor of Metropolis and Hastings, so that the chains have the posterior as their limit,
    however well or badly the density agrees with it.
    """

    def __init__(self, move: Any, density: Density) -> None:
        self.move, self.density = move, density
        self.nsplits, self.randomize_split = move.nsplits, move.randomize_split

    def setup(self, places: FloatArray) -> None:
        """Prepare the move of emcee for walkers at ``places``."""
        self.move.setup(places)

    def get_proposal(
        self, own: FloatArray, others: Sequence[FloatArray], random: np.random.RandomState
    ) -> tuple[FloatArray, FloatArray]:
        """Return proposed places (walker, free), and the logarithm of the factor of each in its acceptance."""
        proposed, factors = self.move.get_proposal(own, others, random)
        drawn, ratio = self.density.propose(own, random)
        guided = random.random_sample(len(own)) < _SHARE
        return np.where(guided[:, None], drawn, proposed), np.where(guided, ratio, factors)
