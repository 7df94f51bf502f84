"""The check of figures finds each fault that it names, and nothing in a sound figure."""

from __future__ import annotations

import numpy as np
import pytest

from neusee.workflows.report.figures.style import canvas, drawn
from tests.figure_faults import watched


def faults(draw):
    """Write a figure as the program does, and return what the check found."""
    found = []

    @drawn
    def figure():
        figure, axes = canvas(5.0, 3.0)
        watched(figure, found)
        axes[0, 0].plot([1, 2, 3], [1, 4, 9], label="squares")
        axes[0, 0].set(xlabel="number", ylabel="square", title="squares")
        draw(figure, axes[0, 0])
        return figure

    figure()
    return found


def test_a_sound_figure_has_no_fault():
    assert faults(lambda figure, ax: ax.legend()) == []


def far_apart(figure, ax):
    ax.loglog([0.3, 1e5], [1e-17, 1e-5])
    # the numbers 0.1 and 1e-18 are just outside, and hidden
    ax.set(xlim=(0.15, 6e5), ylim=(4e-18, 2e-4))


def by_markers(figure, ax):
    ax.clear()
    for mark in "os":
        ax.errorbar([1, 2], [1, 2], yerr=0.1, marker=mark, color="black", label=f"with {mark}")
    ax.set_xlim(0, 3)
    ax.legend()


@pytest.mark.parametrize("draw", [far_apart, by_markers])
def test_what_a_reader_tells_apart_is_no_fault(draw):
    assert faults(draw) == []


def twins(figure, ax):
    ax.plot([1, 2], [2, 1], color=ax.lines[0].get_color(), label="a twin")
    ax.legend()


def beyond(figure, ax):
    figure.text(2.0, 0.5, "far")


FAULTS = {
    "an empty panel": lambda figure, ax: figure.add_axes((0.7, 0.7, 0.2, 0.2)),
    "no point of any line": lambda figure, ax: ax.set_xlim(5, 6),
    "a picture without one finite value": lambda figure, ax: ax.imshow(np.full((2, 2), np.nan)),
    "texts overlap: 'one' and 'other'": lambda figure, ax: [
        ax.text(2, 4, word) for word in ("one", "other")
    ],
    "text of 6 points": lambda figure, ax: ax.text(2, 4, "small", fontsize=6),
    "drawn far beyond the canvas": beyond,
    "entries that look the same: squares, a twin": twins,
}


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_found(fault):
    assert any(fault in line for line in faults(FAULTS[fault]))
