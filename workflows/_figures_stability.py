"""The grid of the stability study: a cell a colour, a sign and the two numbers behind it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from neusee.workflows._extremes_cell import Cell
from neusee.workflows._figures_style import BLACK, canvas, drawn

_COLOURS = {"pass": "#9AD6C1", "warn": "#F6D58A", "fail": "#F2B08A"}
_WIDE, _TALL = 0.62, 0.36  #: inches of a cell

Entry = tuple[str, str, str, Cell]  #: group, case, node, cell


@drawn
def grid_picture(entries: Sequence[Entry]) -> Any:
    """Cases down, nodes across; above the error of the result, below that of its gradient."""
    cases = list(dict.fromkeys((group, case) for group, case, _, _ in entries))
    nodes = sorted({node for _, _, node, _ in entries}, key=lambda n: (n.startswith("losses."), n))
    figure, axes = canvas(2.2 + _WIDE * len(nodes), 2.0 + _TALL * len(cases))
    ax = axes[0, 0]
    for group, case, node, cell in entries:
        _draw(ax, nodes.index(node), cases.index((group, case)), cell)
    for row in range(1, len(cases)):
        if cases[row][0] != cases[row - 1][0]:
            ax.axhline(row - 0.5, color="#888888", linewidth=0.8)
    ax.set_xticks(range(len(nodes)), nodes, rotation=60, ha="left", rotation_mode="anchor")
    ax.set_yticks(range(len(cases)), [case for _, case in cases])
    ax.tick_params(length=0, top=False, bottom=False, labeltop=True, labelbottom=False, left=False)
    ax.set_xlim(-0.5, len(nodes) - 0.5)
    ax.set_ylim(len(cases) - 0.5, -0.5)
    ax.grid(False)
    for spine in ax.spines.values():
        spine.set_visible(False)
    ax.set_xlabel("above: error of the result, below: of its gradient; ! warn, × fail; r refused, s seen, – no number")
    return figure


def _draw(ax: Any, column: int, row: int, cell: Cell) -> None:
    ax.barh(row, 0.96, 0.94, left=column - 0.48, color=_COLOURS[cell.mark])
    ax.text(column, row, words(cell), ha="center", va="center", color=BLACK, fontsize=7.5, linespacing=1.05)


def words(cell: Cell) -> str:
    """What stands in a cell: a sign where it does not pass, and its numbers."""
    sign = {"pass": "", "warn": "! ", "fail": "× "}[cell.mark]
    if cell.error is None:
        short = "r" if cell.note.startswith("refused") else "s" if "seen" in cell.note else "–"
        return sign + short
    below = "" if cell.slope is None else f"\n{number(cell.slope)}"
    return f"{sign}{number(cell.error)}{below}"


def number(value: float) -> str:
    """``2e-7``, in as few signs as tell the order of magnitude."""
    if value == 0:
        return "0"
    if not math.isfinite(value):
        return "inf" if value > 0 else "nan"
    mantissa, _, exponent = f"{value:.0e}".partition("e")
    return f"{mantissa}e{int(exponent)}"
