"""The stability study: errors of each step in extreme cases, compared with bounds."""

from __future__ import annotations

import itertools
import math
import textwrap
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

from neusee.workflows.engine.local_executor import one_thread
from neusee.workflows.engine.provenance import versions
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.keys.code_digest import Code, engine
from neusee.workflows.report.figures.style import BLACK, canvas, drawn
from neusee.workflows.report.study_report import (
    Mark,
    Progress,
    Section,
    StudyOutcome,
    StudyReport,
    marked_column,
)
from neusee.workflows.store.result_store import Store, compute_once
from neusee.workflows.studies.case_result import Cell, judge_step
from neusee.workflows.studies.extreme_cases import (
    CASES,
    USUAL,
    Case,
    CaseRecipe,
    unchanged_steps,
)

# --- stability figures ----------------------------------------------------------------------------

# The picture of the stability study: a grid with the outcome and the error of each node in each
# extreme case.


_COLOURS = {"pass": "#9AD6C1", "warn": "#F6D58A", "fail": "#F2B08A"}
_WIDE, _TALL = 0.52, 0.23  #: inches of a cell
_LETTER = 0.085  #: inches, width of a letter
_ACROSS = 22  #: largest number of nodes side by side; further nodes are drawn in a panel below

Entry = tuple[str, str, str, Cell]  #: group, case, node, cell


