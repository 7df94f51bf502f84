"""The picture of the stability study: a grid with the outcome and the error of each node in each extreme case."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import Any

from neusee.workflows.report.figures.style import BLACK, canvas, drawn
from neusee.workflows.studies.stability.case_result import Cell

_COLOURS = {"pass": "#9AD6C1", "warn": "#F6D58A", "fail": "#F2B08A"}
_WIDE, _TALL = 0.52, 0.23  #: inches of a cell
_LETTER = 0.085  #: inches, width of a letter
_ACROSS = 22  #: largest number of nodes side by side; further nodes are drawn in a panel below

Entry = tuple[str, str, str, Cell]  #: group, case, node, cell


@drawn
def grid_picture(entries: Sequence[Entry]) -> Any:
    """Draw the grid of test outcomes and errors: a row for each extreme case, a column for each node, losses last."""
    cases = list(dict.fromkeys((group, case) for group, case, _, _ in entries))
    nodes = sorted({node for _, _, node, _ in entries}, key=lambda n: (n.startswith("losses."), n))
    panels = max(1, -(-len(nodes) // _ACROSS))
    across = max(1, -(-len(nodes) // panels))
    left, above = (_LETTER * max(map(len, names), default=0) for names in ([case for _, case in cases], nodes))
    width = max(6.0, left + 1.0 + _WIDE * across)
    figure, axes = canvas(width, panels * (0.8 + 0.8 * above + _TALL * len(cases)), rows=panels)
    for ax, first in zip(axes[:, 0], range(0, max(1, len(nodes)), across), strict=True):
        _panel(ax, [e for e in entries if e[2] in nodes[first : first + across]], cases, nodes[first:], across)
    how = "largest error over the largest element, of the result or (g) of its gradient, whichever is nearer its bound"
    text = f"{how};  ! warn, × fail;  r refused, s seen, – no number to compare"
    figure.supxlabel(textwrap.fill(text, int(width / _LETTER)), fontsize=9)
    return figure


def _panel(ax: Any, entries: Sequence[Entry], cases: list[tuple[str, str]], nodes: list[str], across: int) -> None:
    for group, case, node, cell in entries:
        column, row = nodes.index(node), cases.index((group, case))
        ax.barh(row, 0.96, 0.92, left=column - 0.48, color=_COLOURS[cell.mark])
        ax.text(column, row, cell_text(cell), ha="center", va="center", color=BLACK, fontsize=9)
    for row in range(1, len(cases)):
        if cases[row][0] != cases[row - 1][0]:
            ax.axhline(row - 0.5, color="#888888", linewidth=0.8)
    ax.set_xticks(range(min(across, len(nodes))), nodes[:across], rotation=50, ha="left", rotation_mode="anchor")
    ax.set_yticks(range(len(cases)), [case for _, case in cases])
    ax.tick_params(length=0, top=False, bottom=False, labeltop=True, labelbottom=False, left=False)
    ax.set_xlim(-0.5, across - 0.5)
    ax.set_ylim(len(cases) - 0.5, -0.5)
    ax.grid(False)
    for spine in ax.spines.values():
        spine.set_visible(False)


def cell_text(cell: Cell) -> str:
    """Return the text of one test in the grid: a sign for warn or fail, and the error that is nearest to its bound."""
    sign = {"pass": "", "warn": "!", "fail": "×"}[cell.mark]
    if cell.error is None:
        short = "r" if cell.note.startswith("refused") else "s" if "seen" in cell.note else "–"
        return sign + short
    steep = cell.slope is not None and _share(cell.slope, cell.slope_bound) > _share(cell.error, cell.bound)
    return f"{sign}{short_number(cell.slope or 0.0)}g" if steep else f"{sign}{short_number(cell.error)}"


def _share(value: float, bound: float | None) -> float:
    return value / bound if bound else 0.0


def short_number(value: float) -> str:
    """Return a number as text with one digit and an exponent of at most two digits, such as ``2e-7`` and ``>e99``."""
    if value == 0:
        return "0"
    if not math.isfinite(value):
        return "inf" if value > 0 else "nan"
    if not 1e-99 <= abs(value) < 9.5e99:
        return "<e-99" if abs(value) < 1 else ">e99"
    mantissa, _, exponent = f"{value:.0e}".partition("e")
    return f"{mantissa}e{int(exponent)}"
