"""Importance sampling of a posterior, with a proposal that is fitted in rounds."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from neusee.workflows.calibration.camera_density import (
    CameraDensity,
    GivenWidths,
    NearZero,
    Others,
    hardly_told,
    with_prior_tails,
    with_tails,
)
from neusee.workflows.calibration.log_posterior import LaplaceFit, SensorPosterior
from neusee.workflows.calibration.posterior_mixture import (
    Density,
    Mixture,
    effective,
    finite,
    firm,
    fit_mixture,
    log_sum,
    maximised,
    moments,
    normalised,
    softened,
    weighed,
)

if TYPE_CHECKING:
    from neusee.workflows.calibration.log_posterior import FloatArray


# --- mode mixture ---------------------------------------------------------------------------------

# A density like a posterior with one mode, fitted in rounds to samples from the densities before.
#
# Every sample of every round counts, weighted by the posterior over the mean density of all rounds
# (Cornuet et al., Scand. J. Stat. 39, 798 (2012), adaptive multiple importance sampling). The first
# round draws about the mode.


_TRIED = 3000  #: samples of each round
#: most and fewest rounds; effective sample fraction at which the last one ends
_ROUNDS, _LEAST, _ENOUGH = 8, 3, 0.6
#: components of a fit, its steps, and the share of samples added to each
_PARTS, _STEPS, _BORROWED = 6, 8, 0.1
_START = 6.0  #: degrees of freedom about the mode
_TAIL = 30.0  #: degrees of freedom of the components that are like the posterior
#: least deviation of a logarithm at the mode, which is many times larger where the widths are
_DOUBT = 0.05
#: share, power of the posterior, and degrees of freedom of the wide part
_SAFE, _POWER, _SAFE_TAIL = 0.2, 0.5, 10.0


def fit_about_mode(
    problem: SensorPosterior, mode: LaplaceFit, count: int, rng: np.random.Generator
) -> tuple[Density, FloatArray, FloatArray]:
    """Return a density like the posterior, samples of it (count, free), and the log of posterior
    over density of each.

    The density is a mixture; for a real camera, whose noise has widths that are free, a mixture of
    these widths, with all other parameters as the widths imply: with a long lower tail of one that
    is hardly told from 0 (`camera_density`). A fifth of the mixture is fitted to the square root
    of the posterior, which has the same shape and wider tails, so that no sample far out gets a
    large weight. The density with the largest effective sample size is kept, with parts for the
    lower tails of further parameters (`camera_density`), and new samples are drawn from it, whose
    own effective sample size the caller must check.
    """
    tailed = hardly_told(problem, mode)
    others = (
        _given_widths(problem, mode)
        if problem.coordinates.widths.intersection(problem.names)
        else None
    )
    in_mixture = others.at if others else np.ones(len(mode.theta), dtype=bool)
    mixture = Mixture(
        np.ones(1),
        mode.theta[None, in_mixture],
        _root(mode.covariance[in_mixture][:, in_mixture])[None],
        np.array([_START]),
    )
    mixtures: list[Mixture] = []
    samples: list[FloatArray] = []
    logs: list[FloatArray] = []
    best, best_mixture = -1.0, mixture
    for number in range(1, _ROUNDS + 1):
        proposal: Density = CameraDensity(mixture, others) if others else mixture
        drawn, log = weighed(problem, proposal, _TRIED, rng)
        mixtures.append(mixture)
        samples.append(drawn[:, in_mixture])
        logs.append(log + mixture.log_density(drawn[:, in_mixture]))
        fraction = effective(log)
        if fraction > best:
            best, best_mixture = fraction, mixture
        if number >= _LEAST and best >= _ENOUGH:
            break
        mixture = _next(mixtures, np.concatenate(samples), np.concatenate(logs), rng)
    if others:
        weighted = (
            np.concatenate(samples),
            normalised(_logs(mixtures, np.concatenate(samples), np.concatenate(logs))),
        )
        widths = with_prior_tails(best_mixture, problem, mode, in_mixture, weighted)
        density = with_tails(CameraDensity(widths, others), tailed[1:], mode)
    else:
        density = with_tails(best_mixture, tailed, mode)
    return density, *weighed(problem, density, count, rng)


def _given_widths(problem: SensorPosterior, mode: LaplaceFit) -> Others:
    """Return the distribution of all others given the widths, with a long lower tail of the
    least certain one.
    """
    others, tailed = GivenWidths(problem, mode), hardly_told(problem, mode, _DOUBT)
    return (
        NearZero(others, tailed[0], float(mode.covariance[tailed[0], tailed[0]] ** 0.5))
        if tailed
        else others
    )


def _next(
    mixtures: list[Mixture], samples: FloatArray, log: FloatArray, rng: np.random.Generator
) -> Mixture:
    """Return the mixture for the next round from the ``samples`` of all rounds and their log
    density ``log``.
    """
    like, wide = (
        _fitted(samples, normalised(softened(_logs(mixtures, samples, power * log))), rng)
        for power in (1.0, _POWER)
    )
    return Mixture(
        np.concatenate([(1 - _SAFE) * like.shares, _SAFE * wide.shares]),
        np.concatenate([like.centres, wide.centres]),
        np.concatenate([like.roots, wide.roots]),
        np.repeat([_TAIL, _SAFE_TAIL], _PARTS),
    )


def _logs(mixtures: list[Mixture], samples: FloatArray, log: FloatArray) -> FloatArray:
    """Return the logarithms of the weights of samples of all mixtures, of a density with the
    logarithm ``log``.
    """
    return finite(
        log - log_sum(np.stack([mixture.log_density(samples) for mixture in mixtures], -1))
    )


def _fitted(samples: FloatArray, weight: FloatArray, rng: np.random.Generator) -> Mixture:
    """Return the normal mixture that expectation and maximisation find for weighted samples."""
    _, covariance = moments(samples, weight)
    starts = rng.choice(len(samples), size=_PARTS, p=weight)
    mixture = Mixture(
        np.full(_PARTS, 1 / _PARTS),
        samples[starts],
        np.repeat(0.7 * _root(covariance)[None], _PARTS, 0),
    )
    for _ in range(_STEPS):
        mixture = maximised(
            samples, weight[:, None] * mixture.normal_shares(samples), covariance, _BORROWED
        )
    return mixture


def _root(covariance: FloatArray) -> FloatArray:
    return np.linalg.cholesky(firm(covariance)).astype(np.float64)


# --- importance sampling --------------------------------------------------------------------------

# Importance sampling of a posterior, with a proposal density that is fitted to the posterior in
# several rounds.


DRAWS = 4000
_LEAST_SAMPLES = 0.02  #: least effective sample fraction


class Guide(NamedTuple):
    """A density like a posterior, and importance samples of the posterior that are drawn from
    it.
    """

    density: Density
    samples: FloatArray  #: (draw, free)
    log: FloatArray  #: (draw,) logarithm of posterior density over this density

    def starts(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Return ``count`` different samples, drawn by their weights, at which walkers can
        start.
        """
        weight = normalised(self.log)
        numbers = rng.choice(
            len(weight), size=count, p=weight, replace=int((weight > 0).sum()) < count
        )
        starts: FloatArray = self.samples[numbers]
        return starts


def draw_samples(
    problem: SensorPosterior, mode: LaplaceFit, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return importance samples, and for each sample the logarithm of posterior density over
    proposal density.

    Raises: `ValueError` if the effective sample size stays too small.
    """
    guide = draw_guide(problem, mode, rng)
    return guide.samples, guide.log


def draw_guide(problem: SensorPosterior, mode: LaplaceFit, rng: np.random.Generator) -> Guide:
    """Return a density like the posterior, and importance samples from it.

    The density starts at the mode; where the posterior may be long and bent, at particles that come
    from the prior.
    Raises: `ValueError` if the effective sample size stays too small.
    """
    fit = fit_mixture if problem.coordinates.bent else fit_about_mode
    guide = Guide(*fit(problem, mode, DRAWS, rng))
    _refuse_few(problem, effective(guide.log))
    return guide


def _refuse_few(problem: SensorPosterior, fraction: float) -> None:
    if fraction < _LEAST_SAMPLES:
        raise ValueError(
            f"{DRAWS} draws of {', '.join(problem.names)} have an effective sample size of"
            f" {fraction * DRAWS:.0f}: hold the parameters that the levels do not determine at"
            " fixed values"
        )
