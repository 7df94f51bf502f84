"""Figures of the steps of a run: the graph, and the planned and actual times."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from neusee.workflows.graph.recipe_graph import in_order
from neusee.workflows.placement.heft_schedule import Schedule
from neusee.workflows.report.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    VERMILION,
    canvas,
    drawn,
)

# --- recipe graph ---------------------------------------------------------------------------------

# Figure of the graph of a recipe: one box for each step, in the colour of its state: run, cached or
# left out.


#: fill colour and legend text of each state; a dashed outline marks a left-out step without colour
LOOKS = {
    "run": ("#F7C9A9", "run"),
    "cached": ("#BFDDF0", "from the cache"),
    "left out": ("#FFFFFF", "left out: within the tolerance"),
}
_WIDTH, _HEIGHT = 1.75, 0.66  #: inches, space for a box
_INSIDE = 0.92  #: width of a box, as a share of its space
_LETTER = 5.7  #: points, mean width of a letter in a box


@drawn
def graph(*, sources: Mapping[str, Iterable[str]], states: Mapping[str, str]) -> Any:
    """Draw the graph of a recipe: a box for each step, below the boxes of the steps whose
    results the step reads.
    """
    wires, looks, counts = grouped(sources, states)
    positions = layout(wires)
    columns = max((column for column, _ in positions.values()), default=0.0) + 1
    rows = max((row for _, row in positions.values()), default=0) + 1
    figure_width = min(max(_WIDTH * columns, 6.0), 15.0)
    # letters that fit into a box, at 72 points an inch
    letters = int(72 * _INSIDE * (figure_width - 0.2) / columns / _LETTER)
    figure, axes = canvas(figure_width, _HEIGHT * rows + 0.7)
    ax = axes[0, 0]
    for name, sources_of_step in wires.items():
        for source in sources_of_step:
            _edge(ax, positions[source], positions[name])
    for name, (column, row) in positions.items():
        text = broken(name, letters, f" ×{counts[name]}" if counts[name] > 1 else "")
        _box(ax, column, row, text, looks[name])
    ax.set(xlim=(-0.6, columns - 0.4), ylim=(rows - 0.5, -0.5))
    ax.axis("off")
    _legend(figure, looks.values())
    return figure


def grouped(
    sources: Mapping[str, Iterable[str]], states: Mapping[str, str]
) -> tuple[dict[str, list[str]], dict[str, str], Counter[str]]:
    """Return the sources, the state and the number of copies (such as ``psf[mask]``) of each step
    of a recipe.

    The state is ``run`` if any copy of the step ran.
    """
    family = {name: name.partition("[")[0] for name in sources}
    wires: dict[str, list[str]] = {family_name: [] for family_name in family.values()}
    looks: dict[str, str] = {}
    for name, step_sources in sources.items():
        own_family = family[name]
        wires[own_family] += [
            family_name
            for family_name in dict.fromkeys(family[source_name] for source_name in step_sources)
            if family_name not in (*wires[own_family], own_family)
        ]
        state = states[name] if states.get(name) in LOOKS else "cached"
        # run if any copy ran
        looks[own_family] = "run" if "run" in (state, looks.get(own_family)) else state
    return wires, looks, Counter(family.values())


def layout(wires: Mapping[str, list[str]]) -> dict[str, tuple[float, int]]:
    """Return the position (x, row) of each step in the figure of a graph, below and near the
    sources of the step.
    """
    row_of_step = _depths(wires)
    rows: dict[int, list[str]] = {}
    for name, row in row_of_step.items():
        rows.setdefault(row, []).append(name)
    widest = max((len(row_steps) for row_steps in rows.values()), default=1)
    positions: dict[str, tuple[float, int]] = {}
    for row in sorted(rows):
        # the mean of the sources, else the middle of the figure
        wished_x = {
            step: _mean(
                [positions[source][0] for source in wires[step] if source in positions],
                (widest - 1) / 2,
            )
            for step in rows[row]
        }
        names = sorted(rows[row], key=lambda n: wished_x[n])
        # as near to the wishes as the widest row allows
        first_x = min(
            max(_mean(list(wished_x.values()), 0.0) - (len(names) - 1) / 2, 0.0),
            widest - len(names),
        )
        positions |= {name: (first_x + position, row) for position, name in enumerate(names)}
    return positions


def _depths(wires: Mapping[str, list[str]]) -> dict[str, int]:
    """Return the row of each step in the figure of a graph, just above the first step that reads
    the result.
    """
    order = in_order(wires, wires)
    depth: dict[str, int] = {}
    for name in order:
        # below all sources
        depth[name] = max((depth[source] + 1 for source in wires[name]), default=0)
    first_reader_row: dict[str, int] = {}
    for name in reversed(order):
        # as far down as the first reader allows
        depth[name] = first_reader_row.get(name, depth[name] + 1) - 1
        for source in wires[name]:
            first_reader_row[source] = min(first_reader_row.get(source, depth[name]), depth[name])
    return depth


def _mean(values: list[float], other: float) -> float:
    """Return the mean of values, or ``other`` if there are none."""
    return sum(values) / len(values) if values else other


def _edge(ax: Any, start: tuple[float, int], end: tuple[float, int]) -> None:
    """Draw the arrow from a step to one that reads it, bent where it passes other rows."""
    from matplotlib.patches import FancyArrowPatch

    curvature = 0.12 if end[0] <= start[0] else -0.12
    # neighbouring rows: nothing to pass
    if end[1] - start[1] == 1:
        curvature = 0.0
    arrow_style: dict[str, Any] = {
        "connectionstyle": f"arc3,rad={curvature}",
        "arrowstyle": "-|>",
        "mutation_scale": 9,
    }
    # from the lower edge of a box to the upper edge of the next
    start_point, end_point = (start[0], start[1] + 0.27), (end[0], end[1] - 0.27)
    ax.add_artist(
        FancyArrowPatch(
            start_point,
            end_point,
            color="#8a8a8a",
            linewidth=0.9,
            shrinkA=0,
            shrinkB=0,
            zorder=1,
            **arrow_style,
        )
    )


def _box(ax: Any, x: float, y: float, text: str, look: str) -> None:
    """Draw the box of a step with its name, in the colours of its state."""
    from matplotlib.patches import FancyBboxPatch

    style: dict[str, Any] = {
        "boxstyle": "round,pad=0.0,rounding_size=0.08",
        "mutation_aspect": 1.6,
        "zorder": 2,
    }
    style |= {
        "facecolor": LOOKS[look][0],
        "edgecolor": "#444444",
        "linestyle": "--" if look == "left out" else "-",
    }
    ax.add_artist(FancyBboxPatch((x - _INSIDE / 2, y - 0.26), _INSIDE, 0.52, **style))
    ax.text(x, y, text, ha="center", va="center", fontsize=9.5, zorder=3, linespacing=1.15)


def broken(name: str, letters: int, copies: str = "") -> str:
    """Return the name of a step on at most two lines of ``letters``, shortened in the middle if
    it is still longer.
    """
    if len(name + copies) <= letters:
        return name + copies
    # after a sign between words, else in the middle of a word
    cuts = [
        position + 1
        for position, character in enumerate(name[:-1])
        if character in "_. " and position < letters
    ]
    cut_position = cuts[-1] if cuts else letters
    room = max(letters - len(copies), 3)
    first_line, second_line = name[:cut_position].rstrip(), name[cut_position:]
    if len(second_line) > room:
        second_line = f"{second_line[: room // 2]}…{second_line[-(room - room // 2 - 1) :]}"
    return f"{first_line}\n{second_line}{copies}"


def _legend(figure: Any, looks: Iterable[str]) -> None:
    """Write the legend of the states that occur."""
    from matplotlib.patches import Patch

    states = [state for state in LOOKS if state in set(looks)]
    patches = [
        Patch(facecolor=LOOKS[state][0], edgecolor="#444444", label=LOOKS[state][1])
        for state in states
    ]
    figure.legend(handles=patches, loc="outside upper center", ncols=len(patches), fontsize=10)


# --- gantt ----------------------------------------------------------------------------------------

# Gantt chart with the predicted and the actual times of the steps of a run, by device and by step.


Row = tuple[str, str, float, float]  #: step, device, start in s since the run began, duration in s
Spans = Mapping[str, tuple[str, float, float]]  #: device, start in s and duration in s of each step

_COLOURS = (BLUE, ORANGE, GREEN, "#CC79A7", "#56B4E9", "#8C6D1F", "#6A51A3", "#5F6B6D")
_MOST_ROWS = 80  #: largest number of rows of steps; only the longest steps have a row
_MEASURED = 5  #: texts of the names and of the times that are measured to find the widest
#: inches beside the names and times, above and below the axes
_ASIDE, _ABOVE, _BELOW = 0.15, 0.56, 0.46
_LARGEST_NAME_SHARE = 0.5  #: share of the width for names; longer ones make the picture wider
_BETWEEN = 0.06  #: space between the axes, as a share of their mean height
#: heights in inches of the row of a step and of the row of a device
_STEP_HEIGHT, _LANE_HEIGHT = 0.2, 0.3


class _Chart(NamedTuple):
    """Times and colours of the bars of a Gantt chart."""

    plan: Spans
    ran: Spans
    colour: Mapping[str, str]  #: of each lane
    scale: float  #: of a second, in the unit of the axis


@drawn
def timeline(*, schedule: Schedule, rows: Iterable[Row]) -> Any:
    """Draw a Gantt chart by device and by step, with hollow bars for predicted times and solid bars
    for actual times.

    ``rows``, the steps that ran, may lack steps of ``schedule`` and may contain further steps.
    """
    actual_spans = {step: (lane, began, seconds) for step, lane, began, seconds in rows}
    planned_spans = {
        slot.task: (slot.device, slot.start, slot.end - slot.start) for slot in schedule.slots
    }
    lanes = _lanes_in_use(schedule, planned_spans, actual_spans)
    steps = _shown(planned_spans, actual_spans)
    spans = (*planned_spans.values(), *actual_spans.values())
    last_end = max((start + duration for _, start, duration in spans), default=0.0) or 1.0
    scale, unit = _unit(last_end)
    heights = (_LANE_HEIGHT * max(len(lanes), 2) + 0.25, _STEP_HEIGHT * max(len(steps), 3) + 0.25)
    figure, axes = canvas(
        10.0, sum(heights) + 1.1, 2, 1, layout=None, sharex=True, height_ratios=heights
    )
    colour = dict(zip(lanes, itertools.cycle(_COLOURS), strict=False))
    chart = _Chart(planned_spans, actual_spans, colour, scale)
    _lanes(axes[0, 0], chart)
    critical = {slot.task for slot in schedule.critical_path()}
    _steps(axes[1, 0], steps, chart, critical)
    steps_without_row = len(planned_spans.keys() | actual_spans.keys()) - len(steps)
    xlabel = f"time ({unit})" + (
        f"; the {steps_without_row} shortest steps have no row" if steps_without_row else ""
    )
    axes[1, 0].set(xlabel=xlabel, xlim=(-0.004 * last_end * scale, last_end * scale * 1.01))
    axes[0, 0].set_title(_title(planned_spans, actual_spans), loc="left")
    _gantt_legend(figure)
    _place(figure, [*lanes, *steps])
    return figure


def _lanes_in_use(schedule: Schedule, plan: Spans, ran: Spans) -> list[str]:
    """Return the lanes (devices) of planned and of actual steps, those of the schedule first."""
    in_use = dict.fromkeys(lane for lane, _, _ in (*plan.values(), *ran.values()))
    return [
        *(lane for lane in schedule.peak if lane in in_use),
        *(lane for lane in in_use if lane not in schedule.peak),
    ]


def _shown(plan: Spans, ran: Spans) -> list[str]:
    """Return the longest steps of a run, at most 80, in the order of their start."""
    longest = sorted(
        # element 2 is the duration, element 1 the start
        {**plan, **ran},
        key=lambda s: -max(plan.get(s, ("", 0, 0))[2], ran.get(s, ("", 0, 0))[2]),
    )
    return sorted(longest[:_MOST_ROWS], key=lambda s: (ran.get(s) or plan[s])[1])


def _lanes(ax: Any, chart: _Chart) -> None:
    """Draw two rows of bars for each device: the predicted times of its steps above, the actual
    times below.
    """
    plan, ran, colour, scale = chart
    for y, lane in enumerate(colour):
        planned_bars = [
            (start * scale, duration * scale)
            for lane_of_step, start, duration in plan.values()
            if lane_of_step == lane
        ]
        actual = [
            (start * scale, duration * scale)
            for lane_of_step, start, duration in ran.values()
            if lane_of_step == lane
        ]
        ax.broken_barh(
            planned_bars, (y - 0.4, 0.36), facecolor="white", edgecolor=colour[lane], linewidth=0.9
        )
        ax.broken_barh(
            actual, (y + 0.04, 0.36), facecolor=colour[lane], edgecolor="white", linewidth=0.3
        )
    _rows(ax, list(colour))
    for tick, shade in zip(ax.get_yticklabels(), colour.values(), strict=True):
        tick.set(color=shade, fontweight="bold")


def _steps(ax: Any, steps: Sequence[str], chart: _Chart, critical: set[str]) -> None:
    """Draw one row for each step, and write the predicted and the actual duration of the step at
    the right.
    """
    plan, ran, colour, scale = chart
    beside_the_axes: dict[str, Any] = {"transform": ax.get_yaxis_transform(), "va": "center"}
    for y, step in enumerate(steps):
        if step in plan:
            lane, start, duration = plan[step]
            _bar(ax, y, start * scale, duration * scale, 0.74, fc="none", ec=colour[lane], zorder=3)
        if step in ran:
            lane, start, duration = ran[step]
            _bar(ax, y, start * scale, duration * scale, 0.4, fc=colour[lane], ec=colour[lane])
        times = (_time(spans[step][2]) if step in spans else "–" for spans in (plan, ran))
        ax.text(1.01, y, " → ".join(times), **beside_the_axes)
    ax.text(1.01, -1, "planned → took", fontweight="bold", **beside_the_axes)
    _rows(ax, steps)
    for tick, step in zip(ax.get_yticklabels(), steps, strict=True):
        tick.set_color(VERMILION if step in critical else BLACK)


def _bar(ax: Any, y: float, start: float, width: float, height: float, **look: Any) -> None:
    """Draw a bar without adjusting the limits of the axes, which are set to contain all bars."""
    from matplotlib.patches import Rectangle

    ax.add_artist(Rectangle((start, y - height / 2), width, height, linewidth=0.9, **look))


def _place(figure: Any, names: Sequence[str]) -> None:
    """Place the axes in the figure: beside the longest names, and with room for title, legend and
    times.

    Only few texts are measured, so that this takes a tenth of the time of matplotlib's own placing.
    """
    renderer, (width, height) = figure.canvas.get_renderer(), figure.get_size_inches()
    device_axis, step_axis = figure.axes
    longest = sorted(names, key=len)[-_MEASURED:]
    names_beside = [*device_axis.get_yticklabels(), *step_axis.get_yticklabels()]
    labels = [label for label in names_beside if label.get_text() in longest]
    times = sorted(step_axis.texts, key=lambda text: len(text.get_text()))[-_MEASURED:]
    name_width, time_width = (
        max((label.get_window_extent(renderer).width for label in texts), default=0.0) / figure.dpi
        for texts in (labels, times)
    )
    sides = {
        "left": min((name_width + _ASIDE) / width, _LARGEST_NAME_SHARE),
        "right": 1 - (time_width + _ASIDE) / width,
    }
    figure.subplots_adjust(
        **sides, top=1 - _ABOVE / height, bottom=_BELOW / height, hspace=_BETWEEN
    )


def _rows(ax: Any, names: Sequence[str]) -> None:
    """Label the rows of an axis, the first at the top."""
    ax.set_yticks(range(len(names)), names)
    ax.set_ylim(max(len(names), 1) - 0.4, -0.6)
    ax.tick_params(axis="y", length=0)
    ax.spines["left"].set_visible(False)
    ax.grid(False, axis="y")
    ax.set_axisbelow(True)
    if not names:
        ax.text(0.5, 0.5, "no step", transform=ax.transAxes, ha="center", va="center")


def _title(plan: Spans, ran: Spans) -> str:
    """Return the end times of the planned and of the actual run as text."""
    times_by_word = {
        word: _time(max(start + duration for _, start, duration in spans.values()))
        for word, spans in (("planned", plan), ("took", ran))
        if spans
    }
    predicted = sum(step in plan for step in ran)
    if plan and predicted < len(ran):
        times_by_word["planned"] += f" for {predicted} of {len(ran)} steps"
    return ", ".join(f"{word} {end}" for word, end in times_by_word.items()) or "nothing to run"


def _unit(seconds: float) -> tuple[float, str]:
    """Return the unit (s, ms or µs) that suits the size of a time, as the factor from seconds
    and the name.
    """
    if seconds >= 1.0:
        return 1.0, "s"
    return (1e3, "ms") if seconds >= 1e-3 else (1e6, "µs")


def _time(seconds: float) -> str:
    """Return a time as text, in s, ms or us."""
    scale, unit = _unit(seconds)
    return f"{seconds * scale:.3g} {unit}"


def _letter() -> Any:
    """Return the letter a as a marker; a text in dollar signs would make matplotlib build a parser
    of formulas first.
    """
    from matplotlib.textpath import TextPath
    from matplotlib.transforms import Affine2D

    path = TextPath((0, 0), "a", size=10)
    box = path.get_extents()
    return path.transformed(Affine2D().translate(-(box.x0 + box.x1) / 2, -(box.y0 + box.y1) / 2))


def _gantt_legend(figure: Any) -> None:
    """Write the legend of the chart: hollow and solid bars, and the colour of the critical path."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles = [
        Patch(facecolor="white", edgecolor="#555555", label="planned"),
        Patch(facecolor="#555555", edgecolor="#555555", label="actual"),
        Line2D(
            [],
            [],
            linestyle="none",
            marker=_letter(),
            color=VERMILION,
            label="on the planned critical path",
        ),
    ]
    figure.legend(handles=handles, loc="upper center", ncols=3, handlelength=1.4)
