"""Points of error against run time, their Pareto front, and the quickest settings."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from statistics import median
from typing import Any

from neusee.workflows.engine.provenance import machine
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.recipe_graph import Event, Recipe, needed
from neusee.workflows.graph.run_error import RunError
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.keys.code_digest import Code, engine
from neusee.workflows.store.result_store import Store, compute_once
from neusee.workflows.studies.cold_run import cold, key_parts, run_cold
from neusee.workflows.tolerance.cheaper_steps import with_substitutions
from neusee.workflows.tolerance.error_norm import error_of

# --- work precision points ------------------------------------------------------------------------

# Points of a diagram of error against run time: the time of a cold run and the errors of the
# outputs.


TIMES = 3  #: cold runs of a point; the median of their times counts
_QUICK = 5.0  #: s; a recipe that takes longer is run once
_ABOUT = {"step": "study accuracy"}


@dataclass(frozen=True)
class Trial:
    """A setting to measure, as a changed recipe or as the reason why the setting is not
    possible.
    """

    line: str  #: the parameter that is set
    label: str
    recipe: Recipe | None
    refused: str = ""
    value: float | None = None  #: the tolerance, for settings of the tolerance
    own: bool = False  #: whether the recipe itself has this setting

    @property
    def name(self) -> str:
        """Return the parameter and its setting as text."""
        return f"{self.line} {self.label}".strip()


@dataclass(frozen=True)
class PointMeasurement:
    """Errors of the outputs and run times of a recipe, in types that the store can save."""

    errors: dict[str, list[float]] = field(default_factory=dict)  #: by output, one for each seed
    seconds: list[float] = field(default_factory=list)  #: of the engine, one for each cold run
    computing: float = 0.0  #: s in the steps of the first cold run
    load: float = 0.0  #: runnable processes for each core before the run, this process included
    #: largest error that the run states for its outputs; None if one is unknown
    bound: float | None = None
    steps: dict[str, float] = field(default_factory=dict)  #: s by step, in the first cold run
    refused: str = ""


@dataclass(frozen=True)
class WorkPrecisionPoint:
    """A point of a diagram of error against run time: a setting of the recipe and its
    measurement.
    """

    trial: Trial
    found: PointMeasurement

    @property
    def seconds(self) -> float:
        return median(self.found.seconds) if self.found.seconds else float("inf")

    @property
    def by_seed(self) -> list[float]:
        """Return the largest error over all outputs for each random seed."""
        return [max(column) for column in zip(*self.found.errors.values(), strict=True)]

    @property
    def error(self) -> float:
        """Return the largest error over all outputs, as the median over the random seeds."""
        return median(self.by_seed) if self.by_seed else float("inf")

    @property
    def most(self) -> float:
        """Return the largest error over all outputs and random seeds, which must be within the
        tolerance.
        """
        return max(self.by_seed, default=float("inf"))

    @property
    def sound(self) -> bool:
        """Return True if the recipe ran and its outputs were compared with the reference."""
        return bool(self.found.errors and self.found.seconds)


class PointCache:
    """A cache of measured points: a recipe that was once compared with the reference is not run
    again.
    """

    def __init__(self, reference: Recipe, store: Store, seeds: int, device: str = "cpu") -> None:
        """Prepare measurements against ``reference``, with ``seeds`` seeds of the noise (one
        without noise).
        """
        self.reference, self.store, self.device = reference, store, device
        has_noise = any(
            reference.steps[name].node.random for name in needed(reference, reference.outputs)
        )
        self.seeds = seeds if has_noise else 1
        self._truth: dict[int, dict[str, Any]] = {}
        self._code = Code(store.code_memo)
        self._warm = False

    def point(self, trial: Trial) -> WorkPrecisionPoint:
        """Return the errors and run times of a setting; measure the setting if the store has no
        measurement of it.
        """
        recipe = trial.recipe
        if recipe is None:
            return WorkPrecisionPoint(trial, PointMeasurement(refused=trial.refused))
        key = self.key(recipe)
        measurement = compute_once(
            self.store, key, PointMeasurement, lambda: self._measure(recipe), _ABOUT
        )
        return WorkPrecisionPoint(trial, measurement)

    def time_again(self, point: WorkPrecisionPoint, number: int) -> WorkPrecisionPoint:
        """Return a measurement with the time of cold run ``number`` added, or unchanged if the
        first run was slow.
        """
        recipe, seconds = point.trial.recipe, point.found.seconds
        if recipe is None or not seconds or seconds[0] >= _QUICK:
            return point
        timed = compute_once(
            self.store, digest(self.key(recipe), number), list, lambda: [self._time(recipe)], _ABOUT
        )
        return WorkPrecisionPoint(point.trial, replace(point.found, seconds=[*seconds, *timed]))

    def _time(self, recipe: Recipe) -> float:
        self._warm_up(recipe)
        return run_cold(recipe, self.store, self.device).seconds

    def key(self, recipe: Recipe) -> str:
        """Return the store key of a measurement: a digest of recipe, reference, engine, seeds,
        device and machine.
        """
        recipe_and_reference = [
            key_parts(compared, self._code, self.device) for compared in (recipe, self.reference)
        ]
        return digest(
            "accuracy", recipe_and_reference, self.seeds, self.device, engine(), machine()
        )

    def truth(self, seed: int) -> dict[str, Any]:
        """Return the outputs of the reference with the noise of ``seed``, from the store or
        computed now.
        """
        if seed not in self._truth:
            recipe = replace(self.reference, seed=self.reference.seed + seed)
            result = run(recipe, self.store, device=self.device)
            self._truth[seed] = result.values
            # a process that has computed most of the steps has imported their libraries
            self._warm |= (
                sum(done.state == "run" for done in result.done.values()) > len(result.done) / 2
            )
        return self._truth[seed]

    def _measure(self, recipe: Recipe) -> PointMeasurement:
        """Run a recipe cold and compare its outputs with the reference; return errors and times."""
        load_per_core = (
            os.getloadavg()[0] / (os.cpu_count() or 1) if hasattr(os, "getloadavg") else 0.0
        )
        seconds_by_step: dict[str, float] = {}

        def watch(event: Event) -> None:
            if event.done is not None and event.done.state == "run":  # again if the engine retries
                seconds_by_step[event.step] = (
                    seconds_by_step.get(event.step, 0.0) + event.done.seconds
                )

        try:
            self._warm_up(recipe)
            with cold(self.store) as store:
                result = run(recipe, store, watch=watch, device=self.device)
                errors = self._errors(recipe, result.values, store)
        except RunError as error:
            return PointMeasurement(refused=f"{error.step}: {error.cause}")
        return PointMeasurement(
            errors,
            [result.seconds],
            sum(seconds_by_step.values()),
            load_per_core,
            result.proof.worst_stated(result.values),
            seconds_by_step,
        )

    def _warm_up(self, recipe: Recipe) -> None:
        """Run the recipe once without timing, because the first run of a process imports
        libraries and reads code.
        """
        self.truth(0)
        for step in with_substitutions(recipe, recipe.outputs).steps.values():
            # digests of the code are kept in the store, and then not timed
            self._code.digest(step.node.fn.__module__)
        self._code.save()
        if not self._warm:
            run_cold(recipe, self.store, self.device)
            self._warm = True

    def _errors(
        self, recipe: Recipe, values: Mapping[str, Any], store: Store
    ) -> dict[str, list[float]]:
        """Return the errors of each output for all seeds, without outputs whose shape differs
        from the reference.
        """
        # the same noise in recipe and reference
        by_output = compare_outputs(values, self.truth(0))
        for seed in range(1, self.seeds):
            other_seed = run(replace(recipe, seed=recipe.seed + seed), store, device=self.device)
            for name, errors in compare_outputs(other_seed.values, self.truth(seed)).items():
                by_output[name] += errors
        return by_output


def compare_outputs(values: Mapping[str, Any], truth: Mapping[str, Any]) -> dict[str, list[float]]:
    """Return the error of each output by name, without outputs whose shape differs from the
    reference.
    """
    errors: dict[str, list[float]] = {}
    for name, value in values.items():
        # an output of another shape cannot be compared
        with suppress(ValueError):
            errors[name] = [error_of(value, truth[name])]
    return errors


# --- pareto line ----------------------------------------------------------------------------------

# The Pareto front of error and run time, and the engine's choices compared with the quickest
# settings.


Points = Sequence[WorkPrecisionPoint]


@dataclass(frozen=True)
class ToleranceChoice:
    """The engine's choice for a tolerance, and the quickest measured setting within the
    tolerance.
    """

    tolerance: float
    chosen: WorkPrecisionPoint
    cheapest: WorkPrecisionPoint | None  #: None where no point is within the tolerance

    @property
    def held(self) -> bool:
        """Return True if the error of the engine's choice is within the tolerance."""
        return self.chosen.most <= self.tolerance

    @property
    def ratio(self) -> float | None:
        """Return the run time of the engine's choice divided by the run time of the quickest
        setting.
        """
        return None if self.cheapest is None else self.chosen.seconds / self.cheapest.seconds


def pareto_front(points: Points) -> list[WorkPrecisionPoint]:
    """Return the Pareto front: settings that no other setting beats in both run time and error,
    the quickest first.
    """
    front: list[WorkPrecisionPoint] = []
    for point in sorted(points, key=lambda p: (p.seconds, p.most)):
        # quickest first, so that a point has to be more accurate than all before it
        if not front or point.most < front[-1].most:
            front.append(point)
    return front


def cheapest(points: Points, tolerance: float) -> WorkPrecisionPoint | None:
    """Return the quickest setting whose largest error is within ``tolerance``, or None if there
    is no such setting.
    """
    return min((p for p in points if p.most <= tolerance), key=lambda p: p.seconds, default=None)


def median_ratio(choices: Iterable[ToleranceChoice]) -> float | None:
    """Return the median over all tolerances of the engine's run time divided by the quickest run
    time.
    """
    ratios = [choice.ratio for choice in choices if choice.ratio is not None]
    return median(ratios) if ratios else None
