"""Labels of the points of a diagram, each where the label covers no other label, no marker and no note."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

_OFFSETS = ((6, 4), (6, -12), (-6, 4), (-6, -12), (0, 9), (0, -17), (16, 13), (-16, 13), (16, -21), (-16, -21))
_MARKER = 12  #: pixels, the side of the square that the marker of a point takes
_APART = 3  #: pixels between two labels side by side
_FRAME = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "black", "linewidth": 0.8}
_FEW = 2.5  #: decades of an axis with numbers between the powers of ten
_SUBS = (((1.0, 2.0, 5.0), 0.3), ((1.0, 3.0), 0.47))  #: numbers of a decade, and their least distance in decades
_POINTS = 9.0  #: size of the numbers of an axis
_SHORT = 0.85  #: share of the length of an axis that is left after the layout


class PointLabel(NamedTuple):
    """A point of a diagram, with the text and the colour of its label; a point without text only takes its place."""

    x: float
    y: float
    text: str
    colour: str


def place_labels(figure: Any, points: Mapping[Any, Sequence[PointLabel]], framed: bool = False) -> None:
    """Write the labels of the points of each diagram where nothing is covered; omit labels without free space.

    ``framed`` labels have a white box, to be read on a picture.
    """
    figure.draw_without_rendering()
    renderer = figure.canvas.get_renderer()
    for ax, own in points.items():
        taken = _taken(ax, own, renderer)
        for point in own:
            if point.text:
                _place(ax, point, taken, renderer, framed)


def _taken(ax: Any, points: Sequence[PointLabel], renderer: Any) -> list[Any]:
    """Return the boxes in pixels that the markers, the notes and the legend of a diagram cover."""
    from matplotlib.transforms import Bbox

    centres = (ax.transData.transform((point.x, point.y)) for point in points)
    half = _MARKER / 2
    legend = [ax.get_legend()] if ax.get_legend() else []
    return [
        *(Bbox.from_bounds(x - half, y - half, _MARKER, _MARKER) for x, y in centres),
        *(artist.get_window_extent(renderer) for artist in (*ax.texts, *legend)),
    ]


def _place(ax: Any, point: PointLabel, taken: list[Any], renderer: Any, framed: bool) -> None:
    """Write a label at the first offset at which it overlaps no box in ``taken``, and append its box to ``taken``."""
    from matplotlib.patheffects import withStroke

    inside = ax.get_window_extent()
    style = {"color": point.colour, "path_effects": [withStroke(linewidth=2.5, foreground="white")], "zorder": 5}
    style |= {"bbox": _FRAME} if framed else {}
    for x, y in _OFFSETS:
        side = "left" if x > 0 else "right" if x < 0 else "center"
        at = {"xytext": (x, y), "textcoords": "offset points", "ha": side}
        text = ax.annotate(point.text, (point.x, point.y), **at, fontsize=9, **style)
        text.set_in_layout(False)
        box = text.get_window_extent(renderer)
        whole = inside.x0 <= box.x0 and box.x1 <= inside.x1 and inside.y0 <= box.y0 and box.y1 <= inside.y1
        if whole and not any(box.padded(_APART, _APART * framed).overlaps(other) for other in taken):
            taken.append(box)
            return
        text.remove()


def plain_ticks(axis: Any) -> None:
    """Label a logarithmic axis with plain numbers such as 0.5 and 20, as many as stand apart from each other."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = sorted(axis.get_view_interval())
    decades, room, size = math.log10(high / low), _length(axis), _label_size(axis, low, high)
    few = [subs for subs, gap in _SUBS if decades <= _FEW and gap * room / decades > size]
    axis.set_major_locator(LogLocator(subs=few[0] if few else (1.0,), numticks=max(2, int(room / size))))
    axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def _length(axis: Any) -> float:
    """Return the length of an axis in points before the layout is known, on the short side."""
    box = axis.axes.get_window_extent()
    pixels = box.width if axis.axis_name == "x" else box.height
    return float(_SHORT * pixels * 72 / axis.figure.dpi)


def _label_size(axis: Any, low: float, high: float) -> float:
    """Return the space in points along an axis that the longest plain number between two values needs."""
    if axis.axis_name == "y":
        return 1.5 * _POINTS
    ends = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    return 0.65 * _POINTS * (1 + max(len(f"{10.0**end:g}") for end in ends))
