"""The study of what a recipe leaves out: a row for each omission and each output, and what simpler scenes cost."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from neusee.workflows.engine.provenance import timestamp, versions
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.report.run_folder import RunFolder, new_run
from neusee.workflows.report.study_page import Mark, Section, page
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.leave_out.omission_rows import Bench, Promise, Row
from neusee.workflows.studies.leave_out.scene_costs import Cost, costs

Tell = Callable[[str], None]
_COLUMNS = ("what", "name", "kind", "chosen", "bound", "rms", "largest", "outputs", "put back", "seconds", "holds")
_HOW = {
    "handed on": "left out",
    "not added": "not added",
    "stands in": "summed",
}


@dataclass(frozen=True)
class Found:
    """All that the study measured."""

    promises: Sequence[Promise]
    rows: Sequence[Row]
    costs: Sequence[Cost]

    @property
    def failed(self) -> int:
        """Bounds and outputs that do not hold."""
        return sum(not holds for holds in (*(p.holds for p in self.promises), *(r.holds for r in self.rows)))


def study(recipe: Recipe, store: Store, runs: Path, command: Sequence[str], tell: Tell, contents: bool = True) -> Path:
    """Measure every omission of ``recipe``; with ``contents``, also what simpler scenes cost."""
    began = time.perf_counter()
    bench = Bench(recipe, store)
    promises, rows = bench.promises(), []
    for promise in promises:
        tell(f"{promise.output}: error {promise.rms:.2g}, tolerance {recipe.tolerance:.2g}{_said(promise.holds)}")
    for row in bench.rows():
        rows.append(row)
        tell(f"{row.name} {row.kind}: {row.rms:.2g}, stated at most {row.bound:.2g}{_said(row.holds)}")
    found = Found(promises, rows, list(costs(recipe, store, tell)) if contents else [])
    doc = _document(recipe, command, found, time.perf_counter() - began)
    with new_run(runs, f"{recipe.name}_leave_out", digest(doc["rows"])) as folder:
        _write(folder, recipe, found, doc)
    return folder.path


def _said(holds: bool) -> str:
    return "" if holds else ": does not hold"


def _document(recipe: Recipe, command: Sequence[str], found: Found, seconds: float) -> dict[str, Any]:
    return {
        "study": "leave-out",
        "recipe": recipe.name,
        "tolerance": recipe.tolerance,
        "command": " ".join(command),
        "date": timestamp(),
        "seconds": seconds,
        "failed": found.failed,
        "outputs": [asdict(promise) for promise in found.promises],
        "rows": [asdict(row) for row in found.rows],
        "costs": [asdict(cost) for cost in found.costs],
        "versions": versions(),
        "config": recipe.config.to_yaml(),
    }


def _write(folder: RunFolder, recipe: Recipe, found: Found, doc: Mapping[str, Any]) -> None:
    folder.write_rows("table.csv", _COLUMNS, [*map(_output_line, found.promises), *map(_line, found.rows)])
    scenes = [(c.scene, c.seconds, c.computing, c.steps, "; ".join(c.left_out), c.refused) for c in found.costs]
    if scenes:
        folder.write_rows("costs.csv", ("scene", "seconds", "computing", "steps", "left out", "refused"), scenes)
    folder.write("provenance.json", json.dumps(doc, indent=1, ensure_ascii=False))
    sections = [_outputs(recipe, found), _omissions(found), *([_scenes(found)] if found.costs else [])]
    for section in sections:
        if section.picture:
            folder.write("figures/content.png", section.picture)
    told = {name: doc[name] for name in ("command", "date", "seconds", "tolerance", "versions")}
    folder.write("report.html", page(f"{recipe.name}: what is left out", _lead(recipe, found), sections, told))


def _output_line(p: Promise) -> Sequence[Any]:
    return "output", p.output, "", "", p.bound, p.rms, p.largest, "", "", "", p.holds


def _line(r: Row) -> Sequence[Any]:
    worst = max(r.outputs.values(), default=0.0)
    return "omission", r.name, r.kind, r.taken, r.bound, r.rms, r.largest, worst, r.back, r.seconds, r.holds


def _lead(recipe: Recipe, found: Found) -> str:
    chosen = [row for row in found.rows if row.taken]
    worst = max((p.rms for p in found.promises), default=0.0)
    held = "All bounds hold" if not found.failed else f"{found.failed} bounds do not hold"
    return (
        f"{held}. Of {len(found.rows)} steps that could be left out or made cheaper with a known bound, the recipe "
        f"does so with {len(chosen)} at its tolerance of {recipe.tolerance:.2g}; its worst output is then {worst:.2g} "
        "from the one with everything in full."
    )


def _outputs(recipe: Recipe, found: Found) -> Section:
    rows = [(p.output, p.bound, p.rms, p.largest, recipe.tolerance, _held(p.holds)) for p in found.promises]
    text = """Each output of the recipe as it chooses, against the same with everything in full (--exact). The
        error is the root mean square of the difference over the largest element, which is what the tolerance limits;
        the proved bound is what the nodes carry on from what was left out, where they can tell."""
    columns = ("output", "proved bound", "error", "largest difference", "tolerance", "holds")
    return Section("The outputs", text, columns, rows, marks=_marks([p.holds for p in found.promises], 5))


def _omissions(found: Found) -> Section:
    text = """Each omission alone, everything else in full. A step that is left out hands its input on; light that is
        not added stays away; of an image that is summed, only the sums over bands that its readers ask for are
        convolved. The stated bound and the change are shares of the largest element of the step's full result; of what
        is not added, of what it would be added to; of what is summed, of the steps that read it. For noise and for sums
        the bound limits the root mean square, where one draw of the noise may lie four standard errors beside the mean;
        for all else it limits the largest difference.

        Outputs: the error of the worst output by this omission alone. Put back: the change of the worst output when the
        recipe as it chooses computes this one in full after all. Saved: what its steps took, in seconds. A bound that
        the tolerance does not allow is tested all the same."""
    columns = ("step", "how", "chosen", "bound", "error", "largest", "outputs", "put back", "saved s", "holds")
    rows = [(*_told(r), _held(r.holds)) for r in found.rows]
    marks = _marks([r.holds for r in found.rows], len(columns) - 1)
    return Section("Each omission", text, columns, rows, marks=marks)


def _told(r: Row) -> Sequence[Any]:
    worst = max(r.outputs.values(), default=0.0)
    return r.name, _HOW[r.kind], r.taken, r.bound, r.rms, r.largest, worst, r.back, r.seconds


def _scenes(found: Found) -> Section:
    text = """What the engine takes from an empty store, in one process: the median of up to three runs. The first row
        computes everything in full; each of the others may leave out what its scene does not need."""
    full = found.costs[0].seconds
    rows = [
        (c.scene, None if c.refused else c.seconds, None if c.refused else c.seconds / full, c.steps, _listed(c))
        for c in found.costs
    ]
    columns = ("scene", "seconds", "share of full", "steps", "left out or made cheaper")
    drawn = [c for c in found.costs if math.isfinite(c.seconds)]
    from neusee.workflows.studies.leave_out.scene_cost_figures import bars

    return Section("Cost follows content", text, columns, rows, bars(drawn) if drawn else None)


def _listed(cost: Cost) -> str:
    return cost.refused or ", ".join(cost.left_out) or "nothing"


def _held(holds: bool) -> str:
    return "holds" if holds else "fails"


def _marks(holds: Sequence[bool], column: int) -> dict[tuple[int, int], Mark]:
    return {(row, column): "pass" if one else "fail" for row, one in enumerate(holds)}
