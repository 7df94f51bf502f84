"""The page of the accuracy study: tables, diagrams and explanations."""

from __future__ import annotations

import itertools
import math
import os
import platform
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.report.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    VERMILION,
    PointLabel,
    canvas,
    drawn,
    place_labels,
    plain_ticks,
)
from neusee.workflows.report.study_page import Mark, Marked, Section
from neusee.workflows.studies.accuracy.single_steps import USED, StepTried
from neusee.workflows.studies.accuracy.work_precision_points import (
    Points,
    ToleranceChoice,
    WorkPrecisionPoint,
    cheapest,
    median_ratio,
    pareto_front,
)

# --- accuracy figures -----------------------------------------------------------------------------

# Diagrams of the accuracy study: error against run time, and measured error against tolerance.


EXACT = 1e-9  #: the level at which smaller errors are drawn, because a logarithmic axis has no 0
#: the same level in the diagrams of single steps, some of which are in double precision
_STEP_EXACT = 1e-17
_COLOURS = (BLUE, ORANGE, GREEN, VERMILION, "#CC79A7", "#56B4E9", "#8B7500", "#555555")
_MARKERS = "osD^vP*X"
_GREY = "#777777"
_ENTRY = 2.1  #: inches, room for an entry of a legend


@dataclass(frozen=True)
class Dot:
    """A point of a diagram, with a run time, an error and a label."""

    seconds: float
    error: float
    label: str
    least: float | None = None  #: smallest error over the seeds, for an error bar
    most: float | None = None  #: largest error over the seeds
    own: bool = False  #: whether the recipe itself has this setting


Styles = Mapping[str, tuple[str, str]]  #: colour and marker of each line by its name
#: axes, lines, styles, `EXACT` or `_STEP_EXACT`
Diagram = tuple[Any, Sequence["Line"], Styles, float]


@dataclass(frozen=True)
class Line:
    """A line of a diagram, with one point for each setting of a parameter."""

    name: str
    dots: Sequence[Dot]
    strong: bool = False  #: whether the line is thicker than other lines


@drawn
def work_precision(
    lines: Sequence[Line], pareto_front: Sequence[tuple[float, float]], tolerance: float, title: str
) -> Any:
    """Draw error against run time: a line for each parameter, the Pareto front, and a ring at
    the recipe's settings.
    """
    figure, axes = canvas(10.0, 7.0)
    ax = axes[0, 0]
    styles = _styles(line.name for line in lines)
    diagram = (ax, lines, styles, EXACT)
    _draw_diagram(diagram, errors=[tolerance])
    _ring_own_setting(ax, lines)
    if pareto_front:
        x, y = zip(*pareto_front, strict=True)
        style = {"color": BLACK, "linewidth": 5.0, "alpha": 0.16, "zorder": 0}
        ax.step(x, np.maximum(y, EXACT), where="post", label="Pareto front", **style)
    ax.axhline(
        tolerance, color=VERMILION, linestyle="--", linewidth=1.2, label="tolerance of the recipe"
    )
    ax.set_title(title)
    ax.set_xlabel("run time (s)")
    ax.set_ylabel("error: rms over the largest element of the reference")
    figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    _place_labels(figure, [diagram])
    return figure


@drawn
def steps(diagrams: Sequence[tuple[str, Sequence[Line], float]]) -> Any:
    """Draw error against run time in ms for each step, with a dotted line at the time of the
    reference node.
    """
    columns = min(3, len(diagrams))
    rows = -(-len(diagrams) // columns)
    styles = _styles(line.name for line in itertools.chain(*(lines for _, lines, _ in diagrams)))
    width = 3.9 * columns + 0.4
    across = min(int(width / _ENTRY), 1 + len(styles))
    below = max(0.7, 0.25 * math.ceil((1 + len(styles)) / across))
    figure, axes = canvas(width, 3.5 * rows + below, rows, columns)
    shown: list[Diagram] = []
    for ax, (name, lines, reference) in zip(axes.flat, diagrams, strict=False):
        scaled = [
            replace(line, dots=[replace(d, seconds=1e3 * d.seconds) for d in line.dots])
            for line in lines
        ]
        shown.append((ax, scaled, styles, _STEP_EXACT))
        _draw_diagram(shown[-1], seconds=[1e3 * reference])
        ax.axvline(1e3 * reference, color=_GREY, linestyle=":", label="reference of the step")
        ax.set_title(name)
        ax.set_xlabel("run time (ms)")
        ax.set_ylabel("error")
    for ax in list(axes.flat)[len(diagrams) :]:
        ax.set_axis_off()
    handles: dict[str, Any] = {}
    for ax in axes.flat:
        marks, labels = ax.get_legend_handles_labels()
        handles |= dict(zip(labels, marks, strict=True))
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=across)
    _place_labels(figure, shown)
    return figure


