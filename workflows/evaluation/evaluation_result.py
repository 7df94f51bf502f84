"""The measurements of an evaluation: points, mask optics, and restorers with erroneous data."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from neusee.nodes import metrics
from neusee.nodes.metrics import least_lsr, most_unsuppressed
from neusee.workflows.engine.runner import run
from neusee.workflows.evaluation.confidence_intervals import METRICS, Interval, MetricTable, Numbers
from neusee.workflows.evaluation.evaluation_points import (
    EvaluationPoints,
    PointNumbers,
    PointRequest,
    errors_of,
    mistold,
    reduced,
)
from neusee.workflows.evaluation.evaluation_scenes import Scene, UnreadablePhotograph
from neusee.workflows.evaluation.pipelines import (
    CASES,
    FLAT,
    NONE,
    SIX,
    EvaluationRefused,
    NamedRecipe,
    Pipeline,
    PipelineRecipes,
    compose_pipelines,
    read_settings,
)
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.protection.equal_rivals import EqualProtection
from neusee.workflows.recipe.blocks.settings_block import EvaluateSettings, Mismatch
from neusee.workflows.report.study_report import Progress
from neusee.workflows.store.result_store import Store, compute_once

# --- mask optics ----------------------------------------------------------------------------------

# Figures of merit of a mask by wavelength: laser suppression and image contrast, with their
# physical bounds.


@dataclass(frozen=True)
class MaskOptics:
    """The laser suppression and the image contrast of a mask, by spectral band."""

    wavelengths: Numbers  #: nm
    lsr: Numbers
    bsr: Numbers  #: mean over scenes
    median: Numbers  #: median contrast over the frequencies that the clear aperture passes
    rms: Numbers  #: rms contrast over the same frequencies
    floor: Numbers  #: smallest LSR of a mask that keeps all light in the field
    most: Numbers  #: largest rms contrast that the peak allows
    unsuppressed: Numbers  #: largest rms contrast of a mask with an LSR of 1 that keeps all light


def masks(
    pipelines: Sequence[PipelineRecipes],
    store: Store,
    device: str,
    points: Mapping[str, Sequence[Mapping[float, Any]]],
) -> dict[str, MaskOptics]:
    """Return the laser suppression and the image contrast of each mask, by name of the mask."""
    optics: dict[str, MaskOptics] = {}
    for pipeline in pipelines:
        if pipeline.pipeline.front not in optics:
            # the BSR is the same at every strength: take the first
            contrasts = [next(iter(point.values()))["bsr"] for point in points[pipeline.name]]
            optics[pipeline.pipeline.front] = _mask(
                pipeline, store, device, np.mean(contrasts, axis=0)
            )
    return optics


def _mask(pipeline: PipelineRecipes, store: Store, device: str, bsr: Numbers) -> MaskOptics:
    """Return the optics of a pipeline's mask; ``bsr`` is its mean over scenes."""
    names = ("bands", "lsr[mask]", "mtf[mask]", "psf[mask]")
    values = run(pipeline.recipe(NONE), store, names, device=device).values
    bands, lsr, mtf, psf = (values[name] for name in names)
    return MaskOptics(
        wavelengths=_numbers(bands.centres) * 1e9,
        lsr=_numbers(lsr),
        bsr=bsr,
        median=_numbers(mtf.median),
        rms=_numbers(mtf.rms),
        floor=_numbers(least_lsr(psf)),
        most=_numbers(metrics.limits(psf).passed),
        unsuppressed=_numbers(most_unsuppressed(psf)),
    )


def _numbers(tensor: Tensor) -> Numbers:
    """Return a tensor as a float64 array."""
    array: Numbers = tensor.double().cpu().numpy()
    return array


# --- comparison pictures --------------------------------------------------------------------------

# Pictures for the comparison figure of the paper: one scene with each laser, for each pipeline.


_SIDE = 200  #: length of the shorter side of a picture in the figure, in pixels
_PLAIN, _MASKED = "developed[plain]", "developed[mask]"
_WEAKEST = 1e4  #: strength of the first laser in the figure of the paper


@dataclass(frozen=True)
class Panel:
    """A column of the comparison figure: pictures with one laser, in linear sRGB (3, y, x)."""

    case: str
    strength: float
    pictures: dict[str, Tensor]  #: by row name: "truth"


