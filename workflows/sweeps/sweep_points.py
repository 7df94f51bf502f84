"""The points of a sweep: all are checked first, then run in an order that shares results.

Two points share the result of a step if the step has the same key at both. An axis that affects
costly steps varies slowly, and only one axis changes from point to point: a costly result is
computed once and freed early.
"""

from __future__ import annotations

import math
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field, fields, replace
from functools import cache, partial
from pathlib import Path
from statistics import median
from typing import Any, Literal, NamedTuple

from neusee.workflows.engine.execution import RunSeries
from neusee.workflows.engine.local_executor import memory_limit
from neusee.workflows.engine.node_call import place
from neusee.workflows.engine.result_values import numbers_of
from neusee.workflows.engine.runner import run
from neusee.workflows.engine.worker_processes import shared
from neusee.workflows.graph.errors import Diagnostic, RecipeError, RunError
from neusee.workflows.graph.final_values import Config
from neusee.workflows.graph.recipe_graph import Event, Recipe, needed
from neusee.workflows.keys.cache_key import Key
from neusee.workflows.recipe.loading import check
from neusee.workflows.recipe.text.composition import Composer
from neusee.workflows.store.result_store import Store
from neusee.workflows.sweeps.axes import Point
from neusee.workflows.tolerance.cheaper_steps import with_substitutions

# --- order of the points --------------------------------------------------------------------------

# The order of the points, the results that they share, and their computing times.


@dataclass(frozen=True, slots=True)
class PointJob:
    """The steps needed by one point of a sweep, with the cache key and the inputs of each step."""

    place: tuple[int, ...]  #: index of the value on each axis
    keys: Mapping[str, Key]  #: cache key of every step that the outputs need
    sources: Mapping[str, tuple[str, ...]]  #: input steps of each step
    outputs: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Sharing:
    """The number of results that points share, and the computing time that sharing saves."""

    points: int
    distinct: Mapping[str, int]  #: number of distinct results of each step
    steps: int  #: number of steps of all points together
    made: int  #: number of distinct results of all steps
    #: work of all points without sharing: in seconds, or in steps if no step has run before
    alone: float
    together: float  #: work of the distinct results, each computed once

    @property
    def saved(self) -> float:
        """Return the fraction of the computing time, from 0 to 1, that sharing saves."""
        return 1 - self.together / self.alone if self.alone else 0.0


def filled(costs: Mapping[str, float], steps: Iterable[str]) -> dict[str, float]:
    """Return the computing time of each step; an unknown time is replaced by the median of the
    known times, or by 1.
    """
    steps = list(steps)
    times = [costs[step] for step in steps if step in costs]
    median_time = median(times) if times else 1.0
    return {step: costs.get(step, median_time) for step in steps}


def best_order(
    jobs: Sequence[PointJob], costs: Mapping[str, float], paired: bool = False
) -> list[int]:
    """Return the order of the points in which costly shared steps run once and few results stay in
    memory.

    The order is a list of indices of ``jobs``.

    Args:
        jobs: one job for each point, in the order of the product of the axes, the last axis fastest
        costs: known seconds by step
        paired: the axes vary together like one axis

    If each axis changes a fixed set of steps, no other order recomputes less from point to point.
    """
    weights = filled(costs, _steps(jobs))
    if paired:
        return _grouped(jobs, weights)
    sizes = [1 + max(job.place[axis] for job in jobs) for axis in range(len(jobs[0].place))]
    recompute_times = [_reach(jobs, weights, sizes, axis) for axis in range(len(sizes))]
    slowest_first = sorted(range(len(sizes)), key=lambda n: -recompute_times[n])
    job_of_place = {job.place: i for i, job in enumerate(jobs)}
    return [job_of_place[indices] for indices in _there_and_back(sizes, slowest_first)]


def _steps(jobs: Iterable[PointJob]) -> set[str]:
    """Return the names of all steps of the jobs."""
    return set[str]().union(*(job.keys for job in jobs))


