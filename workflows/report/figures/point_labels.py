"""Labels of the points of a diagram, each where the label covers no other label, no marker and no note."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

_OFFSETS = ((6, 4), (6, -12), (-6, 4), (-6, -12), (0, 9), (0, -17), (16, 13), (-16, 13), (16, -21), (-16, -21))
_MARKER = 12  #: pixels, the side of the square that the marker of a point takes
_APART = 3  #: pixels between two labels side by side


class PointLabel(NamedTuple):
    """A point of a diagram, with the text and the colour of its label; a point without text only takes its place."""

    x: float
    y: float
    text: str
    colour: str


def place_labels(figure: Any, points: Mapping[Any, Sequence[PointLabel]]) -> None:
    """Write the labels of the points of each diagram where nothing is covered; omit labels without free space."""
    figure.canvas.draw()
    renderer = figure.canvas.get_renderer()
    for ax, own in points.items():
        taken = _taken(ax, own, renderer)
        for point in own:
            if point.text:
                _place(ax, point, taken, renderer)


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


def _place(ax: Any, point: PointLabel, taken: list[Any], renderer: Any) -> None:
    """Write a label at the first offset at which it overlaps no box in ``taken``, and append its box to ``taken``."""
    from matplotlib.patheffects import withStroke

    inside = ax.get_window_extent()
    style = {"color": point.colour, "path_effects": [withStroke(linewidth=2.5, foreground="white")], "zorder": 5}
    for x, y in _OFFSETS:
        side = "left" if x > 0 else "right" if x < 0 else "center"
        at = {"xytext": (x, y), "textcoords": "offset points", "ha": side}
        text = ax.annotate(point.text, (point.x, point.y), **at, fontsize=9, **style)
        text.set_in_layout(False)
        box = text.get_window_extent(renderer)
        whole = inside.x0 <= box.x0 and box.x1 <= inside.x1 and inside.y0 <= box.y0 and box.y1 <= inside.y1
        if whole and not any(box.padded(_APART, 0).overlaps(other) for other in taken):
            taken.append(box)
            return
        text.remove()


def plain_ticks(axis: Any) -> None:
    """Label a logarithmic axis with plain numbers such as 0.5 and 20, at 1, 2 and 5 if it has few decades."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = axis.get_view_interval()
    many = math.log10(high / low) > 2.5
    axis.set_major_locator(LogLocator(subs=(1.0,) if many else (1.0, 2.0, 5.0), numticks=20))
    axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axis.set_minor_formatter(NullFormatter())
