"""The paper's figure: one scene behind each laser and behind none, seen by a plain lens and by every pipeline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

from torch import Tensor

from neusee.workflows.evaluation.evaluation_points import EvaluationPoints, PointRequest, reduced
from neusee.workflows.evaluation.evaluation_scenes import Scene
from neusee.workflows.evaluation.pipelines import CASES, NONE, PipelineRecipes
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.store.memo import compute_once

_SIDE = 200  #: pixels of the shorter side, as drawn
_PLAIN = "developed[plain]"
_WEAKEST = 1e4  #: the paper's figure begins there


@dataclass(frozen=True)
class Panel:
    """A column of the figure: pictures by row, linear sRGB (3, y, x)."""

    case: str
    strength: float
    pictures: dict[str, Tensor]  #: "truth", "plain lens" and pipelines


def panels(
    bench: EvaluationPoints, each: Sequence[PipelineRecipes], scene: Scene, strengths: Sequence[float]
) -> list[Panel]:
    """Return the scene behind every laser, from a strength of 1e4, as in the paper, to the strongest asked for."""
    found = []
    lasers = [case for case in CASES if case != NONE]
    top = max(max(strengths), _WEAKEST)
    steps = [_WEAKEST * (top / _WEAKEST) ** (i / (len(lasers) - 1)) for i in range(len(lasers))]
    for case, strength in zip((*lasers, NONE), (*steps, 0.0), strict=True):
        bench.forget()
        alone = replace(scene, case=case)
        found.append(Panel(case, strength, _pictures(bench, each, PointRequest(alone, case, strength))))
    return found


def _pictures(bench: EvaluationPoints, each: Sequence[PipelineRecipes], wanted: PointRequest) -> dict[str, Tensor]:
    key = digest("evaluate pictures", _SIDE, [[p.name, bench.key(p, wanted)] for p in each])
    return compute_once(bench.store, key, dict, partial(_develop, bench, each, wanted), {"step": "evaluate"})


def _develop(bench: EvaluationPoints, each: Sequence[PipelineRecipes], wanted: PointRequest) -> dict[str, Tensor]:
    """Return the truth, the picture of the plain lens and that of each pipeline, as large as they are drawn."""
    found: dict[str, Tensor] = {}
    for number, pipeline in enumerate(each):
        values = bench.values(pipeline, wanted, () if number else (_PLAIN,))
        if not number:
            found |= {"truth": _shrink(values["truth"]), "plain lens": _shrink(values[_PLAIN])}
        found[pipeline.name] = _shrink(values[pipeline.pipeline.picture])
    return found


def _shrink(picture: Tensor) -> Tensor:
    side = min(_SIDE, *picture.shape[-2:])
    return reduced(picture.detach().cpu().float(), side).contiguous()
