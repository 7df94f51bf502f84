"""The points of a sweep, checked and then run one after another on one store.

Every point is composed and checked before the first one runs. A point keeps its composed values,
which share almost everything with the other points; its steps are bound again when it runs.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, Literal

from neusee.workflows.engine.node_call import place
from neusee.workflows.engine.runner import Result, run
from neusee.workflows.graph.diagnostics import Diagnostic, RecipeError
from neusee.workflows.graph.recipe_graph import Recipe, needed
from neusee.workflows.graph.run_error import RunError
from neusee.workflows.graph.step_record import Event
from neusee.workflows.keys.cache_key import Key, key_of
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.recipe.loading import check
from neusee.workflows.recipe.text.composition import Composed, compose
from neusee.workflows.report.result_numbers import numbers_of
from neusee.workflows.store.result_store import Store
from neusee.workflows.sweeps.axes import Point
from neusee.workflows.sweeps.point_order import Job, best_order, work_left
from neusee.workflows.tolerance.cheaper_steps import with_substitutions

State = Literal["run", "cached", "failed"]
OnError = Literal["continue", "stop"]
Number = tuple[str, str, int | str, float]  #: step, field, index (empty of a single number), value


@dataclass(frozen=True, slots=True)
class Checked:
    """A point in which nothing is wrong, and what it asks of the engine."""

    point: Point
    composed: Composed
    job: Job


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a point."""

    point: Point
    state: State  #: ``cached``: no step had to run
    seconds: float
    numbers: tuple[Number, ...] = ()
    step: str = ""  #: the one that failed
    message: str = ""  #: why it failed, with the place where the step is written
    left: float = 0.0  #: seconds that the points after it will take, as the ones before it took


@dataclass(frozen=True)
class Plan:
    """The points in the order in which they run."""

    recipe: Recipe  #: of the first point
    checked: tuple[Checked, ...]
    costs: dict[str, float]  #: seconds by step, of those that ran before
    work: tuple[float, ...]  #: of every point in turn that is not stored: seconds, or steps where none ran before
    notes: tuple[str, ...]

    @property
    def jobs(self) -> list[Job]:
        return [checked.job for checked in self.checked]


def planned(
    recipe: str, points: Sequence[Point], folder: Path, store: Store, paired: bool = False, device: str = "cpu"
) -> Plan:
    """Compose and check every point and put them in order; a `RecipeError` has every mistake of all of them."""
    checker = _Checker(recipe, folder, store, device)
    checked = list(checker.every(points))
    if checker.diagnostics or checker.first is None:
        raise RecipeError(checker.diagnostics)
    costs = _costs(store)
    in_turn = [checked[i] for i in best_order([c.job for c in checked], costs, paired)]
    work = work_left([c.job for c in in_turn], costs, store.has)
    return Plan(checker.first, tuple(in_turn), costs, tuple(work), tuple(checker.notes))


def outcomes(
    plan: Plan,
    store: Store,
    on_error: OnError = "stop",
    device: str = "cpu",
    started: Callable[[Point], None] = lambda point: None,
    watch: Callable[[Event], None] | None = None,
) -> Generator[Outcome, None, None]:
    """Run the points in turn and say at once what became of each.

    With ``on_error="stop"`` the error of the first point that fails is raised after its outcome was given.
    """
    clock = _Clock(plan.work)
    for checked in plan.checked:
        started(checked.point)
        began, failure, result = time.perf_counter(), None, None
        try:
            result = run(check(checked.composed), store, watch=watch, device=device)
            numbers = _numbers(result)
        except Exception as error:
            failure = error
        seconds = time.perf_counter() - began
        left = clock.left(seconds)
        if failure is not None:
            failure.add_note(f"at point {checked.point.number}: {checked.point.shown}")
            yield _failed(checked.point, failure, seconds, left)
            if on_error == "stop":
                raise failure
            failure = None  # it holds the values that the failed step was given
        elif result is not None:
            state: State = "run" if any(d.state == "run" for d in result.done.values()) else "cached"
            yield Outcome(checked.point, state, seconds, numbers, left=left)


def _failed(point: Point, error: Exception, seconds: float, left: float) -> Outcome:
    step = error.step if isinstance(error, RunError) else ""
    message = str(error) if isinstance(error, RunError | RecipeError) else f"{type(error).__name__}: {error}"
    return Outcome(point, "failed", seconds, step=step, message=message, left=left)


def _numbers(result: Result) -> tuple[Number, ...]:
    """Every small output, number by number."""
    rows = (row for step, value in result.values.items() for row in numbers_of(step, value))
    return tuple((step, field, index, number) for step, field, index, number in rows)


def _costs(store: Store) -> dict[str, float]:
    """Median seconds of every step that this store has results of."""
    found: dict[str, list[float]] = defaultdict(list)
    for row in store.journal.rows():
        if row["step"] and row["seconds"] is not None:
            found[row["step"]].append(row["seconds"])
    return {step: median(seconds) for step, seconds in found.items()}


class _Clock:
    """Predicts how long the rest takes, from the work that is done and the work that is left."""

    def __init__(self, work: Sequence[float]) -> None:
        least = sum(work) / 100 / len(work) or 1.0  # reading a point's numbers is work too
        self.work = [max(one, least) for one in work]
        self.todo = sum(self.work)
        self.done = self.seconds = 0.0

    def left(self, seconds: float) -> float:
        """Seconds for the points to come, after one that took ``seconds``."""
        one = self.work[0]
        del self.work[0]
        self.todo, self.done, self.seconds = self.todo - one, self.done + one, self.seconds + seconds
        return max(self.todo, 0.0) * self.seconds / self.done if self.work else 0.0


class _Checker:
    """Looks at one point after another."""

    def __init__(self, recipe: str, folder: Path, store: Store, device: str) -> None:
        self.recipe, self.folder, self.device = recipe, folder, device
        self.code = Code(store.code_memo)
        self.diagnostics: list[Diagnostic] = []
        self.notes: dict[str, None] = {}
        self.first: Recipe | None = None
        self._same: dict[Any, Any] = {}

    def every(self, points: Sequence[Point]) -> Iterator[Checked]:
        """The points that are right; what is wrong with the others is in ``problems``."""
        for point in points:
            try:
                composed = compose(self.recipe, point.overrides, self.folder)
                yield Checked(point, composed, self._job(point, check(composed)))
            except RecipeError as error:
                self.diagnostics += error.diagnostics
        self.code.save()

    def _job(self, point: Point, recipe: Recipe) -> Job:
        self.first = self.first or recipe
        self.notes.update(dict.fromkeys(recipe.notes))
        keys: dict[str, Key] = {}
        recipe = with_substitutions(recipe, recipe.outputs)
        for name in needed(recipe, recipe.outputs):
            step = recipe.steps[name]
            try:
                keys[name] = self._once(key_of(step, keys, recipe.seed, self.code, place(step, self.device))[0])
            except (OSError, LookupError, TypeError) as error:
                raise RecipeError([Diagnostic(step.mark, name, str(error))]) from error
        sources = tuple((name, recipe.steps[name].sources) for name in keys)
        graph = self._same.setdefault(sources, dict(sources))
        return Job(point.place, keys, graph, recipe.outputs)

    def _once(self, key: Key) -> Key:
        """The same text for the same key: a thousand points share most of theirs."""
        return str(self._same.setdefault(key, key))
