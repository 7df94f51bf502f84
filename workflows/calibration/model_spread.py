"""Parameter intervals for a camera of unknown response, from posteriors with several models of the response."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from neusee.nodes.values import Levels
from neusee.workflows.calibration.importance_sampling import draw_samples, weights
from neusee.workflows.calibration.log_posterior import SensorPosterior
from neusee.workflows.calibration.posterior_mode import initial_theta, search_mode
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.recipe.distributions.joint import Z_90
from neusee.workflows.store.result_store import Store

TERMS = ("bend", "twist")  #: terms of the response, in the order in which models add them


@dataclass(frozen=True)
class IntervalEstimate:
    """The value of a parameter and its central 90 % interval."""

    value: float
    low: float
    high: float

    def holds(self, value: float) -> bool:
        """Return True if the interval contains ``value``."""
        return self.low <= value <= self.high


@dataclass(frozen=True)
class ModelSpread:
    """The posterior of one parameter with each model of the camera's response, and the interval to report."""

    name: str
    models: tuple[IntervalEstimate, ...]  #: the posterior with 0, 1, 2 terms of the response, as far as they are free
    stated: IntervalEstimate


_Posterior = dict[str, tuple[float, float]]  #: mean and standard deviation of each coordinate


def compare_models(recipe: Recipe, store: Store, seed: int = 0) -> list[ModelSpread]:
    """Return the posterior with each model of the camera's response and the interval to report, for each parameter.

    The stated value is the mean of the two models with the most terms. The stated width is the standard deviation of
    this mean (`width_of_mean`) and half the distance of both values, added in quadrature.

    One model is not enough. For 36 simulated cameras a response with 1 million pixels a level, cubic by 5 % at 4095 DN,
    the 90 % interval of two terms contained the true gain in 44 % of all cases. Models weighted by their probability at
    the mode were no better, because the best of several wrong models takes all weight. For a power of 6 the share was
    81 %. Half the distance of all three models contained the true gain in 94 % and more, but with twice the standard
    deviation (1.7 % to 1.0 %; for a linear bend 1.1 % to 0.24 %), because the straight line counts although the levels
    have refuted it. The mean of two models contained the true gain in 94 % and more, for a linear camera too.

    Raises: `ValueError` if there are too few levels, no mode is found, or the effective sample size is too small.
    """
    full = SensorPosterior.of(recipe, store)
    if not isinstance(full.levels, Levels):
        raise ValueError(
            f"the likelihood of {recipe.name} assumes identical pixels: use the node calibrate.camera instead"
        )
    terms = [name for name in TERMS if name in full.names]
    _check_levels(full, full.levels, terms)
    rng = np.random.default_rng(seed)
    models = [_without(recipe, full.step, terms[count:]) for count in range(len(terms) + 1)]
    problems = [SensorPosterior.of(model, store) for model in models]
    posteriors = [_posterior(problem, rng) for problem in problems]
    return [_spread(name, problems[0], posteriors) for name in problems[0].names]


def _check_levels(problem: SensorPosterior, levels: Levels, terms: list[str]) -> None:
    """Raise `ValueError` if too few lit levels exist to tell the non-linear response ``terms`` from lamp drift.

    For 60 simulated cameras and two terms, 90 % intervals contained the truth in 93 % with 4 lit levels, and in
    58 % with 2 lit levels.
    """
    used = problem.likelihood(initial_theta(problem)[None]).degrees_of_freedom > 0
    lit = len(set(levels.photons[used & (levels.photons > 0)].tolist()))
    if lit < len(terms) + 2:
        raise ValueError(
            f"{lit} lit levels do not separate a response of {len(terms)} terms from a drifting lamp: "
            f"give {len(terms) + 2} or more levels of different light below saturation, or "
            f"fix {' and '.join(terms[max(0, lit - 2) :])} at 0"
        )


def _without(recipe: Recipe, weighing: str, terms: list[str]) -> Recipe:
    """Return the recipe with the response ``terms`` fixed at zero in the prior and the likelihood step ``weighing``."""
    steps = dict(recipe.steps)
    for name, step in steps.items():
        if step.node.path == "calibrate.camera_prior":
            steps[name] = replace(step, params={**step.params, **dict.fromkeys(terms)})
        elif name == weighing:
            steps[name] = replace(step, params={**step.params, **dict.fromkeys(terms, 0.0)})
    return replace(recipe, steps=steps)


def _posterior(problem: SensorPosterior, rng: np.random.Generator) -> _Posterior:
    mode = search_mode(problem)
    if not mode.settled:
        raise ValueError(f"no posterior mode of {', '.join(problem.names)} was found: give narrower priors")
    samples, log = draw_samples(problem, mode, rng)
    weight = weights(log)
    centre = weight @ samples
    width = np.sqrt(weight @ (samples - centre) ** 2)
    return dict(zip(problem.names, zip(centre.tolist(), width.tolist(), strict=True), strict=True))


def _spread(name: str, problem: SensorPosterior, posteriors: list[_Posterior]) -> ModelSpread:
    linear = name in problem.coordinates.linear
    models = [posterior[name] for posterior in posteriors]
    (low, narrow), (high, wide) = models[-2:] if len(models) > 1 else models * 2
    middle, width = 0.5 * (low + high), math.hypot(width_of_mean(narrow, wide), 0.5 * (high - low))
    return ModelSpread(name, tuple(_interval(*model, linear) for model in models), _interval(middle, width, linear))


def width_of_mean(fewer: float, more: float) -> float:
    """Return the standard deviation of the mean of the values that two nested models give for the same levels.

    ``fewer`` and ``more`` are the widths of the posteriors with fewer and with more terms. An efficient estimate and
    its difference to any other unbiased estimate of the same data are independent, so that the difference has the
    variance more^2 - fewer^2, and the mean has fewer^2 and a quarter of that. The wider posterior alone was too wide:
    for 24 simulated cameras the errors of the gain scatter by 0.68 of it, and by 0.82 of what is stated now.

    Source: Hausman, Econometrica 46, 1251 (1978), for the variance of the difference.
    """
    difference = max(0.0, more**2 - fewer**2)
    return math.sqrt(fewer**2 + difference / 4)


def _interval(centre: float, width: float, linear: bool) -> IntervalEstimate:
    ends = [centre, centre - Z_90 * width, centre + Z_90 * width]
    return IntervalEstimate(*(ends if linear else [float(np.exp(x)) for x in ends]))