@drawn
def grid_picture(entries: Sequence[Entry]) -> Any:
    """Draw the grid of outcomes and errors: a row for each extreme case, a column for each node,
    losses last.
    """
    cases = list(dict.fromkeys((group, case) for group, case, _, _ in entries))
    # False sorts before True, so that losses come last
    nodes = sorted({node for _, _, node, _ in entries}, key=lambda n: (n.startswith("losses."), n))
    # number of panels, rounded up
    panels = max(1, -(-len(nodes) // _ACROSS))
    columns = max(1, -(-len(nodes) // panels))
    # inches, for the longest name of a case and of a node
    label_width, label_height = (
        _LETTER * max(map(len, names), default=0) for names in ([case for _, case in cases], nodes)
    )
    width = max(6.0, label_width + 1.0 + _WIDE * columns)
    figure, axes = canvas(
        width, panels * (0.8 + 0.8 * label_height + _TALL * len(cases)), rows=panels
    )
    for ax, first_node in zip(axes[:, 0], range(0, max(1, len(nodes)), columns), strict=True):
        _panel(
            ax,
            # an entry's third element is the node
            [entry for entry in entries if entry[2] in nodes[first_node : first_node + columns]],
            cases,
            nodes[first_node:],
            columns,
        )
    measure_text = (
        "largest error over the largest element, of the result or (g) of its gradient, whichever is"
        " nearer its bound"
    )
    text = f"{measure_text};  ! warn, × fail;  r refused, s seen, – no number to compare"
    figure.supxlabel(textwrap.fill(text, int(width / _LETTER)), fontsize=9)
    return figure


def _panel(
    ax: Any, entries: Sequence[Entry], cases: list[tuple[str, str]], nodes: list[str], across: int
) -> None:
    """Draw one panel of the grid: the cells of the first ``across`` nodes in ``nodes``."""
    for group, case, node, cell in entries:
        column, row = nodes.index(node), cases.index((group, case))
        ax.barh(row, 0.96, 0.92, left=column - 0.48, color=_COLOURS[cell.mark])
        ax.text(column, row, cell_text(cell), ha="center", va="center", color=BLACK, fontsize=9)
    for row in range(1, len(cases)):
        # a line between two groups of cases
        if cases[row][0] != cases[row - 1][0]:
            ax.axhline(row - 0.5, color="#888888", linewidth=0.8)
    ax.set_xticks(
        range(min(across, len(nodes))),
        nodes[:across],
        rotation=50,
        ha="left",
        rotation_mode="anchor",
    )
    ax.set_yticks(range(len(cases)), [case for _, case in cases])
    ax.tick_params(length=0, top=False, bottom=False, labeltop=True, labelbottom=False, left=False)
    ax.set_xlim(-0.5, across - 0.5)
    ax.set_ylim(len(cases) - 0.5, -0.5)
    ax.grid(False)
    for spine in ax.spines.values():
        spine.set_visible(False)


def cell_text(cell: Cell) -> str:
    """Return the text of one grid cell: a sign for warn or fail, and the error that is closest to
    its bound.
    """
    sign = {"pass": "", "warn": "!", "fail": "×"}[cell.mark]
    if cell.error is None:
        if cell.note.startswith("refused"):
            return f"{sign}r"
        return f"{sign}s" if "seen" in cell.note else f"{sign}–"
    # g marks the gradient, whose error is a larger share of its bound
    gradient_is_nearer = cell.slope is not None and _share(cell.slope, cell.slope_bound) > _share(
        cell.error, cell.bound
    )
    return (
        f"{sign}{short_number(cell.slope or 0.0)}g"
        if gradient_is_nearer
        else f"{sign}{short_number(cell.error)}"
    )


def _share(value: float, bound: float | None) -> float:
    """Return the ratio of an error to its bound; 0 without a bound."""
    return value / bound if bound else 0.0


def short_number(value: float) -> str:
    """Return a number as text with one digit and an exponent of at most two digits, such as
    ``2e-7`` and ``>e99``.
    """
    if value == 0:
        return "0"
    if not math.isfinite(value):
        return "inf" if value > 0 else "nan"
    if not 1e-99 <= abs(value) < 9.5e99:
        return "<e-99" if abs(value) < 1 else ">e99"
    mantissa, _, exponent = f"{value:.0e}".partition("e")
    return f"{mantissa}e{int(exponent)}"


# --- stability study ------------------------------------------------------------------------------

# The stability study: errors of each step's result and gradient in extreme cases, compared with
# bounds.


_COLUMNS = (
    "case",
    "step",
    "node",
    "mark",
    "error",
    "bound",
    "gradient error",
    "gradient bound",
    "note",
)
_GUIDE = """Each step has the inputs of the recipe, at a small size, with one change: a parameter of
the recipe, the result of an earlier step, or the pictures among the inputs of the step. A random
height map of the same depth takes the place of a mask from a file, whose samples do not fit the
small pupil. The result is compared with the node's own reference, or with the same function on the
same inputs in float64. The error is the largest difference over the largest element, and the bound
is the node's rtol (at least 1.2e-7, the rounding of single precision). A single number f in which
terms cancel counts with the sum of its terms, sum |x df/dx| over the pictures.

The second error is that of the gradient of a weighted sum of the result with respect to every
picture, over the gradient's largest element; the bound is 1e-4, or ten times the node's rtol if
that is more. An error above half of its bound is a warning: with the rounding of another machine it
may exceed the bound. NaN or infinity must be refused with a reason, show in the result, or have the
effect of a large number. A step that refuses its inputs passes if its error names the cause. An
empty cell: the step has the inputs of the usual case, or no inputs."""


@dataclass(frozen=True)
class GridCell:
    """The result of one test, with its extreme case, step and node."""

    case: Case
    step: str
    node: str
    cell: Cell

    @property
    def severity(self) -> tuple[int, float]:
        """Return a sort key that is largest for the worst result: outcome first, then the largest
        ratio of error to bound.
        """
        cell = self.cell
        pairs = ((cell.error, cell.bound), (cell.slope, cell.slope_bound))
        error_over_bound = [error / bound for error, bound in pairs if error is not None and bound]
        return ("pass", "warn", "fail").index(cell.mark), max(error_over_bound, default=-1.0)


@dataclass(frozen=True)
class StabilityOptions:
    """Which extreme cases are tested."""

    cases: Sequence[Case] = CASES


def study(
    recipe: Recipe, store: Store, progress: Progress, options: StabilityOptions
) -> StudyOutcome:
    """Test every step of ``recipe`` and its losses in every extreme case."""
    with one_thread():
        rows = list(_rows(recipe, store, options.cases, progress))
    content = _document(rows)
    key = digest([repr(_line(row)) for row in rows])
    return StudyOutcome(key, content, _report(recipe, rows, content))


def _rows(
    recipe: Recipe, store: Store, cases: Sequence[Case], progress: Progress
) -> Iterator[GridCell]:
    """Yield the result of each step in each case, except steps whose inputs the case does not
    change.
    """
    code = Code(store.code_memo)
    engine_digest = engine("studies.extreme_cases", "studies.case_result")
    usual_recipe = CaseRecipe.of(recipe, USUAL, code)
    for number, case in enumerate(cases, 1):
        case_recipe = (
            usual_recipe if case is USUAL else CaseRecipe.of(recipe, case, code, usual_recipe)
        )
        cells = list(
            _row(case_recipe, set(unchanged_steps(case_recipe, usual_recipe)), store, engine_digest)
        )
        yield from cells
        failures = sum(row.cell.mark == "fail" for row in cells)
        progress(f"[{number}/{len(cases)}] {case.name}: {len(cells)} steps, {failures} fail")
    code.save()


def _row(chain: CaseRecipe, same: set[str], store: Store, own: str) -> Iterator[GridCell]:
    """Yield the results of one case, from the store or computed now.

    ``same`` has the names of the steps that the case does not change; ``own`` is the digest of the
    study's code.
    """
    for name, step in chain.steps.items():
        if name in same:
            continue
        key = digest(
            "stability",
            own,
            chain.case.name,
            chain.keys[name],
            [chain.keys[source] for source in step.sources],
        )
        description = {
            "step": f"stability of {name}: {chain.case.name}",
            "recipe": chain.recipe.name,
            "versions": versions(),
        }
        cell = compute_once(store, key, dict, partial(_judge, chain, name), description, small=True)
        # empty where there is nothing to test
        if cell:
            yield GridCell(chain.case, name, step.node.path, Cell(**cell))


def _judge(chain: CaseRecipe, name: str) -> dict[str, Any]:
    """Return the result of a step's test as a dict; empty if an earlier step failed or the case
    changes no input.
    """
    try:
        inputs = chain.inputs(name)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            cell = judge_step(chain.steps[name], inputs, chain.case, chain.recipe.seed)
    except LookupError:  # an earlier step gave no result
        return {}
    return {} if cell is None else asdict(cell)


# --- the folder -----------------------------------------------------------------------------------


def _document(rows: Sequence[GridCell]) -> dict[str, Any]:
    """Return the number of cells for each outcome."""
    count = {mark: sum(row.cell.mark == mark for row in rows) for mark in ("pass", "warn", "fail")}
    return {
        "cells": len(rows),
        "passed": count["pass"],
        "warned": count["warn"],
        "failed": count["fail"],
    }


def _report(recipe: Recipe, rows: Sequence[GridCell], content: Mapping[str, Any]) -> StudyReport:
    """Return the page of the study: the grid, the cells that fail or nearly fail, and the cases."""
    worst_cells = _worst_by_case_and_node(rows)
    picture = grid_picture(
        [(row.case.group, row.case.name, row.node, row.cell) for row in worst_cells]
    )
    lead = (
        f"{content['cells']} cells, {len({r.case.name for r in rows})} cases by"
        f" {len({r.node for r in rows})} nodes: {content['failed']} fail, {content['warned']}"
        f" warn, {content['passed']} pass."
    )
    return StudyReport(
        f"Stability of {recipe.name}",
        lead,
        [Section("How to read it", _GUIDE, picture=picture), *_tables(rows)],
        {"stability": picture},
        tables={"table.csv": (_COLUMNS, map(_line, rows))},
        shown=None,
    )


def _worst_by_case_and_node(rows: Sequence[GridCell]) -> list[GridCell]:
    """Return the worst result of each node in each case, over all steps of the node."""
    # `groupby` needs equal keys to be adjacent
    ordered = sorted(rows, key=lambda r: (CASES.index(r.case) if r.case in CASES else 0, r.node))
    groups = itertools.groupby(ordered, key=lambda r: (r.case.name, r.node))
    return [max(group, key=lambda r: r.severity) for _, group in groups]


def _tables(rows: Sequence[GridCell]) -> Iterator[Section]:
    """Yield the tables of failed cells, of nearly failed cells, and of the cases."""
    headings: dict[Mark, str] = {
        "fail": "What fails",
        "warn": "What uses more than half of its bound",
    }
    for mark, heading in headings.items():
        lines = [_line(row) for row in rows if row.cell.mark == mark]
        marked = marked_column(lines, _COLUMNS.index("mark"), [mark] * len(lines))
        yield Section(heading, "" if lines else "No cell.", _COLUMNS if lines else (), marked)
    cases = {row.case.name: row.case for row in rows}.values()
    yield Section(
        "The cases",
        "",
        ("case", "group", "what"),
        [(case.name, case.group, case.what) for case in cases],
    )


def _line(row: GridCell) -> tuple[Any, ...]:
    """Return the row of a result in the table, with the columns of `_COLUMNS`."""
    cell = row.cell
    return (
        row.case.name,
        row.step,
        row.node,
        cell.mark,
        cell.error,
        cell.bound,
        cell.slope,
        cell.slope_bound,
        cell.note,
    )