@drawn
def promises(
    asked: Sequence[float], measured: Mapping[str, Sequence[float]], stated: Sequence[float | None]
) -> Any:
    """Draw the measured error of each output and the stated error against the requested
    tolerance.
    """
    figure, axes = canvas(8.4, 5.0)
    ax = axes[0, 0]
    ax.loglog(asked, asked, color=BLACK, linewidth=1.2, label="error equal to the tolerance")
    bounds = [(t, max(b, EXACT)) for t, b in zip(asked, stated, strict=True) if b is not None]
    if bounds:
        ax.loglog(*zip(*bounds, strict=True), color=_GREY, linestyle="--", label="stated error")
    for name, (colour, mark) in _styles(measured).items():
        style = {"color": colour, "marker": mark, "markersize": 6, "linewidth": 1.0}
        ax.loglog(asked, np.maximum(measured[name], EXACT), label=name, **style)
    ax.set_title("Measured error of each output against the requested tolerance")
    ax.set_xlabel("tolerance")
    ax.set_ylabel("error")
    ax.invert_xaxis()
    _draw_exact_level(ax, itertools.chain.from_iterable(measured.values()), EXACT)
    ax.set_ylim(bottom=min(ax.get_ylim()[0], EXACT / 5))
    figure.legend(*ax.get_legend_handles_labels(), loc="outside right upper")
    return figure