def sharing(jobs: Sequence[PointJob], costs: Mapping[str, float]) -> Sharing:
    """Count the distinct results of every step in a sweep, and sum the computing time with and
    without sharing.
    """
    weights = filled(costs, _steps(jobs))
    weight_of_result: dict[Key, float] = {}
    work_apart, steps = 0.0, 0
    for job in jobs:
        weight_of_key = {key: weights[step] for step, key in job.keys.items()}
        # shared results count once
        weight_of_result |= weight_of_key
        work_apart, steps = work_apart + sum(weight_of_key.values()), steps + len(weight_of_key)
    pairs = set[tuple[str, Key]]().union(*(job.keys.items() for job in jobs))
    distinct = Counter(step for step, _ in pairs)
    return Sharing(
        len(jobs),
        distinct,
        steps,
        len(weight_of_result),
        work_apart,
        sum(weight_of_result.values()),
    )


def work_left(
    jobs: Iterable[PointJob], costs: Mapping[str, float], stored: Callable[[Key], bool]
) -> list[float]:
    """Return the computing time of each point, without results that are stored or computed for
    earlier points.
    """
    computed: set[Key] = set()
    in_store = cache(stored)
    work_of_points = []
    for job in jobs:
        step_times, seconds, names_left = filled(costs, job.keys), list[float](), list(job.outputs)
        while names_left:
            name = names_left.pop()
            key = job.keys[name]
            if key not in computed and not in_store(key):
                computed.add(key)
                seconds.append(step_times[name])
                names_left += job.sources[name]
        work_of_points.append(sum(seconds))
    return work_of_points


def _reach(
    jobs: Sequence[PointJob], weights: Mapping[str, float], sizes: Sequence[int], axis: int
) -> float:
    """Return the mean computing time of the steps that must run again after moving to the next
    value on ``axis``.
    """
    # jobs are in product order: distance to the job with the previous value on the axis
    distance = math.prod(sizes[axis + 1 :])
    times = [
        sum(
            weights[step]
            for step, key in job.keys.items()
            if jobs[i - distance].keys.get(step) != key
        )
        for i, job in enumerate(jobs)
        # skip the first value
        if job.place[axis]
    ]
    return sum(times) / len(times) if times else 0.0


def _there_and_back(sizes: Sequence[int], slowest_first: Sequence[int]) -> list[tuple[int, ...]]:
    """Return all points as index tuples in serpentine order: successive points differ by 1 in one
    index.
    """
    rows: list[list[int]] = [[0] * len(sizes)]
    for axis in slowest_first:
        longer_rows = []
        for row_number, row in enumerate(rows):
            # every second row is reversed
            indices = range(sizes[axis]) if row_number % 2 == 0 else reversed(range(sizes[axis]))
            longer_rows += [[*row[:axis], i, *row[axis + 1 :]] for i in indices]
        rows = longer_rows
    return [tuple(row) for row in rows]


def _grouped(jobs: Sequence[PointJob], weights: Mapping[str, float]) -> list[int]:
    """Return the indices of the points, sorted so that points sharing costly results are
    adjacent.
    """
    first_job_of_key: dict[str, dict[Key, int]] = defaultdict(dict)
    for i, job in enumerate(jobs):
        for step, key in job.keys.items():
            first_job_of_key[step].setdefault(key, i)
    # ignore steps with one result for all points, or with a different one for each
    shared_steps = [step for step, keys in first_job_of_key.items() if 1 < len(keys) < len(jobs)]
    shared_steps.sort(key=lambda step: -weights[step])
    return sorted(
        range(len(jobs)),
        # sort by the costliest step first: points with equal results of it are adjacent
        key=lambda i: [
            first_job_of_key[step].get(jobs[i].keys.get(step, ""), -1) for step in shared_steps
        ],
    )


# --- kept recipes ---------------------------------------------------------------------------------

