"""Judge masks and restorers as the paper does: many scenes, many strengths, every pipeline on the very same ones.

    evaluate("first_light", read_pipelines("flat+none, five_half_rings+wiener", Path()), data=Path("photographs"))

Each point, of a scene, a laser's strength and a pipeline, is a run of the recipe that the pipeline makes, to the last
bit; but what a run would compute again and more strictly, because it could not prove its tolerance, is computed once.
Points are kept in the store, so that what was stopped goes on.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from neusee.workflows.engine.provenance import timestamp, versions
from neusee.workflows.evaluation.comparison_pictures import panels
from neusee.workflows.evaluation.confidence_intervals import METRICS, against, table
from neusee.workflows.evaluation.evaluation_points import Bench, Point, Wanted
from neusee.workflows.evaluation.evaluation_result import Evaluated
from neusee.workflows.evaluation.evaluation_scenes import Scene, scenes
from neusee.workflows.evaluation.mask_optics import masks
from neusee.workflows.evaluation.pipelines import NONE, Composed, Pipeline, Refused, composed, read_pipelines
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.recipe.loading import load
from neusee.workflows.recipe.text.overrides import Override
from neusee.workflows.report.run_folder import RunFolder, new_run
from neusee.workflows.store.remote_store import open_store
from neusee.workflows.store.result_store import Store

__all__ = ["STRENGTHS", "Evaluated", "Refused", "evaluate", "read_pipelines"]

STRENGTHS = (0.0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6)  #: the paper's
SMALL = 256  #: pixels of the shorter side, at which the paper restores
Tell = Callable[[str], None]


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
    store: Store | None = None,
    runs: Path = Path("runs"),
    command: Sequence[str] = (),
    tell: Tell = lambda line: None,
    device: str = "cpu",
    folder: Path | None = None,
) -> Path:
    """Measure every pipeline over ``count`` scenes and all ``strengths``; give the folder of the results.

    Args: recipe, changes: the camera, as `load` takes them. data: a folder of photographs; without, the recipe's own
    scene. small: shorter side of the pictures that are compared a second time. reference: the pipeline that all are
    compared with, the first if none. Raises `Refused` with every mistake before anything runs.
    """
    began, store, place = time.perf_counter(), store or open_store(), folder or Path.cwd()
    each = composed(recipe, changes, pipelines, place)
    strengths, reference = _strengths(strengths), _reference(reference, pipelines)
    base = load(recipe, changes, place)
    shown, broken = scenes(base, store, data, count)
    _announce(tell, each, shown, broken, strengths)
    bench = Bench(store, small, device)
    points = _points(bench, each, shown, strengths, tell)
    optics = masks(each, store, device, points)
    drawn = panels(bench, each, shown[0], strengths)
    tables = {name: table(found, strengths) for name, found in points.items()}
    least = min(small, *(base.steps["truth"].params["shape"])) if "truth" in base.steps else small
    more = {name: against(own, tables[reference], base.seed) for name, own in tables.items()}
    rest = (reference, points, tables, more, optics, drawn, list(pipelines))
    found = Evaluated(base, shown, broken, strengths, least, *rest)
    doc = _document(found, bench, command, time.perf_counter() - began)
    with new_run(runs, f"{base.name}_evaluate", digest(doc["summary"])) as made:
        _write(made, found, doc)
    return made.path


def _strengths(strengths: Sequence[float]) -> tuple[float, ...]:
    if not strengths or min(strengths) < 0 or not all(map(np.isfinite, strengths)):
        raise Refused("--strengths: write multiples of saturation from 0, such as 0,1e1,1e3,1e6")
    return tuple(sorted(set(map(float, strengths))))


def _reference(reference: str, pipelines: Sequence[Pipeline]) -> str:
    names = [pipeline.name for pipeline in pipelines]
    if reference and reference not in names:
        raise Refused(f"--reference {reference}: is none of the pipelines {', '.join(names)}")
    return reference or names[0]


def _announce(
    tell: Tell, each: Sequence[Composed], shown: Sequence[Scene], broken: Sequence[Any], strengths: Sequence[float]
) -> None:
    tell(f"{len(shown)} scenes, {len(strengths)} strengths, {len(each)} pipelines: {', '.join(p.name for p in each)}")
    for path, reason in broken[:5]:
        tell(f"not read: {path.name}: {reason}")
    if len(broken) > 5:
        tell(f"not read: {len(broken) - 5} more")


def _points(
    bench: Bench, each: Sequence[Composed], shown: Sequence[Scene], strengths: Sequence[float], tell: Tell
) -> dict[str, list[dict[float, Point]]]:
    """Every point; the scenes of one laser after another, for they have its optics in common."""
    found: dict[str, list[dict[float, Point]]] = {p.name: [{} for _ in shown] for p in each}
    before, order = "", [scene.case for scene in shown]
    for done, scene in enumerate(sorted(shown, key=lambda scene: order.index(scene.case)), 1):
        if before not in ("", scene.case):
            bench.forget()
        before, alone = scene.case, replace(scene)  # its picture goes with it
        for strength in strengths if scene.case != NONE else (0.0,):
            for pipeline in each:
                found[pipeline.name][scene.number][strength] = bench.point(
                    pipeline, Wanted(alone, scene.case, strength)
                )
        tell(f"scene {done} of {len(shown)} ({scene.case}, {scene.name}): {bench.computed} points computed")
    return found


# --- the folder -------------------------------------------------------------------------------------------------------


def _document(found: Evaluated, bench: Bench, command: Sequence[str], seconds: float) -> dict[str, Any]:
    from neusee.workflows.evaluation.evaluation_page import summary

    return {
        "study": "evaluate",
        "recipe": found.recipe.name,
        "command": " ".join(command),
        "date": timestamp(),
        "seconds": seconds,
        "scenes": [[s.number, s.name, s.case, s.seed] for s in found.scenes],
        "not read": [[str(path), reason] for path, reason in found.broken],
        "strengths": list(found.strengths),
        "small": found.small,
        "reference": found.reference,
        "computed": bench.computed,
        "seconds a point": bench.seconds / bench.computed if bench.computed else None,
        "summary": summary(found),
        "versions": versions(),
        "config": found.recipe.config.to_yaml(),
    }


def _write(folder: RunFolder, found: Evaluated, doc: dict[str, Any]) -> None:
    from neusee.workflows.evaluation.evaluation_page import COLUMNS, drawn, lead, rows, sections
    from neusee.workflows.report.study_page import page

    pictures = drawn(found)
    for name, content in pictures.items():
        folder.write(f"figures/{name}.png", content)
    folder.write("provenance.json", json.dumps(doc, indent=1, ensure_ascii=False))
    folder.write_rows("points.csv", ("pipeline", "mask", "restorer", *_POINT, *METRICS), _point_rows(found))
    folder.write_rows("table.csv", COLUMNS, rows(found))
    folder.write_rows("suppression.csv", ("mask", "wavelength (nm)", "lsr", "bsr", "floor"), _curve_rows(found))
    told = ("command", "date", "seconds", "computed", "seconds a point", "reference", "versions")
    said = {name: doc[name] for name in told}
    folder.write("report.html", page(f"{found.recipe.name}: evaluated", lead(found), sections(found, pictures), said))


_POINT = ("scene", "photograph", "laser", "strength")


def _point_rows(found: Evaluated) -> list[Sequence[Any]]:
    return [
        (p.name, p.front, p.back, s.number, s.name, s.case, f"{k:g}", *(point[metric] for metric in METRICS))
        for p in found.pipelines
        for s, at in zip(found.scenes, found.points[p.name], strict=True)
        for k, point in at.items()
    ]


def _curve_rows(found: Evaluated) -> list[Sequence[Any]]:
    return [
        (name, f"{x:.6g}", *row)
        for name, mask in found.masks.items()
        for x, *row in zip(mask.wavelengths, mask.lsr, mask.bsr, mask.floor, strict=True)
    ]
