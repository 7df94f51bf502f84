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
from neusee.workflows.studies.leave_out.omission_rows import OmissionComparison, OmissionRow, OutputError
from neusee.workflows.studies.leave_out.scene_costs import SceneCost, measure_scenes

_WAITING = "#9DB8CC"  #: the colour of seconds that the engine takes beside the steps
_COLUMNS = ("what", "name", "kind", "chosen", "bound", "rms", "largest", "outputs", "put back", "seconds", "holds")
_HOW = {
    "handed on": "left out",
    "not added": "not added",
    "stands in": "summed",
}


@dataclass(frozen=True)
class LeaveOutResult:
    """All that the study measured."""

    output_errors: Sequence[OutputError]
    rows: Sequence[OmissionRow]
    costs: Sequence[SceneCost]

    @property
    def failed(self) -> int:
        """Return how many bounds and outputs do not hold."""
        return sum(not holds for holds in (*(p.holds for p in self.output_errors), *(r.holds for r in self.rows)))


def study(
    recipe: Recipe, store: Store, runs: Path, command: Sequence[str], progress: Progress, contents: bool = True
) -> Path:
    """Measure every omission of ``recipe``; with ``contents``, also what simpler scenes cost."""
    study_run = StudyRun("leave-out", recipe, command)
    comparison = OmissionComparison(recipe, store)
    output_errors, rows = comparison.output_errors(), []
    for promise in output_errors:
        progress(
            f"{promise.output}: error {promise.rms:.2g}, tolerance {recipe.tolerance:.2g}{_failure_note(promise.holds)}"
        )
    for row in comparison.rows():
        rows.append(row)
        progress(f"{row.name} {row.kind}: {row.rms:.2g}, stated at most {row.bound:.2g}{_failure_note(row.holds)}")
    found = LeaveOutResult(output_errors, rows, list(measure_scenes(recipe, store, progress)) if contents else [])
    document = study_run.document(_document(recipe, found))
    return study_run.write(runs, digest(document["rows"]), document, _report(recipe, found))


def _failure_note(holds: bool) -> str:
    return "" if holds else ": does not hold"


def _document(recipe: Recipe, found: LeaveOutResult) -> dict[str, Any]:
    """Return what the folder says of the study, beside what every study says."""
    return {
        "tolerance": recipe.tolerance,
        "failed": found.failed,
        "outputs": [asdict(promise) for promise in found.output_errors],
        "rows": [asdict(row) for row in found.rows],
        "costs": [asdict(cost) for cost in found.costs],
    }


def _report(recipe: Recipe, found: LeaveOutResult) -> StudyReport:
    tables: dict[str, CsvTable] = {
        "table.csv": (_COLUMNS, [*map(_output_line, found.output_errors), *map(_line, found.rows)])
    }
    sections, picture = [_outputs(recipe, found), _omissions(found)], None
    if found.costs:
        scenes = [(c.scene, c.seconds, c.computing, c.steps, "; ".join(c.left_out), c.refused) for c in found.costs]
        tables["costs.csv"] = (("scene", "seconds", "computing", "steps", "left out", "refused"), scenes)
        sections.append(_scenes(found))
        picture = sections[-1].picture
    title, shown = f"{recipe.name}: what is left out", (*SHOWN, "tolerance")
    return StudyReport(title, _lead(recipe, found), sections, {"content": picture}, tables, shown=shown)


def _output_line(p: OutputError) -> Sequence[Any]:
    return "output", p.output, "", "", p.bound, p.rms, p.largest, "", "", "", p.holds


def _line(r: OmissionRow) -> Sequence[Any]:
    worst = max(r.outputs.values(), default=0.0)
    return "omission", r.name, r.kind, r.taken, r.bound, r.rms, r.largest, worst, r.back, r.seconds, r.holds


def _lead(recipe: Recipe, found: LeaveOutResult) -> str:
    chosen = [row for row in found.rows if row.taken]
    worst = max((p.rms for p in found.output_errors), default=0.0)
    held = "All bounds hold" if not found.failed else f"{found.failed} bounds do not hold"
    return (
        f"{held}. Of {len(found.rows)} steps that could be left out or made cheaper with a known bound, the recipe "
        f"does so with {len(chosen)} at its tolerance of {recipe.tolerance:.2g}; its worst output is then {worst:.2g} "
        "from the one with everything in full."
    )


def _outputs(recipe: Recipe, found: LeaveOutResult) -> Section:
    rows = [(p.output, p.bound, p.rms, p.largest, recipe.tolerance, _held(p.holds)) for p in found.output_errors]
    text = """Each output of the recipe as it chooses, against the same with everything in full (--exact). The
        error is the root mean square of the difference over the largest element, which the tolerance limits. The
        proved bound is what the nodes propagate from the omissions, where they have a bound."""
    columns = ("output", "proved bound", "error", "largest difference", "tolerance", "holds")
    return Section("The outputs", text, columns, rows, marks=_marks([p.holds for p in found.output_errors], 5))


def _omissions(found: LeaveOutResult) -> Section:
    text = """Each omission alone, with everything else in full. A step that is left out passes its input on. Light
        may be not added. For a summed image, only the sums over bands that its readers need are convolved. The stated
        bound and the change are shares of the largest element: of the step's full result; for light that is not added,
        of the sum; for a summed image, of the steps that read it. For noise and for sums the bound limits the root mean
        square, and one draw of the noise may differ by four standard errors; for all others it limits the largest
        difference.

        Outputs: the error of the worst output by this omission alone. Put back: the change of the worst output when the
        recipe as it chooses computes this one step in full. Saved: the seconds of its steps. A bound that the tolerance
        does not allow is tested too."""
    columns = ("step", "how", "chosen", "bound", "error", "largest", "outputs", "put back", "saved s", "holds")
    rows = [(*_cells(r), _held(r.holds)) for r in found.rows]
    marks = _marks([r.holds for r in found.rows], len(columns) - 1)
    return Section("Each omission", text, columns, rows, marks=marks)


def _cells(r: OmissionRow) -> Sequence[Any]:
    worst = max(r.outputs.values(), default=0.0)
    return r.name, _HOW[r.kind], r.taken, r.bound, r.rms, r.largest, worst, r.back, r.seconds


def _scenes(found: LeaveOutResult) -> Section:
    text = """The run time from an empty store, in one process: the median of up to three runs. The first row
        computes everything in full; the others may leave out what their scene does not need."""
    full = found.costs[0].seconds
    rows = [
        (c.scene, None if c.refused else c.seconds, None if c.refused else c.seconds / full, c.steps, _listed(c))
        for c in found.costs
    ]
    columns = ("scene", "seconds", "share of full", "steps", "left out or made cheaper")
    timed = [c for c in found.costs if math.isfinite(c.seconds)]
    return Section("Cost follows content", text, columns, rows, _bars(timed) if timed else None)


@drawn
def _bars(costs: Sequence[SceneCost]) -> Any:
    """Draw the seconds of each scene: in its steps, and in the engine beside them."""
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


def _listed(cost: SceneCost) -> str:
    return cost.refused or ", ".join(cost.left_out) or "nothing"


def _held(holds: bool) -> str:
    return "holds" if holds else "fails"


def _marks(holds: Sequence[bool], column: int) -> dict[tuple[int, int], Mark]:
    return {(row, column): "pass" if one else "fail" for row, one in enumerate(holds)}