# Recipes of the points of a sweep, each stored as differences from the recipe of the first point.


@dataclass(frozen=True, slots=True)
class Same:
    """For each name, the latest step or value that was equal to that of the first recipe but
    another object.
    """

    steps: dict[str, Any] = field(default_factory=dict)
    values: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class KeptRecipe:
    """A checked recipe in little memory: only the steps, values and fields that differ from another
    recipe.
    """

    first: Recipe
    steps: Mapping[str, Any]
    values: Mapping[str, Any]
    others: Mapping[str, Any]  #: other differing fields of `Recipe`

    @classmethod
    def of(cls, recipe: Recipe, first: Recipe, same: Same | None = None) -> KeptRecipe:
        """Store ``recipe`` as differences from ``first``.

        Pass the same ``same`` to all calls for one ``first``: values found equal are not compared
        again.
        """
        same = same or Same()
        names = (f.name for f in fields(Recipe))
        other_fields = {
            name: getattr(recipe, name)
            for name in names
            if getattr(recipe, name) is not getattr(first, name)
        }
        steps = _changed(recipe.steps, first.steps, same.steps)
        values = _changed(recipe.config.settings, first.config.settings, same.values)
        # stored as differences
        if steps is not None:
            other_fields.pop("steps", None)
        if values is not None:
            other_fields.pop("config", None)
        return cls(first, steps or {}, values or {}, other_fields)

    @property
    def recipe(self) -> Recipe:
        """Return a recipe equal to the stored one."""
        first_recipe = self.first
        steps, values = (
            {**first_recipe.steps, **self.steps},
            {**first_recipe.config.settings, **self.values},
        )
        return replace(first_recipe, **{"steps": steps, "config": Config(values), **self.others})


def _changed(
    mapping: Mapping[str, Any], first: Mapping[str, Any], same: dict[str, Any]
) -> dict[str, Any] | None:
    """Return the entries of a mapping that differ from those of ``first``; None if the keys differ.

    Entries in ``same`` are known to be equal; newly found equal entries are added to it.
    """
    if list(mapping) != list(first):
        return None
    different = {}
    for key, value in mapping.items():
        if value is first[key] or (key in same and value is same[key]):
            continue
        if _equal(value, first[key]):
            same[key] = value
        else:
            different[key] = value
    return different


def _equal(left: Any, right: Any) -> bool:
    """Return True for values that are equal and have the same text, unlike 0.0 and -0.0, or 1, 1.0
    and True.
    """
    with suppress(Exception):  # for values such as arrays, whose comparison is not a single boolean
        return bool(left == right) and repr(left) == repr(right)
    return False


# --- sweep points ---------------------------------------------------------------------------------

# The runs of a sweep: all points are checked first, then run in worker processes or one after
# another.
#
# Every point is composed and checked before the first one runs. Only the differences from the first
# point are stored.


PointState = Literal["run", "cached", "failed"]
OnError = Literal["continue", "stop"]
#: step, field, index (empty for a single number), value
ResultNumber = tuple[str, str, int | str, float]


@dataclass(frozen=True, slots=True)
class CheckedPoint:
    """A point of a sweep that passed all checks, with the steps that it needs."""

    point: Point
    kept: KeptRecipe
    job: PointJob


@dataclass(frozen=True, slots=True)
class PointOutcome:
    """The outcome of one point: its numbers, or the error that stopped it."""

    point: Point
    state: PointState  #: ``cached``: no step had to run
    seconds: float
    numbers: tuple[ResultNumber, ...] = ()
    step: str = ""  #: the step that failed
    message: str = ""  #: error message, with the location of the step in the recipe
    left: float = 0.0  #: s, predicted time for all later points


