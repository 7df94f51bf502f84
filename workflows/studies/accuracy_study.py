"""The accuracy study: error against run time for tolerances, for settings of a recipe, and for
single steps.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.keys.code_digest import engine
from neusee.workflows.recipe.loading import changed
from neusee.workflows.report.study_report import Progress, StudyOutcome, StudyReport
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies import accuracy_page
from neusee.workflows.studies.accuracy_page import (
    KEEP_ALL,
    TOLERANCE,
    AccuracyResult,
    power_of_ten,
)
from neusee.workflows.studies.recipe_knobs import Knobs, finest, knobs
from neusee.workflows.studies.work_precision import (
    TIMES,
    PointCache,
    Trial,
    WorkPrecisionPoint,
    steps_that_matter,
    try_step,
)
from neusee.workflows.tolerance.cheaper_steps import with_substitutions

TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
_QUICK_TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4)
#: s, largest run time of a step's reference; the second value is for ``quick``
_PATIENCE, _LITTLE = 4.0, 1.0
_LEFT = "not measured within the budget: run the study again to continue"


@dataclass(frozen=True)
class AccuracyOptions:
    """How much the study measures."""

    seeds: int = 3  #: number of noise seeds, which give the range of each error
    quick: bool = False  #: True for fewer settings
    #: time in s after which no further parameter setting is measured; the page lists the remaining
    #: settings, and the next study measures them
    budget: float | None = None
    device: str = "cpu"


def study(
    recipe: Recipe, store: Store, progress: Progress, options: AccuracyOptions
) -> StudyOutcome:
    """Measure error against run time; raise `ValueError` for less than one seed."""
    if options.seeds < 1:
        raise ValueError(
            f"seeds={options.seeds}: the accuracy study needs at least one random seed,"
            " such as seeds=3"
        )
    cache = PointCache(finest(recipe), store, options.seeds, options.device)
    end_time = math.inf if options.budget is None else time.monotonic() + options.budget
    result = _measure(recipe, cache, progress, options.quick, end_time)
    key = digest(
        "accuracy",
        cache.key(recipe),
        [[p.trial.line, p.trial.label] for p in result.points],
        options.quick,
    )
    return StudyOutcome(key, _document(result, cache, options.quick), _report(result))


def trials(recipe: Recipe, turned: Knobs, quick: bool) -> Iterator[Trial]:
    """Yield the settings to measure: each tolerance, the full computation, and each value of
    each varied parameter.
    """
    tolerances = sorted(
        {*(_QUICK_TOLERANCES if quick else TOLERANCES), recipe.tolerance}, reverse=True
    )
    for tolerance in tolerances:
        with_tolerance = replace(recipe, tolerance=tolerance, exact=False)
        is_own_setting = tolerance == recipe.tolerance and not recipe.exact
        yield Trial(
            TOLERANCE, power_of_ten(tolerance), with_tolerance, value=tolerance, own=is_own_setting
        )
    yield Trial(KEEP_ALL, "", replace(recipe, exact=True), own=recipe.exact)
    for knob in turned.found:
        # shorter for the page: step.parameter
        paths = (
            path.strip().removeprefix("steps.").replace(".with.", ".")
            for path in knob.name.split(",")
        )
        name = f"{knob.what} ({', '.join(paths)})"
        for change in knob.changes:
            try:
                yield Trial(
                    name,
                    change.label,
                    changed(recipe, change.overrides) if change.overrides else recipe,
                )
            except RecipeError as error:
                yield Trial(name, change.label, None, refused=error.diagnostics[0].message)


def _measure(
    recipe: Recipe, cache: PointCache, progress: Progress, quick: bool, until: float
) -> AccuracyResult:
    """Measure all points, then again for their times, then the slow steps.

    ``until`` is the monotonic time after which no further parameter setting is measured.
    """
    varied = knobs(recipe, quick)
    queue = list(trials(recipe, varied, quick))
    progress(
        f"{len(queue)} points, {cache.seeds} seed{'s' * (cache.seeds > 1)}; the reference first"
    )
    cache.truth(0)
    points = []
    for number, trial in enumerate(queue, 1):
        out_of_time = time.monotonic() > until and _may_wait(trial, cache)
        points.append(
            cache.point(replace(trial, recipe=None, refused=_LEFT) if out_of_time else trial)
        )
        progress(f"{number}/{len(queue)}  {accuracy_page.summary_line(points[-1])}")
    # repeat all points in turn, so that other load on the machine affects them alike
    for number in range(2, TIMES + 1):
        points = [cache.time_again(point, number) for point in points]
        progress(f"timed again: {number} of {TIMES}")
    steps = []
    for recipe_of_step, name, share in _slow_steps(recipe, points):
        steps.append(
            try_step(recipe_of_step, name, share, cache.store, _LITTLE if quick else _PATIENCE)
        )
        progress(f"step {name}: {steps[-1].found.refused or f'{len(steps[-1].variants)} variants'}")
    return AccuracyResult(recipe, tuple(points), tuple(steps), varied.without, cache.seeds)


def _may_wait(trial: Trial, cache: PointCache) -> bool:
    """Return True if the setting may be left to a later study: it varies a parameter and is not
    measured yet.
    """
    if trial.recipe is None or trial.line in (TOLERANCE, KEEP_ALL):
        return False
    return not cache.store.has(cache.key(trial.recipe))


def _slow_steps(
    recipe: Recipe, points: Sequence[WorkPrecisionPoint]
) -> Iterator[tuple[Recipe, str, float]]:
    """Yield (recipe, step name, share of run time) of each slow step, also of cheaper steps that
    replace others.
    """
    seconds = next((point.found.steps for point in points if point.trial.line == KEEP_ALL), {})
    for name, share in steps_that_matter(recipe, seconds):
        yield recipe, name, share
    own_seconds = next((point.found.steps for point in points if point.trial.own), {})
    cheaper = with_substitutions(recipe, recipe.outputs)
    for name, share in steps_that_matter(cheaper, own_seconds):
        # steps of the recipe have been yielded above
        if name not in recipe.steps:
            yield cheaper, name, share


def _document(result: AccuracyResult, cache: PointCache, quick: bool) -> dict[str, Any]:
    """Return the entries for provenance.json."""
    return {
        "tolerance": result.recipe.tolerance,
        "seed": result.recipe.seed,
        "seeds": result.seeds,
        "quick": quick,
        "device": cache.device,
        "machine": accuracy_page.machine_line(),
        "failed": accuracy_page.count_missed(result.points),  # number of tolerances
        "engine": engine(),
    }


def _report(result: AccuracyResult) -> StudyReport:
    """Return the page of the study, with its diagrams and its table."""
    pictures = accuracy_page.pictures(result)
    return StudyReport(
        f"Accuracy of {result.recipe.name}",
        accuracy_page.lead(result.recipe, result.points),
        accuracy_page.sections(result, pictures),
        pictures,
        tables={"table.csv": (accuracy_page.HEADER, accuracy_page.table(result))},
        shown=None,
    )
