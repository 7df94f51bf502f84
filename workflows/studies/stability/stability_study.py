"""Is every step sound at the extremes: the grid of cases and steps, each cell a stated bound and a number."""

from __future__ import annotations

import itertools
import json
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from neusee.workflows.engine.provenance import versions
from neusee.workflows.engine.threads import one_thread
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import Key, digest
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.engine_digest import engine
from neusee.workflows.report.run_folder import RunFolder, new_run
from neusee.workflows.report.study_page import Mark, Section, page
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.stability.case_recipe import Chain, untouched
from neusee.workflows.studies.stability.case_result import Cell, judged
from neusee.workflows.studies.stability.extreme_cases import CASES, USUAL, Case
from neusee.workflows.studies.stability.stability_figures import grid_picture

Tell = Callable[[str], None]
_COLUMNS = ("case", "step", "node", "mark", "error", "bound", "gradient error", "gradient bound", "note")
_HOW = """Each step is given what the recipe gives it, at a small size, with one thing changed: a parameter of the
recipe, the result of one of its steps, or the pictures that the step itself is given. Its result is compared with the
node's own reference, or with the same function on the same inputs in float64; the number is the largest difference over
the largest element, and the bound is the node's rtol (no less than 1.2e-7, what single precision can hold).

The second number is that of the gradient of a weighted sum of the result with respect to every picture, over its
largest element; the bound is 1e-4, or ten times the node's rtol where that is more. What holds by less than twice is
marked as a warning: another machine's rounding may take it over. A number that is none, or infinite,
must be refused with a reason, stay to be seen in the result, or count as the limit of large numbers. One that refuses
passes where its error says what is wrong. Empty: the step is given what it is given in the usual case, or nothing."""


@dataclass(frozen=True)
class Row:
    """One cell with where it stands."""

    case: Case
    step: str
    node: str
    cell: Cell

    @property
    def severity(self) -> tuple[int, float]:
        """The worst cell of several steps of one node is the one shown."""
        shares = [e / b for e, b in ((self.cell.error, self.cell.bound), (self.cell.slope, self.cell.slope_bound))
                  if e is not None and b]  # fmt: skip
        return ("pass", "warn", "fail").index(self.cell.mark), max(shares, default=-1.0)


def study(
    recipe: Recipe,
    store: Store,
    runs: Path,
    command: Sequence[str],
    tell: Tell,
    cases: Sequence[Case] = CASES,
) -> Path:
    """Judge every step of ``recipe``, and its losses, in every case; cells that are stored are not judged again."""
    began = time.perf_counter()
    with one_thread():
        rows = list(_rows(recipe, store, cases, tell))
    doc = _document(recipe, rows, command, time.perf_counter() - began)
    with new_run(runs, f"{recipe.name}_stability", digest([repr(_line(row)) for row in rows])) as folder:
        _write(folder, recipe, rows, doc)
    return folder.path


def _rows(recipe: Recipe, store: Store, cases: Sequence[Case], tell: Tell) -> Iterator[Row]:
    code = Code(store.code_memo)
    own = engine("studies.stability.extreme_cases", "studies.stability.case_result")
    usual = Chain.of(recipe, USUAL, code)
    for number, case in enumerate(cases, 1):
        chain = usual if case is USUAL else Chain.of(recipe, case, code)
        found = list(_row(chain, set(untouched(chain, usual)), store, own))
        yield from found
        bad = sum(row.cell.mark == "fail" for row in found)
        tell(f"[{number}/{len(cases)}] {case.name}: {len(found)} steps, {bad} fail")
    code.save()


def _row(chain: Chain, same: set[str], store: Store, own: str) -> Iterator[Row]:
    for name, step in chain.steps.items():
        if name in same:
            continue
        key = digest("stability", own, chain.case.name, chain.keys[name], [chain.keys[s] for s in step.sources])
        known = _stored(store, key)
        if known is None:
            known = _judged(chain, name, store, key)
        if known:
            yield Row(chain.case, name, step.node.path, Cell(**known))


