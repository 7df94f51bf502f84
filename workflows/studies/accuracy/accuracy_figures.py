"""Pictures of the study of accuracy: error against run time, and what a tolerance promises against what it gives."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from neusee.workflows.report.figures.style import BLACK, BLUE, GREEN, ORANGE, VERMILION, canvas, drawn

EXACT = 1e-9  #: where what is the same to the last bit is drawn, since no logarithm holds 0
_STEP_EXACT = 1e-17  #: the same of a single step, in double precision
_COLOURS = (BLUE, ORANGE, GREEN, VERMILION, "#CC79A7", "#56B4E9", "#8B7500", "#555555")
_MARKS = "osD^vP*X"
_PLACES = ((6, 4), (6, -12), (-6, 4), (-6, -12), (0, 9), (0, -17), (16, 13), (-16, 13), (16, -21), (-16, -21))
_GREY = "#777777"


@dataclass(frozen=True)
class Dot:
    """A point of a diagram."""

    seconds: float
    error: float
    label: str
    least: float | None = None  #: of the seeds, for an error bar
    most: float | None = None
    own: bool = False  #: what the recipe itself says


Styles = Mapping[str, tuple[str, str]]  #: colour and mark by the name of a line


@dataclass(frozen=True)
class Line:
    """The points of one knob."""

    name: str
    dots: Sequence[Dot]
    strong: bool = False  #: drawn thicker than the rest


@drawn
def work_precision(
    lines: Sequence[Line], pareto_front: Sequence[tuple[float, float]], tolerance: float, title: str
) -> Any:
    """Draw error against run time on logarithmic axes: a line for each knob, the Pareto line, the recipe in a ring."""
    figure, axes = canvas(10.0, 7.0)
    ax = axes[0, 0]
    styles = {line.name: (_COLOURS[i % 8], _MARKS[i % 8]) for i, line in enumerate(lines)}
    _diagram(ax, lines, styles, EXACT, tolerance)
    _ring(ax, [d for line in lines for d in line.dots if d.own])
    if pareto_front:
        x, y = zip(*pareto_front, strict=True)
        how = {"color": BLACK, "linewidth": 5.0, "alpha": 0.16, "zorder": 0}
        ax.step(x, [max(e, EXACT) for e in y], where="post", label="Pareto line", **how)
    ax.axhline(tolerance, color=VERMILION, linestyle="--", linewidth=1.2, label="tolerance of the recipe")
    ax.set_title(title)
    ax.set_xlabel("run time (s)")
    ax.set_ylabel("error: rms over the largest element of the reference")
    figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    _place_labels(figure, [(ax, lines, styles, EXACT)])
    return figure


@drawn
def steps(diagrams: Sequence[tuple[str, Sequence[Line], float]]) -> Any:
    """Draw error against run time in ms for each step: its forms, and the time of its reference as a dotted line."""
    columns = min(3, len(diagrams))
    rows = -(-len(diagrams) // columns)
    figure, axes = canvas(3.9 * columns + 0.4, 3.5 * rows + 0.7, rows, columns)
    names = dict.fromkeys(line.name for _, lines, _ in diagrams for line in lines)
    styles = {name: (_COLOURS[i % 8], _MARKS[i % 8]) for i, name in enumerate(names)}
    shown = []
    for ax, (name, lines, reference) in zip(axes.flat, diagrams, strict=False):
        scaled = [replace(line, dots=[replace(d, seconds=1e3 * d.seconds) for d in line.dots]) for line in lines]
        _diagram(ax, scaled, styles, _STEP_EXACT, None, 1e3 * reference)
        ax.axvline(1e3 * reference, color=_GREY, linestyle=":", label="its reference")
        ax.set_title(name)
        ax.set_xlabel("run time (ms)")
        ax.set_ylabel("error")
        shown.append((ax, scaled, styles, _STEP_EXACT))
    for ax in list(axes.flat)[len(diagrams) :]:
        ax.set_axis_off()
    handles = {label: h for ax in axes.flat for h, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=min(5, len(handles)))
    _place_labels(figure, shown)
    return figure


@drawn
def promises(asked: Sequence[float], measured: Mapping[str, Sequence[float]], proved: Sequence[float | None]) -> Any:
    """Draw the measured error of each output, and the proved bound, against the tolerance that was asked for."""
    figure, axes = canvas(8.4, 5.0)
    ax = axes[0, 0]
    ax.loglog(asked, asked, color=BLACK, linewidth=1.2, label="as asked")
    told = [(t, max(b, EXACT)) for t, b in zip(asked, proved, strict=True) if b is not None]
    if told:
        ax.loglog(*zip(*told, strict=True), color=_GREY, linestyle="--", label="proved before it was measured")
    for i, (name, errors) in enumerate(measured.items()):
        how = {"color": _COLOURS[i % 8], "marker": _MARKS[i % 8], "markersize": 6, "linewidth": 1.0}
        ax.loglog(asked, [max(e, EXACT) for e in errors], label=name, **how)
    ax.set_title("Measured error of each output against the tolerance asked")
    ax.set_xlabel("tolerance")
    ax.set_ylabel("error")
    ax.invert_xaxis()
    _say_exact(ax, [e for errors in measured.values() for e in errors], EXACT)
    ax.set_ylim(bottom=min(ax.get_ylim()[0], EXACT / 5))
    figure.legend(*ax.get_legend_handles_labels(), loc="outside right upper")
    return figure


def _diagram(ax: Any, lines: Sequence[Line], styles: Styles, exact: float, *also: float | None) -> None:
    """Draw lines and marks; ``also`` is an error and a time that the axes must include, where there are such."""
    ax.set_xscale("log")
    ax.set_yscale("log")
    dots = [d for line in lines for d in line.dots]
    tolerance, seconds = (*also, None, None)[:2]
    x = [d.seconds for d in dots] + ([] if seconds is None else [seconds])
    y = [max(e, exact) for d in dots for e in (d.error, d.most or d.error)] + ([] if tolerance is None else [tolerance])
    # before anything is drawn: left to itself the axis warns of errors that differ in their last digit alone
    ax.set_xlim(*_room(x, 10.0, 1.5))
    ax.set_ylim(*_room(y, 100.0, 4.0))
    for line in lines:
        _draw(ax, line, *styles[line.name], exact)
    _tick_seconds(ax)
    _say_exact(ax, [d.error for d in dots], exact)


def _room(values: Sequence[float], least: float, margin: float) -> tuple[float, float]:
    """Return limits that hold the values with a margin and are at least a factor of ``least`` apart."""
    low, high = min(values) / margin, max(values) * margin
    wider = math.sqrt(max(1.0, least / (high / low)))
    return low / wider, high * wider


def _draw(ax: Any, line: Line, colour: str, mark: str, exact: float) -> None:
    x, y = [d.seconds for d in line.dots], [max(d.error, exact) for d in line.dots]
    ends = [(d.error if d.least is None else d.least, d.error if d.most is None else d.most) for d in line.dots]
    bars = [[max(0.0, v - max(e[0], exact)) for v, e in zip(y, ends, strict=True)]]
    bars += [[max(0.0, max(e[1], exact) - v) for v, e in zip(y, ends, strict=True)]]
    how = {"color": colour, "marker": mark, "markersize": 7, "capsize": 3}
    width, alpha = (2.0, 1.0) if line.strong else (0.9, 0.75)
    ax.errorbar(x, y, yerr=bars, linewidth=width, alpha=alpha, label=line.name, zorder=3 if line.strong else 2, **how)


def _ring(ax: Any, own: Sequence[Dot]) -> None:
    ring = {"marker": "o", "markersize": 17, "markerfacecolor": "none", "markeredgecolor": BLACK, "linestyle": ""}
    for dot in own[:1]:
        at = [dot.seconds], [max(dot.error, EXACT)]
        ax.plot(*at, **ring, markeredgewidth=1.6, label="the recipe as it is", zorder=4)


def _tick_seconds(ax: Any) -> None:
    """Set ticks at 1, 2 and 5 of each decade, as plain numbers; at the decades alone where there are many."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = ax.get_xlim()
    many = math.log10(high / low) > 2.5
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0,) if many else (1.0, 2.0, 5.0), numticks=20))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    ax.xaxis.set_minor_formatter(NullFormatter())


