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
from neusee.workflows.report.study_report import Mark, Marked, Section
from neusee.workflows.studies.work_precision import (
    USED,
    Points,
    StepTried,
    ToleranceChoice,
    WorkPrecisionPoint,
    cheapest,
    median_ratio,
    pareto_front,
)

# --- accuracy figures -----------------------------------------------------------------------------

# Diagrams of the accuracy study: error against run time, and measured error against tolerance.


EXACT = 1e-9  #: smaller errors are drawn at this level, because a logarithmic axis has no 0
#: the same for the diagrams of single steps, some of which are in double precision
_STEP_EXACT = 1e-17
_COLOURS = (BLUE, ORANGE, GREEN, VERMILION, "#CC79A7", "#56B4E9", "#8B7500", "#555555")
_MARKERS = "osD^vP*X"
_GREY = "#777777"
_ENTRY = 2.1  #: inches, width of a legend entry


@dataclass(frozen=True)
class Dot:
    """A point of a diagram, with a run time, an error and a label."""

    seconds: float
    error: float
    label: str
    least: float | None = None  #: smallest error over the seeds, for an error bar
    most: float | None = None  #: largest error over the seeds
    own: bool = False  #: whether the recipe itself has this setting


Styles = Mapping[str, tuple[str, str]]  #: colour and marker by the name of a line
#: axes, lines, styles, `EXACT` or `_STEP_EXACT`
Diagram = tuple[Any, Sequence["Line"], Styles, float]


@dataclass(frozen=True)
class Line:
    """A line of a diagram, with one point for each setting of a parameter."""

    name: str
    dots: Sequence[Dot]
    strong: bool = False  #: whether the line is thicker than other lines


@drawn
def work_precision_diagram(
    lines: Sequence[Line], pareto_front: Sequence[tuple[float, float]], tolerance: float, title: str
) -> Any:
    """Draw error against run time: a line for each parameter, the Pareto front, and a ring at the
    recipe's own settings.
    """
    figure, axes = canvas(10.0, 7.0)
    ax = axes[0, 0]
    styles = _styles(line.name for line in lines)
    diagram = (ax, lines, styles, EXACT)
    _draw_diagram(diagram, errors=[tolerance])
    _ring_own_setting(ax, lines)
    if pareto_front:
        seconds, front_errors = zip(*pareto_front, strict=True)
        style = {"color": BLACK, "linewidth": 5.0, "alpha": 0.16, "zorder": 0}
        ax.step(
            seconds, np.maximum(front_errors, EXACT), where="post", label="Pareto front", **style
        )
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
    # number of rows, rounded up
    rows = -(-len(diagrams) // columns)
    styles = _styles(line.name for line in itertools.chain(*(lines for _, lines, _ in diagrams)))
    figure_width = 3.9 * columns + 0.4
    legend_columns = min(int(figure_width / _ENTRY), 1 + len(styles))
    # inches, 0.25 for each row of the legend
    legend_height = max(0.7, 0.25 * math.ceil((1 + len(styles)) / legend_columns))
    figure, axes = canvas(figure_width, 3.5 * rows + legend_height, rows, columns)
    scaled_diagrams: list[Diagram] = []
    for ax, (name, lines, reference) in zip(axes.flat, diagrams, strict=False):
        scaled = [
            replace(line, dots=[replace(dot, seconds=1e3 * dot.seconds) for dot in line.dots])
            for line in lines
        ]
        scaled_diagrams.append((ax, scaled, styles, _STEP_EXACT))
        _draw_diagram(scaled_diagrams[-1], seconds=[1e3 * reference])
        ax.axvline(1e3 * reference, color=_GREY, linestyle=":", label="reference of the step")
        ax.set_title(name)
        ax.set_xlabel("run time (ms)")
        ax.set_ylabel("error")
    # panels without a step
    for ax in list(axes.flat)[len(diagrams) :]:
        ax.set_axis_off()
    handles: dict[str, Any] = {}
    for ax in axes.flat:
        handles_of_axes, labels = ax.get_legend_handles_labels()
        handles |= dict(zip(labels, handles_of_axes, strict=True))
    figure.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=legend_columns
    )
    _place_labels(figure, scaled_diagrams)
    return figure


