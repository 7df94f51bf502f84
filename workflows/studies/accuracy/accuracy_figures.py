"""Diagrams of the accuracy study: error against run time, and measured error against tolerance."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from neusee.workflows.report.figures.point_labels import PointLabel, place_labels, plain_ticks
from neusee.workflows.report.figures.style import BLACK, BLUE, GREEN, ORANGE, VERMILION, canvas, drawn

EXACT = 1e-9  #: the level at which smaller errors are drawn, because a logarithmic axis has no 0
_STEP_EXACT = 1e-17  #: the same level in the diagrams of single steps, some of which are in double precision
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
Diagram = tuple[Any, Sequence["Line"], Styles, float]  #: axes, lines, styles, `EXACT` or `_STEP_EXACT`


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
    """Draw error against run time: a line for each parameter, the Pareto front, and a ring at the recipe's settings."""
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
    ax.axhline(tolerance, color=VERMILION, linestyle="--", linewidth=1.2, label="tolerance of the recipe")
    ax.set_title(title)
    ax.set_xlabel("run time (s)")
    ax.set_ylabel("error: rms over the largest element of the reference")
    figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    _place_labels(figure, [diagram])
    return figure


@drawn
def steps(diagrams: Sequence[tuple[str, Sequence[Line], float]]) -> Any:
    """Draw error against run time in ms for each step, with a dotted line at the time of the reference node."""
    columns = min(3, len(diagrams))
    rows = -(-len(diagrams) // columns)
    styles = _styles(line.name for _, lines, _ in diagrams for line in lines)
    width = 3.9 * columns + 0.4
    across = min(int(width / _ENTRY), 1 + len(styles))
    below = max(0.7, 0.25 * math.ceil((1 + len(styles)) / across))
    figure, axes = canvas(width, 3.5 * rows + below, rows, columns)
    shown: list[Diagram] = []
    for ax, (name, lines, reference) in zip(axes.flat, diagrams, strict=False):
        scaled = [replace(line, dots=[replace(d, seconds=1e3 * d.seconds) for d in line.dots]) for line in lines]
        shown.append((ax, scaled, styles, _STEP_EXACT))
        _draw_diagram(shown[-1], seconds=[1e3 * reference])
        ax.axvline(1e3 * reference, color=_GREY, linestyle=":", label="reference of the step")
        ax.set_title(name)
        ax.set_xlabel("run time (ms)")
        ax.set_ylabel("error")
    for ax in list(axes.flat)[len(diagrams) :]:
        ax.set_axis_off()
    handles = {label: h for ax in axes.flat for h, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=across)
    _place_labels(figure, shown)
    return figure


@drawn
def promises(asked: Sequence[float], measured: Mapping[str, Sequence[float]], stated: Sequence[float | None]) -> Any:
    """Draw the measured error of each output and the stated error against the requested tolerance."""
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
    _draw_exact_level(ax, [e for errors in measured.values() for e in errors], EXACT)
    ax.set_ylim(bottom=min(ax.get_ylim()[0], EXACT / 5))
    figure.legend(*ax.get_legend_handles_labels(), loc="outside right upper")
    return figure


def _styles(names: Iterable[str]) -> Styles:
    """Return colour and marker of each line; when all colours are used, each begins again with the next marker."""
    count = len(_COLOURS)
    looks = ((_COLOURS[i % count], _MARKERS[(i + i // count) % count]) for i in itertools.count())
    return dict(zip(dict.fromkeys(names), looks, strict=False))


def _draw_diagram(diagram: Diagram, errors: Sequence[float] = (), seconds: Sequence[float] = ()) -> None:
    """Draw the lines of a diagram on logarithmic axes whose limits also include ``errors`` and ``seconds``."""
    ax, lines, styles, exact = diagram
    ax.set_xscale("log")
    ax.set_yscale("log")
    dots = [d for line in lines for d in line.dots]
    y = [max(e, exact) for d in dots for e in (d.error, d.most or d.error)]
    # set limits first: with automatic limits, matplotlib warns of errors that differ in the last digit only
    ax.set_xlim(*_axis_limits([*(d.seconds for d in dots), *seconds], 10.0, 1.5))
    ax.set_ylim(*_axis_limits([*y, *errors], 100.0, 4.0))
    for line in lines:
        _draw(ax, line, *styles[line.name], exact)
    plain_ticks(ax.xaxis)
    _draw_exact_level(ax, [d.error for d in dots], exact)


def _axis_limits(values: Sequence[float], least: float, margin: float) -> tuple[float, float]:
    """Return the limits of a logarithmic axis: a margin around all values, and a ratio of at least ``least``."""
    low, high = min(values) / margin, max(values) * margin
    wider = math.sqrt(max(1.0, least / (high / low)))
    return low / wider, high * wider


def _draw(ax: Any, line: Line, colour: str, mark: str, exact: float) -> None:
    """Draw one line with a marker at each point, and error bars from the smallest to the largest error of the point."""
    y = np.maximum([d.error for d in line.dots], exact)
    least = np.maximum([d.error if d.least is None else d.least for d in line.dots], exact)
    most = np.maximum([d.error if d.most is None else d.most for d in line.dots], exact)
    style = {"color": colour, "marker": mark, "markersize": 7, "capsize": 3, "label": line.name}
    style |= {"linewidth": 2.0, "alpha": 1.0, "zorder": 3} if line.strong else {"linewidth": 0.9, "alpha": 0.75}
    ax.errorbar([d.seconds for d in line.dots], y, yerr=np.maximum([y - least, most - y], 0.0), **{"zorder": 2} | style)


def _ring_own_setting(ax: Any, lines: Sequence[Line]) -> None:
    ring = {"marker": "o", "markersize": 17, "markerfacecolor": "none", "markeredgecolor": BLACK, "linestyle": ""}
    for dot in [d for line in lines for d in line.dots if d.own][:1]:
        at = [dot.seconds], [max(dot.error, EXACT)]
        ax.plot(*at, **ring, markeredgewidth=1.6, label="the recipe's own settings", zorder=4)


def _draw_exact_level(ax: Any, errors: Iterable[float], exact: float) -> None:
    if any(e < exact for e in errors):
        ax.axhline(exact, color=_GREY, linewidth=0.8, linestyle=":")
        at = ax.get_yaxis_transform()
        ax.text(0.01, exact / 1.2, "smaller errors, and no error", transform=at, va="top", fontsize=9, color=_GREY)


def _place_labels(figure: Any, diagrams: Sequence[Diagram]) -> None:
    """Write the label of each point of the diagrams where the label covers no marker, no note and no other label."""
    points = {
        ax: [
            PointLabel(d.seconds, max(d.error, exact), d.label, styles[line.name][0])
            for line in lines
            for d in line.dots
        ]
        for ax, lines, styles, exact in diagrams
    }
    place_labels(figure, points)
