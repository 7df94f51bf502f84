"""An evaluation on paper."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from neusee.workflows.evaluation import evaluation_figures as figures
from neusee.workflows.evaluation.confidence_intervals import METRICS, Interval, mean
from neusee.workflows.evaluation.pipelines import CASES
from neusee.workflows.report.study_page import Mark, Section

if TYPE_CHECKING:
    from neusee.workflows.evaluation.evaluation_result import Evaluated

_EACH = ("mean", "low", "high")
COLUMNS = ("pipeline", "mask", "restorer", "scenes", *(f"{m} {e}" for m in METRICS for e in _EACH),
           *(f"{name} {e}" for name in ("l1 less", "l1 gain", "l1 small gain") for e in _EACH))  # fmt: skip
_COARSE = 1.05  #: the band of the aperture is a disc, counted by the grid of frequencies that the pixels sample
_DIGITS = {"psnr": ".2f", "l1": ".4f", "ssim": ".3f", "saturated": ".0f", "damaged": ".2f"}


def drawn(found: Evaluated) -> dict[str, bytes]:
    """The pictures, by name."""
    return {
        "cases": figures.cases(found.panels),
        "strengths": figures.strengths(found.tables, found.small),
        "curves": figures.curves(found.masks),
        "plane": figures.plane(found.masks),
    }


def summary(found: Evaluated) -> dict[str, Any]:
    """By pipeline: every metric's mean over scenes with its interval, and what the reference's L1 is more."""
    return {
        p.name: {
            "mask": p.front,
            "restorer": p.back,
            **{metric: asdict(mean(found.tables[p.name].scenes(metric))) for metric in METRICS},
            "against": {name: asdict(x) for name, x in found.against[p.name].items()},
        }
        for p in found.pipelines
    }


def rows(found: Evaluated) -> list[Sequence[Any]]:
    """The same as a table."""
    listed: list[Sequence[Any]] = []
    for p in found.pipelines:
        each = [mean(found.tables[p.name].scenes(metric)) for metric in METRICS] + list(found.against[p.name].values())
        numbers = [x for interval in each for x in (interval.mean, interval.low, interval.high)]
        listed.append((p.name, p.front, p.back, len(found.scenes), *("" if math.isnan(x) else x for x in numbers)))
    return listed


def lead(found: Evaluated) -> str:
    """What came out."""
    best = min(found.pipelines, key=lambda p: float(found.tables[p.name].scenes("l1").mean()))
    said = _said(mean(found.tables[best.name].scenes("l1")), "l1")
    strengths = ", ".join("none" if k == 0 else f"{k:g}".replace("e+0", "e") for k in found.strengths)
    enough = len(found.scenes) >= len(CASES)
    few = "" if enough else f" These are too few scenes for all {len(CASES)} cases of the protocol."
    uncertain = found.recipe.uncertain
    laws = [name for name in (uncertain.names if uncertain else ()) if not name.startswith("lasers.")]
    drawn = f" Drawn anew for each scene: {', '.join(laws)}." if laws else ""
    return f"""{len(found.scenes)} scenes, laser strengths {strengths} (multiples of what saturates a pixel of the
        plain lens), {len(found.pipelines)} pipelines of a mask and a restorer. Least L1: {best.name}, {said}.
        {few}{drawn}"""


def sections(found: Evaluated, shown: Mapping[str, bytes]) -> list[Section]:
    """Mask by restorer, all numbers, against the reference, over strength, the cases, the masks, the data."""
    parts = [_crossed(found), _numbers(found), _compared(found)]
    text = """Mean over scenes and its 95 % interval. A scene without a laser counts at no strength but none, so
        that the scenes of the other points have a laser each."""
    parts.append(Section("Error over strength", text, picture=shown["strengths"]))
    text = """The first scene behind each laser of the protocol and behind none, all by one stretch: rows are the
        truth, the plain lens, whose picture is developed and no more, and every pipeline."""
    parts.append(Section("Lasers, and none", text, picture=shown["cases"]))
    return [*parts, _suppression(found, shown["curves"]), _plane(found, shown["plane"]), *_data(found)]


def _crossed(found: Evaluated) -> Section:
    masks = list(dict.fromkeys(p.front for p in found.pipelines))
    restorers = list(dict.fromkeys(p.back for p in found.pipelines))
    each = {(p.front, p.back): p.name for p in found.pipelines}
    listed = [(mask, *(_cell(found, each.get((mask, back))) for back in restorers)) for mask in masks]
    text = """L1 at full size (sRGB as a display shows it, 0 to 1): of each scene the mean over its strengths, then
        mean and 95 % confidence interval over scenes (Student's t)."""
    return Section("Mask by restorer", text, ("mask", *restorers), listed)


def _cell(found: Evaluated, name: str | None) -> str | None:
    return _said(mean(found.tables[name].scenes("l1")), "l1") if name else None


def _said(x: Interval, metric: str) -> str:
    how = _DIGITS.get(metric.partition(" ")[0], ".3g")
    return (
        f"{x.mean:{how}}"
        if math.isnan(x.half)
        else f"{x.mean:{how}}\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}{x.half:{how}}"
    )


def _numbers(found: Evaluated) -> Section:
    text = f"""Mean and 95 % interval over scenes. Small: the picture that a display shows, reduced to {found.small}
        pixels of its shorter side in linear light, antialiased. Saturated: pixels of the raw picture. Damaged:
        share of the points whose brightest pixel passes the damage threshold of the sensor. PSNR is a mean of
        decibels."""
    metrics = [metric for metric in METRICS if metric != "peak"]
    columns = ("pipeline", *(re.sub("l1|psnr|ssim", lambda found: found[0].upper(), metric) for metric in metrics))
    listed = [
        (p.name, *(_said(mean(found.tables[p.name].scenes(metric)), metric) for metric in metrics))
        for p in found.pipelines
    ]
    return Section("All numbers", text, columns, listed)


def _compared(found: Evaluated) -> Section:
    text = f"""Against {found.reference}, scene by scene. L1 less: how much lower the L1 is (Student's t of the
        differences). Gain: the same as a share of the reference's mean L1, its interval from scenes drawn again
        (10 000 times, both pipelines on the same; of fewer than five scenes none is given). Marked where zero lies
        outside the interval. Many pipelines against one: one in twenty passes by chance."""
    listed: list[Sequence[Any]] = []
    marks: dict[tuple[int, int], Mark] = {}
    for p in found.pipelines:
        if p.name == found.reference:
            continue
        less, share, small = found.against[p.name].values()
        for column, interval in ((1, less), (2, share), (3, small)):
            if interval.excludes_zero:
                marks[len(listed), column] = "pass" if interval.mean > 0 else "fail"
        listed.append((p.name, _between(less, ".4f"), _between(share, ".1%"), _between(small, ".1%")))
    columns = ("pipeline", "L1 less", "gain", "gain, small")
    return Section(f"Against {found.reference}", text, columns, listed, marks=marks)


def _between(x: Interval, how: str) -> str:
    return f"{x.mean:{how}}" if math.isnan(x.low) else f"{x.mean:{how}} ({x.low:{how}} to {x.high:{how}})"


def _suppression(found: Evaluated, picture: bytes) -> Section:
    own = next(p.front for p in found.pipelines if p.name == found.reference)
    text = f"""LSR: the brightest pixel of a laser behind the mask over that behind the clear lens; BSR: light of
        the scene in the field over that of the plain lens, mean over scenes. Energy floor: the LSR of light that is
        spread evenly over the window of the PSF. Stronger: how many times lower the mean LSR is than that of {own}.
        The same by wavelength: suppression.csv."""
    base = float(found.masks[own].lsr.mean())
    listed: list[Sequence[Any]] = []
    for name, m in found.masks.items():
        middle = float(m.lsr.mean())
        numbers = (m.lsr.min(), m.lsr.max(), base / middle, m.floor.mean(), m.bsr.mean())
        listed.append((name, middle, *map(float, numbers)))
    columns = ("mask", "mean LSR", "least", "greatest", "stronger", "floor", "mean BSR")
    return Section("Suppression by wavelength", text, columns, listed, picture)


def _plane(found: Evaluated, picture: bytes) -> Section:
    text = """Means over wavelengths, contrast within the band that the clear aperture passes. A low peak costs
        contrast: by Parseval the rms over all sampled frequencies is at most sqrt(LSR p0), p0 the share of light in
        the brightest pixel of the clear lens, and within the band, a share 4 p0 of them, at most sqrt(LSR) / 2; the
        median is at most 1.41 times the rms. Where a mask throws light out of the window, contrast is that of the
        light that is kept, and its own bound is that much higher: the table has it."""
    listed: list[Sequence[Any]] = []
    marks: dict[tuple[int, int], Mark] = {}
    for name, m in found.masks.items():
        marks[len(listed), 4] = _mark(bool((m.rms <= _COARSE * m.most).all()))
        listed.append((name, *(float(x.mean()) for x in (m.lsr, m.median, m.rms, m.most))))
    columns = ("mask", "mean LSR", "median", "rms", "rms at most")
    return Section("Suppression and contrast", text, columns, listed, picture, marks)


def _mark(held: bool) -> Mark:
    return "pass" if held else "fail"


def _data(found: Evaluated) -> list[Section]:
    text = """Scenes in the order of their numbers; each is a part of a photograph that the recipe's seed decides,
        and has its own seed, of the laser's direction and of the noise, the same behind every pipeline. A run of
        the recipe with that seed and scene gives the same numbers."""
    listed = [(s.number, s.name, s.case, s.seed) for s in found.scenes]
    parts = [Section("Scenes", text, ("scene", "photograph", "laser", "seed"), listed)]
    if found.broken:
        broken = [(path.name, reason) for path, reason in found.broken]
        parts.append(Section("Photographs that were passed over", "", ("file", "why"), broken))
    return parts
