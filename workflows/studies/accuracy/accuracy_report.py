"""The page of the study of accuracy: its tables, its pictures and the sentences around them."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch

from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.report.study_page import Mark, Section
from neusee.workflows.studies.accuracy.accuracy_figures import Dot, Line, promises, steps, work_precision
from neusee.workflows.studies.accuracy.pareto_line import ToleranceChoice, cheapest, median_ratio, pareto_front
from neusee.workflows.studies.accuracy.single_steps import USED, StepTried
from neusee.workflows.studies.accuracy.work_precision_points import WorkPrecisionPoint

TOLERANCE, KEEP_ALL = "tolerance", "everything kept"
HEADER = ("part", "line", "setting", "output", "seed", "error", "seconds", "computing", "proved", "refused")
_BUSY = 1.5  #: processes for each core, above which times are not reliable
_NO_WORSE = 2.0  #: factor over the error of everything kept, which is one draw of its rounding
_FACTOR = 2.0  #: the most that the choice may cost over the cheapest

_REFERENCE = """The reference is the recipe at its own sampling (bands, pupil samples, window), nothing left out,
every step in the best precision that it has. So a coarser setting shows what it loses, a finer one what the recipe's
own sampling leaves open. The error of an output is the root mean square of its difference from the reference over
the reference's largest element; the worst output counts. Outputs whose shape a knob changes are not
compared at its settings and stand as a dash."""
_TIME = """Run time is what the engine takes for a cold run of the outputs, choosing and writing results included: an
empty store in a temporary folder, in a process that has imported its libraries. It is the median of three, taken in
turn with the other points, where one takes less than 5 s, and a single one otherwise."""

_POISSON = """But the Poisson law takes as many numbers from its stream as the light asks for: light that differs by
rounding alone can shift the rest of the stream, and the errors then hold the noise."""


def power_of_ten(tolerance: float) -> str:
    """Return a tolerance as text, such as ``1e-3``."""
    return f"{tolerance:.2g}" if tolerance >= 1 else f"{tolerance:.0e}".replace("e-0", "e-")


def short_path(path: str) -> str:
    """Return the path of a knob without the parts that every path has: ``line.count``, ``optics.bands``."""
    return ", ".join(p.strip().removeprefix("steps.").replace(".with.", ".") for p in path.split(","))


def machine_line() -> str:
    """Return the machine in words, without its name."""
    return f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores, {torch.get_num_threads()} threads"


def summary_line(point: WorkPrecisionPoint) -> str:
    """Return one line of progress for a point."""
    name = f"{point.trial.line} {point.trial.label}".strip()
    if point.found.refused:
        return f"{name}: {point.found.refused}"
    return f"{name}: {point.seconds:.3g} s, error {point.error:.2g}"


def choices(points: Sequence[WorkPrecisionPoint]) -> list[ToleranceChoice]:
    """Return for each tolerance the point that the engine chose, and the cheapest point that holds the tolerance."""
    sound = [p for p in points if p.sound]
    asked = [p for p in sound if p.trial.value is not None]
    return [
        ToleranceChoice(float(p.trial.value or 0.0), p, cheapest(sound, float(p.trial.value or 0.0))) for p in asked
    ]


def count_missed(points: Sequence[WorkPrecisionPoint]) -> int:
    """Return how many tolerances were not held although they could be held."""
    return sum(not c.held and not _beyond(c, points) for c in choices(points))


def lead(recipe: Recipe, points: Sequence[WorkPrecisionPoint]) -> str:
    """Return the result in a few sentences."""
    own = next((p for p in points if p.trial.own and p.sound), None)
    whole = next((p for p in points if p.trial.line == KEEP_ALL and p.sound), None)
    said = []
    if own is not None:
        said.append(
            f"As it is written, with a tolerance of {power_of_ten(recipe.tolerance)}, the recipe takes "
            f"{own.seconds:.3g} s and is off by {own.most:.2g} at most, {_worst(own)} being the worst."
        )
    if own is not None and whole is not None:
        said.append(f"Everything in full takes {whole.seconds:.3g} s, {whole.seconds / own.seconds:.1f} times as long.")
    made = choices(points)
    held, ratio = sum(c.held for c in made), median_ratio(made)
    said.append(f"{held} of {len(made)} tolerances were held.")
    if whole is not None and any(_beyond(c, points) for c in made):
        said.append(
            f"{sum(_beyond(c, points) for c in made)} cannot be told: everything kept is off by {whole.most:.1g} "
            "itself, by its arithmetic."
        )
    if ratio is not None:
        said.append(f"The engine's choice costs {ratio:.2f} times the cheapest setting that holds, at the median.")
    load = max((p.found.load for p in points), default=0.0)
    if load > _BUSY:
        said.append(f"The machine was busy with other work ({load:.1f} processes a core): times are long and scatter.")
    return " ".join(said)


def _beyond(choice: ToleranceChoice, points: Sequence[WorkPrecisionPoint]) -> bool:
    """Return True if a tolerance was missed by no more than the error of everything kept in the recipe's precision."""
    whole = next((p.most for p in points if p.trial.line == KEEP_ALL and p.sound), 0.0)
    return not choice.held and choice.chosen.most <= choice.tolerance + _NO_WORSE * whole


