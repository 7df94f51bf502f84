"""The paper's figure: one scene behind each laser and behind none, seen by a plain lens and by every pipeline."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

from torch import Tensor

from neusee.workflows.engine.provenance import timestamp
from neusee.workflows.evaluation.evaluation_points import Bench, Wanted, smaller
from neusee.workflows.evaluation.evaluation_scenes import Scene
from neusee.workflows.evaluation.pipelines import CASES, NONE, Composed
from neusee.workflows.keys.cache_key import digest

_SIDE = 200  #: pixels of the shorter side, as drawn
_PLAIN = "developed[plain]"
_WEAKEST = 1e4  #: the paper's figure begins there


@dataclass(frozen=True)
class Panel:
    """A column of the figure: pictures by row, linear sRGB (3, y, x)."""

    case: str
    strength: float
    pictures: dict[str, Tensor]  #: "truth", "plain lens" and pipelines


def panels(bench: Bench, each: Sequence[Composed], scene: Scene, strengths: Sequence[float]) -> list[Panel]:
    """The scene behind every laser; as in the paper, from 1e4 to the strongest that was asked for."""
    found = []
    lasers = [case for case in CASES if case != NONE]
    top = max(max(strengths), _WEAKEST)
    steps = [_WEAKEST * (top / _WEAKEST) ** (i / (len(lasers) - 1)) for i in range(len(lasers))]
    for case, strength in zip((*lasers, NONE), (*steps, 0.0), strict=True):
        bench.forget()
        alone = replace(scene, case=case)
        found.append(Panel(case, strength, _pictures(bench, each, Wanted(alone, case, strength))))
    return found


def _pictures(bench: Bench, each: Sequence[Composed], wanted: Wanted) -> dict[str, Tensor]:
    key = digest("evaluate pictures", _SIDE, [[p.name, bench.key(p, wanted)] for p in each])
    with suppress(KeyError):
        kept: dict[str, Tensor] = bench.store.get(key)
        return kept
    found: dict[str, Tensor] = {}
    for number, pipeline in enumerate(each):
        values = bench.values(pipeline, wanted, () if number else (_PLAIN,))
        if not number:
            found |= {"truth": _shown(values["truth"]), "plain lens": _shown(values[_PLAIN])}
        found[pipeline.name] = _shown(values[pipeline.pipeline.picture])
    bench.store.put(key, found, {"step": "evaluate", "seconds": 1.0, "date": timestamp()})
    return found


def _shown(picture: Tensor) -> Tensor:
    side = min(_SIDE, *picture.shape[-2:])
    return smaller(picture.detach().cpu().float(), side).contiguous()
