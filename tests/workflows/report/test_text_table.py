"""Tables of the terminal: a table that is wider than the terminal loses the columns that a reader can spare."""

from __future__ import annotations

import pytest

from neusee.workflows.report.text_table import columns_within

ROWS = [
    ["step", "node", "seconds", "reads"],
    ["restored", "restore.colour", "0.010 s", "deconvolved, matrix"],
    ["peak[mask]", "metrics.peak_irradiance", "0.003 s", "image[mask], bands, level"],
]


@pytest.mark.parametrize(
    ("width", "head", "left_out"),
    [
        (None, "step        node                     seconds  reads", None),
        (80, "step        node                     seconds  reads", None),
        (60, "step        node                     seconds", "reads"),
        (40, "step        seconds", "reads, node"),
    ],
)
def test_a_table_leaves_out_columns_until_it_fits(width, head, left_out):
    lines = columns_within(ROWS, width, ("reads", "node"))
    assert lines[0] == head
    assert all(len(line) <= (width or 80) for line in lines[:3])
    assert lines[3:] == ([f"left out on this narrow terminal: {left_out}"] if left_out else [])


def test_every_column_that_a_reader_needs_stays():
    lines = columns_within(ROWS, 10, ("reads", "node"))
    assert [line.split() for line in lines[1:3]] == [["restored", "0.010", "s"], ["peak[mask]", "0.003", "s"]]
