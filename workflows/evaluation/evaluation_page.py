"""The report page of an evaluation of masks and restorers, with tables, pictures and explanations."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple
from typing import TYPE_CHECKING, Any

from neusee.workflows.evaluation import evaluation_figures as figures
from neusee.workflows.evaluation.confidence_intervals import METRICS, Interval, mean
from neusee.workflows.evaluation.equal_protection import protection_section
from neusee.workflows.evaluation.paired_intervals import gains_by_strength
from neusee.workflows.evaluation.pipelines import CASES, DRAWN
from neusee.workflows.evaluation.point_commands import shown_commands
from neusee.workflows.report.study_page import Mark, Section

if TYPE_CHECKING:
    from neusee.workflows.evaluation.evaluation_result import EvaluationResult

_EACH = ("mean", "low", "high")
COLUMNS = ("pipeline", "mask", "restorer", "scenes", *(f"{m} {e}" for m in METRICS for e in _EACH),
           *(f"{name} {e}" for name in ("l1 less", "l1 gain", "l1 small gain") for e in _EACH))  # fmt: skip
_COARSE = 1.05  #: tolerance of a bound, because a circular aperture is sampled on a square grid of frequencies
_DIGITS = {"psnr": ".2f", "l1": ".4f", "ssim": ".3f", "saturated": ".0f", "above": ".2f"}


def draw_pictures(result: EvaluationResult) -> dict[str, bytes]:
    """Draw the figures of the evaluation page, and return the PNG files by name."""
    waves = {"wavelengths": figures.wavelengths(result)} if _drawn(result) else {}
    return waves | {
        "cases": figures.cases(result.panels),
        "strengths": figures.strengths(result.tables, result.small),
        "curves": figures.curves(result.masks),
        "plane": figures.plane(result.masks),
    }


def summary(result: EvaluationResult) -> dict[str, Any]:
    """Return the mean and the interval of every metric, and the gain over the reference, for each mask and restorer."""
    return {
        p.name: {
            "mask": p.front,
            "restorer": p.back,
            **{metric: asdict(result.tables[p.name].mean(metric)) for metric in METRICS},
            "against": {name: asdict(x) for name, x in result.against[p.name].items()},
        }
        for p in result.pipelines
    }


def rows(result: EvaluationResult) -> list[Sequence[Any]]:
    """Return the rows of ``table.csv``, one for each mask and restorer, with the numbers from `summary`."""
    listed: list[Sequence[Any]] = []
    for p in result.pipelines:
        each = [result.tables[p.name].mean(metric) for metric in METRICS] + list(result.against[p.name].values())
        numbers = [x for interval in each for x in astuple(interval)]
        listed.append((p.name, p.front, p.back, len(result.scenes), *("" if math.isnan(x) else x for x in numbers)))
    return listed


def lead(result: EvaluationResult) -> str:
    """Return a few sentences with the main result of the evaluation."""
    best = min(result.pipelines, key=lambda p: float(result.tables[p.name].scenes("l1").mean()))
    least = _with_interval(result.tables[best.name].mean("l1"), "l1")
    strengths = ", ".join("none" if k == 0 else f"{k:g}".replace("e+0", "e") for k in result.strengths)
    enough = len(result.scenes) >= len(CASES) or _drawn(result)
    few = "" if enough else f" These are too few scenes for all {len(CASES)} lasers of the protocol."
    uncertain = result.recipe.uncertain
    names = [name for name in (uncertain.names if uncertain else ()) if not name.startswith("lasers.")]
    laser = " The wavelength of the laser of each scene is drawn by the law of the recipe." if _drawn(result) else ""
    drawn = f"{laser} These values are drawn for each scene: {', '.join(names)}." if names else laser
    level = result.protection.level if result.protection else 0.0
    which = "every pipeline" if all(p.shade for p in result.pipelines) else "each of them once more"
    equal = f" Filters and stops bring {which} to a peak of {level:g} of the plain lens's." if level else ""
    return f"""{len(result.scenes)} scenes, laser strengths {strengths} (1 saturates a pixel of the plain lens),
        {len(result.pipelines)} pipelines of a mask and a restorer. Lowest L1: {best.name}, {least}.
        {few}{drawn}{equal}"""


def sections(result: EvaluationResult, shown: Mapping[str, bytes]) -> list[Section]:
    """Return all sections of the report page of an evaluation."""
    compared = (_compared(result, name) for name in dict.fromkeys(result.references.values()))
    gained = (_gained(result, name) for name in dict.fromkeys(result.references.values()))
    parts = [*protection_section(result), _crossed(result), _by_strength(result), *gained, _numbers(result), *compared]
    parts += _mistold(result)
    text = """Mean over scenes and its 95 % interval. A scene without a laser counts only at the strength none, so
        that every scene of the other points has a laser. The axis ends at most at three times the largest mean; an
        interval of few scenes may reach beyond."""
    parts.append(Section("Error over strength", text, picture=shown["strengths"]))
    if "wavelengths" in shown:
        text = f"""One dot for each scene: its drawn wavelength, and its L1 at the strength {max(result.strengths):g} at
            {result.small} pixels. Lines: means over sixths of the range."""
        parts.append(Section("Error over wavelength", text, picture=shown["wavelengths"]))
    text = """The first scene with each laser of the protocol and without a laser, all with the same scale. The rows are
        the truth, the picture of the plain lens without restoration, and every pipeline; the figure with six lasers has
        the pictures of the sensor behind each mask too."""
    parts.append(Section("With each laser and without a laser", text, picture=shown["cases"]))
    return [*parts, _suppression(result, shown["curves"]), _plane(result, shown["plane"]), *_data(result)]


def _crossed(result: EvaluationResult) -> Section:
    masks = list(dict.fromkeys(p.front for p in result.pipelines))
    restorers = list(dict.fromkeys(p.back for p in result.pipelines))
    l1 = {(p.front, p.back): _with_interval(result.tables[p.name].mean("l1"), "l1") for p in result.pipelines}
    listed = [(mask, *(l1.get((mask, back)) for back in restorers)) for mask in masks]
    text = """L1 at full size (sRGB from 0 to 1, as a display shows it): the mean over the strengths of each scene, then
        mean and 95 % confidence interval (Student's t). Scenes of one photograph count as one draw."""
    return Section("Mask by restorer", text, ("mask", *restorers), listed)


def _drawn(result: EvaluationResult) -> bool:
    return any(scene.case == DRAWN for scene in result.scenes)


def _strength_names(result: EvaluationResult) -> list[str]:
    return ["none" if k == 0 else f"{k:g}".replace("e+0", "e") for k in result.strengths]


def _by_strength(result: EvaluationResult) -> Section:
    text = f"""L1 of the pictures reduced to {result.small} pixels of their shorter side, at each laser strength: mean
        and 95 % interval."""
    columns = ("pipeline", *_strength_names(result))
    listed = [
        (p.name, *(_with_interval(result.tables[p.name].at("l1 small", i), "l1") for i in range(len(columns) - 1)))
        for p in result.pipelines
    ]
    return Section(f"L1 by strength, {result.small} pixels", text, columns, listed)


def _gained(result: EvaluationResult, reference: str) -> Section:
    text = f"""By which fraction the L1 of the reduced pictures lies below that of {reference} on the same pictures, at
        each laser strength, with 95 % intervals as below. A colour marks an interval without zero."""
    listed: list[Sequence[Any]] = []
    marks: dict[tuple[int, int], Mark] = {}
    for name in (name for name, other in result.references.items() if other == reference != name):
        found = gains_by_strength(result.tables[name], result.tables[reference], result.recipe.seed)
        for i, x in enumerate(found, 1):
            if x.excludes_zero:
                marks[len(listed), i] = "pass" if x.mean > 0 else "fail"
        listed.append((name, *(_between(x, ".1%") for x in found)))
    columns = ("pipeline", *_strength_names(result))
    return Section(f"Gain by strength over {reference}", text, columns, listed, marks=marks)


def _with_interval(x: Interval, metric: str) -> str:
    digits = _DIGITS.get(metric.partition(" ")[0], ".3g")
    half = "" if math.isnan(x.half) else f" ±\N{NO-BREAK SPACE}{x.half:{digits}}"
    return f"{x.mean:{digits}}{half}"


def _numbers(result: EvaluationResult) -> Section:
    text = f"""Mean and 95 % interval over scenes. Small: the picture that a display shows, reduced to {result.small}
        pixels of its shorter side in linear light, antialiased. Saturated: number of saturated pixels of the raw
        picture. Above: fraction of the points whose brightest pixel exceeds `reading.damage_multiple`
        times saturation, where the paper expects damage: a reading of the paper and no verdict, because 1e6 are
        2 W/cm2 at its exposure, which damages nothing that is known. PSNR is a mean of decibels."""
    metrics = [metric for metric in METRICS if metric != "peak"]
    columns = ("pipeline", *(_column(metric) for metric in metrics))
    listed = [
        (p.name, *(_with_interval(result.tables[p.name].mean(metric), metric) for metric in metrics))
        for p in result.pipelines
    ]
    return Section("All numbers", text, columns, listed)


def _mistold(result: EvaluationResult) -> list[Section]:
    """Return the section of restorers that are told optics or laser with an error, if there are any."""
    if not result.mistold:
        return []
    errors = list(dict.fromkeys(point.error for point in result.mistold))
    strength, listed = result.mistold[0].strength, []
    for name in dict.fromkeys(point.pipeline for point in result.mistold):
        own = [point for point in result.mistold if point.pipeline == name]
        told = {point.scene.number: point.true["psnr"] for point in own}
        each = [[p.wrong["psnr"] for p in own if p.error == error] for error in errors]
        cells = (_with_interval(mean(values), "psnr") if values else "" for values in each)
        listed.append((name, _with_interval(mean(list(told.values())), "psnr"), *cells))
    text = f"""PSNR in dB of the restored picture at the strength {strength:g}, in the first scenes with a laser: mean
        and 95 % interval. In every other table the restorer is told the exact PSF and the exact pattern of the laser,
        which no camera knows. Here it is told one of them with the error of the column. The recipe sets these errors in
        `evaluate.mismatch`; mistold.csv has every point."""
    return [Section("What the restorer is not told", text, ("pipeline", "told exactly", *errors), listed)]


def _column(metric: str) -> str:
    """Return the heading of a column with a metric, with its unit."""
    units = {"psnr": " (dB)", "saturated": " (pixels)"}
    name = re.sub("l1|psnr|ssim", lambda match: match[0].upper(), metric)
    return name + units.get(metric.partition(" ")[0], "")


def _compared(result: EvaluationResult, reference: str) -> Section:
    text = f"""Differences from {reference} in the same scenes. L1 less: by how much L1 is lower. Gain: the same
        as a fraction of the mean L1 of the reference. Intervals of 95 % come from 10 000 draws of the photographs
        (bootstrap-t); fewer than five photographs have no interval. A colour marks an interval without zero. If many
        pipelines are compared with one reference, about one in twenty is marked by chance."""
    listed: list[Sequence[Any]] = []
    marks: dict[tuple[int, int], Mark] = {}
    for p in result.pipelines:
        if p.name == reference or result.references[p.name] != reference:
            continue
        less, share, small = result.against[p.name].values()
        for column, interval in ((1, less), (2, share), (3, small)):
            if interval.excludes_zero:
                marks[len(listed), column] = "pass" if interval.mean > 0 else "fail"
        listed.append((p.name, _between(less, ".4f"), _between(share, ".1%"), _between(small, ".1%")))
    columns = ("pipeline", "L1 less", "gain", "gain, small")
    return Section(f"Against {reference}", text, columns, listed, marks=marks)


def _between(x: Interval, digits: str) -> str:
    return f"{x.mean:{digits}}" + ("" if math.isnan(x.low) else f" ({x.low:{digits}} to {x.high:{digits}})")


def _suppression(result: EvaluationResult, picture: bytes) -> Section:
    own = next(p.front for p in result.pipelines if p.name == result.reference)
    text = f"""LSR: the brightest pixel of a laser with the mask, divided by the brightest pixel without the mask; BSR:
        share of the scene's light that stays in the field, at most 1, mean over scenes. Energy floor: the
        LSR of light that is spread evenly over the window of the PSF. Stronger: the mean LSR of {own} divided by the
        mean LSR of the mask. The file suppression.csv has LSR and BSR by wavelength."""
    base = float(result.masks[own].lsr.mean())
    listed: list[Sequence[Any]] = []
    for name, m in result.masks.items():
        middle = float(m.lsr.mean())
        numbers = (m.lsr.min(), m.lsr.max(), base / middle, m.floor.mean(), m.bsr.mean())
        listed.append((name, middle, *map(float, numbers)))
    columns = ("mask", "mean LSR", "least", "greatest", "stronger", "floor", "mean BSR")
    return Section("Suppression by wavelength", text, columns, listed, picture)


def _plane(result: EvaluationResult, picture: bytes) -> Section:
    text = """Means over wavelengths, with the contrast within the band that the clear aperture passes. A low peak costs
        contrast: by Parseval the rms over all sampled frequencies is at most sqrt(LSR p0), where p0 is the fraction of
        light in the brightest pixel of the clear lens, and the rms within the band, a fraction 4 p0 of the frequencies,
        is at most sqrt(LSR) / 2; the median is at most 1.41 times the rms. If a mask sends light out of the window, the
        contrast is that of the remaining light, and the bound of the mask, in the table, is higher."""
    listed: list[Sequence[Any]] = []
    marks: dict[tuple[int, int], Mark] = {}
    for name, m in result.masks.items():
        marks[len(listed), 4] = "pass" if (m.rms <= _COARSE * m.most).all() else "fail"
        listed.append((name, *(float(x.mean()) for x in (m.lsr, m.median, m.rms, m.most))))
    columns = ("mask", "mean LSR", "median", "rms", "rms at most")
    return Section("Suppression and contrast", text, columns, listed, picture, marks)


def _commands(result: EvaluationResult) -> list[Section]:
    """Return the section with the command of one point of each pipeline, beside the numbers that it gives."""
    listed: list[Sequence[Any]] = []
    for name, place, strength, command in shown_commands(result.commands):
        point = result.points[name][place][strength]
        numbers = (f"{point['l1']:.6g}", f"{point['psnr']:.6g}", f"{point['ssim']:.6g}", f"{point['saturated']:.0f}")
        said = command or "no command: a random part of the camera, such as dirt, has the seed of the evaluation"
        listed.append((name, result.scenes[place].number, f"{strength:g}", *numbers, said))
    if not listed:
        return []
    text = """One point of each pipeline, with the command that gives its numbers at full size, in the folder in which
        this evaluation was started: `metrics.csv` of the run has them. Each point has its command in `points.csv`. The
        same recipe with another seed, another part of the photograph, or another direction of the laser gives other
        numbers."""
    columns = ("pipeline", "scene", "strength", "L1", "PSNR", "SSIM", "saturated", "command")
    return [Section("The same numbers again", text, columns, listed)]


def _data(result: EvaluationResult) -> list[Section]:
    text = """Scenes in the order of their numbers. The seed of the recipe chooses part of a photograph for each scene.
        The seed of a scene decides the direction of the laser and the noise, which are the same for every pipeline."""
    listed = [(s.number, s.name, s.case, s.seed) for s in result.scenes]
    parts = [Section("Scenes", text, ("scene", "photograph", "laser", "seed"), listed), *_commands(result)]
    if result.broken:
        broken = [(path.name, reason) for path, reason in result.broken]
        parts.append(Section("Photographs that cannot be read", "", ("file", "why"), broken))
    return parts
