"""The protection study: a mask, a grey filter and a smaller stop of equal protection, quiet and under attack."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.protection.camera_parts import ProtectionCamera
from neusee.workflows.protection.equal_rivals import CONTRAST, MEASURES
from neusee.workflows.protection.front_optics import FrontBench, FrontSettings
from neusee.workflows.protection.protection_result import DRAWN, LIGHTS, ProtectionResult, measure_protection
from neusee.workflows.protection.unknown_conditions import Condition, UnknownLaws, draw_conditions
from neusee.workflows.report.study_folder import SHOWN, Progress, StudyReport, StudyRun
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.protection.protection_page import draw_pictures, quotable, sections

_COLUMNS = ("protection", "scene light", "measure", "gain", "5 %", "95 %")
_VARIANCE, _LOW = 0.1, 0.12  #: contrast of a natural scene; highest frequency of the mean log NEQ, cycles per pixel
_CONTINUOUS = 0.1  #: s, dwell time of continuous light
_LAWS = UnknownLaws()


def study(
    recipe: Recipe,
    store: Store,
    runs: Path,
    command: Sequence[str],
    progress: Progress,
    draws: int = 12,
    bands: int = 7,
    light: str = "pulse",
    size: float = 14.0,
    prnu: float = 0.01,
    residual: float = 0.02,
) -> Path:
    """Compare the mask of a recipe with filters and stops of equal protection, and return the folder with the results.

    Args: draws: of the unknown conditions. bands: wavelengths of the scene; the laser may have each of the recipe.
    light: `pulse`, whose peak does harm, or `continuous`, whose heat does. size: height of the targets in pixels.
    prnu: relative spread of the sensitivity of pixels. residual: share of the glare that is subtracted wrongly.
    """
    study_run = StudyRun("protection", recipe, command)
    camera = ProtectionCamera.of(recipe, store, bands)
    side = min(int(n) for n in camera.lens["shape"])
    if 4 * size > side:
        raise ValueError(f"a text {size:g} pixels high is wider than the PSF window of {side}; give a smaller --size")
    dwell = None if light == "pulse" else _CONTINUOUS
    settings = FrontSettings(_VARIANCE, _LOW, size, (side, 2 * side, 4 * side), dwell)
    bench = FrontBench(camera, store, settings)
    conditions = draw_conditions(draws, recipe.seed, _LAWS)
    result = measure_protection(bench, conditions, camera.pixel(prnu, residual), progress)
    said = quotable(result, recipe.name, light)
    document = study_run.document({"light": light, "paragraph": said, **_document(result, conditions)})
    options = {"light": light, "size": size, "prnu": prnu, "residual": residual}
    report = _report(recipe, result, said, _notes(camera, options))
    return study_run.write(runs, digest(document["gain"], document["lost"], options), document, report)


def _document(result: ProtectionResult, conditions: Sequence[Condition]) -> dict[str, Any]:
    return {
        "protection": result.own,
        "draws": [one.plain for one in conditions],
        "laws": asdict(_LAWS),
        "rivals": {name: rival.said for name, rival in result.rivals.items()},
        "gain": _texts(result.gain[result.own]),
        "drawn": _texts(result.drawn),
        "quiet": {name: _texts(rows) for name, rows in result.quiet.items()},
        "bound": {f"{n:g}": {"gain": pair[0], "bound": pair[1]} for n, pair in result.bound.items()},
        "largest glare": _texts(result.forbidden),
        "lost": {name: list(rows) for name, rows in result.lost.items()},
        "tint": dict(result.tint),
        "failed": 0,
    }


def _texts(rows: Any) -> dict[str, Any]:
    return {f"{key:g}": value for key, value in rows.items()}


def _report(recipe: Recipe, result: ProtectionResult, said: str, notes: Sequence[str]) -> StudyReport:
    pictures = draw_pictures(result)
    return StudyReport(
        f"{recipe.name}: equal protection",
        said,
        sections(result, pictures, notes),
        pictures,
        tables={"table.csv": (_COLUMNS, list(_rows(result)))},
        files={"paragraph.txt": said + "\n"},
        shown=(*SHOWN, "light"),
    )


def _rows(result: ProtectionResult) -> Iterator[Sequence[Any]]:
    import numpy as np

    for level, lights in result.gain.items():
        for n in LIGHTS:
            for measure in MEASURES:
                ends: Sequence[Any] = ("", "")
                if level == result.own and measure in DRAWN:
                    ends = np.quantile(result.drawn[n][measure], [0.05, 0.95]).tolist()
                yield level, n, measure, lights[n][measure], *ends


def _notes(camera: ProtectionCamera, options: dict[str, Any]) -> list[str]:
    noise = camera.noise
    harm = "peak of the PSF" if options["light"] == "pulse" else f"heat of the hottest pixel after {_CONTINUOUS:g} s"
    laws = ", ".join(f"{name.replace('_', ' ')} {law}" for name, law in asdict(_LAWS).items())
    wavelengths = len(camera.laser_bands.centres)
    return [
        f"Equal protection: the {harm} at the worst of {wavelengths} wavelengths. Sensor: read noise "
        f"{noise['read_noise']:g} e-, well {noise['full_well']:g} e-, PRNU {options['prnu']:.1%}, residual glare "
        f"{options['residual']:.1%} (the share of the glare that is subtracted wrongly).",
        f"Scene: grey, natural spectrum 1 / frequency^2 with a contrast variance of {_VARIANCE:g}. Targets: "
        f"{options['size']:g} pixels high, contrast {CONTRAST:g}. Every rival is restored by the Wiener filter for its "
        "own PSF and its noise.",
        f"Unknown in the draws: {laws}. Directions are shares of the field.",
        "Left out: ghosts, blooming, edges of the picture, contrast that scattered light of the scene takes, a "
        "response of the eye, and masks that would be designed for this camera.",
    ]