def pictures(recipe: Recipe, points: Sequence[WorkPrecisionPoint], tried: Sequence[StepTried]) -> dict[str, bytes]:
    """Return the diagrams that can be drawn of the points and steps, by name."""
    sound = [p for p in points if p.sound]
    found = {}
    if sound:
        line = [(p.seconds, p.error) for p in pareto_front(sound)]
        title = f"{recipe.name}: error against run time"
        found["work_precision"] = work_precision(_lines(recipe, sound), line, recipe.tolerance, title)
    asked = [p for p in sound if p.trial.value is not None]
    if asked:
        names = asked[0].found.errors
        measured = {name: [max(p.found.errors[name]) for p in asked] for name in names}
        found["promises"] = promises(
            [float(p.trial.value or 0.0) for p in asked], measured, [p.found.bound for p in asked]
        )
    with_forms = [s for s in tried if s.forms]
    if with_forms:
        found["steps"] = steps([_diagram(s) for s in with_forms])
    return found


def sections(
    recipe: Recipe,
    points: Sequence[WorkPrecisionPoint],
    tried: Sequence[StepTried],
    without: Sequence[str],
    seeds: int,
    drawn: Mapping[str, bytes],
) -> list[Section]:
    """Return the parts of the page."""
    many = f"Noise was drawn with {seeds} seeds, the same ones for every point: the error is the median over them, "
    many += "and least to most stand beside it. The names of its streams are the same at every point, so that noise "
    many += "itself is no error."
    if any("poisson" in step.params.values() for step in recipe.steps.values()):
        many += " " + _POISSON
    text = f"{_REFERENCE}\n\n{_TIME}\n\n{many if seeds > 1 else 'One seed: errors have no range.'}"
    once = [p for p in points if p.trial.recipe is not recipe]  # the recipe's own setting of a knob is the recipe
    return [
        _whole(once, text, drawn.get("work_precision")),
        _chosen(points),
        _outputs(once, drawn.get("promises")),
        _steps(tried, drawn.get("steps")),
        _not_turned(points, without),
    ]


def _whole(points: Sequence[WorkPrecisionPoint], text: str, picture: bytes | None) -> Section:
    columns = (
        "knob",
        "setting",
        "run time, s",
        "of it computing, s",
        "error",
        "least",
        "most",
        "proved",
        "worst output",
    )
    best = {id(p) for p in pareto_front([p for p in points if p.sound])}
    rows, marks = [], {}
    for p in (p for p in points if p.sound):
        found = p.found
        row = (p.seconds, found.computing, p.error, min(p.by_seed), p.most, found.bound, _worst(p))
        rows.append((p.trial.line, f"{p.trial.label}{' (the recipe)' * p.trial.own}{' *' * (id(p) in best)}", *row))
        if p.trial.value is not None:
            marks[len(rows) - 1, 6] = _mark(ToleranceChoice(p.trial.value, p, None), points)
    text += "\n\nA star: on the Pareto line, no other point is as quick and as right. Marks: whether a tolerance was "
    text += "held with every seed; an exclamation mark where only arithmetic, that of everything kept, misses it."
    return Section("Error against run time", text, columns, rows, picture, marks)


def _chosen(points: Sequence[WorkPrecisionPoint]) -> Section:
    columns = ("tolerance", "chosen: error", "s", "cheapest that holds", "error", "s", "chosen over cheapest")
    rows: list[tuple[Any, ...]] = []
    marks: dict[tuple[int, int], Mark] = {}
    for i, c in enumerate(choices(points)):
        other = c.cheapest
        assert other is None or isinstance(other, WorkPrecisionPoint)
        name = f"{other.trial.line} {other.trial.label}".strip() if other else None
        price = (other.most, other.seconds) if other else (None, None)
        rows.append((power_of_ten(c.tolerance), c.chosen.most, c.chosen.seconds, name, *price, c.ratio))
        marks[i, 1] = _mark(c, points)
        if c.ratio is not None:
            marks[i, 6] = "pass" if c.ratio <= _FACTOR else "warn"
    text = "For each tolerance, the engine's choice against the quickest of all points above whose error it would also "
    text += f"have allowed. Marked: up to {_FACTOR:g} times."
    return Section("Chosen against cheapest", text, columns, rows, None, marks)