@dataclass(frozen=True)
class SweepPlan:
    """The checked points of a sweep in run order, with the known computing times."""

    recipe: Recipe  #: the recipe of the first point
    checked: tuple[CheckedPoint, ...]
    costs: dict[str, float]  #: s, by step, for steps that ran before
    #: work of each point without stored results: in seconds, or in steps if no step ran before
    work: tuple[float, ...]
    notes: tuple[str, ...]
    device: str  #: device of all points; keys depend on it
    series: RunSeries  #: shared by all points; has the code digests of all nodes

    @property
    def jobs(self) -> list[PointJob]:
        return [checked.job for checked in self.checked]


def plan_sweep(
    recipe: str,
    points: Sequence[Point],
    folder: Path,
    store: Store,
    paired: bool = False,
    device: str = "cpu",
) -> SweepPlan:
    """Check all points of a sweep and choose their order.

    Raises `RecipeError` with the errors of all points.
    """
    checker = _Checker(recipe, folder, store, device)
    checked_points = list(checker.every(points))
    if checker.diagnostics or checker.first is None:
        raise RecipeError(checker.diagnostics)
    costs = _costs(store)
    ordered_points = [
        checked_points[i]
        for i in best_order([checked_point.job for checked_point in checked_points], costs, paired)
    ]
    # without results that are stored or shared with earlier points
    work_of_points = work_left(
        [checked_point.job for checked_point in ordered_points], costs, store.has
    )
    return SweepPlan(
        checker.first,
        tuple(ordered_points),
        costs,
        tuple(work_of_points),
        tuple(checker.notes),
        device,
        checker.series,
    )


def outcomes(
    plan: SweepPlan,
    store: Store,
    on_error: OnError = "stop",
    started: Callable[[Point], None] = lambda point: None,
    watch: Callable[[Event], None] | None = None,
    workers: int = 1,
) -> Generator[PointOutcome, None, None]:
    """Run the points of a sweep, and yield each outcome as its point ends.

    Several ``workers`` are processes with one thread each; a single worker is this process. A point
    that fails in a worker is repeated in this process. With ``on_error="stop"``, the first error is
    raised after the outcome of its point is yielded.
    """
    clock = _Clock(plan.work)
    memory = partial(memory_limit, None, workers)

    def alone(number: int) -> _Found:
        return _found(plan, number, store, None, int(memory()))

    with closing(shared(alone, range(len(plan.checked)), workers, apart=True)) as ended:
        for number, returned in ended:
            checked, began = plan.checked[number], time.perf_counter()
            # None: no worker finished the point, so this process runs it
            if returned is None:
                started(checked.point)
            try:
                outcome = returned[0] if returned else _found(plan, number, store, watch)
            except Exception as error:
                seconds = time.perf_counter() - began
                error.add_note(f"at point {checked.point.number}: {checked.point.shown}")
                yield _failed(checked.point, error, seconds, clock.left(number))
                if on_error == "stop":
                    raise
            else:
                if outcome.failure:
                    store.pass_on(outcome.failure)
                # state, seconds and numbers
                yield PointOutcome(checked.point, *outcome[:3], left=clock.left(number))


class _Found(NamedTuple):
    """The result of running one point, with the warning of a store that cannot be written."""

    state: PointState
    seconds: float
    numbers: tuple[ResultNumber, ...]
    failure: str


def _found(
    plan: SweepPlan,
    number: int,
    store: Store,
    watch: Callable[[Event], None] | None,
    memory: int | None = None,
) -> _Found:
    """Run one point of a sweep; return its state, time and numbers."""
    began = time.perf_counter()
    recipe = plan.checked[number].kept.recipe
    result = run(recipe, store, watch=watch, device=plan.device, memory=memory, series=plan.series)
    numbers: list[ResultNumber] = []
    for step, value in result.values.items():
        rows = numbers_of(step, value)
        numbers += [(name, field, index, number) for name, field, index, number in rows]
    has_run = any(record.state == "run" for record in result.done.values())
    state: PointState = "run" if has_run else "cached"
    return _Found(state, time.perf_counter() - began, tuple(numbers), store.failure)


