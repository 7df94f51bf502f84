"""Pipelines that protect the sensor equally: each gets the filter and the stop that bring its
peak to one share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from neusee.workflows.engine.runner import run
from neusee.workflows.evaluation.evaluation_result import EvaluationResult
from neusee.workflows.evaluation.pipelines import (
    NONE,
    EvaluationRefused,
    PipelineRecipes,
    compose_pipelines,
)
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.protection.equal_rivals import (
    WAYS,
    EqualProtection,
    EqualShade,
    shade_equally,
)
from neusee.workflows.protection.protection_camera import ProtectionCamera
from neusee.workflows.recipe.text.overrides import Override
from neusee.workflows.report.study_folder import Progress
from neusee.workflows.report.study_page import Section
from neusee.workflows.store.result_store import Store

_BANDS = 7  #: wavelengths at which stops are compared
COLUMNS = ("pipeline", "mask alone", "stop", "filter", "exposure", "peak")


def read_protection(level: float | None, way: str) -> EqualProtection | None:
    """Return what was asked for, or None; raise `EvaluationRefused` for a share that no filter
    can reach.
    """
    if way not in WAYS:
        raise EvaluationRefused(f"--by {way}: write one of {', '.join(WAYS)}")
    if level is None:
        return None
    if not 0 < level < 1:
        raise EvaluationRefused(
            f"--equal-protection {level:g}: write the peak of a laser as a share of that behind the"
            " plain lens, above 0 and below 1, such as 0.001"
        )
    return EqualProtection(level, way)


def protect(
    recipe: str,
    changes: Sequence[str | Override],
    pipelines: Sequence[PipelineRecipes],
    asked: EqualProtection,
    store: Store,
    folder: Path,
    progress: Progress,
) -> list[PipelineRecipes]:
    """Return the pipelines with the filters and stops that bring every peak to the level that is
    asked for.

    Raises: `EvaluationRefused` with every mask that is shaded already or protects more than is
            asked, before any scene.
    """
    shades: dict[str, EqualShade] = {}
    faults: dict[str, None] = {}
    for pipeline in pipelines:
        front = pipeline.pipeline.front
        if front in shades:
            continue
        try:
            shades[front] = _shade(recipe, changes, pipeline, asked, store, folder)
            progress(
                f"{front}: peak"
                f" {shades[front].alone:.3g}{shades[front].said or ', without a filter'}"
            )
        except ValueError as error:
            faults[f"--equal-protection {asked.level:g}: {front} {error}"] = None
    if faults:
        raise EvaluationRefused("\n".join(faults))
    return compose_pipelines(
        recipe,
        changes,
        [
            replace(composed.pipeline, shade=shades[composed.pipeline.front])
            for composed in pipelines
        ],
        folder,
    )


def _shade(
    recipe: str,
    changes: Sequence[str | Override],
    pipeline: PipelineRecipes,
    asked: EqualProtection,
    store: Store,
    folder: Path,
) -> EqualShade:
    """Return the stop and the filter with which the mask of a pipeline has the wanted peak.

    Raises `EvaluationRefused` for a mask that is shaded already.
    """
    without_laser = pipeline.recipe(NONE)
    if without_laser.steps["pupil[mask]"].wires.get("shade"):
        raise EvaluationRefused(
            "has a filter or a stop of its own: leave it out, because every pipeline gets one"
        )
    camera = ProtectionCamera.of(without_laser, store, _BANDS)

    def peak_of(shade: EqualShade) -> float:
        shaded = replace(pipeline.pipeline, shade=shade)
        (shaded_recipes,) = compose_pipelines(recipe, changes, [shaded], folder)
        return float(
            run(shaded_recipes.recipe(NONE), store, ["lsr[mask]"]).values["lsr[mask]"].max()
        )

    return shade_equally(
        camera, store, asked.level, asked.way, partial(_scene_light, without_laser, store), peak_of
    )


def _scene_light(recipe: Recipe, store: Store) -> float:
    """Return the mean light of the recipe's scene behind the plain lens, in e- a pixel."""
    return max(
        1.0, float(run(recipe, store, ["signal[plain]"]).values["signal[plain]"].double().mean())
    )


def as_document(result: EvaluationResult) -> dict[str, Any]:
    """Return the protection, and the recipe arguments of each pipeline, as JSON values; nothing
    if none was asked.
    """
    if result.protection is None:
        return {}
    shades = {
        pipeline.name: pipeline.shade for pipeline in result.pipelines if pipeline.shade is not None
    }
    protections = {name: {**asdict(shade), "words": shade.words} for name, shade in shades.items()}
    return {
        "equal protection": {
            "peak": result.protection.level,
            "by": result.protection.way,
            "pipelines": protections,
        }
    }


def protection_rows(result: EvaluationResult) -> list[Sequence[Any]]:
    """Return mask alone, stop, filter, exposure and the peak with all of them, for each
    pipeline.
    """
    rows: list[Sequence[Any]] = []
    for pipeline in result.pipelines:
        shade = pipeline.shade
        if shade is not None:
            peak = float(result.masks[pipeline.front].lsr.max())
            rows.append(
                (
                    pipeline.name,
                    shade.alone,
                    shade.diameter,
                    shade.transmittance,
                    shade.brightness,
                    peak,
                )
            )
    return rows


def protection_section(result: EvaluationResult) -> list[Section]:
    """Return the section of the page with the filter and the stop of each pipeline, if
    protection was made equal.
    """
    if result.protection is None:
        return []
    ways = {
        "best": (
            "the stop and the filter with the least error of the filtered picture at the light of"
            " the scene"
        ),
        "filter": "a grey filter",
        "stop": "a smaller stop, and a filter for the rest",
    }
    text = f"""Every pipeline of this table lowers the peak of a laser to
        {result.protection.level:g} of that behind the plain lens, at the worst wavelength: each has
        {ways[result.protection.way]}. Mask alone: its peak without them. Stop: diameter relative to
        the lens. Filter: transmittance. Exposure: no picture is scored as dark as filter and stop
        make it. One that is not restored is brightened by this factor, 1 over the light that they
        pass, which makes its noise brighter too; a Wiener filter knows the PSF with filter and
        stop, and brightens its picture itself."""
    return [Section("Equal protection", text, COLUMNS, protection_rows(result))]
