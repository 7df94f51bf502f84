"""The evaluation of masks and restorers as in the paper, with the same scenes and laser strengths
for all.

    named = NamedRecipe("first_light", [], Path())
    pipelines = read_pipelines("flat+none, five_half_rings+wiener", Path())
    question = EvaluationQuestion(pipelines, data=Path("photographs"))
    evaluate(AskedCamera.of(named, Store(), print), question)

Each point has a scene, a laser strength and a pipeline, and its metrics equal those of a run of the
recipe to the last bit. A run that cannot prove its tolerance is repeated with stricter settings.
All points are kept in the store, so that an interrupted evaluation continues and no point is
computed twice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from neusee.workflows.evaluation.confidence_intervals import METRICS, compare_with, metric_table
from neusee.workflows.evaluation.evaluation_page import (
    COLUMNS,
    draw_pictures,
    lead,
    rows,
    sections,
    summary,
)
from neusee.workflows.evaluation.evaluation_points import EvaluationPoints, PointCommands
from neusee.workflows.evaluation.evaluation_result import (
    AskedCamera,
    EvaluationResult,
    Measured,
    measure,
    mistold_rows,
)
from neusee.workflows.evaluation.evaluation_scenes import (
    Scene,
    photographs,
    refuse_directions,
    scenes,
    wavelengths,
)
from neusee.workflows.evaluation.pipelines import (
    CASES,
    DRAWN,
    PROTECTION_COLUMNS,
    EvaluationRefused,
    NamedRecipe,
    Pipeline,
    PipelineRecipes,
    base_recipe,
    compose_pipelines,
    named_apart,
    protect,
    protection_document,
    protection_rows,
    read_pipelines,
    read_protection,
    read_settings,
    refuse_fixed_laser,
)
from neusee.workflows.graph.errors import Location
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.protection.equal_rivals import EqualProtection
from neusee.workflows.report.study_report import CsvTable, Progress, StudyReport, StudyRun

__all__ = [
    "STRENGTHS",
    "AskedCamera",
    "EvaluationQuestion",
    "EvaluationRefused",
    "EvaluationResult",
    "NamedRecipe",
    "evaluate",
    "options_of",
    "read_pipelines",
    "read_settings",
]

#: strengths of the paper, in multiples of saturation
STRENGTHS = (0.0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6)
SMALL = 256  #: pixels of the shorter side of the pictures that the paper restores


@dataclass(frozen=True)
class EvaluationQuestion:
    """The pipelines that an evaluation compares, with its scenes and laser strengths."""

    pipelines: Sequence[Pipeline]
    data: Path | None = None  #: folder of photographs; None: the scene of the recipe
    count: int | None = 20  #: number of scenes; None: every photograph once
    strengths: tuple[float, ...] = STRENGTHS  #: laser strengths, in multiples of saturation
    #: length in pixels of the shorter side of reduced pictures, which are compared too
    small: int = SMALL
    reference: str = ""  #: pipeline with which all others are compared; empty: the first
    equal: EqualProtection | None = None  #: equal peak for every pipeline, by filters and stops


def evaluate(
    asked: AskedCamera,
    question: EvaluationQuestion,
    *,
    runs: Path = Path("runs"),
    command: Sequence[str] = (),
    device: str = "cpu",
) -> Path:
    """Evaluate every pipeline on all scenes at all laser strengths, and return the folder of the
    results.

    Raises: `EvaluationRefused` with every mistake before anything runs.
    """
    base = base_recipe(asked.named)
    pipelines = named_apart(question.pipelines)
    # before filters and stops for equal protection are added
    bare_pipelines = compose_pipelines(asked.named, pipelines)
    question = replace(
        question,
        strengths=_strengths(question.strengths),
        reference=_reference(question.reference, pipelines),
    )
    study_run = StudyRun("evaluate", base, command)
    lasers = list(CASES)
    if asked.settings.lasers == "drawn":
        refuse_fixed_laser(base)
        lasers = [DRAWN]
    shown_scenes, unreadable = scenes(base, asked.store, question.data, question.count, lasers)
    # checking one pipeline is enough: all have the same lens and sensor
    refuse_directions(bare_pipelines[0], shown_scenes)
    final_pipelines, references = _equalled(asked, bare_pipelines, question)
    _report_scenes(shown_scenes, unreadable, question.strengths, final_pipelines, asked.progress)
    bench = EvaluationPoints(asked.store, question.small, device)
    measured = measure(asked, bench, final_pipelines, shown_scenes, question.strengths)
    point_commands = PointCommands(asked.named, bench)
    result = replace(
        _result(base, question, measured, final_pipelines, references),
        broken=[*unreadable, *measured.broken],
        wavelengths=tuple(wavelengths(bare_pipelines[0], measured.scenes)),
        commands=point_commands.commands(final_pipelines, measured.scenes, question.strengths),
    )
    document = study_run.document(_document(result, bench))
    return study_run.write(runs, digest(document["summary"]), document, _report(result))


def options_of(
    asked: AskedCamera,
    pipelines: str | Sequence[Pipeline] | None,
    scenes: int | None,
    reference: str,
    equal_protection: float | None,
    by: str | None,
) -> dict[str, Any]:
    """Return fields of `EvaluationQuestion`: from the arguments, or else from the settings of the
    recipe.
    """
    settings, folder = asked.settings, asked.named.folder
    pipelines_text = settings.pipelines if pipelines is None else pipelines
    written_at = (
        Location("evaluate.pipelines", 1, folder=str(folder)) if pipelines is None else None
    )
    peak_level = settings.equal_protection if equal_protection is None else equal_protection
    return {
        "pipelines": read_pipelines(pipelines_text, folder, written_at)
        if isinstance(pipelines_text, str)
        else pipelines_text,
        "count": scenes or (None if settings.scenes == "all" else settings.scenes),
        "reference": reference or (settings.reference if pipelines is None else ""),
        "equal": read_protection(peak_level, by or settings.by),
    }


def _equalled(
    asked: AskedCamera, bare: list[PipelineRecipes], question: EvaluationQuestion
) -> tuple[list[PipelineRecipes], dict[str, str]]:
    """Return the pipelines, at equal protection if requested, and the name of each one's
    reference.
    """
    reference = question.reference
    if question.equal is None:
        return bare, dict.fromkeys((composed.name for composed in bare), reference)
    shaded_pipelines = protect(asked.named, bare, question.equal, asked.store, asked.progress)
    shaded_reference = {
        bare_pipeline.name: shaded_pipeline.name
        for bare_pipeline, shaded_pipeline in zip(bare, shaded_pipelines, strict=True)
    }[reference]
    references = dict.fromkeys((composed.name for composed in shaded_pipelines), shaded_reference)
    if not asked.settings.beside:
        return shaded_pipelines, references
    return [*bare, *shaded_pipelines], {
        **dict.fromkeys((composed.name for composed in bare), reference),
        **references,
    }


def _result(
    base: Recipe,
    question: EvaluationQuestion,
    measured: Measured,
    pipelines: Sequence[PipelineRecipes],
    references: dict[str, str],
) -> EvaluationResult:
    """Return the result of an evaluation with its statistics over scenes."""
    photograph_numbers = photographs(measured.scenes)
    tables = {
        name: metric_table(pipeline_metrics, question.strengths, photograph_numbers)
        for name, pipeline_metrics in measured.points.items()
    }
    # the reduced pictures are no larger than the true picture
    small = question.small
    if "truth" in base.steps:
        small = min(small, min(base.steps["truth"].params["shape"]))
    comparisons = {
        name: compare_with(pipeline_metrics, tables[references[name]], base.seed)
        for name, pipeline_metrics in tables.items()
    }
    return EvaluationResult(
        recipe=base,
        scenes=measured.scenes,
        broken=measured.broken,
        strengths=question.strengths,
        small=small,
        references=references,
        points=measured.points,
        tables=tables,
        against=comparisons,
        masks=measured.masks,
        panels=measured.panels,
        pipelines=[composed.pipeline for composed in pipelines],
        mistold=measured.mistold,
        protection=question.equal,
    )


def _strengths(strengths: Sequence[float]) -> tuple[float, ...]:
    """Return the strengths in rising order without repetition; raise `EvaluationRefused` for
    invalid ones.
    """
    if not strengths or min(strengths) < 0 or not all(map(np.isfinite, strengths)):
        raise EvaluationRefused(
            "--strengths: write finite multiples of saturation that are not negative, such as"
            " 0,1e1,1e6"
        )
    return tuple(sorted(set(map(float, strengths))))


def _reference(reference: str, pipelines: Sequence[Pipeline]) -> str:
    """Return the name of the reference, by default the first pipeline; raise `EvaluationRefused` if
    it is not evaluated.
    """
    names = [pipeline.name for pipeline in pipelines]
    if reference and reference not in names:
        raise EvaluationRefused(
            f"--reference {reference} is not evaluated: write one of {', '.join(names)}"
        )
    return reference or names[0]


def _report_scenes(
    shown: Sequence[Scene],
    broken: Sequence[tuple[Path, str]],
    strengths: Sequence[float],
    pipelines: Sequence[PipelineRecipes],
    progress: Progress,
) -> None:
    """Report the numbers of scenes, strengths and pipelines, and the unreadable photographs."""
    names = ", ".join(pipeline.name for pipeline in pipelines)
    progress(
        f"{len(shown)} scenes, {len(strengths)} strengths, {len(pipelines)} pipelines: {names}"
    )
    for path, reason in broken[:5]:
        progress(f"not read: {path.name}: {reason}")
    if len(broken) > 5:
        progress(f"not read: {len(broken) - 5} more")


# --- the folder -----------------------------------------------------------------------------------


def _document(result: EvaluationResult, bench: EvaluationPoints) -> dict[str, Any]:
    """Return the result of an evaluation as JSON values."""
    return {
        "scenes": [[scene.number, scene.name, scene.case, scene.seed] for scene in result.scenes],
        "not read": [[str(path), reason] for path, reason in result.broken],
        "strengths": list(result.strengths),
        "small": result.small,
        "reference": result.reference,
        "lasers": [None if metres is None else metres * 1e9 for metres in result.wavelengths],
        **protection_document(result),
        "computed": bench.computed,
        "seconds a point": bench.seconds / bench.computed if bench.computed else None,
        "summary": summary(result),
    }


def _report(result: EvaluationResult) -> StudyReport:
    """Return the page of an evaluation with its tables."""
    pictures = draw_pictures(result)
    tables: dict[str, CsvTable] = {
        "points.csv": ((*_POINT, *METRICS, "command"), _point_rows(result)),
        "table.csv": (COLUMNS, rows(result)),
        "mistold.csv": (
            # columns pipeline, told, scene, photograph, laser, strength
            (*_POINT[:1], "told", *_POINT[3:6], *_POINT[7:], *METRICS),
            mistold_rows(result.mistold),
        ),
        "suppression.csv": (
            ("mask", "wavelength (nm)", "lsr", "bsr", "floor"),
            _curve_rows(result),
        ),
    }
    if result.protection is not None:
        tables["protection.csv"] = (
            PROTECTION_COLUMNS,
            protection_rows(result),
        )
    shown_facts = (
        "command",
        "date",
        "seconds",
        "computed",
        "seconds a point",
        "reference",
        "versions",
    )
    title = f"{result.recipe.name}: evaluated"
    return StudyReport(
        title, lead(result), sections(result, pictures), pictures, tables, shown=shown_facts
    )


_POINT = (
    "pipeline",
    "mask",
    "restorer",
    "scene",
    "photograph",
    "laser",
    "wavelength (nm)",
    "strength",
)


def _point_rows(result: EvaluationResult) -> list[Sequence[Any]]:
    """Return the rows of points.csv: one for each pipeline, scene and strength."""
    wavelengths_nm = [
        "" if metres is None else f"{metres * 1e9:.6g}" for metres in result.wavelengths
    ]
    rows: list[Sequence[Any]] = []
    for pipeline in result.pipelines:
        rows_of_scenes = zip(
            result.scenes,
            result.points[pipeline.name],
            wavelengths_nm,
            result.commands[pipeline.name],
            strict=True,
        )
        for scene, points, wavelength_nm, commands in rows_of_scenes:
            first_cells = (
                pipeline.name,
                pipeline.front,
                pipeline.back,
                scene.number,
                scene.name,
                scene.case,
                wavelength_nm,
            )
            for strength, point in points.items():
                rows.append(
                    (
                        *first_cells,
                        f"{strength:g}",
                        *(point[metric] for metric in METRICS),
                        commands[strength],
                    )
                )
    return rows


def _curve_rows(result: EvaluationResult) -> list[Sequence[Any]]:
    """Return the rows of suppression.csv: one for each mask and wavelength in nm."""
    rows: list[Sequence[Any]] = []
    for name, mask in result.masks.items():
        columns = zip(mask.wavelengths, mask.lsr, mask.bsr, mask.floor, strict=True)
        rows += [(name, f"{wavelength_nm:.6g}", *row) for wavelength_nm, *row in columns]
    return rows