@drawn
def promises(
    asked: Sequence[float], measured: Mapping[str, Sequence[float]], stated: Sequence[float | None]
) -> Any:
    """Draw the measured error of each output, and the stated error, against the requested
    tolerance.
    """
    figure, axes = canvas(8.4, 5.0)
    ax = axes[0, 0]
    ax.loglog(asked, asked, color=BLACK, linewidth=1.2, label="error equal to the tolerance")
    bounds = [
        (tolerance, max(bound, EXACT))
        for tolerance, bound in zip(asked, stated, strict=True)
        if bound is not None
    ]
    if bounds:
        ax.loglog(*zip(*bounds, strict=True), color=_GREY, linestyle="--", label="stated error")
    for name, (colour, marker) in _styles(measured).items():
        style = {"color": colour, "marker": marker, "markersize": 6, "linewidth": 1.0}
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
    """Return colour and marker of each line; once all colours are used, they repeat with the next
    marker.
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
    drawn_errors = [max(dot.error, exact) for dot in dots] + [
        max(dot.most or dot.error, exact) for dot in dots
    ]
    # set limits first: with automatic limits matplotlib warns of errors that differ only in the
    # last digit. The arguments are the least ratio of both limits, and the margin factor.
    ax.set_xlim(*_axis_limits([*(dot.seconds for dot in dots), *seconds], 10.0, 1.5))
    ax.set_ylim(*_axis_limits([*drawn_errors, *errors], 100.0, 4.0))
    for line in lines:
        _draw(ax, line, *styles[line.name], exact)
    plain_ticks(ax.xaxis)
    _draw_exact_level(ax, [dot.error for dot in dots], exact)


def _dots(lines: Sequence[Line]) -> list[Dot]:
    """Return the dots of all lines."""
    return list(itertools.chain(*(line.dots for line in lines)))


def _axis_limits(values: Sequence[float], ratio: float, margin: float) -> tuple[float, float]:
    """Return the limits of a logarithmic axis: a margin around all values, and a ratio of at
    least ``ratio``.
    """
    least, greatest = min(values) / margin, max(values) * margin
    # on a logarithmic axis both ends move by the same factor
    widening = math.sqrt(max(1.0, ratio / (greatest / least)))
    return least / widening, greatest * widening


def _draw(ax: Any, line: Line, colour: str, mark: str, exact: float) -> None:
    """Draw one line with a marker at each point, and error bars from the smallest to the largest
    error.
    """
    errors = np.maximum([dot.error for dot in line.dots], exact)
    lower = np.maximum([dot.error if dot.least is None else dot.least for dot in line.dots], exact)
    upper = np.maximum([dot.error if dot.most is None else dot.most for dot in line.dots], exact)
    style = {"color": colour, "marker": mark, "markersize": 7, "capsize": 3, "label": line.name}
    style |= (
        {"linewidth": 2.0, "alpha": 1.0, "zorder": 3}
        if line.strong
        else {"linewidth": 0.9, "alpha": 0.75}
    )
    ax.errorbar(
        [dot.seconds for dot in line.dots],
        errors,
        yerr=np.maximum([errors - lower, upper - errors], 0.0),
        **{"zorder": 2} | style,
    )


def _ring_own_setting(ax: Any, lines: Sequence[Line]) -> None:
    """Draw a ring around the first dot with the recipe's own settings."""
    ring = {
        "marker": "o",
        "markersize": 17,
        "markerfacecolor": "none",
        "markeredgecolor": BLACK,
        "linestyle": "",
    }
    # all lines meet there, so that one ring is enough
    for dot in [d for d in _dots(lines) if d.own][:1]:
        position = [dot.seconds], [max(dot.error, EXACT)]
        ax.plot(*position, **ring, markeredgewidth=1.6, label="the recipe's own settings", zorder=4)