def _say_exact(ax: Any, errors: Iterable[float], exact: float) -> None:
    """Draw a line at the level where points stand whose error is too small for the axis."""
    if any(e < exact for e in errors):
        ax.axhline(exact, color=_GREY, linewidth=0.8, linestyle=":")
        at = ax.get_yaxis_transform()
        ax.text(0.01, exact / 1.2, "no error, or less", transform=at, va="top", fontsize=9, color=_GREY)


def _place_labels(figure: Any, shown: Sequence[tuple[Any, Sequence[Line], Styles, float]]) -> None:
    """Put each label at the first position beside its point where it covers no other; else leave the label out."""
    figure.canvas.draw()
    for ax, lines, styles, exact in shown:
        dots = [(d, styles[line.name][0]) for line in lines for d in line.dots]
        taken = [_around(ax.transData.transform((d.seconds, max(d.error, exact)))) for d, _ in dots]
        for dot, colour in dots:
            if dot.label:
                _label(figure, ax, replace(dot, error=max(dot.error, exact)), colour, taken)


def _label(figure: Any, ax: Any, dot: Dot, colour: str, taken: list[Any]) -> None:
    inside = ax.get_window_extent()
    from matplotlib.patheffects import withStroke

    for x, y in _PLACES:
        side = "left" if x > 0 else "right" if x < 0 else "center"
        text = ax.annotate(
            dot.label,
            (dot.seconds, dot.error),
            (x, y),
            textcoords="offset points",
            ha=side,
            color=colour,
            fontsize=9,
            path_effects=[withStroke(linewidth=2.5, foreground="white")],
            zorder=5,
        )
        text.set_in_layout(False)
        box = text.get_window_extent(figure.canvas.get_renderer())
        whole = inside.x0 <= box.x0 and box.x1 <= inside.x1 and inside.y0 <= box.y0 and box.y1 <= inside.y1
        if whole and not any(box.overlaps(other) for other in taken):
            taken.append(box)
            return
        text.remove()


def _around(point: Any) -> Any:
    """Return the box of pixels that a mark covers."""
    from matplotlib.transforms import Bbox

    return Bbox.from_bounds(point[0] - 6, point[1] - 6, 12, 12)
