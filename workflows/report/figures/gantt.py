"""Gantt chart with the predicted and the actual times of the steps of a run, by device and by step."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from neusee.workflows.placement.heft_schedule import Schedule
from neusee.workflows.report.figures.style import BLACK, BLUE, GREEN, ORANGE, VERMILION, canvas, drawn

Row = tuple[str, str, float, float]  #: step, device, start in s since the run began, duration in s
Spans = Mapping[str, tuple[str, float, float]]  #: device, start in s and duration in s of each step

_COLOURS = (BLUE, ORANGE, GREEN, "#CC79A7", "#56B4E9", "#8C6D1F", "#6A51A3", "#5F6B6D")
_MOST = 80  #: largest number of rows of steps; only the longest steps have a row
_MEASURED = 5  #: texts of the names and of the times that are measured to find the widest
_ASIDE, _ABOVE, _BELOW = 0.15, 0.56, 0.46  #: inches beside the names and times, above and below the axes
_MOST_BESIDE = 0.5  #: share of the width for names; longer ones make the picture wider
_BETWEEN = 0.06  #: space between the axes, as a share of their mean height
_STEP_HEIGHT, _LANE_HEIGHT = 0.2, 0.3  #: heights in inches of the row of a step and of the row of a device


@drawn
def timeline(*, schedule: Schedule, rows: Iterable[Row]) -> Any:
    """Draw a Gantt chart by device and by step, with hollow bars for predicted times and solid bars for actual times.

    ``rows``, the steps that ran, may lack steps of ``schedule`` and may contain further steps.
    """
    ran = {step: (lane, began, seconds) for step, lane, began, seconds in rows}
    plan = {slot.task: (slot.device, slot.start, slot.end - slot.start) for slot in schedule.slots}
    used = dict.fromkeys(lane for lane, _, _ in (*plan.values(), *ran.values()))
    lanes = [*(lane for lane in schedule.peak if lane in used), *(lane for lane in used if lane not in schedule.peak)]
    steps = _shown(plan, ran)
    end = max((start + took for _, start, took in (*plan.values(), *ran.values())), default=0.0) or 1.0
    scale, unit = _unit(end)
    heights = (_LANE_HEIGHT * max(len(lanes), 2) + 0.25, _STEP_HEIGHT * max(len(steps), 3) + 0.25)
    figure, axes = canvas(10.0, sum(heights) + 1.1, 2, 1, layout=None, sharex=True, height_ratios=heights)
    colour = dict(zip(lanes, itertools.cycle(_COLOURS), strict=False))
    _lanes(axes[0, 0], colour, plan, ran, scale)
    critical = {slot.task for slot in schedule.critical_path()}
    _steps(axes[1, 0], steps, plan, ran, colour, scale, critical)
    left = len(plan.keys() | ran.keys()) - len(steps)
    xlabel = f"time ({unit})" + (f"; the {left} shortest steps have no row" if left else "")
    axes[1, 0].set(xlabel=xlabel, xlim=(-0.004 * end * scale, end * scale * 1.01))
    axes[0, 0].set_title(_title(plan, ran), loc="left")
    _legend(figure)
    _place(figure, [*lanes, *steps])
    return figure


def _shown(plan: Spans, ran: Spans) -> list[str]:
    """Return the longest steps of a run, at most 80, in the order of their start."""
    longest = sorted({**plan, **ran}, key=lambda s: -max(plan.get(s, ("", 0, 0))[2], ran.get(s, ("", 0, 0))[2]))
    return sorted(longest[:_MOST], key=lambda s: (ran.get(s) or plan[s])[1])


def _lanes(ax: Any, colour: Mapping[str, str], plan: Spans, ran: Spans, scale: float) -> None:
    """Draw two rows of bars for each device: the predicted times of its steps above, the actual times below."""
    for y, lane in enumerate(colour):
        planned = [(start * scale, took * scale) for on, start, took in plan.values() if on == lane]
        done = [(start * scale, took * scale) for on, start, took in ran.values() if on == lane]
        ax.broken_barh(planned, (y - 0.4, 0.36), facecolor="white", edgecolor=colour[lane], linewidth=0.9)
        ax.broken_barh(done, (y + 0.04, 0.36), facecolor=colour[lane], edgecolor="white", linewidth=0.3)
    _rows(ax, list(colour))
    for tick, shade in zip(ax.get_yticklabels(), colour.values(), strict=True):
        tick.set(color=shade, fontweight="bold")


def _steps(
    ax: Any, steps: Sequence[str], plan: Spans, ran: Spans, colour: Mapping[str, str], scale: float, critical: set[str]
) -> None:
    """Draw one row for each step, and write the predicted and the actual duration of the step at the right."""
    right: dict[str, Any] = {"transform": ax.get_yaxis_transform(), "va": "center"}
    for y, step in enumerate(steps):
        if step in plan:
            lane, start, took = plan[step]
            _bar(ax, y, start * scale, took * scale, 0.74, fc="none", ec=colour[lane], zorder=3)
        if step in ran:
            lane, start, took = ran[step]
            _bar(ax, y, start * scale, took * scale, 0.4, fc=colour[lane], ec=colour[lane])
        times = (_time(spans[step][2]) if step in spans else "–" for spans in (plan, ran))
        ax.text(1.01, y, " → ".join(times), **right)
    ax.text(1.01, -1, "planned → took", fontweight="bold", **right)
    _rows(ax, steps)
    for tick, step in zip(ax.get_yticklabels(), steps, strict=True):
        tick.set_color(VERMILION if step in critical else BLACK)


def _bar(ax: Any, y: float, start: float, width: float, height: float, **look: Any) -> None:
    """Draw a bar whose row is in the limits of the axes, which are therefore not computed from the bars."""
    from matplotlib.patches import Rectangle

    ax.add_artist(Rectangle((start, y - height / 2), width, height, linewidth=0.9, **look))


def _place(figure: Any, names: Sequence[str]) -> None:
    """Place the axes in the figure: beside the longest names, and with room for title, legend and times.

    Only few texts are measured, so that this takes a tenth of the time of matplotlib's own placing.
    """
    renderer, (width, height) = figure.canvas.get_renderer(), figure.get_size_inches()
    top, bottom = figure.axes
    longest = sorted(names, key=len)[-_MEASURED:]
    labels = [t for ax in (top, bottom) for t in ax.get_yticklabels() if t.get_text() in longest]
    times = sorted(bottom.texts, key=lambda text: len(text.get_text()))[-_MEASURED:]
    left, right = (
        max((text.get_window_extent(renderer).width for text in texts), default=0.0) / figure.dpi
        for texts in (labels, times)
    )
    inner = {"left": min((left + _ASIDE) / width, _MOST_BESIDE), "right": 1 - (right + _ASIDE) / width}
    figure.subplots_adjust(**inner, top=1 - _ABOVE / height, bottom=_BELOW / height, hspace=_BETWEEN)


def _rows(ax: Any, names: Sequence[str]) -> None:
    ax.set_yticks(range(len(names)), names)
    ax.set_ylim(max(len(names), 1) - 0.4, -0.6)
    ax.tick_params(axis="y", length=0)
    ax.spines["left"].set_visible(False)
    ax.grid(False, axis="y")
    ax.set_axisbelow(True)
    if not names:
        ax.text(0.5, 0.5, "no step", transform=ax.transAxes, ha="center", va="center")


def _title(plan: Spans, ran: Spans) -> str:
    ends = {
        word: _time(max(start + took for _, start, took in spans.values()))
        for word, spans in (("planned", plan), ("took", ran))
        if spans
    }
    known = sum(step in plan for step in ran)
    if plan and known < len(ran):
        ends["planned"] += f" for {known} of {len(ran)} steps"
    return ", ".join(f"{word} {end}" for word, end in ends.items()) or "nothing to run"


def _unit(seconds: float) -> tuple[float, str]:
    """Return the unit (s, ms or µs) that suits the size of a time, as the factor from seconds and the name."""
    return (1.0, "s") if seconds >= 1.0 else (1e3, "ms") if seconds >= 1e-3 else (1e6, "µs")


def _time(seconds: float) -> str:
    scale, unit = _unit(seconds)
    return f"{seconds * scale:.3g} {unit}"


def _letter() -> Any:
    """Return a letter as a marker, without dollar signs, for which matplotlib first makes a parser of formulas."""
    from matplotlib.textpath import TextPath
    from matplotlib.transforms import Affine2D

    path = TextPath((0, 0), "a", size=10)
    box = path.get_extents()
    return path.transformed(Affine2D().translate(-(box.x0 + box.x1) / 2, -(box.y0 + box.y1) / 2))


def _legend(figure: Any) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles = [
        Patch(facecolor="white", edgecolor="#555555", label="planned"),
        Patch(facecolor="#555555", edgecolor="#555555", label="actual"),
        Line2D([], [], linestyle="none", marker=_letter(), color=VERMILION, label="on the planned critical path"),
    ]
    figure.legend(handles=handles, loc="upper center", ncols=3, handlelength=1.4)
