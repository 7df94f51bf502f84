"""A corner plot: the draws of each parameter, and of every pair of parameters, in a triangle of panels.

The package `corner` draws the same picture; it makes all panels of the square and hides half, which takes three times
as long for ten parameters.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from neusee.workflows.report.figures.style import BLUE, ORANGE, drawn

if TYPE_CHECKING:
    from neusee.workflows.calibration.log_posterior import FloatArray

_PAGE = 11.4  #: inches, the width of the page at 100 pixels an inch
_WIDEST = 13  #: characters of a line of a label
_NEARLY_ALL = (0.005, 0.995)  #: quantiles, so that a single draw does not squeeze a panel of the corner plot
_BINS = 20  #: of each side of a panel
_LEVELS = 1 - np.exp(-0.5 * np.array([0.5, 1.0, 1.5, 2.0]) ** 2)  #: shares of the draws inside the contours
_SIZE, _LEFT, _GAP = 1.75, 0.9, 0.06  #: inches of a panel, of the margin with the labels, and between panels


@drawn
def corners(draws: FloatArray, names: Sequence[str], nominal: Sequence[float]) -> Any:
    """Draw a corner plot of all pairs of parameters, with the recipe's own values in orange."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    count = len(names)
    size = _SIZE * count + _LEFT
    text = 10 * max(1.0, size / _PAGE)  # a large picture is shrunk to the width of the page
    figure = Figure(figsize=(size, size), dpi=100)
    FigureCanvasAgg(figure)
    ranges = _ranges(draws, nominal)
    for row in range(count):
        for column in range(row + 1):
            left, low = _LEFT + _SIZE * column, _LEFT + _SIZE * (count - 1 - row)
            ax = figure.add_axes((left / size, low / size, (_SIZE - _GAP) / size, (_SIZE - _GAP) / size))
            _panel(ax, draws[:, [column, row]], [ranges[column], ranges[row]], (nominal[column], nominal[row]))
            _labelled(ax, names[column] if row == count - 1 else "", names[row] if column == 0 < row else "", text)
    return figure


def _panel(ax: Any, pair: FloatArray, ends: Sequence[tuple[float, float]], own: tuple[float, float]) -> None:
    """Draw the histogram of one parameter, or the histogram of two with its contours, and the recipe's own values."""
    ax.grid(False)
    ax.set_xlim(ends[0])
    ax.axvline(own[0], color=ORANGE, linewidth=1.0)
    if np.array_equal(pair[:, 0], pair[:, 1]):
        ax.stairs(*np.histogram(pair[:, 0], _BINS, ends[0]), color=BLUE)
        ax.set(yticks=[], ylim=(0, None))
        return
    counts, x, y = np.histogram2d(pair[:, 0], pair[:, 1], _BINS, np.array(ends))
    ax.imshow(counts.T, origin="lower", extent=(*ends[0], *ends[1]), aspect="auto", cmap="Blues", vmin=0)
    heights = _heights(counts)
    if len(heights):
        middle = [0.5 * (edges[1:] + edges[:-1]) for edges in (x, y)]
        ax.contour(*middle, counts.T, levels=heights, colors=BLUE, linewidths=0.8)
    ax.axhline(own[1], color=ORANGE, linewidth=1.0)
    ax.set_ylim(ends[1])


def _heights(counts: FloatArray) -> FloatArray:
    """Return the counts of a cell above which the shares `_LEVELS` of all draws lie, rising and different."""
    rising = np.sort(counts.ravel())[::-1]
    at = np.searchsorted(np.cumsum(rising), _LEVELS * rising.sum())
    heights = np.unique(rising[at.clip(max=len(rising) - 1)])
    inside: FloatArray = heights[(heights > 0) & (heights < rising[0])]
    return inside


def _labelled(ax: Any, below: str, left: str, text: float) -> None:
    from matplotlib.ticker import MaxNLocator, ScalarFormatter

    for axis, label in ((ax.xaxis, below), (ax.yaxis, left)):
        if not label:
            axis.set_ticks([])
            continue
        axis.set_major_locator(MaxNLocator(3, prune="lower"))
        axis.set_major_formatter(ScalarFormatter(useOffset=False))
        axis.set_tick_params(labelsize=0.9 * text, labelrotation=45)
        axis.set_label_text(_wrapped(label), fontsize=text)


def _wrapped(label: str) -> str:
    """Return a label with its lines broken between words, so that it is no wider than a panel."""
    return "\n".join(textwrap.fill(line, _WIDEST) for line in label.splitlines())


def _ranges(draws: FloatArray, nominal: Sequence[float]) -> list[tuple[float, float]]:
    """Return the range of each parameter in the corner plot: nearly all draws, and the recipe's value if among them."""
    ends = np.quantile(draws, _NEARLY_ALL, axis=0).T
    rim = 0.1 * (ends[:, 1] - ends[:, 0])
    shown = np.column_stack([ends[:, 0] - rim, ends[:, 1] + rim]).clip(draws.min(0)[:, None], draws.max(0)[:, None])
    own = np.asarray(nominal)
    inside = (own >= draws.min(0)) & (own <= draws.max(0))
    low, high = (
        np.where(inside, which(shown[:, i], own), shown[:, i]) for i, which in ((0, np.minimum), (1, np.maximum))
    )
    return [(float(a), float(b)) if b > a else (float(a) - 0.5, float(a) + 0.5) for a, b in zip(low, high, strict=True)]