def _stored(store: Store, key: Key) -> dict[str, Any] | None:
    """The fields of a cell, none where there is none to be had; None where it was never judged."""
    try:
        found: dict[str, Any] = store.get(key)
    except KeyError:
        return None
    return found


def _judged(chain: Chain, name: str, store: Store, key: Key) -> dict[str, Any]:
    """The same, judged now and kept; none where a step before this one refused or the case changes nothing of it."""
    step, began = chain.steps[name], time.perf_counter()
    try:
        inputs = chain.inputs(name)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            cell = judged(step, inputs, chain.case, chain.recipe.seed)
    except LookupError:
        cell = None
    fields = {} if cell is None else asdict(cell)
    store.put_small(key, fields, _about(chain, name, time.perf_counter() - began))
    return fields


def _about(chain: Chain, name: str, seconds: float) -> dict[str, Any]:
    date = datetime.now(UTC).isoformat(timespec="seconds")
    return {"step": f"stability of {name}: {chain.case.name}", "recipe": chain.recipe.name, "seconds": seconds,
            "versions": versions(), "date": date}  # fmt: skip


# --- the folder -------------------------------------------------------------------------------------------------------


def _document(recipe: Recipe, rows: Sequence[Row], command: Sequence[str], seconds: float) -> dict[str, Any]:
    count = {mark: sum(row.cell.mark == mark for row in rows) for mark in ("pass", "warn", "fail")}
    return {
        "study": "stability",
        "recipe": recipe.name,
        "command": " ".join(command),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "cells": len(rows),
        "passed": count["pass"],
        "warned": count["warn"],
        "failed": count["fail"],
        "seconds": round(seconds, 2),
        "versions": versions(),
    }


def _write(folder: RunFolder, recipe: Recipe, rows: Sequence[Row], doc: dict[str, Any]) -> None:
    worst = _worst(rows)
    picture = grid_picture([(row.case.group, row.case.name, row.node, row.cell) for row in worst])
    folder.write("figures/stability.png", picture)
    folder.write_rows("table.csv", _COLUMNS, map(_line, rows))
    folder.write("provenance.json", json.dumps(doc, indent=1, ensure_ascii=False))
    lead = (
        f"{doc['cells']} cells, {len({r.case.name for r in rows})} cases by {len({r.node for r in rows})} nodes: "
        f"{doc['failed']} fail, {doc['warned']} warn, {doc['passed']} pass."
    )
    sections = [Section("How to read it", _HOW, picture=picture), *_tables(rows)]
    folder.write("report.html", page(f"Stability of {recipe.name}", lead, sections, doc))


def _worst(rows: Sequence[Row]) -> list[Row]:
    """One row for each case and node."""
    ordered = sorted(rows, key=lambda r: (CASES.index(r.case) if r.case in CASES else 0, r.node))
    groups = itertools.groupby(ordered, key=lambda r: (r.case.name, r.node))
    return [max(group, key=lambda r: r.severity) for _, group in groups]


def _tables(rows: Sequence[Row]) -> Iterator[Section]:
    told: tuple[tuple[Mark, str, str], ...] = (
        ("fail", "What fails", "Nothing."),
        ("warn", "What holds by less than twice", "Nothing."),
    )
    for mark, heading, nothing in told:
        found = [row for row in rows if row.cell.mark == mark]
        marks = {(i, _COLUMNS.index("mark")): mark for i in range(len(found))}
        yield Section(
            heading, "" if found else nothing, _COLUMNS if found else (), [_line(r) for r in found], marks=marks
        )
    cases = {row.case.name: row.case for row in rows}.values()
    yield Section("The cases", "", ("case", "group", "what"), [(c.name, c.group, c.what) for c in cases])


def _line(row: Row) -> tuple[Any, ...]:
    c = row.cell
    return row.case.name, row.step, row.node, c.mark, c.error, c.bound, c.slope, c.slope_bound, c.note
