"""The leave-out study: the error of a recipe with steps left out, and the run time of simpler scenes."""

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

_WAITING = "#9DB8CC"  #: the colour of the seconds that the engine takes outside the steps
_COLUMNS = ("what", "name", "kind", "chosen", "bound", "rms", "largest", "outputs", "put back", "seconds", "holds")
_HOW = {"handed on": "left out", "not added": "not added", "stands in": "summed"}
_HELD = {True: "holds", False: "fails"}


@dataclass(frozen=True)
class LeaveOutResult:
    """The result of the leave-out study: errors of outputs, errors of left-out steps, and run times of scenes."""

    output_errors: Sequence[OutputError]
    rows: Sequence[OmissionRow]
    costs: Sequence[SceneCost]

    @property
    def failed(self) -> int:
        """Return how many outputs and left-out steps exceed their error bounds."""
        return sum(not output.holds for output in self.output_errors) + sum(not row.holds for row in self.rows)


def study(
    recipe: Recipe, store: Store, runs: Path, command: Sequence[str], progress: Progress, contents: bool = True
) -> Path:
    """Measure the errors of a recipe with steps left out, and with ``contents`` the run times for simpler scenes."""
    study_run = StudyRun("leave-out", recipe, command)
    comparison = OmissionComparison(recipe, store)
    output_errors, rows = comparison.output_errors(), []
    failure = {True: "", False: ": does not hold"}
    for output in output_errors:
        stated = output.kind if output.bound is None else f"{output.bound:.2g} ({output.kind})"
        error = f"error {output.rms:.2g}, stated {stated}, tolerance {recipe.tolerance:.2g}"
        progress(f"{output.output}: {error}{failure[output.holds]}")
    for row in comparison.rows():
        rows.append(row)
        error = f"{row.rms:.2g}, stated at most {row.bound:.2g}{failure[row.holds]}"
        progress(f"{row.name} {row.kind}: {error} ({len(rows)} of {len(comparison.found)})")
    result = LeaveOutResult(output_errors, rows, list(measure_scenes(recipe, store, progress)) if contents else [])
    document = study_run.document({"tolerance": recipe.tolerance, "failed": result.failed, **_document(result)})
    return study_run.write(runs, digest(document["rows"]), document, _report(recipe, result))


def _document(result: LeaveOutResult) -> dict[str, Any]:
    parts: dict[str, Sequence[Any]] = {"outputs": result.output_errors, "rows": result.rows, "costs": result.costs}
    return {name: [asdict(row) for row in rows] for name, rows in parts.items()}


def _report(recipe: Recipe, result: LeaveOutResult) -> StudyReport:
    lines = [*map(_output_line, result.output_errors), *(("omission", *_cells(r), r.holds) for r in result.rows)]
    tables: dict[str, CsvTable] = {"table.csv": (_COLUMNS, lines)}
    sections, picture = [_outputs(recipe, result), _omissions(result)], None
    if result.costs:
        scenes = [(c.scene, c.seconds, c.computing, c.steps, "; ".join(c.left_out), c.refused) for c in result.costs]
        tables["costs.csv"] = (("scene", "seconds", "computing", "steps", "left out", "refused"), scenes)
        sections.append(_scenes(result))
        picture = sections[-1].picture
    title, shown = f"{recipe.name}: omissions", (*SHOWN, "tolerance")
    return StudyReport(title, _lead(recipe, result), sections, {"content": picture}, tables, shown=shown)


def _output_line(p: OutputError) -> Sequence[Any]:
    return "output", p.output, p.kind, "", p.bound, p.rms, p.largest, "", "", "", p.holds


def _cells(r: OmissionRow) -> tuple[Any, ...]:
    worst = max(r.outputs.values(), default=0.0)
    return r.name, r.kind, r.taken, r.bound, r.rms, r.largest, worst, r.back, r.seconds


def _lead(recipe: Recipe, result: LeaveOutResult) -> str:
    chosen = [row for row in result.rows if row.taken]
    worst = max((p.rms for p in result.output_errors), default=0.0)
    held = "All stated errors hold" if not result.failed else f"{result.failed} stated errors are too small"
    return (
        f"{held}. Of {len(result.rows)} possible omissions with a known bound, the recipe chooses {len(chosen)} at its "
        f"tolerance of {recipe.tolerance:.2g}. The largest error of an output is then {worst:.2g}, "
        "relative to the full computation."
    )