def panels(
    bench: EvaluationPoints,
    pipelines: Sequence[PipelineRecipes],
    scene: Scene,
    strengths: Sequence[float],
    figure: Collection[str] | None = None,
) -> list[Panel]:
    """Return the columns of the comparison figure: one for each laser, and one without a laser.

    The laser strengths rise from 1e4, as in the paper, to the largest of ``strengths``. ``figure``
    has the names of the lasers; with it the columns also contain the pictures of the sensor behind
    each mask.
    """
    columns = []
    lasers = [case for case in figure or CASES if case != NONE]
    largest_strength = max(max(strengths), _WEAKEST)
    # a geometric series from 1e4 to the largest
    rising_strengths = [
        _WEAKEST * (largest_strength / _WEAKEST) ** (number / (len(lasers) - 1))
        for number in range(len(lasers))
    ]
    # the last column is without a laser
    for case, strength in zip((*lasers, NONE), (*rising_strengths, 0.0), strict=True):
        bench.forget()
        point = PointRequest(replace(scene, case=case), strength)
        key = digest(
            "evaluate pictures",
            _SIDE,
            bool(figure),
            [[composed.name, bench.key(composed, point)] for composed in pipelines],
        )
        compute = partial(_develop, bench, pipelines, point, bool(figure))
        columns.append(
            Panel(
                case, strength, compute_once(bench.store, key, dict, compute, {"step": "evaluate"})
            )
        )
    return columns


def _develop(
    bench: EvaluationPoints,
    pipelines: Sequence[PipelineRecipes],
    point: PointRequest,
    sensors: bool,
) -> dict[str, Tensor]:
    """Return the pictures of one laser by name; with ``sensors`` also those of the sensor behind
    each mask.
    """
    pictures: dict[str, Tensor] = {}
    restored: dict[str, Tensor] = {}
    for pipeline in pipelines:
        pipeline_names = pipeline.pipeline
        needs_sensor = (
            sensors
            and pipeline_names.mask != FLAT
            and f"{pipeline_names.front}, sensor" not in pictures
        )
        further_steps = (_MASKED,) if needs_sensor else ()
        # compute truth and plain lens only once: they are the same for all pipelines
        values = bench.values(
            pipeline, point, (_PLAIN, *further_steps) if not pictures else further_steps
        )
        if not pictures:
            pictures = {"truth": _shrink(values["truth"]), "plain lens": _shrink(values[_PLAIN])}
        if needs_sensor:
            pictures[f"{pipeline_names.front}, sensor"] = _shrink(values[_MASKED])
        if not sensors or pipeline_names.restorer != NONE:
            restored[pipeline.name] = _shrink(values[pipeline_names.picture])
    return pictures | restored


def _shrink(picture: Tensor) -> Tensor:
    """Return a picture with at most `_SIDE` pixels on its shorter side, on the CPU."""
    side = min(_SIDE, *picture.shape[-2:])
    return reduced(picture.detach().cpu().float(), side).contiguous()


# --- evaluation result ----------------------------------------------------------------------------

# The result of an evaluation: the metrics of every mask and restorer in every scene, and statistics
# over scenes.


@dataclass(frozen=True)
class MistoldPoint:
    """The metrics of one scene with exact data of the restorer, and with one error in its optics or
    laser data.
    """

    pipeline: str
    error: str
    scene: Scene
    strength: float
    true: PointNumbers
    wrong: PointNumbers


@dataclass(frozen=True)
class EvaluationResult:
    """The result of an evaluation: scenes, metrics by scene, statistics over scenes, masks and
    pictures.
    """

    recipe: Recipe
    scenes: Sequence[Scene]
    broken: Sequence[tuple[Path, str]]
    strengths: tuple[float, ...]
    small: int  #: pixels of the shorter side of the reduced pictures
    references: Mapping[str, str]  #: reference of each pipeline
    points: dict[str, list[dict[float, PointNumbers]]]  #: by pipeline and scene
    tables: dict[str, MetricTable]  #: by pipeline
    #: decrease of L1 relative to the reference, by pipeline
    against: dict[str, dict[str, Interval]]
    masks: dict[str, MaskOptics]  #: by mask
    panels: Sequence[Panel]
    pipelines: Sequence[Pipeline]
    mistold: Sequence[MistoldPoint] = ()
    protection: EqualProtection | None = None  #: the requested equal protection, if any
    wavelengths: Sequence[float | None] = ()  #: of the laser of each scene, in m
    #: one command for each entry of `points`
    commands: Mapping[str, Sequence[Mapping[float, str]]] = field(default_factory=dict)

    @property
    def reference(self) -> str:
        """Return the reference of the first pipeline and of those of the same kind."""
        return next(iter(self.references.values()))