def _draw_exact_level(ax: Any, errors: Iterable[float], exact: float) -> None:
    """Draw a line with a note at the level ``exact`` if some errors are smaller and drawn there."""
    if any(error < exact for error in errors):
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
    """Write the label of each point where it covers no marker, note or other label."""
    labels: dict[Any, list[PointLabel]] = {}
    for ax, lines, styles, exact in diagrams:
        labels[ax] = []
        for line in lines:
            colour = styles[line.name][0]
            labels[ax] += [
                PointLabel(dot.seconds, max(dot.error, exact), dot.label, colour)
                for dot in line.dots
            ]
    place_labels(figure, labels)


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
_BUSY = 1.5  #: load per core above which run times are unreliable
#: factor on the error of the full computation, which is only one sample of its rounding error
_NO_WORSE = 2.0
_ABREAST = 6  #: largest number of outputs side by side in a table
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
    without: tuple[str, ...]  #: parameters that are not varied, with the reasons
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
    """Return the engine's choice for each tolerance, and the fastest measured setting within the
    tolerance.
    """
    measured = [point for point in points if point.sound]
    with_tolerances = ((point.trial.value, point) for point in measured)
    return [
        ToleranceChoice(value, point, cheapest(measured, value))
        for value, point in with_tolerances
        if value is not None
    ]


def count_missed(points: Points) -> int:
    """Return the number of tolerances that the measured error exceeds by more than the rounding
    error.
    """
    return sum(
        not choice.held and not _beyond_rounding(choice, points) for choice in choices(points)
    )


def lead(recipe: Recipe, points: Points) -> str:
    """Return the summary of the accuracy study in a few sentences."""
    sentences = [*_times(recipe, points), *_kept_tolerances(points)]
    load = max((point.found.load for point in points), default=0.0)
    if load > _BUSY:
        busy_text = f"The machine was busy with other work ({load:.1f} processes for each core)"
        sentences.append(f"{busy_text}: run times are too long and vary.")
    return " ".join(sentences)


def _times(recipe: Recipe, points: Points) -> Iterator[str]:
    """Yield sentences on the run times of the recipe and of the full computation."""
    own_point, full_point = _own(points), _whole(points)
    if own_point is None:
        return
    yield (
        f"With its own tolerance of {power_of_ten(recipe.tolerance)}, the recipe takes"
        f" {own_point.seconds:.3g} s; its largest error is {own_point.most:.2g}, at the output"
        f" {_worst_output(own_point)}."
    )
    if full_point is not None:
        ratio = full_point.seconds / own_point.seconds
        yield f"The full computation takes {full_point.seconds:.3g} s, {ratio:.1f} times as long."


def _kept_tolerances(points: Points) -> Iterator[str]:
    """Yield sentences on the number of tolerances held, and on the quality of the
    engine's choices.
    """
    full_computation, decisions = _whole(points), choices(points)
    yield f"{sum(choice.held for choice in decisions)} of {len(decisions)} tolerances were held."
    if full_computation is not None and (
        untestable := sum(_beyond_rounding(choice, points) for choice in decisions)
    ):
        yield (
            f"{untestable} cannot be tested: rounding gives the full computation itself an error of"
            f" {full_computation.most:.1g}."
        )
    if (ratio_of_times := median_ratio(decisions)) is not None:
        yield (
            f"At the median, the engine's choice takes {ratio_of_times:.2f} times as long as the"
            " cheapest setting."
        )


def _own(points: Points) -> WorkPrecisionPoint | None:
    """Return the point of the recipe's own settings, or None if it was not measured."""
    return next((point for point in points if point.trial.own and point.sound), None)


def _whole(points: Points) -> WorkPrecisionPoint | None:
    """Return the point of the full computation, or None if it was not measured."""
    return next((point for point in points if point.trial.line == KEEP_ALL and point.sound), None)


def _beyond_rounding(choice: ToleranceChoice, points: Points) -> bool:
    """Return True if the measured error exceeds the tolerance, but by at most the rounding
    error.
    """
    full_computation = _whole(points)
    rounding = _NO_WORSE * full_computation.most if full_computation else 0.0
    return not choice.held and choice.chosen.most <= choice.tolerance + rounding


def pictures(result: AccuracyResult) -> dict[str, bytes]:
    """Return the diagrams of the accuracy study's page by name, as PNG bytes."""
    images = {}
    sound = [point for point in result.points if point.sound]
    if sound:
        front = [(point.seconds, point.error) for point in pareto_front(sound)]
        title = f"{result.recipe.name}: error against run time"
        images["work_precision"] = work_precision_diagram(
            _lines(result.recipe, sound), front, result.recipe.tolerance, title
        )
    if engine_choices := choices(sound):
        images["promises"] = _promises(engine_choices)
    if measured_steps := [step for step in result.steps if step.variants]:
        images["steps"] = steps([_diagram(step) for step in measured_steps])
    return images


