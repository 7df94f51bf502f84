"""The study of what a recipe leaves out: a row for each omission and each output, and what simpler scenes cost."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.report.figures.style import BLUE, canvas, drawn
from neusee.workflows.report.study_folder import SHOWN, CsvTable, Progress, StudyReport, StudyRun
from neusee.workflows.report.study_page import Mark, Section
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.leave_out.omission_rows import Bench, Promise, Row
from neusee.workflows.studies.leave_out.scene_costs import Cost, costs

_WAITING = "#9DB8CC"  #: the colour of seconds that the engine takes beside the steps
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


def study(
    recipe: Recipe, store: Store, runs: Path, command: Sequence[str], progress: Progress, contents: bool = True
) -> Path:
    """Measure every omission of ``recipe``; with ``contents``, also what simpler scenes cost."""
    study_run = StudyRun("leave-out", recipe, command)
    bench = Bench(recipe, store)
    promises, rows = bench.promises(), []
    for promise in promises:
        progress(f"{promise.output}: error {promise.rms:.2g}, tolerance {recipe.tolerance:.2g}{_said(promise.holds)}")
    for row in bench.rows():
        rows.append(row)
        progress(f"{row.name} {row.kind}: {row.rms:.2g}, stated at most {row.bound:.2g}{_said(row.holds)}")
    found = Found(promises, rows, list(costs(recipe, store, progress)) if contents else [])
    document = study_run.document(_document(recipe, found))
    return study_run.write(runs, digest(document["rows"]), document, _report(recipe, found))


def _said(holds: bool) -> str:
    return "" if holds else ": does not hold"


def _document(recipe: Recipe, found: Found) -> dict[str, Any]:
    """Return what the folder says of the study, beside what every study says."""
    return {
        "tolerance": recipe.tolerance,
        "failed": found.failed,
        "outputs": [asdict(promise) for promise in found.promises],
        "rows": [asdict(row) for row in found.rows],
        "costs": [asdict(cost) for cost in found.costs],
    }


def _report(recipe: Recipe, found: Found) -> StudyReport:
    tables: dict[str, CsvTable] = {
        "table.csv": (_COLUMNS, [*map(_output_line, found.promises), *map(_line, found.rows)])
    }
    sections, picture = [_outputs(recipe, found), _omissions(found)], None
    if found.costs:
        scenes = [(c.scene, c.seconds, c.computing, c.steps, "; ".join(c.left_out), c.refused) for c in found.costs]
        tables["costs.csv"] = (("scene", "seconds", "computing", "steps", "left out", "refused"), scenes)
        sections.append(_scenes(found))
        picture = sections[-1].picture
    title, shown = f"{recipe.name}: what is left out", (*SHOWN, "tolerance")
    return StudyReport(title, _lead(recipe, found), sections, {"content": picture}, tables, shown=shown)


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
    timed = [c for c in found.costs if math.isfinite(c.seconds)]
    return Section("Cost follows content", text, columns, rows, _bars(timed) if timed else None)


@drawn
def _bars(costs: Sequence[Cost]) -> Any:
    """Seconds of each scene: in its steps, and in the engine beside them."""
    figure, axes = canvas(8.0, 0.42 * len(costs) + 1.0)
    ax = axes[0, 0]
    names = [cost.scene for cost in costs]
    inside = [min(cost.computing, cost.seconds) for cost in costs]
    ax.barh(names, inside, color=BLUE, label="in the steps")
    beside = [cost.seconds - part for cost, part in zip(costs, inside, strict=True)]
    ax.barh(names, beside, left=inside, color=_WAITING, label="reading, keeping, choosing")
    for row, cost in enumerate(costs):
        ax.annotate(f" {cost.seconds:.3g} s", (cost.seconds, row), va="center", fontsize=9)
    ax.invert_yaxis()
    ax.grid(False, axis="y")
    ax.set_xlabel("seconds, from an empty store")
    ax.set_xlim(0, 1.15 * max(cost.seconds for cost in costs))
    ax.legend(loc="lower right")
    return figure


def _listed(cost: Cost) -> str:
    return cost.refused or ", ".join(cost.left_out) or "nothing"


def _held(holds: bool) -> str:
    return "holds" if holds else "fails"


def _marks(holds: Sequence[bool], column: int) -> dict[tuple[int, int], Mark]:
    return {(row, column): "pass" if one else "fail" for row, one in enumerate(holds)}
