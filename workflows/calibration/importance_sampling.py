"""Importance sampling of a posterior, with a proposal density that is fitted to the posterior in several rounds."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from neusee.workflows.calibration.log_posterior import SensorPosterior
from neusee.workflows.calibration.posterior_mixture import Mixture, fit_mixture
from neusee.workflows.calibration.posterior_mode import LaplaceFit

if TYPE_CHECKING:
    from neusee.workflows.calibration.log_posterior import FloatArray

DRAWS = 4000
_ROUNDS, _TAIL = 8, 6.0
_ENOUGH, _SOFT, _LEAST = 0.3, 0.1, 0.02  #: effective sample fractions: to stop, to fit the next proposal, to accept


class Guide(NamedTuple):
    """A mixture of densities like a posterior, and importance samples of the posterior that are drawn from it."""

    mixture: Mixture
    samples: FloatArray  #: (draw, free)
    log: FloatArray  #: (draw,) logarithm of posterior density over density of the mixture

    def starts(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Return ``count`` different samples, drawn by their weights, at which walkers can start."""
        weight = weights(self.log)
        chosen = rng.choice(len(weight), size=count, p=weight, replace=int((weight > 0).sum()) < count)
        starts: FloatArray = self.samples[chosen]
        return starts


def draw_samples(problem: SensorPosterior, mode: LaplaceFit, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return importance samples, and for each sample the logarithm of posterior density over proposal density.

    The proposal is Student's t distribution; its mean and covariance start at those of the mode and are fitted to the
    weighted samples. Where the posterior may be long and bent, the proposal is a mixture of such distributions.
    Raises: `ValueError` if the effective sample size stays too small.
    """
    if problem.coordinates.bent:
        guide = draw_guide(problem, mode, rng)
        return guide.samples, guide.log
    centre, covariance = mode.theta, mode.covariance
    kept, best = (np.empty((0, len(centre))), np.empty(0)), 0.0
    for _ in range(_ROUNDS):
        samples, log = _proposed(problem, centre, covariance, rng)
        fraction = _effective_sample_fraction(weights(log))
        if fraction > best:
            kept, best = (samples, log), fraction
        if best >= _ENOUGH:
            break
        while _effective_sample_fraction(soft := weights(log)) < _SOFT:
            log = 0.5 * log  # few samples would make the next density too narrow
        centre = soft @ samples
        covariance = (samples - centre).T @ (soft[:, None] * (samples - centre))
    _refuse_few(problem, best)
    return kept


def draw_guide(problem: SensorPosterior, mode: LaplaceFit, rng: np.random.Generator) -> Guide:
    """Return a mixture like the posterior, and importance samples from it.

    Raises: `ValueError` if the effective sample size stays too small.
    """
    guide = Guide(*fit_mixture(problem, mode, DRAWS, rng))
    _refuse_few(problem, _effective_sample_fraction(weights(guide.log)))
    return guide


def _refuse_few(problem: SensorPosterior, fraction: float) -> None:
    if fraction < _LEAST:
        raise ValueError(
            f"{DRAWS} draws of {', '.join(problem.names)} have an effective sample size of {fraction * DRAWS:.0f}: "
            "hold the parameters that the levels do not determine at fixed values"
        )


def weights(log: FloatArray) -> FloatArray:
    """Return importance weights with a sum of 1 from the logarithms of unnormalised weights."""
    weight = np.exp(log - log.max())
    normalized: FloatArray = weight / weight.sum()
    return normalized


def _proposed(
    problem: SensorPosterior, centre: FloatArray, covariance: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Draw samples from Student's t distribution; return the samples and the logarithms of their weights."""
    off = rng.standard_normal((DRAWS, len(centre))) / np.sqrt(rng.chisquare(_TAIL, (DRAWS, 1)) / _TAIL)
    samples = centre + off @ np.linalg.cholesky(covariance).T
    log: FloatArray = problem.log_posterior(samples) + 0.5 * (_TAIL + len(centre)) * np.log1p((off**2).sum(1) / _TAIL)
    return samples, log


def _effective_sample_fraction(weight: FloatArray) -> float:
    """Return the effective sample size divided by the number of samples."""
    return float(1.0 / (weight**2).sum() / len(weight))