def _outputs(points: Sequence[WorkPrecisionPoint], picture: bytes | None) -> Section:
    names = list(dict.fromkeys(name for p in points for name in p.found.errors))
    rows = [
        (p.trial.line, p.trial.label, *(max(p.found.errors[n]) if n in p.found.errors else None for n in names))
        for p in points
        if p.sound
    ]
    text = "The greatest error over the seeds of every output; a dash where the knob changes its shape."
    return Section("Every output", text, ("knob", "setting", *names), rows, picture)


def _steps(tried: Sequence[StepTried], picture: bytes | None) -> Section:
    columns = ("step", "node", "share of time", "form", "error", "run time, s", "reference, s", "tried on")
    rows: list[tuple[Any, ...]] = []
    for s in tried:
        head = (s.step, s.node, f"{100 * s.share:.1f} %")
        on = s.found.cut_inputs or "its own inputs"
        rows += [(*head, f"{f.line} {f.label}".strip(), f.error, f.seconds, s.found.reference, on) for f in s.forms]
        if s.found.refused:
            rows.append((*head, f"not tried: {s.found.refused}", None, None, None, None))
    text = "Steps that take more than a hundredth of the time with everything kept; of several items, the slowest. "
    text += "Each form of a step is compared with its reference, float64 and direct, on the step's own inputs; where "
    text += "that would take too long, on a part of them, with the times of that part. `left out` hands on the first "
    text += "input. Times are medians of repeated calls."
    return Section("Step by step", text, columns, rows, picture)


def _not_turned(points: Sequence[WorkPrecisionPoint], without: Sequence[str]) -> Section:
    rows = [(why.partition(": ")[0], "", why.partition(": ")[2]) for why in without]
    rows += [(p.trial.line, p.trial.label, p.found.refused) for p in points if p.found.refused]
    text = "Knobs that this recipe has not, and settings that cannot be." if rows else "Every knob could be turned."
    return Section("Not turned", text, ("knob", "setting", "why"), rows)


def table(points: Sequence[WorkPrecisionPoint], tried: Sequence[StepTried]) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of the tidy table: one for each number."""
    for p in points:
        head = ("recipe", p.trial.line, p.trial.label)
        if p.found.refused:
            yield (*head, "", "", "", "", "", "", p.found.refused)
        for name, errors in p.found.errors.items():
            for seed, error in enumerate(errors):
                yield (*head, name, seed, error, p.seconds, p.found.computing, p.found.bound, "")
    for s in tried:
        for form in s.forms:
            yield (
                f"step {s.step}",
                form.line,
                form.label,
                s.found.cut_inputs,
                "",
                form.error,
                form.seconds,
                "",
                "",
                "",
            )
        if s.found.refused:
            yield (f"step {s.step}", s.node, "", "", "", "", "", "", "", s.found.refused)


def _lines(recipe: Recipe, points: Sequence[WorkPrecisionPoint]) -> list[Line]:
    names = dict.fromkeys(p.trial.line for p in points)
    lines = {name: [_dot(p, p.trial.recipe is recipe) for p in points if p.trial.line == name] for name in names}
    turned = (n for n in names if any(p.trial.recipe is not recipe for p in points if p.trial.line == n))
    return [Line(name, lines[name], strong=name == TOLERANCE) for name in turned]


def _dot(p: WorkPrecisionPoint, own: bool) -> Dot:
    """Return a point of a diagram; the point of the recipe's own setting, where all lines meet, has no label."""
    return Dot(p.seconds, p.error, "" if own else p.trial.label, min(p.by_seed), p.most, p.trial.own)


def _diagram(s: StepTried) -> tuple[str, list[Line], float]:
    """Return the forms of a step by what is changed; the line of the form that is used is drawn thicker."""
    names = dict.fromkeys(f.line for f in s.forms)
    lines = [Line(n, [Dot(f.seconds, f.error, f.label) for f in s.forms if f.line == n], n == USED) for n in names]
    on = f"\non {s.found.cut_inputs}" if s.found.cut_inputs else ""
    return f"{s.step}\n{s.node}{on}", lines, s.found.reference


def _worst(p: WorkPrecisionPoint) -> str:
    return max(p.found.errors, key=lambda name: max(p.found.errors[name]))


def _mark(choice: ToleranceChoice, points: Sequence[WorkPrecisionPoint]) -> Mark:
    return "pass" if choice.held else "warn" if _beyond(choice, points) else "fail"
