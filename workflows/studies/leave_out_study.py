"""The leave-out study: error of left-out steps, and run time of simpler scenes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from neusee.workflows.engine.provenance import machine
from neusee.workflows.engine.runner import Result
from neusee.workflows.graph.errors import UNREAD, RecipeError, RunError
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.keys.code_digest import Code, engine
from neusee.workflows.recipe.loading import changed
from neusee.workflows.report.figures.style import BLUE, canvas, drawn
from neusee.workflows.report.study_report import (
    SHOWN,
    CsvTable,
    Marked,
    Progress,
    Section,
    StudyOutcome,
    StudyReport,
)
from neusee.workflows.store.result_store import Store, compute_once
from neusee.workflows.studies.left_out_steps import (
    OmissionComparison,
    OmissionRow,
    OutputError,
)
from neusee.workflows.studies.run_study import key_parts, run_cold

# --- scene costs ----------------------------------------------------------------------------------

# Run times of simpler scenes: the recipe without a laser, at one wavelength, or behind a clean
# window.


_TIMES = 3  #: cold runs of a scene, of which the median time is used
_QUICK_SECONDS = 5.0  #: s; a scene that takes longer is run once
_WINDOW = ("flare.dirt", "flare.ghosts")
#: a node that also works with a single band
_LIFT = "steps.cube={node: spectra.lift_mallett, from: {rgb: scene, bands: bands}}"
_GREY = "steps.scene={node: scene.targets, with: {kind: siemens, shape: '${scene.shape}'}}"


@dataclass(frozen=True)
class SceneCost:
    """The run time of a recipe with one scene, and the steps that the engine omitted."""

    scene: str
    seconds: float  #: median of the engine's cold runs; NaN if the scene could not be run
    computing: float  #: s in the steps
    steps: int  #: number of computed steps
    left_out: tuple[str, ...]  #: steps that the engine left out, or replaced by cheaper steps
    refused: str = ""


def measure_scenes(
    recipe: Recipe, store: Store, progress: Callable[[str], None]
) -> Iterator[SceneCost]:
    """Yield the run time of ``recipe`` with each simpler scene, from the store or measured now."""
    code, warm = Code(store.code_memo), list[Result]()
    for scene, changed_recipe in scenes(recipe).items():
        if isinstance(changed_recipe, str):
            yield SceneCost(scene, float("nan"), 0.0, 0, (), changed_recipe)
            continue

        def compute(scene: str = scene, recipe: Recipe = changed_recipe) -> SceneCost:
            if not warm:  # the first run of a process imports libraries and reads code
                warm.append(run_cold(recipe, store))
            return _cost(scene, recipe, store)

        code_and_machine = engine("studies.leave_out_study", "engine.runner"), machine()
        key = digest("content", key_parts(changed_recipe, code), *code_and_machine)
        # scenes with equal steps share a stored result under another name
        cost = replace(
            compute_once(store, key, SceneCost, compute, {"step": "study leave-out"}), scene=scene
        )
        progress(f"{scene}: {cost.refused or f'{cost.seconds:.3g} s'}")
        yield cost


def scenes(recipe: Recipe) -> dict[str, Recipe | str]:
    """Return the recipe with each simpler scene by name, or the reason why this scene is
    impossible.
    """
    recipe_of_scene: dict[str, Recipe | str] = {"everything in full": replace(recipe, exact=True)}
    recipe_of_scene["as the recipe chooses"] = recipe
    for scene, overrides in _overrides(recipe).items():
        try:
            recipe_of_scene[scene] = _changed(recipe, overrides)
        except RecipeError as error:
            recipe_of_scene[scene] = "; ".join(problem.message for problem in error.diagnostics)
    return recipe_of_scene


def _changed(recipe: Recipe, overrides: Sequence[str]) -> Recipe:
    """Apply overrides to ``recipe``, and remove (``~path``) recipe values that no step reads any
    more.
    """
    try:
        return changed(recipe, overrides)
    except RecipeError as error:
        removals = [f"~{problem.path}" for problem in error.diagnostics if problem.code == UNREAD]
        # another error, which removals do not fix
        if len(removals) < len(error.diagnostics):
            raise
        return changed(recipe, [*overrides, *removals])


def _overrides(recipe: Recipe) -> Mapping[str, Sequence[str]]:
    """Return the overrides for each simpler scene; scenes that the recipe cannot have are
    omitted.
    """
    no_laser, clean_window = _no_laser(recipe), _clean_window(recipe)
    lift = [_LIFT] if "cube" in recipe.steps else []
    one_wavelength = [*_bands(recipe, "549 nm", "551 nm", 1), *lift]
    changes = {
        "no laser": no_laser,
        "clean window": clean_window,
        "grey scene": _grey_scene(recipe),
        "narrow band, 540 to 560 nm": _bands(recipe, "540 nm", "560 nm", 3),
        "one wavelength": one_wavelength,
        "one wavelength, no laser, clean window": [*no_laser, *clean_window, *one_wavelength],
    }
    return {scene: overrides for scene, overrides in changes.items() if overrides}


def _no_laser(recipe: Recipe) -> list[str]:
    has_laser = any(name.startswith("lasers.") for name in recipe.config.settings)
    return ["lasers={}"] if has_laser else []


def _clean_window(recipe: Recipe) -> list[str]:
    names = {name.partition("[")[0] for name in _window_steps(recipe)}
    return [f"steps.{name}=null" for name in sorted(names)]


def _grey_scene(recipe: Recipe) -> list[str]:
    has_shape = "scene" in recipe.steps and "scene.shape" in recipe.config.settings
    return [_GREY] if has_shape else []


def _window_steps(recipe: Recipe) -> set[str]:
    """Return the steps that compute window dirt or ghosts, and all steps that require their
    results.
    """
    window = {name for name, step in recipe.steps.items() if step.node.path in _WINDOW}
    for name, step in recipe.steps.items():
        required_sources = {
            source
            for input_name, source in step.wires.items()
            if isinstance(source, str) and input_name not in step.node.optional
        }
        if name in window or not required_sources.isdisjoint(window):
            window.add(name)
    return window


def _bands(recipe: Recipe, start: str, stop: str, count: int) -> list[str]:
    """Return overrides for ``count`` bands between two wavelengths; empty if the recipe lacks these
    settings.
    """
    names = ("optics.shortest", "optics.longest", "optics.bands")
    if any(name not in recipe.config.settings for name in names):
        return []
    return [f"{name}={value}" for name, value in zip(names, (start, stop, count), strict=True)]


def _cost(scene: str, recipe: Recipe, store: Store) -> SceneCost:
    """Return the run time of a scene, or why the scene could not be run."""
    try:
        result = _median_run(recipe, store)
    except RunError as error:
        return SceneCost(scene, float("nan"), 0.0, 0, (), f"{error.step}: {error.cause}")
    seconds_of_steps = [done.seconds for done in result.done.values() if done.state == "run"]
    left_out = [done.step for done in result.done.values() if done.state == "left out"]
    replaced = [economy.step for economy in result.recipe.substitutions]
    return SceneCost(
        scene, result.seconds, sum(seconds_of_steps), len(seconds_of_steps), (*left_out, *replaced)
    )


def _median_run(recipe: Recipe, store: Store) -> Result:
    """Return the run with the median time; only fast runs are repeated."""
    results = [run_cold(recipe, store)]
    while max(measured.seconds for measured in results) < _QUICK_SECONDS and len(results) < _TIMES:
        results.append(run_cold(recipe, store))
    return sorted(results, key=lambda r: r.seconds)[len(results) // 2]


# --- leave out study ------------------------------------------------------------------------------

# The leave-out study: the error of a recipe with steps left out, and the run time of simpler
# scenes.


_WAITING = "#9DB8CC"  #: colour of the time that the engine spends outside the steps
_COLUMNS = (
    "what",
    "name",
    "kind",
    "chosen",
    "bound",
    "rms",
    "largest",
    "outputs",
    "put back",
    "seconds",
    "holds",
)
_KIND_TEXT = {"handed on": "left out", "not added": "not added", "stands in": "summed"}
_HELD = {True: Marked("holds", "pass"), False: Marked("fails", "fail")}


@dataclass(frozen=True)
class LeaveOutResult:
    """The result of the leave-out study: errors of outputs and omissions, and run times
    of scenes.
    """

    output_errors: Sequence[OutputError]
    rows: Sequence[OmissionRow]
    costs: Sequence[SceneCost]

    @property
    def failed(self) -> int:
        """Return the number of outputs and omissions that exceed their error bounds."""
        return sum(not output.holds for output in self.output_errors) + sum(
            not row.holds for row in self.rows
        )


@dataclass(frozen=True)
class LeaveOutOptions:
    """What the study measures in addition to the errors of omissions."""

    contents: bool = True  #: whether to measure the run times of simpler scenes


def study(
    recipe: Recipe, store: Store, progress: Progress, options: LeaveOutOptions
) -> StudyOutcome:
    """Measure the errors of a recipe with steps left out, and the run times of simpler scenes."""
    comparison = OmissionComparison(recipe, store)
    output_errors, rows = comparison.output_errors(), []
    failure = {True: "", False: ": does not hold"}
    for output in output_errors:
        stated_text = output.kind if output.bound is None else f"{output.bound:.2g} ({output.kind})"
        error = f"error {output.rms:.2g}, stated {stated_text}, tolerance {recipe.tolerance:.2g}"
        progress(f"{output.output}: {error}{failure[output.holds]}")
    for row in comparison.rows():
        rows.append(row)
        error = f"{row.rms:.2g}, stated at most {row.bound:.2g}{failure[row.holds]}"
        progress(f"{row.name} {row.kind}: {error} ({len(rows)} of {len(comparison.found)})")
    costs = list(measure_scenes(recipe, store, progress)) if options.contents else []
    result = LeaveOutResult(output_errors, rows, costs)
    rows_and_costs = _document(result)
    content = {"tolerance": recipe.tolerance, "failed": result.failed, **rows_and_costs}
    return StudyOutcome(digest(content["rows"]), content, _report(recipe, result))


def _document(result: LeaveOutResult) -> dict[str, Any]:
    """Return the rows of outputs, omissions and scenes as JSON values."""
    parts: dict[str, Sequence[Any]] = {
        "outputs": result.output_errors,
        "rows": result.rows,
        "costs": result.costs,
    }
    return {name: [asdict(row) for row in rows] for name, rows in parts.items()}


def _report(recipe: Recipe, result: LeaveOutResult) -> StudyReport:
    """Return the page of the study with its tables."""
    table_rows = [
        *map(_output_line, result.output_errors),
        *(("omission", *_cells(row), row.holds) for row in result.rows),
    ]
    tables: dict[str, CsvTable] = {"table.csv": (_COLUMNS, table_rows)}
    sections, picture = [_outputs(recipe, result), _omissions(result)], None
    if result.costs:
        scenes = [
            (
                cost.scene,
                cost.seconds,
                cost.computing,
                cost.steps,
                "; ".join(cost.left_out),
                cost.refused,
            )
            for cost in result.costs
        ]
        tables["costs.csv"] = (
            ("scene", "seconds", "computing", "steps", "left out", "refused"),
            scenes,
        )
        sections.append(_scenes(result))
        picture = sections[-1].picture
    title, shown_facts = f"{recipe.name}: omissions", (*SHOWN, "tolerance")
    return StudyReport(
        title, _lead(recipe, result), sections, {"content": picture}, tables, shown=shown_facts
    )


def _output_line(p: OutputError) -> Sequence[Any]:
    return "output", p.output, p.kind, "", p.bound, p.rms, p.largest, "", "", "", p.holds


def _cells(r: OmissionRow) -> tuple[Any, ...]:
    worst_output = max(r.outputs.values(), default=0.0)
    return r.name, r.kind, r.taken, r.bound, r.rms, r.largest, worst_output, r.back, r.seconds


def _lead(recipe: Recipe, result: LeaveOutResult) -> str:
    """Return the summary of the study in a few sentences."""
    chosen = [row for row in result.rows if row.taken]
    worst_error = max((output.rms for output in result.output_errors), default=0.0)
    held = (
        "All stated errors hold"
        if not result.failed
        else f"{result.failed} stated errors are too small"
    )
    return (
        f"{held}. Of {len(result.rows)} possible omissions with a known bound, the recipe chooses"
        f" {len(chosen)} at its tolerance of {recipe.tolerance:.2g}. The largest error of an output"
        f" is then {worst_error:.2g}, relative to the full computation."
    )


def _outputs(recipe: Recipe, result: LeaveOutResult) -> Section:
    """Return the section that compares the error of each output with the stated error."""
    tolerance = recipe.tolerance
    rows = [
        (
            output.output,
            output.bound,
            output.kind,
            output.rms,
            output.largest,
            tolerance,
            _HELD[output.holds],
        )
        for output in result.output_errors
    ]
    text = """Each output of the recipe with the chosen omissions, compared with the full
        computation (`--exact`). The error is the root mean square of the difference over the
        largest element; the tolerance limits it before noise and rounding. The stated error is that
        of the page of a run: proved, estimated, or unknown."""
    columns = (
        "output",
        "stated error",
        "kind",
        "error",
        "largest difference",
        "tolerance",
        "holds",
    )
    return Section("The outputs", text, columns, rows)


def _omissions(result: LeaveOutResult) -> Section:
    """Return the section with the bound and the errors of each omission alone."""
    text = """Each omission alone, with all other steps computed in full. A step that is left out
        returns its input. Light that is not added is replaced by zero. For a summed image, only the
        sums over bands that later steps need are convolved. The stated bound and the error are
        relative to the largest element: of the step's full result; of the sum, for light that is
        not added; of the steps that read the image, for a summed image. For noise and for summed
        images the bound limits the root mean square error, and one draw of the noise may exceed the
        bound by four standard errors. For all other omissions the bound limits the largest error.

        Outputs: the error of the worst output with this omission alone. Put back: the change of the
        worst output when the recipe with the chosen omissions computes this step in full. Saved:
        the run time of the omitted steps, in s. Omissions that the tolerance does not allow are
        tested too."""
    columns = (
        "step",
        "how",
        "chosen",
        "bound",
        "error",
        "largest",
        "outputs",
        "put back",
        "saved (s)",
        "holds",
    )
    cells = [(_cells(row), row) for row in result.rows]
    rows = [
        (name, _KIND_TEXT[kind], *numbers, _HELD[row.holds])
        for (name, kind, *numbers), row in cells
    ]
    return Section("Each omission", text, columns, rows)


def _scenes(result: LeaveOutResult) -> Section:
    """Return the section with the run time of each simpler scene."""
    text = """The run time from an empty store, in one process: the median of up to three runs. The
        first row is the full computation; in the other rows the engine may leave out steps that the
        scene does not need."""
    full_seconds = result.costs[0].seconds
    rows = []
    for cost in result.costs:
        seconds = (None, None) if cost.refused else (cost.seconds, cost.seconds / full_seconds)
        rows.append(
            (
                cost.scene,
                *seconds,
                cost.steps,
                cost.refused or ", ".join(cost.left_out) or "nothing",
            )
        )
    columns = ("scene", "seconds", "share of full", "steps", "left out or made cheaper")
    measured_costs = [cost for cost in result.costs if math.isfinite(cost.seconds)]
    return Section(
        "Run time of simpler scenes",
        text,
        columns,
        rows,
        _bars(measured_costs) if measured_costs else None,
    )


@drawn
def _bars(costs: Sequence[SceneCost]) -> Any:
    """Plot the run time of each scene, split into time inside the steps and time outside them."""
    figure, axes = canvas(8.0, 0.42 * len(costs) + 1.3)
    ax = axes[0, 0]
    names = [cost.scene for cost in costs]
    seconds_in_steps = [min(cost.computing, cost.seconds) for cost in costs]
    ax.barh(names, seconds_in_steps, color=BLUE, label="in the steps")
    seconds_outside = [
        cost.seconds - in_steps for cost, in_steps in zip(costs, seconds_in_steps, strict=True)
    ]
    ax.barh(
        names,
        seconds_outside,
        left=seconds_in_steps,
        color=_WAITING,
        label="in the engine and the store",
    )
    for row, cost in enumerate(costs):
        ax.annotate(f" {cost.seconds:.3g} s", (cost.seconds, row), va="center", fontsize=9)
    ax.invert_yaxis()
    ax.grid(False, axis="y")
    ax.set_xlabel("seconds, from an empty store")
    ax.set_xlim(0, 1.15 * max(cost.seconds for cost in costs) or 1.0)
    # above the axes, where no bar and no label can be
    figure.legend(loc="outside upper center", ncols=2)
    return figure
