"""Labels of the points of a diagram: none lies on another, on a marker, on a note or on the
legend.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from neusee.workflows.report.figures.style import (
    BLACK,
    PointLabel,
    canvas,
    place_labels,
    plain_ticks,
)


def labelled(points, note=""):
    figure, axes = canvas(5.0, 3.5)
    ax = axes[0, 0]
    ax.loglog(*zip(*points, strict=True), "o", label="points")
    ax.legend(loc="upper right")
    if note:
        ax.text(*points[0], note)
    place_labels(
        figure, {ax: [PointLabel(x, y, f"label {i}", BLACK) for i, (x, y) in enumerate(points)]}
    )
    return figure, ax


@pytest.mark.parametrize("apart", [1.0, 1.02, 1.2])
def test_labels_of_points_side_by_side_are_apart(apart):
    figure, ax = labelled([(apart**i, 1e-3) for i in range(4)], note="a note")
    renderer = figure.canvas.get_renderer()
    boxes = [text.get_window_extent(renderer) for text in ax.texts] + [
        ax.get_legend().get_window_extent(renderer)
    ]
    assert len(boxes) >= 4
    assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))


def test_a_label_without_free_space_is_omitted():
    figure, ax = labelled([(1.0, 1.0)] * 40)
    assert 1 <= len(ax.texts) < 40
    inside = ax.get_window_extent()
    for text in ax.texts:
        box = text.get_window_extent(figure.canvas.get_renderer())
        assert inside.x0 <= box.x0
        assert box.x1 <= inside.x1


@pytest.mark.parametrize(("low", "high"), [(1e5, 9e5), (2e-6, 4e6), (3e-5, 5e-3)])
def test_plain_numbers_are_apart(low, high):
    figure, axes = canvas(2.4, 2.0)
    ax = axes[0, 0]
    ax.loglog([low, high], [1, 2], "o")
    plain_ticks(ax.xaxis)
    figure.draw_without_rendering()
    end = ax.get_xlim()
    labels = [
        t.label1
        for t in ax.xaxis.get_major_ticks()
        if end[0] <= t.get_loc() <= end[1] and t.label1.get_text()
    ]
    boxes = [label.get_window_extent(figure.canvas.get_renderer()) for label in labels]
    assert len(boxes) >= 1
    assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))


@pytest.mark.parametrize(("low", "high"), [(6, 80), (0.02, 3), (1, 1e4)])
def test_times_are_plain_numbers(low, high):
    figure, axes = canvas(5.0, 3.5)
    ax = axes[0, 0]
    ax.loglog([low, high], [1, 2], "o")
    plain_ticks(ax.xaxis)
    figure.canvas.draw()
    texts = [label.get_text() for label in ax.get_xticklabels(which="both") if label.get_text()]
    assert len(texts) >= 2
    assert np.isfinite([float(text) for text in texts]).all()
