"""The evaluation of masks and restorers as in the paper, with the same scenes and laser strengths for all.

    evaluate("first_light", read_pipelines("flat+none, five_half_rings+wiener", Path()), data=Path("photographs"))

Each point has a scene, a laser strength and a pipeline, and its metrics equal those of a run of the recipe to the last
bit. A run that cannot prove its tolerance is computed again more strictly; a point is computed once. The store keeps
all points, so that an interrupted evaluation continues.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from neusee.workflows.evaluation import equal_protection
from neusee.workflows.evaluation.comparison_pictures import panels
from neusee.workflows.evaluation.confidence_intervals import METRICS, metric_table
from neusee.workflows.evaluation.equal_protection import protect
from neusee.workflows.evaluation.evaluation_points import EvaluationPoints, PointNumbers, PointRequest
from neusee.workflows.evaluation.evaluation_result import EvaluationResult
from neusee.workflows.evaluation.evaluation_scenes import Scene, photographs, refuse_directions, scenes
from neusee.workflows.evaluation.mask_optics import masks
from neusee.workflows.evaluation.mistold_points import mistold_rows, told_with_errors
from neusee.workflows.evaluation.paired_intervals import compare_with
from neusee.workflows.evaluation.pipelines import (
    NONE,
    EvaluationRefused,
    Pipeline,
    PipelineRecipes,
    compose_pipelines,
    read_pipelines,
)
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.protection.equal_shade import EqualProtection
from neusee.workflows.recipe.loading import load
from neusee.workflows.recipe.text.overrides import Override
from neusee.workflows.report.study_folder import CsvTable, Progress, StudyReport, StudyRun, silent
from neusee.workflows.store.remote_store import open_store
from neusee.workflows.store.result_store import Store

__all__ = ["STRENGTHS", "EvaluationRefused", "EvaluationResult", "evaluate", "read_pipelines"]

STRENGTHS = (0.0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6)  #: strengths of the paper, in multiples of saturation
SMALL = 256  #: pixels of the shorter side of the pictures that the paper restores


def evaluate(
    recipe: str,
    pipelines: Sequence[Pipeline],
    changes: Sequence[str | Override] = (),
    *,
    data: Path | None = None,
    count: int = 20,
    strengths: Sequence[float] = STRENGTHS,
    small: int = SMALL,
    reference: str = "",
    equal: EqualProtection | None = None,
    store: Store | None = None,
    runs: Path = Path("runs"),
    command: Sequence[str] = (),
    progress: Progress = silent,
    device: str = "cpu",
    folder: Path | None = None,
) -> Path:
    """Evaluate every pipeline on ``count`` scenes at all laser ``strengths``, and return the folder of the results.

    Args: recipe, changes: the camera, as for `load`. data: a folder of photographs, by default the scene of the recipe.
    small: shorter side of the reduced pictures, which are compared too. reference: the pipeline with which all other
    pipelines are compared, by default the first pipeline. equal: the peak to which filters and stops bring every
    pipeline. progress: receives a line for each scene.
    Raises: `EvaluationRefused` with every mistake before anything runs.
    """
    store, place = store or open_store(), folder or Path.cwd()
    each = compose_pipelines(recipe, changes, pipelines, place)
    strengths, reference = _strengths(strengths), _reference(reference, pipelines)
    each = protect(recipe, changes, each, equal, store, place, progress) if equal else each
    reference = {old.name: new.name for old, new in zip(pipelines, each, strict=True)}[reference]
    base = load(recipe, changes, place)
    study_run = StudyRun("evaluate", base, command)
    shown, broken = scenes(base, store, data, count)
    refuse_directions(each[0], shown)
    _report_scenes(shown, broken, strengths, each, progress)
    bench = EvaluationPoints(store, small, device)
    points = _points(bench, each, shown, strengths, progress)
    mistold = told_with_errors(bench, each, shown, strengths, progress)
    optics = masks(each, store, device, points)
    drawn = panels(bench, each, shown[0], strengths)
    tables = {name: metric_table(own, strengths, photographs(shown)) for name, own in points.items()}
    least = min(small, *(base.steps["truth"].params["shape"])) if "truth" in base.steps else small
    more = {name: compare_with(own, tables[reference], base.seed) for name, own in tables.items()}
    rest = (reference, points, tables, more, optics, drawn, [p.pipeline for p in each], mistold, equal)
    result = EvaluationResult(base, shown, broken, strengths, least, *rest)
    document = study_run.document(_document(result, bench))
    return study_run.write(runs, digest(document["summary"]), document, _report(result))


def _strengths(strengths: Sequence[float]) -> tuple[float, ...]:
    if not strengths or min(strengths) < 0 or not all(map(np.isfinite, strengths)):
        raise EvaluationRefused(
            "--strengths: write finite multiples of saturation that are not negative, such as 0,1e1,1e6"
        )
    return tuple(sorted(set(map(float, strengths))))


def _reference(reference: str, pipelines: Sequence[Pipeline]) -> str:
    names = [pipeline.name for pipeline in pipelines]
    if reference and reference not in names:
        raise EvaluationRefused(f"--reference {reference} is not evaluated: write one of {', '.join(names)}")
    return reference or names[0]


def _report_scenes(
    shown: Sequence[Scene],
    broken: Sequence[tuple[Path, str]],
    strengths: Sequence[float],
    each: Sequence[PipelineRecipes],
    progress: Progress,
) -> None:
    names = ", ".join(pipeline.name for pipeline in each)
    progress(f"{len(shown)} scenes, {len(strengths)} strengths, {len(each)} pipelines: {names}")
    for path, reason in broken[:5]:
        progress(f"not read: {path.name}: {reason}")
    if len(broken) > 5:
        progress(f"not read: {len(broken) - 5} more")


def _points(
    bench: EvaluationPoints,
    each: Sequence[PipelineRecipes],
    shown: Sequence[Scene],
    strengths: Sequence[float],
    progress: Progress,
) -> dict[str, list[dict[float, PointNumbers]]]:
    """Compute all evaluation points laser by laser, because scenes with the same laser have common optical results."""
    points: dict[str, list[dict[float, PointNumbers]]] = {p.name: [{} for _ in shown] for p in each}
    before, order = "", [scene.case for scene in shown]
    for done, scene in enumerate(sorted(shown, key=lambda scene: order.index(scene.case)), 1):
        if before not in ("", scene.case):
            bench.forget()
        before, alone = scene.case, replace(scene)  # a copy, which releases the picture when it is deleted
        for strength in strengths if scene.case != NONE else (0.0,):
            for pipeline in each:
                point = bench.point(pipeline, PointRequest(alone, strength))
                points[pipeline.name][scene.number][strength] = point
        progress(f"scene {done} of {len(shown)} ({scene.case}, {scene.name}): {bench.computed} points computed")
    return points


# --- the folder -------------------------------------------------------------------------------------------------------


def _document(result: EvaluationResult, bench: EvaluationPoints) -> dict[str, Any]:
    from neusee.workflows.evaluation.evaluation_page import summary

    return {
        "scenes": [[s.number, s.name, s.case, s.seed] for s in result.scenes],
        "not read": [[str(path), reason] for path, reason in result.broken],
        "strengths": list(result.strengths),
        "small": result.small,
        "reference": result.reference,
        **equal_protection.as_document(result),
        "computed": bench.computed,
        "seconds a point": bench.seconds / bench.computed if bench.computed else None,
        "summary": summary(result),
    }


def _report(result: EvaluationResult) -> StudyReport:
    from neusee.workflows.evaluation.evaluation_page import COLUMNS, draw_pictures, lead, rows, sections

    pictures = draw_pictures(result)
    tables: dict[str, CsvTable] = {
        "points.csv": ((*_POINT, *METRICS), _point_rows(result)),
        "table.csv": (COLUMNS, rows(result)),
        "mistold.csv": ((*_POINT[:1], "told", *_POINT[3:], *METRICS), mistold_rows(result.mistold)),
        "suppression.csv": (("mask", "wavelength (nm)", "lsr", "bsr", "floor"), _curve_rows(result)),
    }
    if result.protection is not None:
        tables["protection.csv"] = equal_protection.COLUMNS, equal_protection.protection_rows(result)
    shown = ("command", "date", "seconds", "computed", "seconds a point", "reference", "versions")
    title = f"{result.recipe.name}: evaluated"
    return StudyReport(title, lead(result), sections(result, pictures), pictures, tables, shown=shown)


_POINT = ("pipeline", "mask", "restorer", "scene", "photograph", "laser", "strength")


def _point_rows(result: EvaluationResult) -> list[Sequence[Any]]:
    return [
        (p.name, p.front, p.back, s.number, s.name, s.case, f"{k:g}", *(point[metric] for metric in METRICS))
        for p in result.pipelines
        for s, at in zip(result.scenes, result.points[p.name], strict=True)
        for k, point in at.items()
    ]


def _curve_rows(result: EvaluationResult) -> list[Sequence[Any]]:
    return [
        (name, f"{x:.6g}", *row)
        for name, mask in result.masks.items()
        for x, *row in zip(mask.wavelengths, mask.lsr, mask.bsr, mask.floor, strict=True)
    ]