def _promises(asked: Sequence[ToleranceChoice]) -> bytes:
    """Return the diagram of measured against requested errors for the engine's choices."""
    measurements = [choice.chosen.found for choice in asked]
    measured = {
        name: [max(point.errors[name]) for point in measurements] for name in measurements[0].errors
    }
    bounds = [point.bound for point in measurements]
    picture: bytes = promises([c.tolerance for c in asked], measured, bounds)
    return picture


def sections(result: AccuracyResult, drawn: Mapping[str, bytes]) -> list[Section]:
    """Return the sections of the accuracy study's page; ``drawn`` maps names to the PNG bytes of
    diagrams.
    """
    seeds = _SEEDS.format(result.seeds) if result.seeds > 1 else _ONE_SEED
    if result.seeds > 1 and any(
        "poisson" in step.params.values() for step in result.recipe.steps.values()
    ):
        seeds += " " + _POISSON
    # the recipe's own setting of a parameter is the recipe itself
    without_repetition = [
        point for point in result.points if point.trial.recipe is not result.recipe
    ]
    return [
        _all_points(
            without_repetition, f"{_REFERENCE}\n\n{_TIME}\n\n{seeds}", drawn.get("work_precision")
        ),
        _chosen(result.points),
        *_outputs(without_repetition, drawn.get("promises")),
        _steps(result.steps, drawn.get("steps")),
        _not_varied(result),
    ]


def _all_points(points: Points, text: str, picture: bytes | None) -> Section:
    """Return the section with run time and errors of every point; a star marks the Pareto front."""
    columns = ["parameter", "setting", "run time, s", "of it computing, s"]
    columns += ["error", "least", "most", "stated", "worst output"]
    measured = [p for p in points if p.sound]
    # `id`, because points are not hashable
    front = {id(p) for p in pareto_front(measured)}
    rows = []
    for p in measured:
        setting = f"{p.trial.label}{' (the recipe)' * p.trial.own}{' *' * (id(p) in front)}"
        largest_cell = Marked(p.most)
        if p.trial.value is not None:
            largest_cell = Marked(p.most, _mark(ToleranceChoice(p.trial.value, p, None), points))
        times = (p.seconds, p.found.computing)
        errors = (p.error, min(p.by_seed), largest_cell, p.found.bound, _worst_output(p))
        rows.append((p.trial.line, setting, *times, *errors))
    text += """\n\nA star marks the Pareto front: no other point is both quicker and more accurate.
        The marks show whether a tolerance was held with every seed; an exclamation mark, that only
        rounding exceeds it."""
    return Section("Error against run time", text, columns, rows, picture)


def _chosen(points: Points) -> Section:
    """Return the section that compares the engine's choice for each tolerance with the fastest
    point.
    """
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
    for choice in choices(points):
        chosen_cells = (Marked(choice.chosen.most, _mark(choice, points)), choice.chosen.seconds)
        quickest_cells: tuple[Any, ...] = (None, None, None)
        if choice.cheapest:
            quickest_cells = (
                choice.cheapest.trial.name,
                choice.cheapest.most,
                choice.cheapest.seconds,
            )
        ratio = None
        if choice.ratio is not None:
            ratio = Marked(choice.ratio, "pass" if choice.ratio <= _FACTOR else "warn")
        rows.append((power_of_ten(choice.tolerance), *chosen_cells, *quickest_cells, ratio))
    text = f"""For each tolerance, the engine's choice and the quickest of all points above whose
        error is within the tolerance. A choice passes if it takes at most {_FACTOR:g} times as long
        as the quickest point."""
    return Section("Chosen against cheapest", text, columns, rows)


def _outputs(points: Points, picture: bytes | None) -> list[Section]:
    """Return sections with the errors of all outputs, in tables narrow enough for the page."""
    names = list(dict.fromkeys(itertools.chain(*(point.found.errors for point in points))))
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
        # only in the first table
        picture = None
    return parts


def _errors(points: Points, names: Sequence[str]) -> list[tuple[Any, ...]]:
    """Return a row for each point: parameter, setting, and the largest error of each
    named output.
    """
    return [
        (
            point.trial.line,
            point.trial.label,
            *(
                max(point.found.errors[output]) if output in point.found.errors else None
                for output in names
            ),
        )
        for point in points
        if point.sound
    ]


