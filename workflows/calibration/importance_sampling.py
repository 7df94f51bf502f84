"""Draws of a posterior without a chain: importance sampling from a law that is fitted until it agrees."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from neusee.workflows.calibration.log_posterior import SensorPosterior
from neusee.workflows.calibration.posterior_mode import LaplaceFit

if TYPE_CHECKING:
    from neusee.workflows.calibration.log_posterior import Places

DRAWS = 4000
_ROUNDS, _TAIL = 8, 6.0
_ENOUGH, _SOFT, _LEAST = 0.3, 0.1, 0.02  #: of the draws, how many they must be worth: to end, to go on by, at all


def drawn(problem: SensorPosterior, top: LaplaceFit, rng: np.random.Generator) -> tuple[Places, Places]:
    """Places, and the logarithm of the posterior over the law that they were drawn from.

    The law has wide tails, begins as that about the peak, and is fitted to the weighed draws until they agree. Raises
    ValueError where they never do.
    """
    centre, covariance = top.place, top.covariance
    found, best = (np.empty((0, len(centre))), np.empty(0)), 0.0
    for _ in range(_ROUNDS):
        places, log = _proposed(problem, centre, covariance, rng)
        worth = _worth(weights(log))
        if worth > best:
            found, best = (places, log), worth
        if best >= _ENOUGH:
            break
        while _worth(soft := weights(log)) < _SOFT:  # few draws would make the next law too narrow
            log = 0.5 * log
        centre = soft @ places
        covariance = (places - centre).T @ (soft[:, None] * (places - centre))
    if best < _LEAST:
        raise ValueError(
            f"{DRAWS} draws of {', '.join(problem.names)} are worth {best * DRAWS:.0f}: what levels do not tell is "
            "better held"
        )
    return found


def weights(log: Places) -> Places:
    """Shares that sum to one."""
    share = np.exp(log - log.max())
    found: Places = share / share.sum()
    return found


def _proposed(
    problem: SensorPosterior, centre: Places, covariance: Places, rng: np.random.Generator
) -> tuple[Places, Places]:
    """Places by Student's law, and the logarithm of the posterior over that law."""
    off = rng.standard_normal((DRAWS, len(centre))) / np.sqrt(rng.chisquare(_TAIL, (DRAWS, 1)) / _TAIL)
    places = centre + off @ np.linalg.cholesky(covariance).T
    log: Places = problem.log_posterior(places) + 0.5 * (_TAIL + len(centre)) * np.log1p((off**2).sum(1) / _TAIL)
    return places, log


def _worth(weight: Places) -> float:
    """As how many independent draws, as a share of all."""
    return float(1.0 / (weight**2).sum() / len(weight))
