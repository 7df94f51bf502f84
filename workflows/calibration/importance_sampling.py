"""Importance sampling of a posterior, with a proposal density that is fitted to the posterior in several rounds."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from neusee.workflows.calibration.log_posterior import SensorPosterior
from neusee.workflows.calibration.mode_mixture import fit_about_mode
from neusee.workflows.calibration.posterior_mixture import Density, fit_mixture
from neusee.workflows.calibration.posterior_mode import LaplaceFit

if TYPE_CHECKING:
    from neusee.workflows.calibration.log_posterior import FloatArray

DRAWS = 4000
_LEAST = 0.02  #: least effective sample fraction


class Guide(NamedTuple):
    """A density like a posterior, and importance samples of the posterior that are drawn from it."""

    density: Density
    samples: FloatArray  #: (draw, free)
    log: FloatArray  #: (draw,) logarithm of posterior density over this density

    def starts(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Return ``count`` different samples, drawn by their weights, at which walkers can start."""
        weight = weights(self.log)
        chosen = rng.choice(len(weight), size=count, p=weight, replace=int((weight > 0).sum()) < count)
        starts: FloatArray = self.samples[chosen]
        return starts


def draw_samples(problem: SensorPosterior, mode: LaplaceFit, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return importance samples, and for each sample the logarithm of posterior density over proposal density.

    Raises: `ValueError` if the effective sample size stays too small.
    """
    guide = draw_guide(problem, mode, rng)
    return guide.samples, guide.log


def draw_guide(problem: SensorPosterior, mode: LaplaceFit, rng: np.random.Generator) -> Guide:
    """Return a density like the posterior, and importance samples from it.

    The density starts at the mode; where the posterior may be long and bent, at particles that come from the prior.
    Raises: `ValueError` if the effective sample size stays too small.
    """
    fit = fit_mixture if problem.coordinates.bent else fit_about_mode
    guide = Guide(*fit(problem, mode, DRAWS, rng))
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


def _effective_sample_fraction(weight: FloatArray) -> float:
    """Return the effective sample size divided by the number of samples."""
    return float(1.0 / (weight**2).sum() / len(weight))
