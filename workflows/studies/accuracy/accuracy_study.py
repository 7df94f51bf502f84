"""`neusee study accuracy`: error against run time, for the whole recipe and for its steps.

The reference is the recipe at its own sampling with nothing left out and every step in the best precision that it
has. Its points are the tolerances, which the engine meets in its own way, and the knobs of the recipe,
turned one at a time. What is measured is kept: a study that was stopped goes on when it is run again.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from neusee.workflows.engine.provenance import timestamp, versions
from neusee.workflows.graph.diagnostics import RecipeError
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.keys.engine_digest import engine
from neusee.workflows.recipe.changed_recipe import changed
from neusee.workflows.report.run_folder import RunFolder, new_run
from neusee.workflows.report.study_page import page
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.accuracy import accuracy_report
from neusee.workflows.studies.accuracy.recipe_knobs import Knobs, finest, knobs
from neusee.workflows.studies.accuracy.single_steps import StepTried, that_matter, try_step
from neusee.workflows.studies.accuracy.work_precision_points import TIMES, Bench, Measured, Point, Trial
from neusee.workflows.tolerance.cheaper_steps import with_substitutions

TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
_FEWER = (1e-1, 1e-2, 1e-3, 1e-4)
_PATIENCE, _LITTLE = 4.0, 1.0  #: s that the reference of a step may take

Tell = Callable[[str], None]


@dataclass(frozen=True)
class Study:
    """All that was found."""

    recipe: Recipe
    points: tuple[Point, ...]
    steps: tuple[StepTried, ...]
    without: tuple[str, ...]  #: knobs that are not turned, and why
    seeds: int


def study(
    recipe: Recipe,
    store: Store,
    runs: Path,
    command: Sequence[str],
    tell: Tell,
    *,
    seeds: int = 3,
    quick: bool = False,
    budget: float | None = None,
    device: str = "cpu",
) -> Path:
    """Measure and write ``runs/<date>_<recipe>_accuracy_<key>/``; gives the folder.

    Args: seeds: of the noise, for the range of each error. quick: fewer settings. budget: s after which
    no other setting of a knob is begun; what is left is said, and measured when the study is run again.
    Raises: `ValueError` for no seed.
    """
    if seeds < 1:
        raise ValueError(f"seeds={seeds}: a study needs one at least")
    bench = Bench(finest(recipe), store, seeds, device)
    found = _found(recipe, bench, tell, quick, math.inf if budget is None else time.monotonic() + budget)
    key = digest("accuracy", bench.key(recipe), [_named(p) for p in found.points], quick)
    with new_run(runs, f"{recipe.name}_accuracy", key) as folder:
        _write(found, folder, _provenance(found, bench, command, quick))
    return folder.path


def trials(recipe: Recipe, turned: Knobs, quick: bool) -> Iterator[Trial]:
    """The tolerances, everything kept, and each knob in turn on the recipe as it is."""
    asked = sorted({*(_FEWER if quick else TOLERANCES), recipe.tolerance}, reverse=True)
    for tolerance in asked:
        other = replace(recipe, tolerance=tolerance, exact=False)
        own = tolerance == recipe.tolerance and not recipe.exact
        yield Trial(accuracy_report.TOLERANCE, accuracy_report.power(tolerance), other, value=tolerance, own=own)
    yield Trial(accuracy_report.KEEP_ALL, "", replace(recipe, exact=True), own=recipe.exact)
    for knob in turned.found:
        for change in knob.changes:
            name = f"{knob.what} ({accuracy_report.short(knob.name)})"
            try:
                yield Trial(name, change.label, changed(recipe, change.overrides) if change.overrides else recipe)
            except RecipeError as error:
                yield Trial(name, change.label, None, refused=error.diagnostics[0].message)


def _found(recipe: Recipe, bench: Bench, tell: Tell, quick: bool, until: float) -> Study:
    turned = knobs(recipe, quick)
    todo = list(trials(recipe, turned, quick))
    tell(f"{len(todo)} points, {bench.seeds} seed{'s' * (bench.seeds > 1)}; the reference first")
    bench.truth(0)
    points = []
    for number, trial in enumerate(todo, 1):
        points.append(_left(trial) if time.monotonic() > until and _may_wait(trial, bench) else bench.point(trial))
        tell(f"{number}/{len(todo)}  {accuracy_report.told(points[-1])}")
    for number in range(2, TIMES + 1):  # in turn, so that what else the machine does meets all points alike
        points = [bench.again(point, number) for point in points]
        tell(f"timed again: {number} of {TIMES}")
    steps = []
    for stage, name, share in _matter(recipe, points):
        steps.append(try_step(stage, name, share, bench.store, _LITTLE if quick else _PATIENCE))
        tell(f"step {name}: {steps[-1].found.refused or f'{len(steps[-1].forms)} forms'}")
    return Study(recipe, tuple(points), tuple(steps), turned.without, bench.seeds)


def _may_wait(trial: Trial, bench: Bench) -> bool:
    """Whether a trial is a knob's, and nothing is known of it yet."""
    knob = trial.line not in (accuracy_report.TOLERANCE, accuracy_report.KEEP_ALL)
    return knob and trial.recipe is not None and not bench.store.has(bench.key(trial.recipe))


def _left(trial: Trial) -> Point:
    return Point(trial, Measured(refused="left for another time: run the study again to go on"))


def _matter(recipe: Recipe, points: Sequence[Point]) -> Iterator[tuple[Recipe, str, float]]:
    """Steps that matter where everything is kept, and of the recipe as it is, those that stand in for others."""
    whole = next((p.found.steps for p in points if p.trial.line == accuracy_report.KEEP_ALL), {})
    for name, share in that_matter(recipe, whole):
        yield recipe, name, share
    own = next((p.found.steps for p in points if p.trial.own), {})
    cheaper = with_substitutions(recipe, recipe.outputs)
    for name, share in that_matter(cheaper, own):
        if name not in recipe.steps:
            yield cheaper, name, share


def _named(point: Point) -> list[Any]:
    return [point.trial.line, point.trial.label]


def _provenance(found: Study, bench: Bench, command: Sequence[str], quick: bool) -> dict[str, Any]:
    return {
        "recipe": found.recipe.name,
        "command": " ".join(command),
        "date": timestamp(),
        "tolerance": found.recipe.tolerance,
        "seed": found.recipe.seed,
        "seeds": found.seeds,
        "quick": quick,
        "device": bench.device,
        "machine": accuracy_report.machine_said(),
        "failed": accuracy_report.missed(found.points),  # tolerances
        "engine": engine(),
        **versions(),
    }


def _write(found: Study, folder: RunFolder, provenance: dict[str, Any]) -> None:
    pictures = accuracy_report.pictures(found.recipe, found.points, found.steps)
    for name, picture in pictures.items():
        folder.write(f"figures/{name}.png", picture)
    folder.write_rows("table.csv", accuracy_report.HEADER, accuracy_report.table(found.points, found.steps))
    folder.write("recipe.yaml", found.recipe.config.to_yaml())
    folder.write("provenance.json", json.dumps(provenance, indent=1, ensure_ascii=False))
    sections = accuracy_report.sections(found.recipe, found.points, found.steps, found.without, found.seeds, pictures)
    title = f"Accuracy of {found.recipe.name}"
    folder.write("report.html", page(title, accuracy_report.lead(found.recipe, found.points), sections, provenance))
