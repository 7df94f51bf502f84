"""The page of the accuracy study: tables, diagrams and explanations."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.report.study_page import Mark, Section
from neusee.workflows.studies.accuracy.accuracy_figures import Dot, Line, promises, steps, work_precision
from neusee.workflows.studies.accuracy.pareto_line import Points, ToleranceChoice, cheapest, median_ratio, pareto_front
from neusee.workflows.studies.accuracy.single_steps import USED, StepTried
from neusee.workflows.studies.accuracy.work_precision_points import WorkPrecisionPoint

TOLERANCE, KEEP_ALL = "tolerance", "everything kept"
HEADER = ("part", "line", "setting", "output", "seed", "error", "seconds", "computing", "stated", "refused")
_BUSY = 1.5  #: processes for each core, above which times are not reliable
_NO_WORSE = 2.0  #: factor on the error of the full computation, which is one draw of its rounding error
_ABREAST = 6  #: outputs side by side in a table
_FACTOR = 2.0  #: the largest accepted ratio of the chosen run time to the cheapest

_REFERENCE = """The reference is the recipe at its own sampling (bands, pupil samples, window), without omissions,
with every step in its best precision. So a coarser setting shows the error that it adds, and a finer setting the error
of the recipe's own sampling. The error of an output is the root mean square of its difference from the reference,
divided by the reference's largest element; the worst output counts. A dash marks an output that cannot be compared,
because the setting changes its shape."""
_TIME = """Run time is the engine's time for a cold run of the outputs, including its choices and the writing of
results: with an empty store in a temporary folder, in a process that has imported its libraries. A run of less than 5 s
is repeated, in turn with the other points, and the median of three times counts."""
_ONE_SEED = "One seed: errors have no range."
_SEEDS = """Noise was drawn with {} seeds, which are the same for every point. The error is the median over the
seeds, beside the least and the largest error. Every point draws the same noise, so that noise itself is no error."""
_POISSON = """But the light decides how many random numbers the Poisson distribution takes: light that differs only by
rounding can shift all later random numbers, and the errors then include the noise."""


@dataclass(frozen=True)
class AccuracyResult:
    """The result of the accuracy study: error and run time of a recipe at each setting, and of its slow steps."""

    recipe: Recipe
    points: tuple[WorkPrecisionPoint, ...]
    steps: tuple[StepTried, ...]
    without: tuple[str, ...]  #: parameters that are not varied, and why
    seeds: int


def power_of_ten(tolerance: float) -> str:
    """Return a tolerance as text with one digit, such as ``1e-3``."""
    return f"{tolerance:.2g}" if tolerance >= 1 else f"{tolerance:.0e}".replace("e-0", "e-")


def machine_line() -> str:
    """Return a line that describes the machine: system, processor, cores and threads, without the host name."""
    return f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores, {torch.get_num_threads()} threads"


def summary_line(point: WorkPrecisionPoint) -> str:
    """Return a line of progress about one measured setting: parameter, setting, run time and error."""
    return f"{point.trial.name}: {point.found.refused or f'{point.seconds:.3g} s, error {point.error:.2g}'}"


def choices(points: Points) -> list[ToleranceChoice]:
    """Return the engine's choice for each tolerance, and the quickest measured setting within the tolerance."""
    sound = [p for p in points if p.sound]
    asked = ((p.trial.value, p) for p in sound)
    return [ToleranceChoice(value, p, cheapest(sound, value)) for value, p in asked if value is not None]


def count_missed(points: Points) -> int:
    """Return the number of tolerances that the measured error exceeds by more than the rounding error."""
    return sum(not c.held and not _beyond_rounding(c, points) for c in choices(points))


def lead(recipe: Recipe, points: Points) -> str:
    """Return the summary of the accuracy study in a few sentences."""
    own, whole, chosen = _own(points), _whole(points), choices(points)
    sentences = []
    if own is not None:
        sentences.append(
            f"With its own tolerance of {power_of_ten(recipe.tolerance)}, the recipe takes {own.seconds:.3g} s; "
            f"its largest error is {own.most:.2g}, at the output {_worst_output(own)}."
        )
    if own is not None and whole is not None:
        ratio = whole.seconds / own.seconds
        sentences.append(f"The full computation takes {whole.seconds:.3g} s, {ratio:.1f} times as long.")
    sentences.append(f"{sum(c.held for c in chosen)} of {len(chosen)} tolerances were held.")
    if whole is not None and (beyond := sum(_beyond_rounding(c, points) for c in chosen)):
        sentences.append(
            f"{beyond} cannot be tested: rounding gives the full computation itself an error of {whole.most:.1g}."
        )
    if (ratio_of_times := median_ratio(chosen)) is not None:
        sentences.append(
            f"At the median, the engine's choice takes {ratio_of_times:.2f} times as long as the cheapest setting."
        )
    load = max((p.found.load for p in points), default=0.0)
    if load > _BUSY:
        busy = f"The machine was busy with other work ({load:.1f} processes for each core)"
        sentences.append(f"{busy}: run times are too long and vary.")
    return " ".join(sentences)


