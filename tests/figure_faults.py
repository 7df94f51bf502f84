"""Faults of a drawn figure that a reader would see: empty panels, texts that overlap or are
tiny, looks that repeat.
"""

from __future__ import annotations

import functools
import math
from collections import Counter
from typing import Any

import numpy as np

SMALLEST = 9.0  #: points
#: pixels by which the boxes of two texts may overlap, because a box has a rim around its letters
TOUCH = 1.5
#: share of a text's box that another may cover: numbers of two axes touch where the axes meet
COVERED = 0.2
SPREAD = 1.35  #: largest size of all that is drawn, relative to the canvas


def watched(figure: Any, found: list[str]) -> None:
    """Append to ``found`` what is wrong with a figure, when the figure is written as a PNG file."""
    canvas, write = tuple(figure.get_size_inches()), figure.canvas.print_png

    @functools.wraps(write)  # matplotlib passes the options that its signature names
    def written(*arguments: Any, **options: Any) -> None:
        write(*arguments, **options)
        found.extend(faults(figure, canvas))

    figure.canvas.print_png = written


def faults(figure: Any, canvas: tuple[float, float]) -> list[str]:
    """Return what is wrong with a figure that was drawn, one line for each fault; ``canvas`` is its
    size in inches.

    Texts stand where a reader sees them only while the figure is written, before the canvas has its
    own size again.
    """
    renderer = figure.canvas.get_renderer()
    axes = [ax for ax in figure.axes if ax.get_visible()]
    found = [f"{_name(ax)}: {fault}" for ax in axes for fault in _of_axes(ax)]
    texts = [(text, text.get_window_extent(renderer)) for text in _texts(figure, axes)]
    found += [
        f"text of {t.get_fontsize():g} points: {_said(t)}"
        for t, _ in texts
        if t.get_fontsize() < SMALLEST - 0.01
    ]
    found += [f"texts overlap: {_said(a)} and {_said(b)}" for a, b in _overlapping(texts)]
    width, height = figure.get_size_inches()
    if width > SPREAD * canvas[0] or height > SPREAD * canvas[1]:
        found.append(f"drawn far beyond the canvas: {width:.1f} x {height:.1f} inches")
    return [*found, *_same_looks(figure, axes)]


def _of_axes(ax: Any) -> list[str]:
    """Return what is wrong with one panel of a figure."""
    found = []
    limits = (*ax.get_xlim(), *ax.get_ylim())
    if not all(map(math.isfinite, limits)):
        found.append(f"limits {limits}")
    drawn = [*ax.lines, *ax.collections, *ax.patches, *ax.images, *ax.texts, *ax.artists]
    if ax.axison and ax.get_frame_on() and not drawn:
        found.append("an empty panel with axes")
    if (
        ax.lines
        and not ax.collections
        and not ax.patches
        and not ax.images
        and not _any_point_seen(ax)
    ):
        found.append("no point of any line is inside the limits")
    found += [
        f"a picture without one finite value: {im}"
        for im in ax.images
        if not np.isfinite(_numbers(im)).any()
    ]
    return found


def _numbers(image: Any) -> Any:
    return np.ma.filled(np.ma.asarray(image.get_array(), dtype=float), np.nan)


def _any_point_seen(ax: Any) -> bool:
    """Return True if a point of a line lies inside the limits of its panel; a line across the
    panel counts.
    """
    (x0, x1), (y0, y1) = sorted(ax.get_xlim()), sorted(ax.get_ylim())
    for line in ax.lines:
        x, y = (np.asarray(v, dtype=float) for v in line.get_data())
        across = line.get_transform() != ax.transData
        if across or bool(((x >= x0) & (x <= x1) & (y >= y0) & (y <= y1)).any()):
            return True
    return False


