"""Evaluation points of restorers that are told optics or laser with an error, beside those that are told the truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

from neusee.workflows.evaluation.confidence_intervals import METRICS
from neusee.workflows.evaluation.evaluation_points import EvaluationPoints, PointRequest
from neusee.workflows.evaluation.evaluation_result import MistoldPoint
from neusee.workflows.evaluation.evaluation_scenes import Scene
from neusee.workflows.evaluation.mistold_filter import errors_of, mistold
from neusee.workflows.evaluation.pipelines import CASES, NONE, PipelineRecipes
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.recipe.blocks.evaluate_block import EvaluateSettings
from neusee.workflows.report.study_folder import Progress


def told_with_errors(
    bench: EvaluationPoints,
    each: Sequence[PipelineRecipes],
    shown: Sequence[Scene],
    strengths: Sequence[float],
    progress: Progress,
) -> list[MistoldPoint]:
    """Compute the metrics of restorers that are told optics or laser with one error, in the first scenes with a laser.

    The recipe declares the errors; a pipeline whose restorer knows nothing of optics and lasers has none.
    """
    settings = each[0].recipe(NONE).evaluation or EvaluateSettings()
    mismatch, lit = settings.mismatch, [scene for scene in shown if scene.case != NONE]
    strength = max(strengths) if mismatch is None or mismatch.strength is None else mismatch.strength
    if mismatch is None or not strength:
        return []
    found: list[MistoldPoint] = []
    for pipeline in (p for p in each if p.pipeline.restorer != NONE):
        errors = errors_of(pipeline.recipe(next(iter(CASES))), mismatch)
        variants = {text: _variant(pipeline, text, error) for text, error in errors.items()}
        for scene in lit[: mismatch.scenes] if variants else ():
            bench.forget()
            request = PointRequest(scene, strength)
            true = bench.point(pipeline, request)
            for text, variant in variants.items():
                wrong = bench.point(variant, request)
                found.append(MistoldPoint(pipeline.name, text, scene, strength, true, wrong))
        if variants:
            progress(f"{pipeline.name}, told with errors: {bench.computed} points computed")
    return found


def _variant(pipeline: PipelineRecipes, text: str, error: Mapping[str, Any]) -> PipelineRecipes:
    @cache
    def recipe(case: str, *laser: Any) -> Recipe:
        return mistold(pipeline.recipe(case, *laser), error)

    return PipelineRecipes(pipeline.pipeline, recipe, text, error, pipeline.recipe)


def mistold_rows(points: Sequence[MistoldPoint]) -> list[Sequence[Any]]:
    """Return the rows of ``mistold.csv``, with the truth and with each error."""
    rows: dict[Any, Sequence[Any]] = {}
    for p in points:
        for told, numbers in (("exactly", p.true), (p.error, p.wrong)):
            place = (p.pipeline, told, p.scene.number, p.scene.name, p.scene.case, f"{p.strength:g}")
            rows[place] = (*place, *(numbers[metric] for metric in METRICS))
    return list(rows.values())