def _own(points: Points) -> WorkPrecisionPoint | None:
    return next((p for p in points if p.trial.own and p.sound), None)


def _whole(points: Points) -> WorkPrecisionPoint | None:
    return next((p for p in points if p.trial.line == KEEP_ALL and p.sound), None)


def _beyond_rounding(choice: ToleranceChoice, points: Points) -> bool:
    """Return True if the measured error exceeds the tolerance, but by at most the rounding error."""
    whole = _whole(points)
    rounding = _NO_WORSE * whole.most if whole else 0.0
    return not choice.held and choice.chosen.most <= choice.tolerance + rounding


def pictures(result: AccuracyResult) -> dict[str, bytes]:
    """Return the diagrams of the accuracy study's page by name, as PNG bytes."""
    drawn = {}
    sound = [p for p in result.points if p.sound]
    if sound:
        front = [(p.seconds, p.error) for p in pareto_front(sound)]
        title = f"{result.recipe.name}: error against run time"
        drawn["work_precision"] = work_precision(_lines(result.recipe, sound), front, result.recipe.tolerance, title)
    if asked := choices(sound):
        chosen = [choice.chosen.found for choice in asked]
        measured = {name: [max(point.errors[name]) for point in chosen] for name in chosen[0].errors}
        drawn["promises"] = promises([c.tolerance for c in asked], measured, [point.bound for point in chosen])
    if measured_steps := [s for s in result.steps if s.variants]:
        drawn["steps"] = steps([_diagram(s) for s in measured_steps])
    return drawn


def sections(result: AccuracyResult, drawn: Mapping[str, bytes]) -> list[Section]:
    """Return the sections of the accuracy study's page; ``drawn`` has the PNG bytes of each diagram by name."""
    seeds = _SEEDS.format(result.seeds) if result.seeds > 1 else _ONE_SEED
    if result.seeds > 1 and any("poisson" in step.params.values() for step in result.recipe.steps.values()):
        seeds += " " + _POISSON
    # the recipe's own setting of a parameter is the recipe itself
    once = [p for p in result.points if p.trial.recipe is not result.recipe]
    return [
        _all_points(once, f"{_REFERENCE}\n\n{_TIME}\n\n{seeds}", drawn.get("work_precision")),
        _chosen(result.points),
        *_outputs(once, drawn.get("promises")),
        _steps(result.steps, drawn.get("steps")),
        _not_varied(result),
    ]


def _all_points(points: Points, text: str, picture: bytes | None) -> Section:
    columns = ["parameter", "setting", "run time, s", "of it computing, s"]
    columns += ["error", "least", "most", "stated", "worst output"]
    sound = [p for p in points if p.sound]
    best = {id(p) for p in pareto_front(sound)}
    rows, marks = [], {}
    for p in sound:
        row = (p.seconds, p.found.computing, p.error, min(p.by_seed), p.most, p.found.bound, _worst_output(p))
        rows.append((p.trial.line, f"{p.trial.label}{' (the recipe)' * p.trial.own}{' *' * (id(p) in best)}", *row))
        if p.trial.value is not None:
            marks[len(rows) - 1, 6] = _mark(ToleranceChoice(p.trial.value, p, None), points)
    text += """\n\nA star marks the Pareto front: no other point is both quicker and more accurate. The marks show
        whether a tolerance was held with every seed; an exclamation mark, that only rounding exceeds it."""
    return Section("Error against run time", text, columns, rows, picture, marks)


def _chosen(points: Points) -> Section:
    columns = ("tolerance", "chosen: error", "s", "cheapest that holds", "error", "s", "chosen over cheapest")
    rows: list[tuple[Any, ...]] = []
    marks: dict[tuple[int, int], Mark] = {}
    for i, c in enumerate(choices(points)):
        best = (c.cheapest.trial.name, c.cheapest.most, c.cheapest.seconds) if c.cheapest else (None, None, None)
        rows.append((power_of_ten(c.tolerance), c.chosen.most, c.chosen.seconds, *best, c.ratio))
        marks[i, 1] = _mark(c, points)
        if c.ratio is not None:
            marks[i, 6] = "pass" if c.ratio <= _FACTOR else "warn"
    text = f"""For each tolerance, the engine's choice and the quickest of all points above whose error is within the
        tolerance. A choice passes if it takes at most {_FACTOR:g} times as long as the quickest point."""
    return Section("Chosen against cheapest", text, columns, rows, None, marks)