def _failed(point: Point, error: Exception, seconds: float, left: float) -> PointOutcome:
    """Return the outcome of a point that ended with an error."""
    step = error.step if isinstance(error, RunError) else ""
    message = (
        str(error)
        if isinstance(error, RunError | RecipeError)
        else f"{type(error).__name__}: {error}"
    )
    return PointOutcome(point, "failed", seconds, step=step, message=message, left=left)


def _costs(store: Store) -> dict[str, float]:
    """Return the median time (s) of each step from the journal of a store."""
    times: dict[str, list[float]] = defaultdict(list)
    for row in store.journal.latest():
        if row["step"] and row["seconds"] is not None:
            times[row["step"]].append(row["seconds"])
    return {step: median(seconds) for step, seconds in times.items()}


class _Clock:
    """Prediction of the remaining time of a sweep from the time of its finished points, for any
    number of workers.
    """

    def __init__(self, work: Sequence[float]) -> None:
        # least work of a point, because reading stored numbers takes time too: a hundredth of the
        # mean work, or 1 if everything is stored
        shortest = sum(work) / 100 / len(work) or 1.0
        self.work = [max(seconds, shortest) for seconds in work]
        # work left, work done, points left
        self.todo, self.done, self.points = sum(self.work), 0.0, len(self.work)
        self.began = time.perf_counter()

    def left(self, number: int) -> float:
        """Record the end of a point, and return the predicted seconds for all remaining points."""
        work_of_point, self.points = self.work[number], self.points - 1
        self.todo, self.done = self.todo - work_of_point, self.done + work_of_point
        return (
            # remaining work at the pace of the finished work; rounding may make it negative
            max(self.todo, 0.0) * (time.perf_counter() - self.began) / self.done
            if self.points
            else 0.0
        )


class _Checker:
    """Checks the points of a sweep, and collects the errors of all points."""

    def __init__(self, recipe: str, folder: Path, store: Store, device: str) -> None:
        self.recipe, self.folder, self.device = recipe, folder, device
        self.series = RunSeries.begun(store)
        self.diagnostics: list[Diagnostic] = []
        self.notes: dict[str, None] = {}
        self.first: Recipe | None = None
        self._same: dict[Any, Any] = {}  # one shared object for equal keys and graphs
        self._equal = Same()

    def every(self, points: Sequence[Point]) -> Iterator[CheckedPoint]:
        """Yield each point that passes all checks; add the errors of the others to
        ``diagnostics``.
        """
        composer = Composer(self.recipe, self.folder)
        for point in points:
            try:
                recipe = check(composer.compose(point.overrides))
                self.first = self.first or recipe
                yield CheckedPoint(
                    point, KeptRecipe.of(recipe, self.first, self._equal), self._job(point, recipe)
                )
            except RecipeError as error:
                self.diagnostics += error.diagnostics
        self.series.known_keys.code.save()

    def _job(self, point: Point, recipe: Recipe) -> PointJob:
        """Return the steps that a point needs with their keys; raise `RecipeError` if a key cannot
        be computed.
        """
        self.notes.update(dict.fromkeys(recipe.notes))
        keys: dict[str, Key] = {}
        recipe = with_substitutions(recipe, recipe.outputs)
        for name in needed(recipe, recipe.outputs):
            step = recipe.steps[name]
            try:
                key = self.series.known_keys.of(step, keys, recipe.seed, place(step, self.device))[
                    0
                ]
                keys[name] = self._once(key)
            except (OSError, LookupError, TypeError) as error:
                raise RecipeError([Diagnostic(step.mark, name, str(error))]) from error
        sources = tuple((name, recipe.steps[name].sources) for name in keys)
        # one shared object for all points with the same graph
        graph = self._same.setdefault(sources, dict(sources))
        return PointJob(point.place, keys, graph, recipe.outputs)

    def _once(self, key: Key) -> Key:
        """Return the same string object for equal keys, which saves memory because points share
        most keys.
        """
        return str(self._same.setdefault(key, key))
