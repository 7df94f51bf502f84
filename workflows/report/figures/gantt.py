"""Gantt chart of the planned and the actual times of the steps, by lane and by step."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from neusee.workflows.placement.heft_and_cpop import Schedule
from neusee.workflows.report.figures.style import BLACK, BLUE, GREEN, ORANGE, VERMILION, canvas, drawn

Row = tuple[str, str, float, float]  #: step, lane, start in s since the run began, duration in s
Span = tuple[str, float, float]  #: lane, start in s, duration in s

_COLOURS = (BLUE, ORANGE, GREEN, "#CC79A7", "#56B4E9", "#8C6D1F", "#6A51A3", "#5F6B6D")
_MOST = 80  #: rows of steps, at most; of more steps, the longest have a row
_TALL = 0.2  #: inches, height of the row of a step
_LANE = 0.3  #: inches, height of the row of a lane


@drawn
def timeline(*, schedule: Schedule, rows: Iterable[Row]) -> Any:
    """Draw lanes above and steps below: hollow bars show the plan, solid bars show the run; both begin at 0 s.

    ``rows`` may lack steps of the plan, and may have steps that the plan lacks.
    """
    ran = {step: (lane, began, seconds) for step, lane, began, seconds in rows}
    plan = {slot.task: (slot.device, slot.start, slot.end - slot.start) for slot in schedule.slots}
    lanes = list(dict.fromkeys([*schedule.peak, *(lane for lane, _, _ in ran.values())]))
    lanes = [lane for lane in lanes if any(span[0] == lane for span in (*plan.values(), *ran.values()))]
    steps = _shown(plan, ran)
    end = max((start + took for _, start, took in (*plan.values(), *ran.values())), default=0.0) or 1.0
    scale, unit = next((s, u) for least, s, u in ((1.0, 1.0, "s"), (1e-3, 1e3, "ms"), (0.0, 1e6, "µs")) if end >= least)
    high = (_LANE * max(len(lanes), 2) + 0.25, _TALL * max(len(steps), 3) + 0.25)
    figure, axes = canvas(10.0, sum(high) + 1.1, 2, 1, sharex=True, height_ratios=high)
    colour = {lane: _COLOURS[i % len(_COLOURS)] for i, lane in enumerate(lanes)}
    _lanes(axes[0, 0], lanes, plan, ran, colour, scale)
    critical = {slot.task for slot in schedule.critical_path()}
    _steps(axes[1, 0], steps, plan, ran, colour, scale, critical)
    left = len(plan.keys() | ran.keys()) - len(steps)
    axes[1, 0].set_xlabel(f"time ({unit})" + (f"; the {left} shortest steps have no row" if left else ""))
    axes[1, 0].set_xlim(-0.004 * end * scale, end * scale * 1.01)
    axes[0, 0].set_title(_title(plan, ran), loc="left")
    _legend(figure)
    return figure


def _shown(plan: Mapping[str, Span], ran: Mapping[str, Span]) -> list[str]:
    """Return the steps in the order of their start; of more than ``_MOST`` steps, return only the longest."""
    longest = sorted({**plan, **ran}, key=lambda s: -max(plan.get(s, ("", 0, 0))[2], ran.get(s, ("", 0, 0))[2]))
    return sorted(longest[:_MOST], key=lambda s: (ran.get(s) or plan[s])[1])


def _lanes(
    ax: Any,
    lanes: Sequence[str],
    plan: Mapping[str, Span],
    ran: Mapping[str, Span],
    colour: Mapping[str, str],
    scale: float,
) -> None:
    """Draw two rows for each lane: the plan above, the run below."""
    for y, lane in enumerate(lanes):
        planned = [(start * scale, took * scale) for on, start, took in plan.values() if on == lane]
        done = [(start * scale, took * scale) for on, start, took in ran.values() if on == lane]
        ax.broken_barh(planned, (y - 0.4, 0.36), facecolor="white", edgecolor=colour[lane], linewidth=0.9)
        ax.broken_barh(done, (y + 0.04, 0.36), facecolor=colour[lane], edgecolor="white", linewidth=0.3)
    _rows(ax, lanes)
    for tick, lane in zip(ax.get_yticklabels(), lanes, strict=True):
        tick.set_color(colour[lane])
        tick.set_fontweight("bold")


def _steps(
    ax: Any,
    steps: Sequence[str],
    plan: Mapping[str, Span],
    ran: Mapping[str, Span],
    colour: Mapping[str, str],
    scale: float,
    critical: set[str],
) -> None:
    """Draw one row for each step, and write the planned and the actual duration at the right."""
    for y, step in enumerate(steps):
        if step in plan:
            lane, start, took = plan[step]
            ax.barh(
                y, took * scale, 0.74, start * scale, facecolor="none", edgecolor=colour[lane], linewidth=0.9, zorder=3
            )
        if step in ran:
            lane, start, took = ran[step]
            ax.barh(y, took * scale, 0.4, start * scale, facecolor=colour[lane], edgecolor=colour[lane], linewidth=0.9)
        ax.annotate(_said(plan.get(step), ran.get(step)), (1.01, y), xycoords=("axes fraction", "data"), va="center")
    ax.annotate("planned → took", (1.01, -1), xycoords=("axes fraction", "data"), va="center", fontweight="bold")
    _rows(ax, steps)
    for tick, step in zip(ax.get_yticklabels(), steps, strict=True):
        tick.set_color(VERMILION if step in critical else BLACK)


def _rows(ax: Any, names: Sequence[str]) -> None:
    ax.set_yticks(range(len(names)), names)
    ax.set_ylim(max(len(names), 1) - 0.4, -0.6)
    ax.tick_params(axis="y", length=0)
    ax.spines["left"].set_visible(False)
    ax.grid(False, axis="y")
    ax.set_axisbelow(True)


def _said(plan: Span | None, ran: Span | None) -> str:
    return " → ".join(_time(span[2]) if span else "–" for span in (plan, ran))


def _title(plan: Mapping[str, Span], ran: Mapping[str, Span]) -> str:
    ends = [max((start + took for _, start, took in spans.values()), default=None) for spans in (plan, ran)]
    said = [f"{word} {_time(end)}" for word, end in zip(("planned", "took"), ends, strict=True) if end is not None]
    return ", ".join(said) or "nothing to run"


def _time(seconds: float) -> str:
    """Return seconds with three digits and a fitting unit, such as ``12.3 ms``."""
    for least, scale, unit in ((1.0, 1.0, "s"), (1e-3, 1e3, "ms")):
        if seconds >= least:
            return f"{seconds * scale:.3g} {unit}"
    return f"{seconds * 1e6:.3g} µs"


def _legend(figure: Any) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles = [
        Patch(facecolor="white", edgecolor="#555555", label="planned"),
        Patch(facecolor="#555555", edgecolor="#555555", label="actual"),
        Line2D([], [], linestyle="none", marker="$\\mathrm{a}$", color=VERMILION, label="on the planned critical path"),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=3, handlelength=1.4)
