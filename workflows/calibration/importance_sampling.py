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


_ROUND_SAMPLES = 3000  #: samples of each round
#: most and fewest rounds; effective sample fraction at which the last one ends
_MOST_ROUNDS, _LEAST_ROUNDS, _ENOUGH_FRACTION = 8, 3, 0.6
#: components of a fit, its steps, and the share of samples added to each
_COMPONENTS, _FIT_STEPS, _BORROWED_SHARE = 6, 8, 0.1
_MODE_FREEDOM = 6.0  #: degrees of freedom about the mode
_FREEDOM = 30.0  #: degrees of freedom of the components that are like the posterior
#: least deviation of a logarithm at the mode, which is many times larger where the widths are
_DOUBTFUL_SD = 0.05
#: share, power of the posterior, and degrees of freedom of the wide part
_WIDE_SHARE, _WIDE_POWER, _WIDE_FREEDOM = 0.2, 0.5, 10.0


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
    near_zero = hardly_told(problem, mode)
    # only a real camera has widths among its parameters
    law_of_others = (
        _given_widths(problem, mode)
        if problem.coordinates.widths.intersection(problem.names)
        else None
    )
    in_mixture = law_of_others.at if law_of_others else np.ones(len(mode.theta), dtype=bool)
    # begins as one component with the mode and the covariance there
    mixture = Mixture(
        np.ones(1),
        mode.theta[None, in_mixture],
        _root(mode.covariance[in_mixture][:, in_mixture])[None],
        np.array([_MODE_FREEDOM]),
    )
    mixtures: list[Mixture] = []
    samples: list[FloatArray] = []
    log_densities: list[FloatArray] = []
    best_fraction, best_mixture = -1.0, mixture
    for number in range(1, _MOST_ROUNDS + 1):
        proposal: Density = CameraDensity(mixture, law_of_others) if law_of_others else mixture
        new_samples, log_weights = weighed(problem, proposal, _ROUND_SAMPLES, rng)
        mixtures.append(mixture)
        samples.append(new_samples[:, in_mixture])
        # weight times density: the log density of the posterior, for any later mixture
        log_densities.append(log_weights + mixture.log_density(new_samples[:, in_mixture]))
        fraction = effective(log_weights)
        if fraction > best_fraction:
            best_fraction, best_mixture = fraction, mixture
        if number >= _LEAST_ROUNDS and best_fraction >= _ENOUGH_FRACTION:
            break
        # fitted to the samples of all rounds so far
        mixture = _next_mixture(
            mixtures, np.concatenate(samples), np.concatenate(log_densities), rng
        )
    if law_of_others:
        weighted_widths = (
            np.concatenate(samples),
            normalised(
                _pooled_log_weights(
                    mixtures, np.concatenate(samples), np.concatenate(log_densities)
                )
            ),
        )
        width_density = with_prior_tails(best_mixture, problem, mode, in_mixture, weighted_widths)
        # `others` has the tail of the first one itself
        density = with_tails(CameraDensity(width_density, law_of_others), near_zero[1:], mode)
    else:
        density = with_tails(best_mixture, near_zero, mode)
    return density, *weighed(problem, density, count, rng)


def _given_widths(problem: SensorPosterior, mode: LaplaceFit) -> Others:
    """Return the distribution of all others given the widths, with a long lower tail of the
    least certain one.
    """
    linear_law, near_zero = GivenWidths(problem, mode), hardly_told(problem, mode, _DOUBTFUL_SD)
    return (
        NearZero(
            linear_law, near_zero[0], float(mode.covariance[near_zero[0], near_zero[0]] ** 0.5)
        )
        if near_zero
        else linear_law
    )


def _next_mixture(
    mixtures: list[Mixture], samples: FloatArray, log: FloatArray, rng: np.random.Generator
) -> Mixture:
    """Return the mixture for the next round from the ``samples`` of all rounds and their log
    density ``log``.
    """
    # one mixture like the posterior, one like its square root, which has wider tails
    same_shape, wider_tails = (
        _fitted(
            samples, normalised(softened(_pooled_log_weights(mixtures, samples, power * log))), rng
        )
        for power in (1.0, _WIDE_POWER)
    )
    # both mixtures as one
    return Mixture(
        np.concatenate([(1 - _WIDE_SHARE) * same_shape.shares, _WIDE_SHARE * wider_tails.shares]),
        np.concatenate([same_shape.centres, wider_tails.centres]),
        np.concatenate([same_shape.roots, wider_tails.roots]),
        np.repeat([_FREEDOM, _WIDE_FREEDOM], _COMPONENTS),
    )


def _pooled_log_weights(
    mixtures: list[Mixture], samples: FloatArray, log: FloatArray
) -> FloatArray:
    """Return the log weights of samples that were drawn from all `mixtures` together.

    `log` is the log density that they shall represent.
    """
    return finite(
        log - log_sum(np.stack([mixture.log_density(samples) for mixture in mixtures], -1))
    )


def _fitted(samples: FloatArray, weight: FloatArray, rng: np.random.Generator) -> Mixture:
    """Return the normal mixture that expectation and maximisation find for weighted samples."""
    _, covariance = moments(samples, weight)
    start_numbers = rng.choice(len(samples), size=_COMPONENTS, p=weight)
    mixture = Mixture(
        np.full(_COMPONENTS, 1 / _COMPONENTS),
        samples[start_numbers],
        # narrower than all samples, so that the components can separate
        np.repeat(0.7 * _root(covariance)[None], _COMPONENTS, 0),
    )
    for _ in range(_FIT_STEPS):
        mixture = maximised(
            samples, weight[:, None] * mixture.normal_shares(samples), covariance, _BORROWED_SHARE
        )
    return mixture


def _root(covariance: FloatArray) -> FloatArray:
    """Return the Cholesky root of a covariance, made firm against rounding."""
    return np.linalg.cholesky(firm(covariance)).astype(np.float64)


# --- importance sampling --------------------------------------------------------------------------

# Importance sampling of a posterior, with a proposal density that is fitted to the posterior in
# several rounds.


DRAWS = 4000
_LEAST_FRACTION = 0.02  #: least effective sample fraction


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
    """Raise ValueError if the effective fraction of the draws is too small for a posterior."""
    if fraction < _LEAST_FRACTION:
        raise ValueError(
            f"{DRAWS} draws of {', '.join(problem.names)} have an effective sample size of"
            f" {fraction * DRAWS:.0f}: hold the parameters that the levels do not determine at"
            " fixed values"
        )