# --- mistold points -------------------------------------------------------------------------------

# Evaluation points of restorers with erroneous optics or laser data, next to those with exact data.


def told_with_errors(
    bench: EvaluationPoints,
    pipelines: Sequence[PipelineRecipes],
    shown: Sequence[Scene],
    strengths: Sequence[float],
    progress: Progress,
) -> list[MistoldPoint]:
    """Compute the metrics of restorers with one error in their optics or laser data, in the first
    scenes with a laser.

    The recipe sets the errors; there are none for a pipeline whose restorer uses no optics or laser
    data.
    """
    mismatch = (pipelines[0].recipe(NONE).evaluation or EvaluateSettings()).mismatch
    if mismatch is None:
        return []
    strength = _mismatch_strength(mismatch, strengths)
    if not strength:
        return []
    laser_points = [PointRequest(scene, strength) for scene in shown if scene.case != NONE]
    points: list[MistoldPoint] = []
    for pipeline in (composed for composed in pipelines if composed.pipeline.restorer != NONE):
        variants = _variants(pipeline, mismatch)
        if variants:
            points += _mistold_points(bench, pipeline, variants, laser_points[: mismatch.scenes])
            progress(f"{pipeline.name}, told with errors: {bench.computed} points computed")
    return points


def _mismatch_strength(mismatch: Mismatch, strengths: Sequence[float]) -> float:
    """Return the laser strength for the points with erroneous data."""
    return max(strengths) if mismatch.strength is None else mismatch.strength


def _variants(pipeline: PipelineRecipes, mismatch: Mismatch) -> dict[str, PipelineRecipes]:
    """Return the pipeline with each error in the data of its restorer, by description."""
    errors = errors_of(pipeline.recipe(next(iter(CASES))), mismatch)
    return {text: mistold_pipeline(pipeline, text, error) for text, error in errors.items()}


def _mistold_points(
    bench: EvaluationPoints,
    pipeline: PipelineRecipes,
    variants: Mapping[str, PipelineRecipes],
    requests: Sequence[PointRequest],
) -> list[MistoldPoint]:
    """Return the points of a pipeline with each error, paired with those without."""
    points = []
    for request in requests:
        bench.forget()
        exact_numbers = bench.point(pipeline, request)
        for text, variant in variants.items():
            wrong_numbers = bench.point(variant, request)
            points.append(
                MistoldPoint(
                    pipeline.name,
                    text,
                    request.scene,
                    request.strength,
                    exact_numbers,
                    wrong_numbers,
                )
            )
    return points


def mistold_pipeline(
    pipeline: PipelineRecipes, text: str, error: Mapping[str, Any]
) -> PipelineRecipes:
    """Return a pipeline with an error (``text`` and values) in the data of its restorer; its camera
    is unchanged.
    """

    @cache
    def recipe(case: str, *laser: Any) -> Recipe:
        return mistold(pipeline.recipe(case, *laser), error)

    return PipelineRecipes(pipeline.pipeline, recipe, text, error, pipeline.recipe)


def mistold_rows(points: Sequence[MistoldPoint]) -> list[Sequence[Any]]:
    """Return the rows of ``mistold.csv``: with exact data and with each error."""
    rows: dict[Any, Sequence[Any]] = {}
    for point in points:
        for error, metrics_of_point in (("exactly", point.true), (point.error, point.wrong)):
            first_cells = (
                point.pipeline,
                error,
                point.scene.number,
                point.scene.name,
                point.scene.case,
                f"{point.strength:g}",
            )
            # the exact values are repeated for each error: keep one row
            rows[first_cells] = (*first_cells, *(metrics_of_point[metric] for metric in METRICS))
    return list(rows.values())


# --- measured points ------------------------------------------------------------------------------

# All measurements of an evaluation: the points of all scenes, restorers with erroneous data, masks
# and pictures.


class AskedCamera(NamedTuple):
    """The camera of an evaluation, with the store for its results."""

    named: NamedRecipe
    store: Store
    settings: EvaluateSettings
    progress: Progress  #: function that receives a line of text for each scene

    @classmethod
    def of(cls, named: NamedRecipe, store: Store, progress: Progress) -> AskedCamera:
        """Read the block ``evaluate`` of a recipe; raise `EvaluationRefused` with all errors in the
        recipe.
        """
        return cls(named, store, read_settings(named), progress)