def _outputs(points: Points, picture: bytes | None) -> list[Section]:
    """Return the errors of all outputs in tables of a few columns each, which fit the page."""
    names = list(dict.fromkeys(name for p in points for name in p.found.errors))
    groups = [names[i : i + _ABREAST] for i in range(0, len(names), _ABREAST)] or [[]]
    text = "The largest error of each output over the seeds; a dash where the setting changes the output's shape."
    parts = []
    for number, group in enumerate(groups):
        heading = "Every output" + (f", part {number + 1} of {len(groups)}" if number else "")
        columns = ("parameter", "setting", *group)
        parts.append(Section(heading, "" if number else text, columns, _errors(points, group), picture))
        picture = None
    return parts


def _errors(points: Points, names: Sequence[str]) -> list[tuple[Any, ...]]:
    return [
        (p.trial.line, p.trial.label, *(max(p.found.errors[n]) if n in p.found.errors else None for n in names))
        for p in points
        if p.sound
    ]


def _steps(tried: Sequence[StepTried], picture: bytes | None) -> Section:
    columns = ("step", "node", "share of time", "variant", "error", "run time, s", "reference, s", "tried on")
    rows: list[tuple[Any, ...]] = []
    for s in tried:
        head = (s.step, s.node, f"{100 * s.share:.1f} %")
        on = s.found.cut_inputs or "its own inputs"
        rows += [(*head, f"{f.line} {f.label}".strip(), f.error, f.seconds, s.found.reference, on) for f in s.variants]
        if s.found.refused:
            rows.append((*head, f"not tried: {s.found.refused}", None, None, None, None))
    text = """Steps that take more than a hundredth of the run time of the full computation; for a step of several
        items, the slowest item. Each variant is compared with the node's reference, a direct computation in float64, on
        the step's own inputs. If that takes too long, all variants are timed and compared on a part of the inputs.
        `left out` returns the first input. Times are medians of repeated calls."""
    return Section("Step by step", text, columns, rows, picture)


def _not_varied(result: AccuracyResult) -> Section:
    rows = [(what, "", why) for what, _, why in (text.partition(": ") for text in result.without)]
    rows += [(p.trial.line, p.trial.label, p.found.refused) for p in result.points if p.found.refused]
    missing = "Parameters that this recipe does not have, and settings that are not possible."
    text = missing if rows else "Every parameter could be varied."
    return Section("Not varied", text, ("parameter", "setting", "why"), rows)


def table(result: AccuracyResult) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of ``table.csv``: one for each measured error, and one for each setting that was not possible."""
    for p in result.points:
        head = ("recipe", p.trial.line, p.trial.label)
        if p.found.refused:
            yield (*head, *[""] * 6, p.found.refused)
        for name, errors in p.found.errors.items():
            for seed, error in enumerate(errors):
                yield (*head, name, seed, error, p.seconds, p.found.computing, p.found.bound, "")
    for s in result.steps:
        for f in s.variants:
            yield (f"step {s.step}", f.line, f.label, s.found.cut_inputs, "", f.error, f.seconds, "", "", "")
        if s.found.refused:
            yield (f"step {s.step}", s.node, *[""] * 7, s.found.refused)


def _lines(recipe: Recipe, points: Points) -> list[Line]:
    varied = dict.fromkeys(p.trial.line for p in points if p.trial.recipe is not recipe)
    of_line = {name: [_dot(p, recipe) for p in points if p.trial.line == name] for name in varied}
    return [Line(name, dots, strong=name == TOLERANCE) for name, dots in of_line.items()]


def _dot(p: WorkPrecisionPoint, recipe: Recipe) -> Dot:
    """Return the dot of a measured setting, without a label at the recipe's own settings, where all lines meet."""
    label = "" if p.trial.recipe is recipe else p.trial.label
    return Dot(p.seconds, p.error, label, min(p.by_seed), p.most, p.trial.own)


def _diagram(s: StepTried) -> tuple[str, list[Line], float]:
    """Return the data of a step's diagram: title, a line for each changed property, and the reference's time in s."""
    names = dict.fromkeys(f.line for f in s.variants)
    lines = [Line(n, [Dot(f.seconds, f.error, f.label) for f in s.variants if f.line == n], n == USED) for n in names]
    on = f"\non {s.found.cut_inputs}" if s.found.cut_inputs else ""
    return f"{s.step}\n{s.node}{on}", lines, s.found.reference


def _worst_output(p: WorkPrecisionPoint) -> str:
    return max(p.found.errors, key=lambda name: max(p.found.errors[name]))


def _mark(choice: ToleranceChoice, points: Points) -> Mark:
    return "pass" if choice.held else "warn" if _beyond_rounding(choice, points) else "fail"