def _texts(figure: Any, axes: list[Any]) -> list[Any]:
    """Return the texts of a figure that a reader sees: titles, labels, ticks inside the limits,
    notes and legends.
    """
    own = [figure._supxlabel, figure._supylabel, figure._suptitle, *figure.texts]
    own += [text for legend in figure.legends for text in legend.get_texts()]
    for ax in axes:
        own += ax.texts
        own += ax.get_legend().get_texts() if ax.get_legend() else []
        own += [ax.title, ax._left_title, ax._right_title]
        if ax.axison:
            own += [
                ax.xaxis.label,
                ax.yaxis.label,
                *_tick_labels(ax.xaxis),
                *_tick_labels(ax.yaxis),
            ]
    return [
        text for text in own if text is not None and text.get_visible() and text.get_text().strip()
    ]


def _tick_labels(axis: Any) -> list[Any]:
    if not axis.get_visible():
        return []
    # of a logarithmic axis, for example: its rim is a share of its decades
    scale = axis.get_transform()
    low, high = sorted(scale.transform(np.asarray(axis.get_view_interval(), dtype=float)))
    rim = 1e-6 * (high - low)
    ticks = [*axis.get_major_ticks(), *axis.get_minor_ticks()]
    places = scale.transform(np.array([tick.get_loc() for tick in ticks], dtype=float))
    seen = [
        tick for tick, place in zip(ticks, places, strict=True) if low - rim <= place <= high + rim
    ]
    return [label for tick in seen for label in (tick.label1, tick.label2)]


def _overlapping(texts: list[tuple[Any, Any]]) -> list[tuple[Any, Any]]:
    """Return the pairs of texts of which one covers the other; the box of an oblique text says
    too little.
    """
    upright = [(text, box) for text, box in texts if text.get_rotation() % 90 == 0]
    x0, y0, x1, y1 = np.array([box.extents for _, box in upright]).reshape(-1, 4).T
    across = np.minimum.outer(x1, x1) - np.maximum.outer(x0, x0)
    along = np.minimum.outer(y1, y1) - np.maximum.outer(y0, y0)
    area = (x1 - x0) * (y1 - y0)
    covered = np.clip(across - TOUCH, 0, None) * np.clip(
        along - TOUCH, 0, None
    ) > COVERED * np.minimum.outer(area, area)
    pairs = np.argwhere(np.triu(covered, 1))
    both = [(upright[i][0], upright[j][0]) for i, j in pairs]
    return [(a, b) for a, b in both if a.get_text() != b.get_text()]


def _same_looks(figure: Any, axes: list[Any]) -> list[str]:
    """Return the entries of each legend that a reader cannot tell apart."""
    legends = [*figure.legends, *(ax.get_legend() for ax in axes if ax.get_legend())]
    found = []
    for legend in legends:
        names = [text.get_text() for text in legend.get_texts()]
        looks = dict(zip(names, map(_looks, _entries(legend)), strict=True))
        repeated = {look for look, times in Counter(looks.values()).items() if times > 1}
        same = [name for name, look in looks.items() if look in repeated]
        found += [f"the legend has entries that look the same: {', '.join(same)}"] if same else []
    return found


def _entries(legend: Any) -> list[list[Any]]:
    """Return all artists of each entry of a legend, such as the line, the marker and the error
    bar of a point.
    """
    columns = legend._legend_handle_box.get_children()
    return [
        entry.get_children()[0].get_children()
        for column in columns
        for entry in column.get_children()
    ]


def _looks(artists: list[Any]) -> tuple[tuple[str, ...], ...]:
    return tuple(map(_look, artists))


def _look(handle: Any) -> tuple[str, ...]:
    names = (
        "color",
        "facecolor",
        "edgecolor",
        "linestyle",
        "linewidth",
        "marker",
        "markerfacecolor",
        "alpha",
        "hatch",
    )
    return (
        type(handle).__name__,
        *(str(getattr(handle, f"get_{name}", lambda: "")()) for name in names),
    )


def _name(ax: Any) -> str:
    return repr(ax.get_title() or ax.get_ylabel() or ax.get_xlabel() or ax.get_label() or "a panel")


def _said(text: Any) -> str:
    return repr(text.get_text())
