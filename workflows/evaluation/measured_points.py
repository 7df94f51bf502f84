"""Everything that an evaluation measures: the points of all scenes, restorers told with errors, masks and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from neusee.workflows.evaluation.comparison_pictures import Panel, panels
from neusee.workflows.evaluation.evaluation_points import EvaluationPoints, PointNumbers, PointRequest
from neusee.workflows.evaluation.evaluation_result import MistoldPoint
from neusee.workflows.evaluation.evaluation_scenes import Scene, UnreadablePhotograph
from neusee.workflows.evaluation.mask_optics import MaskOptics, masks
from neusee.workflows.evaluation.mistold_points import told_with_errors
from neusee.workflows.evaluation.pipelines import NONE, SIX, EvaluationRefused, PipelineRecipes, compose_pipelines
from neusee.workflows.recipe.blocks.evaluate_block import EvaluateSettings
from neusee.workflows.recipe.text.overrides import Override
from neusee.workflows.report.study_folder import Progress
from neusee.workflows.store.result_store import Store


class AskedCamera(NamedTuple):
    """The camera of an evaluation, and where its results are kept."""

    recipe: str
    changes: Sequence[str | Override]
    folder: Path
    store: Store
    settings: EvaluateSettings
    progress: Progress


class Measured(NamedTuple):
    """What an evaluation measured."""

    points: dict[str, list[dict[float, PointNumbers]]]  #: by pipeline and scene
    scenes: list[Scene]
    broken: list[tuple[Path, str]]  #: photographs that could not be decoded
    mistold: list[MistoldPoint]
    masks: dict[str, MaskOptics]
    panels: list[Panel]


def measure(
    asked: AskedCamera,
    bench: EvaluationPoints,
    each: list[PipelineRecipes],
    shown: Sequence[Scene],
    strengths: tuple[float, ...],
) -> Measured:
    """Return the numbers of all points, those of restorers told with errors, the masks, and the pictures to show."""
    points, kept, broken = _points(bench, each, shown, strengths, asked.progress)
    mistold = told_with_errors(bench, each, kept, strengths, asked.progress)
    optics = masks(each, asked.store, bench.device, points)
    if more := asked.settings.figure:
        bench.release()
        lines = [p.pipeline for p in each]
        each = compose_pipelines(asked.recipe, [*asked.changes, *more], lines, asked.folder)
    figure = SIX if asked.settings.lasers == "drawn" else None
    return Measured(points, kept, broken, mistold, optics, panels(bench, each, kept[0], strengths, figure))


def _points(
    bench: EvaluationPoints,
    each: Sequence[PipelineRecipes],
    shown: Sequence[Scene],
    strengths: Sequence[float],
    progress: Progress,
) -> tuple[dict[str, list[dict[float, PointNumbers]]], list[Scene], list[tuple[Path, str]]]:
    """Compute all evaluation points, and return them, their scenes, and the photographs that could not be decoded.

    The scenes come laser by laser, because scenes with the same laser have common optical results.
    """
    points: dict[int, dict[str, dict[float, PointNumbers]]] = {}
    broken: list[tuple[Path, str]] = []
    before, order = "", [scene.case for scene in shown]
    for done, scene in enumerate(sorted(shown, key=lambda scene: order.index(scene.case)), 1):
        if before not in ("", scene.case):
            bench.forget()
        before, own = scene.case, {p.name: dict[float, PointNumbers]() for p in each}
        try:
            _scene_points(bench, each, scene, strengths, own)
        except UnreadablePhotograph as error:
            broken.append((scene.path or Path(scene.name), str(error)))
            progress(f"not read, and left out: {scene.name}")
            continue
        points[scene.number] = own
        progress(f"scene {done} of {len(shown)} ({scene.case}, {scene.name}): {bench.computed} points computed")
    kept = [scene for scene in shown if scene.number in points]
    if not kept:
        raise EvaluationRefused(broken[0][1])
    return {p.name: [points[scene.number][p.name] for scene in kept] for p in each}, kept, broken


def _scene_points(
    bench: EvaluationPoints,
    each: Sequence[PipelineRecipes],
    scene: Scene,
    strengths: Sequence[float],
    points: dict[str, dict[float, PointNumbers]],
) -> None:
    """Compute the points of one scene into ``points``, by pipeline."""
    alone = replace(scene)  # a copy, which releases the picture when it is deleted
    for strength in strengths if scene.case != NONE else (0.0,):
        for pipeline in each:
            points[pipeline.name][strength] = bench.point(pipeline, PointRequest(alone, strength))
