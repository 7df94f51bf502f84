"""A density of all parameters of a camera: a mixture of the widths of its noise, and of all others given the widths."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from neusee.workflows.calibration.posterior_mixture import Density, Random

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from neusee.workflows.calibration.log_posterior import FloatArray

    Law = tuple[FloatArray, ...]  #: the numbers of a distribution, each for every set of widths (draw, ...)


class Others(Protocol):
    """The distribution of all other parameters given the widths."""

    at: NDArray[np.bool_]  #: (free,) True for a width

    def law(self, widths: FloatArray) -> Law:
        """Return the distribution for each set of ``widths`` (draw, width)."""

    def draw(self, widths: FloatArray, law: Law, rng: Random) -> FloatArray:
        """Return samples (draw, free) with the given ``widths`` and their ``law``."""

    def log_density(self, samples: FloatArray, law: Law) -> FloatArray:
        """Return the log density of the other parameters at ``samples`` given the widths, up to a constant."""


@dataclass(frozen=True)
class CameraDensity:
    """A density of all parameters: a mixture of the widths, and the distribution of all others given the widths."""

    widths: Density
    others: Others

    def draw(self, count: int, rng: Random) -> FloatArray:
        """Draw samples (count, free)."""
        widths = self.widths.draw(count, rng)
        return self.others.draw(widths, self.others.law(widths), rng)

    def log_density(self, samples: FloatArray) -> FloatArray:
        """Return the logarithm of the density at samples (draw, free), up to a constant."""
        widths = samples[:, self.others.at]
        return self.widths.log_density(widths) + self.others.log_density(samples, self.others.law(widths))

    def propose(self, own: FloatArray, rng: Random) -> tuple[FloatArray, FloatArray]:
        """Return new samples like ``own`` (draw, free), and the logarithm of the density at ``own`` over that there."""
        widths = np.concatenate([own[:, self.others.at], self.widths.draw(len(own), rng)])
        law, here, there = self.others.law(widths), slice(None, len(own)), slice(len(own), None)
        drawn = self.others.draw(widths[there], tuple(part[there] for part in law), rng)
        log = self.widths.log_density(widths) + self.others.log_density(np.concatenate([own, drawn]), law)
        return drawn, log[here] - log[there]
