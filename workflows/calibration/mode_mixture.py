"""A density like a posterior with one mode, fitted in rounds to samples from the densities before.

Every sample of every round counts, weighted by the posterior over the mean density of all rounds (Cornuet et al.,
Scand. J. Stat. 39, 798 (2012), adaptive multiple importance sampling). The first round draws about the mode.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from neusee.workflows.calibration.camera_density import CameraDensity, Others
from neusee.workflows.calibration.given_widths import GivenWidths
from neusee.workflows.calibration.posterior_mixture import (
    Density,
    Mixture,
    effective,
    finite,
    firm,
    log_sum,
    maximised,
    moments,
    normalised,
    softened,
    weighed,
)
from neusee.workflows.calibration.tail_density import hardly_told, with_prior_tails, with_tails
from neusee.workflows.calibration.value_near_zero import NearZero

if TYPE_CHECKING:
    from neusee.workflows.calibration.log_posterior import FloatArray, SensorPosterior
    from neusee.workflows.calibration.posterior_mode import LaplaceFit

_TRIED = 3000  #: samples of each round
_ROUNDS, _LEAST, _ENOUGH = 8, 3, 0.6  #: most and fewest rounds; effective sample fraction at which the last one ends
_PARTS, _STEPS, _BORROWED = 6, 8, 0.1  #: components of a fit, its steps, and the share of samples added to each
_START = 6.0  #: degrees of freedom about the mode
_TAIL = 30.0  #: degrees of freedom of the components that are like the posterior
_DOUBT = 0.05  #: least deviation of a logarithm at the mode, which is many times larger where the widths are
_SAFE, _POWER, _SAFE_TAIL = 0.2, 0.5, 10.0  #: share, power of the posterior, and degrees of freedom of the wide part


def fit_about_mode(
    problem: SensorPosterior, mode: LaplaceFit, count: int, rng: np.random.Generator
) -> tuple[Density, FloatArray, FloatArray]:
    """Return a density like the posterior, samples of it (count, free), and the log of posterior over density of each.

    The density is a mixture; for a real camera, whose noise has widths that are free, a mixture of these widths, with
    all other parameters as the widths imply: with a long lower tail of one that is hardly told from 0
    (`value_near_zero`). A fifth of the mixture is fitted to the square root of the posterior, which has the same shape
    and wider tails, so that no sample far out gets a large weight. The density with the largest effective sample size
    is kept, with parts for the lower tails of further parameters (`tail_density`), and new samples are drawn from it,
    whose own effective sample size the caller must check.
    """
    tailed = hardly_told(problem, mode)
    others = _given_widths(problem, mode) if problem.coordinates.widths.intersection(problem.names) else None
    at = others.at if others else np.ones(len(mode.theta), dtype=bool)
    mixture = Mixture(np.ones(1), mode.theta[None, at], _root(mode.covariance[at][:, at])[None], np.array([_START]))
    mixtures: list[Mixture] = []
    samples: list[FloatArray] = []
    logs: list[FloatArray] = []
    best, kept = -1.0, mixture
    for number in range(1, _ROUNDS + 1):
        drawn, log = weighed(problem, CameraDensity(mixture, others) if others else mixture, _TRIED, rng)
        mixtures.append(mixture)
        samples.append(drawn[:, at])
        logs.append(log + mixture.log_density(drawn[:, at]))
        fraction = effective(log)
        if fraction > best:
            best, kept = fraction, mixture
        if number >= _LEAST and best >= _ENOUGH:
            break
        mixture = _next(mixtures, np.concatenate(samples), np.concatenate(logs), rng)
    if others:
        known = np.concatenate(samples), normalised(_logs(mixtures, np.concatenate(samples), np.concatenate(logs)))
        widths = with_prior_tails(kept, problem, mode, at, known)
        whole = with_tails(CameraDensity(widths, others), tailed[1:], mode)
    else:
        whole = with_tails(kept, tailed, mode)
    return whole, *weighed(problem, whole, count, rng)


def _given_widths(problem: SensorPosterior, mode: LaplaceFit) -> Others:
    """Return the distribution of all others given the widths, with a long lower tail of the least certain one."""
    others, tailed = GivenWidths(problem, mode), hardly_told(problem, mode, _DOUBT)
    return NearZero(others, tailed[0], float(mode.covariance[tailed[0], tailed[0]] ** 0.5)) if tailed else others


def _next(mixtures: list[Mixture], samples: FloatArray, log: FloatArray, rng: np.random.Generator) -> Mixture:
    """Return the mixture for the next round from the ``samples`` of all rounds and their log density ``log``."""
    like, wide = (
        _fitted(samples, normalised(softened(_logs(mixtures, samples, power * log))), rng) for power in (1.0, _POWER)
    )
    return Mixture(
        np.concatenate([(1 - _SAFE) * like.shares, _SAFE * wide.shares]),
        np.concatenate([like.centres, wide.centres]),
        np.concatenate([like.roots, wide.roots]),
        np.repeat([_TAIL, _SAFE_TAIL], _PARTS),
    )


def _logs(mixtures: list[Mixture], samples: FloatArray, log: FloatArray) -> FloatArray:
    """Return the logarithms of the weights of samples of all mixtures, of a density with the logarithm ``log``."""
    return finite(log - log_sum(np.stack([mixture.log_density(samples) for mixture in mixtures], -1)))


def _fitted(samples: FloatArray, weight: FloatArray, rng: np.random.Generator) -> Mixture:
    """Return the normal mixture that expectation and maximisation find for weighted samples."""
    _, whole = moments(samples, weight)
    at = rng.choice(len(samples), size=_PARTS, p=weight)
    found = Mixture(np.full(_PARTS, 1 / _PARTS), samples[at], np.repeat(0.7 * _root(whole)[None], _PARTS, 0))
    for _ in range(_STEPS):
        found = maximised(samples, weight[:, None] * found.normal_shares(samples), whole, _BORROWED)
    return found


def _root(covariance: FloatArray) -> FloatArray:
    return np.linalg.cholesky(firm(covariance)).astype(np.float64)
