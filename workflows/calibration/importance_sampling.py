"""Importance sampling of a posterior, with a proposal density that is fitted in several rounds."""

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
# All samples of all rounds are used, weighted by the posterior over the mean density of all rounds
# (Cornuet et al., Scand. J. Stat. 39, 798 (2012), adaptive multiple importance sampling). The first
# round samples around the mode.


_ROUND_SAMPLES = 3000  #: samples of each round
#: most and fewest rounds; effective sample fraction at which the rounds end
_MOST_ROUNDS, _LEAST_ROUNDS, _ENOUGH_FRACTION = 8, 3, 0.6
#: number of components, of fit steps, and of samples (as a share) added to the components
_COMPONENTS, _FIT_STEPS, _BORROWED_SHARE = 6, 8, 0.1
_MODE_FREEDOM = 6.0  #: degrees of freedom of the first proposal, around the mode
_FREEDOM = 30.0  #: degrees of freedom of the components fitted to the posterior itself
#: standard deviation of a logarithm at the mode from which a parameter counts as near 0; it may be
#: many times larger for other widths
_DOUBTFUL_SD = 0.05
#: share, power of the posterior, and degrees of freedom of the wider components
_WIDE_SHARE, _WIDE_POWER, _WIDE_FREEDOM = 0.2, 0.5, 10.0


def fit_about_mode(
    problem: SensorPosterior, mode: LaplaceFit, count: int, rng: np.random.Generator
) -> tuple[Density, FloatArray, FloatArray]:
    """Return a density that approximates the posterior, samples of it (count, free), and the log
    ratio of posterior to density for each.

    The density is a mixture. For a real camera, whose noise widths are free parameters, the mixture
    covers only these widths; all other parameters follow a distribution conditional on the widths,
    with a long lower tail for one that is hardly distinguishable from 0 (`camera_density`). A fifth
    of the mixture is fitted to the square root of the posterior, which has the same shape and wider
    tails, so that no sample far out gets a large weight. The density with the largest effective
    sample size is kept, parts for the lower tails of further parameters are added
    (`camera_density`), and new samples are drawn from it. The caller must check the effective
    sample size of these.
    """
    near_zero = hardly_told(problem, mode)
    # only a real camera has widths among its parameters
    law_of_others = (
        _given_widths(problem, mode)
        if problem.coordinates.widths.intersection(problem.names)
        else None
    )
    in_mixture = law_of_others.at if law_of_others else np.ones(len(mode.theta), dtype=bool)
    # start with one component: the mode and the covariance there
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
        # weight times density is the posterior: kept, so that any later mixture can be used
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
        # `law_of_others` already has the tail of the first of these parameters
        density = with_tails(CameraDensity(width_density, law_of_others), near_zero[1:], mode)
    else:
        density = with_tails(best_mixture, near_zero, mode)
    return density, *weighed(problem, density, count, rng)


def _given_widths(problem: SensorPosterior, mode: LaplaceFit) -> Others:
    """Return the distribution of all other parameters given the widths, with a long lower tail for
    the least certain one.
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
    """Return the mixture for the next round; ``log`` is the log posterior of the ``samples`` of all
    rounds.
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
    """Return the log weights of samples drawn from all ``mixtures`` together.

    ``log`` is the log density that the weighted samples should represent.
    """
    return finite(
        log - log_sum(np.stack([mixture.log_density(samples) for mixture in mixtures], -1))
    )


def _fitted(samples: FloatArray, weight: FloatArray, rng: np.random.Generator) -> Mixture:
    """Return the normal mixture fitted to weighted samples by expectation maximisation."""
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
    """Return the lower Cholesky factor of a covariance, with its diagonal raised slightly against
    rounding.
    """
    return np.linalg.cholesky(firm(covariance)).astype(np.float64)


# --- importance sampling --------------------------------------------------------------------------

# Importance sampling of a posterior, with a proposal density that is fitted to the posterior in
# several rounds.


DRAWS = 4000
_LEAST_FRACTION = 0.02  #: least effective sample fraction that is accepted


class Guide(NamedTuple):
    """A density that approximates the posterior, and importance samples drawn from it."""

    density: Density
    samples: FloatArray  #: (draw, free)
    log: FloatArray  #: (draw,) logarithm of the ratio of posterior to this density

    def starts(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Return ``count`` different samples, drawn by weight, as starting points of walkers."""
        weight = normalised(self.log)
        numbers = rng.choice(
            len(weight), size=count, p=weight, replace=int((weight > 0).sum()) < count
        )
        starts: FloatArray = self.samples[numbers]
        return starts


def draw_samples(
    problem: SensorPosterior, mode: LaplaceFit, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return importance samples, and for each the logarithm of the ratio of posterior to proposal
    density.

    Raises: `ValueError` if the effective sample size stays too small.
    """
    guide = draw_guide(problem, mode, rng)
    return guide.samples, guide.log


def draw_guide(problem: SensorPosterior, mode: LaplaceFit, rng: np.random.Generator) -> Guide:
    """Return a density that approximates the posterior, with importance samples from it.

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
            f" {fraction * DRAWS:.0f}: fix the parameters that the levels do not determine"
        )
