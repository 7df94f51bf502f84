"""The stability study: errors of each step's result and gradient in extreme cases, compared with bounds."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from neusee.workflows.engine.local_executor import one_thread
from neusee.workflows.engine.provenance import versions
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.engine_digest import engine
from neusee.workflows.report.study_folder import Progress, StudyReport, StudyRun
from neusee.workflows.report.study_page import Mark, Section
from neusee.workflows.store.memo import compute_once
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.stability.case_recipe import CaseRecipe, unchanged_steps
from neusee.workflows.studies.stability.case_result import Cell, judge_step
from neusee.workflows.studies.stability.extreme_cases import CASES, USUAL, Case
from neusee.workflows.studies.stability.stability_figures import grid_picture

_COLUMNS = ("case", "step", "node", "mark", "error", "bound", "gradient error", "gradient bound", "note")
_HOW = """Each step has the inputs of the recipe, at a small size, with one change: a parameter of the recipe, the
result of an earlier step, or the pictures among the inputs of the step. A random height map of the same depth takes the
place of a mask from a file, whose samples do not fit the small pupil. The result is compared with the node's own
reference, or with the same function on the same inputs in float64. The error is the largest difference over the
largest element, and the bound is the node's rtol (at least 1.2e-7, the rounding of single precision). A
single number f in which terms cancel counts with the sum of its terms, sum |x df/dx| over the pictures.

The second error is that of the gradient of a weighted sum of the result with respect to every picture, over the
gradient's largest element; the bound is 1e-4, or ten times the node's rtol if that is more. An error above half of its
bound is a warning: with the rounding of another machine it may exceed the bound. NaN or infinity must be refused with a
reason, show in the result, or have the effect of a large number. A step that refuses its inputs passes if its error
names the cause. An empty cell: the step has the inputs of the usual case, or no inputs."""


@dataclass(frozen=True)
class GridCell:
    """One test result with the extreme case, the step and the node that were tested."""

    case: Case
    step: str
    node: str
    cell: Cell

    @property
    def severity(self) -> tuple[int, float]:
        """Return a sort key, largest for the worst result: the outcome, then the largest ratio of error to bound."""
        cell = self.cell
        pairs = ((cell.error, cell.bound), (cell.slope, cell.slope_bound))
        shares = [error / bound for error, bound in pairs if error is not None and bound]
        return ("pass", "warn", "fail").index(cell.mark), max(shares, default=-1.0)


def study(
    recipe: Recipe,
    store: Store,
    runs: Path,
    command: Sequence[str],
    progress: Progress,
    cases: Sequence[Case] = CASES,
) -> Path:
    """Test every step of ``recipe`` and its losses in every extreme case, and return the folder with the results."""
    study_run = StudyRun("stability", recipe, command)
    with one_thread():
        rows = list(_rows(recipe, store, cases, progress))
    document = study_run.document(_document(rows))
    return study_run.write(runs, digest([repr(_line(row)) for row in rows]), document, _report(recipe, rows, document))


def _rows(recipe: Recipe, store: Store, cases: Sequence[Case], progress: Progress) -> Iterator[GridCell]:
    code = Code(store.code_memo)
    own = engine("studies.stability.extreme_cases", "studies.stability.case_result")
    usual = CaseRecipe.of(recipe, USUAL, code)
    for number, case in enumerate(cases, 1):
        chain = usual if case is USUAL else CaseRecipe.of(recipe, case, code, usual)
        found = list(_row(chain, set(unchanged_steps(chain, usual)), store, own))
        yield from found
        bad = sum(row.cell.mark == "fail" for row in found)
        progress(f"[{number}/{len(cases)}] {case.name}: {len(found)} steps, {bad} fail")
    code.save()


def _row(chain: CaseRecipe, same: set[str], store: Store, own: str) -> Iterator[GridCell]:
    for name, step in chain.steps.items():
        if name in same:
            continue
        key = digest("stability", own, chain.case.name, chain.keys[name], [chain.keys[s] for s in step.sources])
        about = {"step": f"stability of {name}: {chain.case.name}", "recipe": chain.recipe.name, "versions": versions()}
        cell = compute_once(store, key, dict, partial(_judge, chain, name), about, small=True)
        if cell:
            yield GridCell(chain.case, name, step.node.path, Cell(**cell))


def _judge(chain: CaseRecipe, name: str) -> dict[str, Any]:
    """Return the test result of a step as a dict, empty if an earlier step failed or the case changes no input."""
    try:
        inputs = chain.inputs(name)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            cell = judge_step(chain.steps[name], inputs, chain.case, chain.recipe.seed)
    except LookupError:
        return {}
    return {} if cell is None else asdict(cell)


# --- the folder -------------------------------------------------------------------------------------------------------


def _document(rows: Sequence[GridCell]) -> dict[str, Any]:
    count = {mark: sum(row.cell.mark == mark for row in rows) for mark in ("pass", "warn", "fail")}
    return {"cells": len(rows), "passed": count["pass"], "warned": count["warn"], "failed": count["fail"]}


def _report(recipe: Recipe, rows: Sequence[GridCell], document: Mapping[str, Any]) -> StudyReport:
    worst = _worst_by_case_and_node(rows)
    picture = grid_picture([(row.case.group, row.case.name, row.node, row.cell) for row in worst])
    lead = (
        f"{document['cells']} cells, {len({r.case.name for r in rows})} cases by {len({r.node for r in rows})} nodes: "
        f"{document['failed']} fail, {document['warned']} warn, {document['passed']} pass."
    )
    return StudyReport(
        f"Stability of {recipe.name}",
        lead,
        [Section("How to read it", _HOW, picture=picture), *_tables(rows)],
        {"stability": picture},
        tables={"table.csv": (_COLUMNS, map(_line, rows))},
        shown=[name for name in document if name != "config"],
    )


def _worst_by_case_and_node(rows: Sequence[GridCell]) -> list[GridCell]:
    ordered = sorted(rows, key=lambda r: (CASES.index(r.case) if r.case in CASES else 0, r.node))
    groups = itertools.groupby(ordered, key=lambda r: (r.case.name, r.node))
    return [max(group, key=lambda r: r.severity) for _, group in groups]


def _tables(rows: Sequence[GridCell]) -> Iterator[Section]:
    headings: dict[Mark, str] = {"fail": "What fails", "warn": "What uses more than half of its bound"}
    for mark, heading in headings.items():
        lines = [_line(row) for row in rows if row.cell.mark == mark]
        marks = {(i, _COLUMNS.index("mark")): mark for i in range(len(lines))}
        yield Section(heading, "" if lines else "No cell.", _COLUMNS if lines else (), lines, marks=marks)
    cases = {row.case.name: row.case for row in rows}.values()
    yield Section("The cases", "", ("case", "group", "what"), [(c.name, c.group, c.what) for c in cases])


def _line(row: GridCell) -> tuple[Any, ...]:
    c = row.cell
    return row.case.name, row.step, row.node, c.mark, c.error, c.bound, c.slope, c.slope_bound, c.note
