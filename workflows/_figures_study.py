"""Pictures of the study of accuracy: error against run time, and what a tolerance promises against what it gives."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from neusee.workflows._figures_style import BLACK, BLUE, GREEN, ORANGE, VERMILION, canvas, drawn

EXACT = 1e-9  #: where what is the same to the last bit is drawn, since no logarithm holds 0
_COLOURS = (BLUE, ORANGE, GREEN, VERMILION, "#CC79A7", "#56B4E9", "#8B7500", "#555555")
_MARKS = "osD^vP*X"
_PLACES = ((5, 4), (5, -11), (-5, 4), (-5, -11), (0, 9), (0, -15), (14, 12), (-14, 12), (14, -20), (-14, -20))
_WAITS = "#777777"


@dataclass(frozen=True)
class Dot:
    """A point of a diagram."""

    seconds: float
    error: float
    label: str
    least: float | None = None  #: of the seeds, for an error bar
    most: float | None = None
    own: bool = False  #: what the recipe itself says


@dataclass(frozen=True)
class Line:
    """The points of one knob."""

    name: str
    dots: Sequence[Dot]
    joined: bool = True


@drawn
def work_precision(lines: Sequence[Line], front: Sequence[tuple[float, float]], tolerance: float, title: str) -> Any:
    """Error against run time, log-log: a line for each knob, the Pareto line, the recipe's own point in a ring."""
    figure, axes = canvas(10.0, 6.2)
    ax = axes[0, 0]
    _diagram(ax, lines, front, tolerance)
    ax.set_title(title)
    ax.set_xlabel("run time (s)")
    ax.set_ylabel("error: rms over the largest element of the reference")
    figure.legend(*ax.get_legend_handles_labels(), loc="outside right upper")
    _place_labels(figure, [(ax, lines)])
    return figure