def _steps(tried: Sequence[StepTried], picture: bytes | None) -> Section:
    """Return the section with the variants of each slow step."""
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
    for step in tried:
        first_cells = (step.step, step.node, f"{100 * step.share:.1f} %")
        tried_on = step.found.cut_inputs or "its own inputs"
        rows += [
            (
                *first_cells,
                f"{variant.line} {variant.label}".strip(),
                variant.error,
                variant.seconds,
                step.found.reference,
                tried_on,
            )
            for variant in step.variants
        ]
        if step.found.refused:
            rows.append((*first_cells, f"not tried: {step.found.refused}", None, None, None, None))
    text = """Steps that take more than a hundredth of the run time of the full computation; for a
        step of several items, the slowest item. Each variant is compared with the node's reference,
        a direct computation in float64, on the step's own inputs. If that takes too long, all
        variants are timed and compared on a part of the inputs. `left out` returns the first input.
        Times are medians of repeated calls."""
    return Section("Step by step", text, columns, rows, picture)


def _not_varied(result: AccuracyResult) -> Section:
    """Return the section on settings that could not be varied, with the reasons."""
    # texts such as "bands: this recipe has no such value"
    rows = [
        (knob, "", reason) for knob, _, reason in (text.partition(": ") for text in result.without)
    ]
    rows += [
        (point.trial.line, point.trial.label, point.found.refused)
        for point in result.points
        if point.found.refused
    ]
    missing = "Parameters that this recipe does not have, and settings that are not possible."
    text = missing if rows else "Every parameter could be varied."
    return Section("Not varied", text, ("parameter", "setting", "why"), rows)


def table(result: AccuracyResult) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of ``table.csv``: one for each measured error, and one for each setting
    that was not possible.
    """
    for point in result.points:
        first_cells = ("recipe", point.trial.line, point.trial.label)
        if point.found.refused:
            # empty from "output" to "stated", then the reason
            yield (*first_cells, *[""] * 6, point.found.refused)
        for name, errors in point.found.errors.items():
            for seed, error in enumerate(errors):
                yield (
                    *first_cells,
                    name,
                    seed,
                    error,
                    point.seconds,
                    point.found.computing,
                    point.found.bound,
                    "",
                )
    for step in result.steps:
        for variant in step.variants:
            yield (
                f"step {step.step}",
                variant.line,
                variant.label,
                step.found.cut_inputs,
                "",
                variant.error,
                variant.seconds,
                "",
                "",
                "",
            )
        if step.found.refused:
            yield (f"step {step.step}", step.node, *[""] * 7, step.found.refused)


def _lines(recipe: Recipe, points: Points) -> list[Line]:
    """Return a line of dots for each varied parameter; the one for the tolerance is thicker."""
    varied = dict.fromkeys(point.trial.line for point in points if point.trial.recipe is not recipe)
    of_line = {
        name: [_dot(point, recipe) for point in points if point.trial.line == name]
        for name in varied
    }
    return [Line(name, dots, strong=name == TOLERANCE) for name, dots in of_line.items()]


def _dot(p: WorkPrecisionPoint, recipe: Recipe) -> Dot:
    """Return the dot of a measured setting; it has no label at the recipe's own settings, where all
    lines meet.
    """
    label = "" if p.trial.recipe is recipe else p.trial.label
    return Dot(p.seconds, p.error, label, min(p.by_seed), p.most, p.trial.own)


def _diagram(s: StepTried) -> tuple[str, list[Line], float]:
    """Return title, lines (one for each changed property) and reference time in s of a step's
    diagram.
    """
    names = dict.fromkeys(variant.line for variant in s.variants)
    lines = [
        Line(
            line_name,
            [
                Dot(variant.seconds, variant.error, variant.label)
                for variant in s.variants
                if variant.line == line_name
            ],
            line_name == USED,
        )
        for line_name in names
    ]
    tried_on = f"\non {s.found.cut_inputs}" if s.found.cut_inputs else ""
    return f"{s.step}\n{s.node}{tried_on}", lines, s.found.reference


def _worst_output(p: WorkPrecisionPoint) -> str:
    return max(p.found.errors, key=lambda name: max(p.found.errors[name]))


def _mark(choice: ToleranceChoice, points: Points) -> Mark:
    if choice.held:
        return "pass"
    return "warn" if _beyond_rounding(choice, points) else "fail"