class Measured(NamedTuple):
    """The measurements of an evaluation."""

    points: dict[str, list[dict[float, PointNumbers]]]  #: by pipeline and scene
    scenes: list[Scene]
    broken: list[tuple[Path, str]]  #: photographs that could not be decoded
    mistold: list[MistoldPoint]
    masks: dict[str, MaskOptics]
    panels: list[Panel]


def measure(
    asked: AskedCamera,
    bench: EvaluationPoints,
    pipelines: list[PipelineRecipes],
    shown: Sequence[Scene],
    strengths: tuple[float, ...],
) -> Measured:
    """Return the metrics of all points, those with erroneous restorer data, the mask optics, and
    the pictures to show.
    """
    points, readable, broken = points_of_scenes(bench, pipelines, shown, strengths, asked.progress)
    mistold = told_with_errors(bench, pipelines, readable, strengths, asked.progress)
    optics = masks(pipelines, asked.store, bench.device, points)
    if figure_changes := asked.settings.figure:
        bench.release()
        asked_pipelines = [composed.pipeline for composed in pipelines]
        pipelines = compose_pipelines(asked.named.changed(figure_changes), asked_pipelines)
    figure_lasers = SIX if asked.settings.lasers == "drawn" else None
    return Measured(
        points,
        readable,
        broken,
        mistold,
        optics,
        panels(bench, pipelines, readable[0], strengths, figure_lasers),
    )


def points_of_scenes(
    bench: EvaluationPoints,
    pipelines: Sequence[PipelineRecipes],
    shown: Sequence[Scene],
    strengths: Sequence[float],
    progress: Progress,
) -> tuple[dict[str, list[dict[float, PointNumbers]]], list[Scene], list[tuple[Path, str]]]:
    """Compute all evaluation points; return them, their scenes, and the photographs that could not
    be decoded.

    Scenes are processed laser by laser, because scenes with the same laser share optical results.
    """
    points: dict[int, dict[str, dict[float, PointNumbers]]] = {}
    broken: list[tuple[Path, str]] = []
    previous_laser = ""
    for count, scene in enumerate(_laser_by_laser(shown), 1):
        if previous_laser not in ("", scene.case):
            bench.forget()
        previous_laser, points_of_scene = (
            scene.case,
            {pipeline.name: dict[float, PointNumbers]() for pipeline in pipelines},
        )
        try:
            _scene_points(bench, pipelines, scene, strengths, points_of_scene)
        except UnreadablePhotograph as error:
            broken.append((scene.path or Path(scene.name), str(error)))
            progress(f"not read, and left out: {scene.name}")
            continue
        points[scene.number] = points_of_scene
        progress(
            f"scene {count} of {len(shown)} ({scene.case}, {scene.name}): {bench.computed} points"
            " computed"
        )
    readable = [scene for scene in shown if scene.number in points]
    if not readable:
        raise EvaluationRefused(broken[0][1])
    return _by_pipeline([points[scene.number] for scene in readable]), readable, broken


def _by_pipeline(
    scenes: Sequence[Mapping[str, dict[float, PointNumbers]]],
) -> dict[str, list[dict[float, PointNumbers]]]:
    """Return the points of all scenes, regrouped by pipeline."""
    return {name: [points[name] for points in scenes] for name in scenes[0]}


def _laser_by_laser(shown: Sequence[Scene]) -> list[Scene]:
    """Return the scenes grouped by laser, in the order of each laser's first scene."""
    order = [scene.case for scene in shown]
    return sorted(shown, key=lambda scene: order.index(scene.case))


def _scene_points(
    bench: EvaluationPoints,
    pipelines: Sequence[PipelineRecipes],
    scene: Scene,
    strengths: Sequence[float],
    points: dict[str, dict[float, PointNumbers]],
) -> None:
    """Compute the points of one scene, and add them to ``points`` by pipeline."""
    scene_copy = replace(scene)  # a copy, which releases the picture when it is deleted
    for strength in strengths if scene.case != NONE else (0.0,):
        for pipeline in pipelines:
            points[pipeline.name][strength] = bench.point(
                pipeline, PointRequest(scene_copy, strength)
            )