@drawn
def steps(diagrams: Sequence[tuple[str, Sequence[Line], float]]) -> Any:
    """The same of each step: its forms against its reference, which is the line on the right."""
    columns = min(2, len(diagrams))
    rows = -(-len(diagrams) // columns)
    figure, axes = canvas(5.2 * columns, 3.9 * rows, rows, columns)
    shown = []
    for ax, (name, lines, reference) in zip(axes.flat, diagrams, strict=False):
        _diagram(ax, lines, (), None)
        if math.isfinite(reference):
            ax.axvline(reference, color=_WAITS, linestyle=":", label="reference (float64, direct)")
        ax.set_title(name)
        ax.set_xlabel("run time (s)")
        ax.set_ylabel("error")
        shown.append((ax, lines))
    for ax in list(axes.flat)[len(diagrams) :]:
        ax.set_axis_off()
    handles = {label: h for ax in axes.flat for h, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=min(4, len(handles)))
    _place_labels(figure, shown)
    return figure


@drawn
def promises(asked: Sequence[float], measured: dict[str, Sequence[float]], proved: Sequence[float | None]) -> Any:
    """What each tolerance gave, output by output, and what was proved, against what was asked."""
    figure, axes = canvas(8.4, 5.0)
    ax = axes[0, 0]
    ax.loglog(asked, asked, color=BLACK, linewidth=1.2, label="as asked")
    told = [(t, max(b, EXACT)) for t, b in zip(asked, proved, strict=True) if b is not None]
    if told:
        ax.loglog(*zip(*told, strict=True), color=_WAITS, linestyle="--", label="proved before it was measured")
    for i, (name, errors) in enumerate(measured.items()):
        how = {"color": _COLOURS[i % 8], "marker": _MARKS[i % 8], "markersize": 6, "linewidth": 1.0}
        ax.loglog(asked, [max(e, EXACT) for e in errors], label=name, **how)
    ax.set_title("Measured error of each output against the tolerance asked")
    ax.set_xlabel("tolerance")
    ax.set_ylabel("error")
    ax.invert_xaxis()
    _say_exact(ax, [e for errors in measured.values() for e in errors])
    figure.legend(*ax.get_legend_handles_labels(), loc="outside right upper")
    return figure


def _diagram(ax: Any, lines: Sequence[Line], front: Sequence[tuple[float, float]], tolerance: float | None) -> None:
    ax.set_xscale("log")
    ax.set_yscale("log")
    for i, line in enumerate(lines):
        _draw(ax, line, _COLOURS[i % 8], _MARKS[i % 8])
    own = [d for line in lines for d in line.dots if d.own]
    if own:
        ring = {"marker": "o", "markersize": 15, "markerfacecolor": "none", "markeredgecolor": BLACK, "linestyle": ""}
        ax.plot([own[0].seconds], [_shown(own[0].error)], **ring, markeredgewidth=1.4, label="the recipe as it is")
    if front:
        x, y = zip(*front, strict=True)
        ax.step(x, [_shown(e) for e in y], where="post", color=BLACK, linewidth=1.0, alpha=0.5, label="Pareto line")
    if tolerance is not None:
        ax.axhline(tolerance, color=VERMILION, linestyle="--", linewidth=1.2, label=f"tolerance {tolerance:.0e}")
    _margins(ax, [d for line in lines for d in line.dots], tolerance)


def _draw(ax: Any, line: Line, colour: str, mark: str) -> None:
    dots = sorted(line.dots, key=lambda d: d.seconds) if line.joined else list(line.dots)
    x, y = [d.seconds for d in dots], [_shown(d.error) for d in dots]
    ends = [(d.error if d.least is None else d.least, d.error if d.most is None else d.most) for d in dots]
    bars = [[max(0.0, v - _shown(e[0])) for v, e in zip(y, ends, strict=True)]]
    bars += [[max(0.0, _shown(e[1]) - v) for v, e in zip(y, ends, strict=True)]]
    style = "-" if line.joined else ""
    how = {"color": colour, "marker": mark, "markersize": 6, "linewidth": 1.0, "capsize": 3}
    ax.errorbar(x, y, yerr=bars, linestyle=style, label=line.name, **how)


def _margins(ax: Any, dots: Sequence[Dot], tolerance: float | None) -> None:
    """Room for the labels: a third of a decade in time, one in error; whole numbers of seconds between the decades."""
    if not dots:
        return
    seconds, errors = [d.seconds for d in dots], [_shown(d.error) for d in dots]
    errors += [] if tolerance is None else [tolerance]
    ax.set_xlim(min(seconds) / 1.6, max(seconds) * 1.9)
    ax.set_ylim(min(errors) / 5, max(errors) * 5)
    _tick_seconds(ax)
    _say_exact(ax, [d.error for d in dots])


def _tick_seconds(ax: Any) -> None:
    """Ticks at 1, 2 and 5 of each decade, as plain numbers; at the decades alone where there are many."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = ax.get_xlim()
    many = math.log10(high / low) > 2.5
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0,) if many else (1.0, 2.0, 5.0), numticks=20))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    ax.xaxis.set_minor_formatter(NullFormatter())


def _say_exact(ax: Any, errors: Iterable[float]) -> None:
    if any(e < EXACT for e in errors):
        ax.axhline(EXACT, color=_WAITS, linewidth=0.8, linestyle=":")
        at = ax.get_yaxis_transform()
        ax.text(0.99, EXACT, "below this line: the same, or nearly", transform=at, ha="right", va="bottom", fontsize=9)


def _shown(error: float) -> float:
    return max(error, EXACT)


def _place_labels(figure: Any, shown: Sequence[tuple[Any, Sequence[Line]]]) -> None:
    """Each label at the first place beside its point where it covers no other; none where there is no such place."""
    figure.canvas.draw()
    for ax, lines in shown:
        dots = [(d, _COLOURS[i % 8]) for i, line in enumerate(lines) for d in line.dots]
        taken = [_around(ax.transData.transform((d.seconds, _shown(d.error)))) for d, _ in dots]
        inside = ax.get_window_extent()
        for dot, colour in dots:
            if dot.label:
                _label(figure, ax, dot, colour, taken, inside)


def _label(figure: Any, ax: Any, dot: Dot, colour: str, taken: list[Any], inside: Any) -> None:
    for x, y in _PLACES:
        side = "left" if x > 0 else "right" if x < 0 else "center"
        text = ax.annotate(
            dot.label,
            (dot.seconds, _shown(dot.error)),
            (x, y),
            textcoords="offset points",
            ha=side,
            color=colour,
            fontsize=9,
        )
        text.set_in_layout(False)
        box = text.get_window_extent(figure.canvas.get_renderer())
        whole = inside.x0 <= box.x0 and box.x1 <= inside.x1 and inside.y0 <= box.y0 and box.y1 <= inside.y1
        if whole and not any(box.overlaps(other) for other in taken):
            taken.append(box)
            return
        text.remove()


def _around(point: Any) -> Any:
    """What a mark covers."""
    from matplotlib.transforms import Bbox

    return Bbox.from_bounds(point[0] - 6, point[1] - 6, 12, 12)