def _styles(names: Iterable[str]) -> Styles:
    """Return colour and marker of each line; when all colours are used, each begins again with
    the next marker.
    """
    count = len(_COLOURS)
    looks = ((_COLOURS[i % count], _MARKERS[(i + i // count) % count]) for i in itertools.count())
    return dict(zip(dict.fromkeys(names), looks, strict=False))


def _draw_diagram(
    diagram: Diagram, errors: Sequence[float] = (), seconds: Sequence[float] = ()
) -> None:
    """Draw the lines of a diagram on logarithmic axes whose limits also include ``errors`` and
    ``seconds``.
    """
    ax, lines, styles, exact = diagram
    ax.set_xscale("log")
    ax.set_yscale("log")
    dots = _dots(lines)
    y = [max(d.error, exact) for d in dots] + [max(d.most or d.error, exact) for d in dots]
    # set limits first: with automatic limits, matplotlib warns of errors that differ in the last
    # digit only
    ax.set_xlim(*_axis_limits([*(d.seconds for d in dots), *seconds], 10.0, 1.5))
    ax.set_ylim(*_axis_limits([*y, *errors], 100.0, 4.0))
    for line in lines:
        _draw(ax, line, *styles[line.name], exact)
    plain_ticks(ax.xaxis)
    _draw_exact_level(ax, [d.error for d in dots], exact)


def _dots(lines: Sequence[Line]) -> list[Dot]:
    """Return the dots of all lines."""
    return list(itertools.chain(*(line.dots for line in lines)))


def _axis_limits(values: Sequence[float], ratio: float, margin: float) -> tuple[float, float]:
    """Return the limits of a logarithmic axis: a margin around all values, and a ratio of at
    least ``ratio``.
    """
    low, high = min(values) / margin, max(values) * margin
    wider = math.sqrt(max(1.0, ratio / (high / low)))
    return low / wider, high * wider


def _draw(ax: Any, line: Line, colour: str, mark: str, exact: float) -> None:
    """Draw one line with a marker at each point, and error bars from the smallest to the largest
    error of the point.
    """
    y = np.maximum([d.error for d in line.dots], exact)
    lower = np.maximum([d.error if d.least is None else d.least for d in line.dots], exact)
    upper = np.maximum([d.error if d.most is None else d.most for d in line.dots], exact)
    style = {"color": colour, "marker": mark, "markersize": 7, "capsize": 3, "label": line.name}
    style |= (
        {"linewidth": 2.0, "alpha": 1.0, "zorder": 3}
        if line.strong
        else {"linewidth": 0.9, "alpha": 0.75}
    )
    ax.errorbar(
        [d.seconds for d in line.dots],
        y,
        yerr=np.maximum([y - lower, upper - y], 0.0),
        **{"zorder": 2} | style,
    )


def _ring_own_setting(ax: Any, lines: Sequence[Line]) -> None:
    ring = {
        "marker": "o",
        "markersize": 17,
        "markerfacecolor": "none",
        "markeredgecolor": BLACK,
        "linestyle": "",
    }
    for dot in [d for d in _dots(lines) if d.own][:1]:
        place = [dot.seconds], [max(dot.error, EXACT)]
        ax.plot(*place, **ring, markeredgewidth=1.6, label="the recipe's own settings", zorder=4)


def _draw_exact_level(ax: Any, errors: Iterable[float], exact: float) -> None:
    if any(e < exact for e in errors):
        ax.axhline(exact, color=_GREY, linewidth=0.8, linestyle=":")
        transform = ax.get_yaxis_transform()
        ax.text(
            0.01,
            exact / 1.2,
            "smaller errors, and no error",
            transform=transform,
            va="top",
            fontsize=9,
            color=_GREY,
        )


def _place_labels(figure: Any, diagrams: Sequence[Diagram]) -> None:
    """Write the label of each point of the diagrams where the label covers no marker, no note
    and no other label.
    """
    points: dict[Any, list[PointLabel]] = {}
    for ax, lines, styles, exact in diagrams:
        points[ax] = []
        for line in lines:
            colour = styles[line.name][0]
            points[ax] += [
                PointLabel(d.seconds, max(d.error, exact), d.label, colour) for d in line.dots
            ]
    place_labels(figure, points)


# --- accuracy report ------------------------------------------------------------------------------

# The page of the accuracy study: tables, diagrams and explanations.


TOLERANCE, KEEP_ALL = "tolerance", "everything kept"
HEADER = (
    "part",
    "line",
    "setting",
    "output",
    "seed",
    "error",
    "seconds",
    "computing",
    "stated",
    "refused",
)
_BUSY = 1.5  #: processes for each core, above which times are not reliable
#: factor on the error of the full computation, which is one draw of its rounding error
_NO_WORSE = 2.0
_ABREAST = 6  #: outputs side by side in a table
_FACTOR = 2.0  #: the largest accepted ratio of the chosen run time to the cheapest

_REFERENCE = """The reference is the recipe at its own sampling (bands, pupil samples, window),
without omissions, with every step in its best precision. So a coarser setting shows the error that
it adds, and a finer setting the error of the recipe's own sampling. The error of an output is the
root mean square of its difference from the reference, divided by the reference's largest element;
the worst output counts. A dash marks an output that cannot be compared, because the setting changes
its shape."""
_TIME = """Run time is the engine's time for a cold run of the outputs, including its choices and
the writing of results: with an empty store in a temporary folder, in a process that has imported
its libraries. A run of less than 5 s is repeated, in turn with the other points, and the median of
three times counts."""
_ONE_SEED = "One seed: errors have no range."
_SEEDS = """Noise was drawn with {} seeds, which are the same for every point. The error is the
median over the seeds, beside the least and the largest error. Every point draws the same noise, so
that noise itself is no error."""
_POISSON = """But the light decides how many random numbers the Poisson distribution takes: light
that differs only by rounding can shift all later random numbers, and the errors then include the
noise."""


@dataclass(frozen=True)
class AccuracyResult:
    """The result of the accuracy study: error and run time of a recipe at each setting, and of
    its slow steps.
    """

    recipe: Recipe
    points: tuple[WorkPrecisionPoint, ...]
    steps: tuple[StepTried, ...]
    without: tuple[str, ...]  #: parameters that are not varied, and why
    seeds: int


def power_of_ten(tolerance: float) -> str:
    """Return a tolerance as text with one digit, such as ``1e-3``."""
    return f"{tolerance:.2g}" if tolerance >= 1 else f"{tolerance:.0e}".replace("e-0", "e-")


def machine_line() -> str:
    """Return a line that describes the machine: system, processor, cores and threads, without
    the host name.
    """
    return (
        f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores,"
        f" {torch.get_num_threads()} threads"
    )


def summary_line(point: WorkPrecisionPoint) -> str:
    """Return a line of progress about one measured setting: parameter, setting, run time and
    error.
    """
    return (
        f"{point.trial.name}:"
        f" {point.found.refused or f'{point.seconds:.3g} s, error {point.error:.2g}'}"
    )


def choices(points: Points) -> list[ToleranceChoice]:
    """Return the engine's choice for each tolerance, and the quickest measured setting within
    the tolerance.
    """
    sound = [p for p in points if p.sound]
    asked = ((p.trial.value, p) for p in sound)
    return [
        ToleranceChoice(value, p, cheapest(sound, value)) for value, p in asked if value is not None
    ]


def count_missed(points: Points) -> int:
    """Return the number of tolerances that the measured error exceeds by more than the rounding
    error.
    """
    return sum(not c.held and not _beyond_rounding(c, points) for c in choices(points))


def lead(recipe: Recipe, points: Points) -> str:
    """Return the summary of the accuracy study in a few sentences."""
    sentences = [*_times(recipe, points), *_kept_tolerances(points)]
    load = max((p.found.load for p in points), default=0.0)
    if load > _BUSY:
        busy = f"The machine was busy with other work ({load:.1f} processes for each core)"
        sentences.append(f"{busy}: run times are too long and vary.")
    return " ".join(sentences)


def _times(recipe: Recipe, points: Points) -> Iterator[str]:
    """Yield how long the recipe and the full computation take."""
    own, full = _own(points), _whole(points)
    if own is None:
        return
    yield (
        f"With its own tolerance of {power_of_ten(recipe.tolerance)}, the recipe takes"
        f" {own.seconds:.3g} s; its largest error is {own.most:.2g}, at the output"
        f" {_worst_output(own)}."
    )
    if full is not None:
        ratio = full.seconds / own.seconds
        yield f"The full computation takes {full.seconds:.3g} s, {ratio:.1f} times as long."


def _kept_tolerances(points: Points) -> Iterator[str]:
    """Yield how many tolerances were held, and how good the choices are."""
    full, judged = _whole(points), choices(points)
    yield f"{sum(c.held for c in judged)} of {len(judged)} tolerances were held."
    if full is not None and (beyond := sum(_beyond_rounding(c, points) for c in judged)):
        yield (
            f"{beyond} cannot be tested: rounding gives the full computation itself an error of"
            f" {full.most:.1g}."
        )
    if (ratio_of_times := median_ratio(judged)) is not None:
        yield (
            f"At the median, the engine's choice takes {ratio_of_times:.2f} times as long as the"
            " cheapest setting."
        )


def _own(points: Points) -> WorkPrecisionPoint | None:
    return next((p for p in points if p.trial.own and p.sound), None)


def _whole(points: Points) -> WorkPrecisionPoint | None:
    return next((p for p in points if p.trial.line == KEEP_ALL and p.sound), None)


def _beyond_rounding(choice: ToleranceChoice, points: Points) -> bool:
    """Return True if the measured error exceeds the tolerance, but by at most the rounding
    error.
    """
    full = _whole(points)
    rounding = _NO_WORSE * full.most if full else 0.0
    return not choice.held and choice.chosen.most <= choice.tolerance + rounding


def pictures(result: AccuracyResult) -> dict[str, bytes]:
    """Return the diagrams of the accuracy study's page by name, as PNG bytes."""
    images = {}
    sound = [p for p in result.points if p.sound]
    if sound:
        front = [(p.seconds, p.error) for p in pareto_front(sound)]
        title = f"{result.recipe.name}: error against run time"
        images["work_precision"] = work_precision(
            _lines(result.recipe, sound), front, result.recipe.tolerance, title
        )
    if asked := choices(sound):
        images["promises"] = _promises(asked)
    if measured_steps := [s for s in result.steps if s.variants]:
        images["steps"] = steps([_diagram(s) for s in measured_steps])
    return images


def _promises(asked: Sequence[ToleranceChoice]) -> bytes:
    """Return the diagram of the measured against the requested error of the engine's choices."""
    measurements = [choice.chosen.found for choice in asked]
    measured = {
        name: [max(point.errors[name]) for point in measurements] for name in measurements[0].errors
    }
    bounds = [point.bound for point in measurements]
    picture: bytes = promises([c.tolerance for c in asked], measured, bounds)
    return picture


def sections(result: AccuracyResult, drawn: Mapping[str, bytes]) -> list[Section]:
    """Return the sections of the accuracy study's page; ``drawn`` has the PNG bytes of each
    diagram by name.
    """
    seeds = _SEEDS.format(result.seeds) if result.seeds > 1 else _ONE_SEED
    if result.seeds > 1 and any(
        "poisson" in step.params.values() for step in result.recipe.steps.values()
    ):
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
    rows = []
    for p in sound:
        setting = f"{p.trial.label}{' (the recipe)' * p.trial.own}{' *' * (id(p) in best)}"
        largest = Marked(p.most)
        if p.trial.value is not None:
            largest = Marked(p.most, _mark(ToleranceChoice(p.trial.value, p, None), points))
        times = (p.seconds, p.found.computing)
        errors = (p.error, min(p.by_seed), largest, p.found.bound, _worst_output(p))
        rows.append((p.trial.line, setting, *times, *errors))
    text += """\n\nA star marks the Pareto front: no other point is both quicker and more accurate.
        The marks show whether a tolerance was held with every seed; an exclamation mark, that only
        rounding exceeds it."""
    return Section("Error against run time", text, columns, rows, picture)


def _chosen(points: Points) -> Section:
    columns = (
        "tolerance",
        "chosen: error",
        "s",
        "cheapest that holds",
        "error",
        "s",
        "chosen over cheapest",
    )
    rows: list[tuple[Any, ...]] = []
    for c in choices(points):
        chosen = (Marked(c.chosen.most, _mark(c, points)), c.chosen.seconds)
        best: tuple[Any, ...] = (None, None, None)
        if c.cheapest:
            best = (c.cheapest.trial.name, c.cheapest.most, c.cheapest.seconds)
        ratio = None
        if c.ratio is not None:
            ratio = Marked(c.ratio, "pass" if c.ratio <= _FACTOR else "warn")
        rows.append((power_of_ten(c.tolerance), *chosen, *best, ratio))
    text = f"""For each tolerance, the engine's choice and the quickest of all points above whose
        error is within the tolerance. A choice passes if it takes at most {_FACTOR:g} times as long
        as the quickest point."""
    return Section("Chosen against cheapest", text, columns, rows)


def _outputs(points: Points, picture: bytes | None) -> list[Section]:
    """Return the errors of all outputs in tables of a few columns each, which fit the page."""
    names = list(dict.fromkeys(itertools.chain(*(p.found.errors for p in points))))
    groups = [names[i : i + _ABREAST] for i in range(0, len(names), _ABREAST)] or [[]]
    text = (
        "The largest error of each output over the seeds; a dash where the setting changes the"
        " output's shape."
    )
    parts = []
    for number, group in enumerate(groups):
        heading = "Every output" + (f", part {number + 1} of {len(groups)}" if number else "")
        columns = ("parameter", "setting", *group)
        parts.append(
            Section(heading, "" if number else text, columns, _errors(points, group), picture)
        )
        picture = None
    return parts


def _errors(points: Points, names: Sequence[str]) -> list[tuple[Any, ...]]:
    return [
        (
            p.trial.line,
            p.trial.label,
            *(max(p.found.errors[n]) if n in p.found.errors else None for n in names),
        )
        for p in points
        if p.sound
    ]


def _steps(tried: Sequence[StepTried], picture: bytes | None) -> Section:
    columns = (
        "step",
        "node",
        "share of time",
        "variant",
        "error",
        "run time, s",
        "reference, s",
        "tried on",
    )
    rows: list[tuple[Any, ...]] = []
    for s in tried:
        head = (s.step, s.node, f"{100 * s.share:.1f} %")
        on = s.found.cut_inputs or "its own inputs"
        rows += [
            (*head, f"{f.line} {f.label}".strip(), f.error, f.seconds, s.found.reference, on)
            for f in s.variants
        ]
        if s.found.refused:
            rows.append((*head, f"not tried: {s.found.refused}", None, None, None, None))
    text = """Steps that take more than a hundredth of the run time of the full computation; for a
        step of several items, the slowest item. Each variant is compared with the node's reference,
        a direct computation in float64, on the step's own inputs. If that takes too long, all
        variants are timed and compared on a part of the inputs. `left out` returns the first input.
        Times are medians of repeated calls."""
    return Section("Step by step", text, columns, rows, picture)


def _not_varied(result: AccuracyResult) -> Section:
    rows = [(knob, "", why) for knob, _, why in (text.partition(": ") for text in result.without)]
    rows += [
        (p.trial.line, p.trial.label, p.found.refused) for p in result.points if p.found.refused
    ]
    missing = "Parameters that this recipe does not have, and settings that are not possible."
    text = missing if rows else "Every parameter could be varied."
    return Section("Not varied", text, ("parameter", "setting", "why"), rows)


def table(result: AccuracyResult) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of ``table.csv``: one for each measured error, and one for each setting
    that was not possible.
    """
    for p in result.points:
        head = ("recipe", p.trial.line, p.trial.label)
        if p.found.refused:
            yield (*head, *[""] * 6, p.found.refused)
        for name, errors in p.found.errors.items():
            for seed, error in enumerate(errors):
                yield (*head, name, seed, error, p.seconds, p.found.computing, p.found.bound, "")
    for s in result.steps:
        for f in s.variants:
            yield (
                f"step {s.step}",
                f.line,
                f.label,
                s.found.cut_inputs,
                "",
                f.error,
                f.seconds,
                "",
                "",
                "",
            )
        if s.found.refused:
            yield (f"step {s.step}", s.node, *[""] * 7, s.found.refused)


def _lines(recipe: Recipe, points: Points) -> list[Line]:
    varied = dict.fromkeys(p.trial.line for p in points if p.trial.recipe is not recipe)
    of_line = {name: [_dot(p, recipe) for p in points if p.trial.line == name] for name in varied}
    return [Line(name, dots, strong=name == TOLERANCE) for name, dots in of_line.items()]


def _dot(p: WorkPrecisionPoint, recipe: Recipe) -> Dot:
    """Return the dot of a measured setting, without a label at the recipe's own settings, where
    all lines meet.
    """
    label = "" if p.trial.recipe is recipe else p.trial.label
    return Dot(p.seconds, p.error, label, min(p.by_seed), p.most, p.trial.own)


def _diagram(s: StepTried) -> tuple[str, list[Line], float]:
    """Return the data of a step's diagram: title, a line for each changed property, and the
    reference's time in s.
    """
    names = dict.fromkeys(f.line for f in s.variants)
    lines = [
        Line(n, [Dot(f.seconds, f.error, f.label) for f in s.variants if f.line == n], n == USED)
        for n in names
    ]
    on = f"\non {s.found.cut_inputs}" if s.found.cut_inputs else ""
    return f"{s.step}\n{s.node}{on}", lines, s.found.reference


def _worst_output(p: WorkPrecisionPoint) -> str:
    return max(p.found.errors, key=lambda name: max(p.found.errors[name]))


def _mark(choice: ToleranceChoice, points: Points) -> Mark:
    if choice.held:
        return "pass"
    return "warn" if _beyond_rounding(choice, points) else "fail"
