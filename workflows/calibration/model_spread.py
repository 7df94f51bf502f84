"""The values to state for a real camera of unknown response: its posteriors, and how models of the response differ."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from neusee.nodes.values import Levels
from neusee.workflows.calibration.importance_sampling import draw_samples, weights
from neusee.workflows.calibration.log_posterior import SensorPosterior
from neusee.workflows.calibration.posterior_mode import find_mode, initial_theta
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.recipe.distributions.joint import Z_90
from neusee.workflows.store.result_store import Store

if TYPE_CHECKING:
    from neusee.workflows.calibration.log_posterior import FloatArray

TERMS = ("bend", "twist")  #: terms of the response, in the order in which models add them


@dataclass(frozen=True)
class IntervalEstimate:
    """A value and its central 90 % interval."""

    value: float
    low: float
    high: float

    def holds(self, value: float) -> bool:
        """Return True if the interval contains a value."""
        return self.low <= value <= self.high


@dataclass(frozen=True)
class ModelSpread:
    """One parameter: its posterior by each model of the response, and the interval to state."""

    name: str
    models: tuple[IntervalEstimate, ...]  #: the posterior with 0, 1, 2 terms of the response, up to those that are free
    stated: IntervalEstimate


@dataclass(frozen=True)
class _ModelPosterior:
    """The posterior of one model, as a normal distribution of each coordinate."""

    names: tuple[str, ...]
    centre: FloatArray
    width: FloatArray

    def of(self, name: str) -> tuple[float, float]:
        at = self.names.index(name)
        return float(self.centre[at]), float(self.width[at])


def compare_models(recipe: Recipe, store: Store, seed: int = 0) -> list[ModelSpread]:
    """Return the parameters that are free in every model, with the posterior of each model and the interval to state.

    The stated value is the middle of the two richest models; its width is the wider of both and half their distance, in
    quadrature.

    One model is not enough. For 36 simulated cameras a response with 1 million pixels a level, cubic by 5 % at 4095 DN,
    the 90 % interval of two terms held the true gain in 44 % of all cases. Models weighed by their probability at the
    mode did no better, because the best of wrong models takes all weight. For a power of 6 the share was 81 %. Half the
    distance of all three models held the true gain in 94 % and more, but with twice the standard deviation (1.7 % to
    1.0 %; for a linear bend 1.1 % to 0.24 %), because it counts a straight line that the levels have refuted. The
    middle of two held the true gain in 94 % and more of all cases, of a linear camera too.

    Raises: `ValueError` for too few levels, where no mode is found, and for too small an effective sample size.
    """
    nothing = SensorPosterior.of(recipe, store)
    if not isinstance(nothing.levels, Levels):
        raise ValueError(f"{recipe.name} weighs pixels that are all alike: for models of the response, use the node "
                         "calibrate.camera")  # fmt: skip
    terms = [name for name in TERMS if name in nothing.names]
    _enough(nothing, nothing.levels, terms)
    rng = np.random.default_rng(seed)
    diagnostics = [
        SensorPosterior.of(_without(recipe, nothing.step, terms[count:]), store) for count in range(len(terms) + 1)
    ]
    laws = [_posterior(problem, rng) for problem in diagnostics]
    return [_row(name, diagnostics[0], laws) for name in diagnostics[0].names]


def _enough(problem: SensorPosterior, levels: Levels, terms: list[str]) -> None:
    """Raise `ValueError` where a drifting lamp leaves too few levels to fit a response through all of them.

    With two terms and 4 lit levels, intervals of 90 % held the truth of 60 cameras in 93 %, with 2 levels in 58 %.
    """
    used = problem.likelihood(initial_theta(problem)[None]).degrees_of_freedom > 0
    lit = len(set(levels.photons[used & (levels.photons > 0)].tolist()))
    if lit < len(terms) + 2:
        raise ValueError(
            f"{lit} lit levels do not separate a response of {len(terms)} terms from a drifting lamp: "
            f"give {len(terms) + 2} or more of different light below saturation, or "
            f"hold {' and '.join(terms[max(0, lit - 2) :])}"
        )


def _without(recipe: Recipe, weighing: str, terms: list[str]) -> Recipe:
    """Return the recipe with some terms of the response held at zero."""

    def held(step: Step) -> Step:
        if step.node.path == "calibrate.camera_prior":
            return replace(step, params={**step.params, **dict.fromkeys(terms)})
        if step.name == weighing:
            return replace(step, params={**step.params, **dict.fromkeys(terms, 0.0)})
        return step

    return replace(recipe, steps={name: held(step) for name, step in recipe.steps.items()})


def _posterior(problem: SensorPosterior, rng: np.random.Generator) -> _ModelPosterior:
    mode = find_mode(problem, initial_theta(problem))
    if not mode.settled:
        raise ValueError(f"no mode of {', '.join(problem.names)} was found: give narrower priors")
    samples, log = draw_samples(problem, mode, rng)
    weight = weights(log)
    centre = weight @ samples
    return _ModelPosterior(problem.names, centre, np.sqrt(weight @ (samples - centre) ** 2))


def _row(name: str, problem: SensorPosterior, laws: list[_ModelPosterior]) -> ModelSpread:
    linear = name in problem.coordinates.linear
    each_law = [law.of(name) for law in laws]
    (low, narrow), (high, wide) = each_law[-2:] if len(each_law) > 1 else each_law * 2
    middle, width = 0.5 * (low + high), float(np.hypot(max(narrow, wide), 0.5 * (high - low)))
    return ModelSpread(name, tuple(_figure(*each, linear) for each in each_law), _figure(middle, width, linear))


def _figure(centre: float, width: float, linear: bool) -> IntervalEstimate:
    ends = [centre, centre - Z_90 * width, centre + Z_90 * width]
    return IntervalEstimate(*(ends if linear else [float(np.exp(x)) for x in ends]))
