"""Pictures for the comparison figure of the paper: one scene with each laser, for each mask and restorer."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial

from torch import Tensor

from neusee.workflows.evaluation.evaluation_points import EvaluationPoints, PointRequest, reduced
from neusee.workflows.evaluation.evaluation_scenes import Scene
from neusee.workflows.evaluation.pipelines import CASES, FLAT, NONE, PipelineRecipes
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.store.memo import compute_once

_SIDE = 200  #: pixels of the shorter side of a picture in the figure
_PLAIN, _MASKED = "developed[plain]", "developed[mask]"
_WEAKEST = 1e4  #: strength of the first laser in the figure of the paper


@dataclass(frozen=True)
class Panel:
    """A column of the figure that compares masks and restorers: pictures with one laser, in linear sRGB (3, y, x)."""

    case: str
    strength: float
    pictures: dict[str, Tensor]  #: by name of the row: "truth", "plain lens" or a pipeline


def panels(
    bench: EvaluationPoints,
    each: Sequence[PipelineRecipes],
    scene: Scene,
    strengths: Sequence[float],
    figure: Collection[str] | None = None,
) -> list[Panel]:
    """Return the columns of the figure that compares masks and restorers, one for each laser and one without a laser.

    The strengths of the lasers rise from 1e4, as in the paper, to the largest of ``strengths``. ``figure`` names the
    lasers; the columns then have the pictures of the sensor behind each mask too.
    """
    columns = []
    lasers = [case for case in figure or CASES if case != NONE]
    top = max(max(strengths), _WEAKEST)
    steps = [_WEAKEST * (top / _WEAKEST) ** (i / (len(lasers) - 1)) for i in range(len(lasers))]
    for case, strength in zip((*lasers, NONE), (*steps, 0.0), strict=True):
        bench.forget()
        point = PointRequest(replace(scene, case=case), strength)
        key = digest("evaluate pictures", _SIDE, bool(figure), [[p.name, bench.key(p, point)] for p in each])
        compute = partial(_develop, bench, each, point, bool(figure))
        columns.append(Panel(case, strength, compute_once(bench.store, key, dict, compute, {"step": "evaluate"})))
    return columns


def _develop(
    bench: EvaluationPoints, each: Sequence[PipelineRecipes], point: PointRequest, sensors: bool
) -> dict[str, Tensor]:
    """Return the pictures of one laser by name, with those of the sensor behind each mask first if ``sensors``."""
    pictures: dict[str, Tensor] = {}
    restored: dict[str, Tensor] = {}
    for pipeline in each:
        line = pipeline.pipeline
        sensor = sensors and line.mask != FLAT and f"{line.front}, sensor" not in pictures
        more = (_MASKED,) if sensor else ()
        values = bench.values(pipeline, point, (_PLAIN, *more) if not pictures else more)
        if not pictures:
            pictures = {"truth": _shrink(values["truth"]), "plain lens": _shrink(values[_PLAIN])}
        if sensor:
            pictures[f"{line.front}, sensor"] = _shrink(values[_MASKED])
        if not sensors or line.restorer != NONE:
            restored[pipeline.name] = _shrink(values[line.picture])
    return pictures | restored


def _shrink(picture: Tensor) -> Tensor:
    side = min(_SIDE, *picture.shape[-2:])
    return reduced(picture.detach().cpu().float(), side).contiguous()
