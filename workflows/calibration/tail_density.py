"""A density with parts for the long lower tails of positive parameters that are hardly told from 0.

The data see such a parameter as 0 where its logarithm falls, so that the posterior is there the prior, of several
units. A density that is fitted about the mode seldom proposes from the tail, in which a walker then stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from neusee.workflows.calibration.posterior_mixture import Density, Mixture, Random, firm, log_sum, uniform

if TYPE_CHECKING:
    from neusee.workflows.calibration.log_posterior import FloatArray, SensorPosterior
    from neusee.workflows.calibration.posterior_mode import LaplaceFit

_DOUBT = 0.12  #: least deviation of a logarithm whose lower tail counts: 0 is then eight deviations away
_SHARE, _REACH, _TAIL = 0.05, 2.5, 6.0  #: share of the parts, their distance below the mode, and degrees of freedom


@dataclass(frozen=True)
class TailDensity:
    """A density of which a fixed share comes from a mixture for the tails; both are normalised alike."""

    body: Density
    tails: Mixture

    def draw(self, count: int, rng: Random) -> FloatArray:
        """Draw samples (count, free)."""
        from_tails = uniform(count, rng) < _SHARE
        samples: FloatArray = np.where(from_tails[:, None], self.tails.draw(count, rng), self.body.draw(count, rng))
        return samples

    def log_density(self, samples: FloatArray) -> FloatArray:
        """Return the logarithm of the density at samples (draw, free), up to a constant."""
        parts = self.body.log_density(samples) + np.log1p(-_SHARE), self.tails.log_density(samples) + np.log(_SHARE)
        return log_sum(np.stack(parts, -1))

    def propose(self, own: FloatArray, rng: Random) -> tuple[FloatArray, FloatArray]:
        """Return new samples like ``own`` (draw, free), and the logarithm of the density at ``own`` over that there."""
        drawn = self.draw(len(own), rng)
        return drawn, self.log_density(own) - self.log_density(drawn)


def hardly_told(problem: SensorPosterior, mode: LaplaceFit) -> list[int]:
    """Return the numbers of the positive parameters that are hardly told from 0, the least certain one first."""
    spread = np.sqrt(np.diagonal(mode.covariance))
    other = problem.coordinates.linear | problem.coordinates.widths
    found = [i for i, name in enumerate(problem.names) if name not in other and spread[i] > _DOUBT]
    return sorted(found, key=lambda i: -spread[i])


def with_tails(body: Density, found: Sequence[int], mode: LaplaceFit) -> Density:
    """Return a density with a part for the tail of each parameter in ``found``, or ``body`` without one.

    In such a part all other parameters lie where a line through the mode leads them, with the deviations that they have
    for a known value, because the levels depend on the parameter itself and not on its logarithm.
    """
    if not found:
        return body
    centres, roots = zip(*(_tail(mode.theta, mode.covariance, i) for i in found), strict=True)
    shares = np.full(len(found), 1 / len(found))
    return TailDensity(body, Mixture(shares, np.stack(centres), np.stack(roots), np.full(len(found), _TAIL)))


def _tail(theta: FloatArray, covariance: FloatArray, i: int) -> tuple[FloatArray, FloatArray]:
    """Return centre and root of the part for the logarithm ``i``."""
    slope = covariance[:, i] / covariance[i, i]
    centre, given = theta - slope, covariance - np.outer(slope, covariance[i])
    centre[i] = theta[i] - _REACH
    given[i], given[:, i] = 0.0, 0.0
    given[i, i] = _REACH**2 / 2
    return centre, np.linalg.cholesky(firm(given)).astype(np.float64)
