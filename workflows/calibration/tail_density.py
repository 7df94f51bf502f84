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
    from numpy.typing import NDArray

    from neusee.workflows.calibration.log_posterior import FloatArray, SensorPosterior
    from neusee.workflows.calibration.posterior_mode import LaplaceFit

_DOUBT = 0.12  #: least deviation of a logarithm whose lower tail counts: 0 is then eight deviations away
_LEAST, _STEPS = 0.03, 20  #: least share of a part, and steps in which the shares are found
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
        body, tails = self.body.log_density(samples), self.tails.log_density(samples)
        return log_sum(np.stack([body + np.log1p(-_SHARE), tails + np.log(_SHARE)], -1))

    def propose(self, own: FloatArray, rng: Random) -> tuple[FloatArray, FloatArray]:
        """Return new samples like ``own`` (draw, free), and the logarithm of the density at ``own`` over that there."""
        drawn = self.draw(len(own), rng)
        return drawn, self.log_density(own) - self.log_density(drawn)


def hardly_told(problem: SensorPosterior, mode: LaplaceFit, doubt: float = _DOUBT) -> list[int]:
    """Return the numbers of the positive parameters that are hardly told from 0, the least certain one first.

    These have logarithms with a standard deviation above ``doubt`` at the mode.
    """
    spread = np.sqrt(np.diagonal(mode.covariance))
    other = problem.coordinates.linear | problem.coordinates.widths
    found = [i for i, name in enumerate(problem.names) if name not in other and spread[i] > doubt]
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
    return TailDensity(body, Mixture(shares, np.stack(centres), np.stack(roots), _TAIL))


def with_prior_tails(
    body: Mixture, problem: SensorPosterior, mode: LaplaceFit, at: NDArray[np.bool_], known: tuple[FloatArray, ...]
) -> Mixture:
    """Return a density of the widths ``at`` (free,) with a part for each width, in which this width has its prior.

    Below some width the levels see none, and the prior alone decides. All other widths lie as in ``body``. The shares
    of the parts follow from ``known``: samples (draw, width) of the posterior and their weights (draw,).
    """
    middle = problem.whitened(mode.theta[None])[0]
    units = (1 / (problem.whitened(mode.theta + np.eye(len(mode.theta))) - middle).diagonal())[at]
    mean = body.shares @ body.centres
    away = body.centres - mean
    covariance = np.einsum("k,kij,klj->il", body.shares, body.roots, body.roots) + away.T @ (
        body.shares[:, None] * away
    )
    centres, roots = np.repeat(mean[None], len(mean), 0), []
    for i, unit in enumerate(units):
        centres[i, i] = mode.theta[at][i] - middle[at][i] * unit
        roots.append(_root(_given(covariance, i), i, unit))
    parts = [Mixture(np.ones(1), centre[None], root[None], _TAIL) for centre, root in zip(centres, roots, strict=True)]
    first, *shares = _shares([body, *parts], *known)
    tails = np.broadcast_to(body.tails, body.shares.shape)
    return Mixture(
        np.concatenate([first * body.shares, shares]),
        np.concatenate([body.centres, centres]),
        np.concatenate([body.roots, np.stack(roots)]),
        np.concatenate([tails, np.full(len(shares), _TAIL)]),
    )


def _shares(parts: Sequence[Mixture], samples: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the share of each part with which a density is most like weighted samples; no part has less than a few."""
    logs = np.stack([part.log_density(samples) for part in parts], -1)
    shares = np.full(len(parts), 1 / len(parts))
    for _ in range(_STEPS):
        each = logs + np.log(shares)
        shares = np.maximum(weight @ np.exp(each - log_sum(each)[:, None]), _LEAST)
        shares /= shares.sum()
    return shares


def _tail(theta: FloatArray, covariance: FloatArray, i: int) -> tuple[FloatArray, FloatArray]:
    """Return centre and root of the part for the logarithm ``i``."""
    centre = theta - covariance[:, i] / covariance[i, i]
    centre[i] = theta[i] - _REACH
    return centre, _root(_given(covariance, i), i, _REACH / np.sqrt(2))


def _given(covariance: FloatArray, i: int) -> FloatArray:
    """Return the covariance of all others for a known value of ``i``."""
    given: FloatArray = covariance - np.outer(covariance[:, i], covariance[i]) / covariance[i, i]
    return given


def _root(given: FloatArray, i: int, spread: float) -> FloatArray:
    """Return the root of a covariance ``given`` the value of ``i``, to which ``i`` joins with its own ``spread``."""
    given[i], given[:, i] = 0.0, 0.0
    given[i, i] = spread**2
    return np.linalg.cholesky(firm(given)).astype(np.float64)