def _outputs(recipe: Recipe, result: LeaveOutResult) -> Section:
    tolerance = recipe.tolerance
    rows = [(p.output, p.bound, p.kind, p.rms, p.largest, tolerance, _HELD[p.holds]) for p in result.output_errors]
    text = """Each output of the recipe with the chosen omissions, compared with the full computation (`--exact`). The
        error is the root mean square of the difference over the largest element; the tolerance limits it before noise
        and rounding. The stated error is that of the page of a run: proved, estimated, or unknown."""
    columns = ("output", "stated error", "kind", "error", "largest difference", "tolerance", "holds")
    return Section("The outputs", text, columns, rows, marks=_marks(result.output_errors, len(columns) - 1))


def _omissions(result: LeaveOutResult) -> Section:
    text = """Each omission alone, with all other steps computed in full. A step that is left out returns its input.
        Light that is not added is replaced by zero. For a summed image, only the sums over bands that later steps need
        are convolved. The stated bound and the error are relative to the largest element: of the step's full result; of
        the sum, for light that is not added; of the steps that read the image, for a summed image. For noise and for
        summed images the bound limits the root mean square error, and one draw of the noise may exceed the bound by
        four standard errors. For all other omissions the bound limits the largest error.

        Outputs: the error of the worst output with this omission alone. Put back: the change of the worst output when
        the recipe with the chosen omissions computes this step in full. Saved: the run time of the omitted steps, in s.
        Omissions that the tolerance does not allow are tested too."""
    columns = ("step", "how", "chosen", "bound", "error", "largest", "outputs", "put back", "saved (s)", "holds")
    cells = [(_cells(row), row) for row in result.rows]
    rows = [(name, _HOW[kind], *rest, _HELD[row.holds]) for (name, kind, *rest), row in cells]
    return Section("Each omission", text, columns, rows, marks=_marks(result.rows, len(columns) - 1))


def _scenes(result: LeaveOutResult) -> Section:
    text = """The run time from an empty store, in one process: the median of up to three runs. The first row is the
        full computation; in the other rows the engine may leave out steps that the scene does not need."""
    full = result.costs[0].seconds
    rows = []
    for c in result.costs:
        seconds = (None, None) if c.refused else (c.seconds, c.seconds / full)
        rows.append((c.scene, *seconds, c.steps, c.refused or ", ".join(c.left_out) or "nothing"))
    columns = ("scene", "seconds", "share of full", "steps", "left out or made cheaper")
    timed = [c for c in result.costs if math.isfinite(c.seconds)]
    return Section("Run time of simpler scenes", text, columns, rows, _bars(timed) if timed else None)


@drawn
def _bars(costs: Sequence[SceneCost]) -> Any:
    figure, axes = canvas(8.0, 0.42 * len(costs) + 1.3)
    ax = axes[0, 0]
    names = [cost.scene for cost in costs]
    inside = [min(cost.computing, cost.seconds) for cost in costs]
    ax.barh(names, inside, color=BLUE, label="in the steps")
    beside = [cost.seconds - part for cost, part in zip(costs, inside, strict=True)]
    ax.barh(names, beside, left=inside, color=_WAITING, label="in the engine and the store")
    for row, cost in enumerate(costs):
        ax.annotate(f" {cost.seconds:.3g} s", (cost.seconds, row), va="center", fontsize=9)
    ax.invert_yaxis()
    ax.grid(False, axis="y")
    ax.set_xlabel("seconds, from an empty store")
    ax.set_xlim(0, 1.15 * max(cost.seconds for cost in costs) or 1.0)
    figure.legend(loc="outside upper center", ncols=2)  # no bar and no note is there, whatever the times
    return figure


def _marks(rows: Sequence[OutputError | OmissionRow], column: int) -> dict[tuple[int, int], Mark]:
    return {(i, column): "pass" if row.holds else "fail" for i, row in enumerate(rows)}
