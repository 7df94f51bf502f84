"""The page of the protection study: a paragraph to quote, the rivals, both questions, and what bounds every mask."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from neusee.workflows.protection.equal_rivals import MEASURES
from neusee.workflows.protection.protection_result import ATTACKED_AT, DRAWN, LIGHTS, ProtectionResult
from neusee.workflows.report.study_page import Section
from neusee.workflows.studies.protection import protection_figures as figures


def draw_pictures(result: ProtectionResult) -> dict[str, bytes]:
    """Return the pictures of the page by name, as PNG bytes."""
    return {
        "region": figures.winning_region(result),
        "gain": figures.gain_with_bounds(result),
        "neq": figures.neq_by_frequency(result),
        "attack": figures.under_attack(result),
    }


def crossing(gains: Sequence[float]) -> float:
    """Return the scene light at which a gain falls to 0: below the least light if it never wins, infinite if always."""
    if gains[0] <= 0:
        return 0.0
    for (n, low), (m, high) in pairwise(zip(LIGHTS, gains, strict=True)):
        if high <= 0:
            return float(n * (m / n) ** (low / (low - high)))
    return math.inf


def quotable(result: ProtectionResult, camera: str, light: str) -> str:
    """Return one paragraph that says where the mask wins, by how much, and where it loses, for both questions."""
    harm = "peak" if light == "pulse" else "heat"
    parts = [
        f"{camera}: this mask lowers the {harm} of a laser to {result.own:.2g} at the worst wavelength. Compared with "
        f"the best smaller stop and grey filter of the same {harm}, in a quiet frame:"
    ]
    parts += [f"{_said(result, measure)};" for measure in DRAWN]
    parts[-1] = parts[-1][:-1] + "."
    names = [name for name in ("mask", "stop and filter", "grey filter") if name in result.lost]
    halves = ", ".join(f"{_interval(result.lost[name], '.1e')} behind the {name}" for name in names)
    parts.append(
        f"Under attack, at {ATTACKED_AT:g} e- a pixel, half of the information of the quiet frame is gone at a "
        f"strength of {halves}. {_why(result)} Intervals hold 90 % of the draws of wavelength, direction, defocus, "
        "dirt and scattered light."
    )
    return " ".join(parts)


def _said(result: ProtectionResult, measure: str) -> str:
    """Return where the mask wins by one measure: medians over the draws, with intervals."""
    draws = np.array([result.drawn[n][measure] for n in LIGHTS])
    own = np.median(draws, axis=1)
    at = crossing(own.tolist())
    if at == 0.0:
        return f"by the {MEASURES[measure]} it loses at every light, by {-own.max():.1f} dB or more"
    most = int(own.argmax())
    by = f"by {own[most]:.1f} dB ({_ends(draws[most], '.1f')}) at {LIGHTS[most]:g} e- a pixel"
    if math.isinf(at):
        return f"by the {MEASURES[measure]} it wins at every light, {by}"
    where = [crossing(row) for row in draws.T.tolist()]
    return f"by the {MEASURES[measure]} it wins below {at:.0f} e- a pixel ({_ends(where, '.0f')}), {by}"


def _why(result: ProtectionResult) -> str:
    brightest = LIGHTS[-1]
    bound = 10 * math.log10(result.bound[brightest][1])
    dark = 10 * math.log10(result.bound[LIGHTS[0]][1])
    return (
        f"In much light shot noise decides, and no mask of this peak gains more than {bound:.1f} dB in mean NEQ over "
        f"the lens band at {brightest:g} e- a pixel, against {dark:.1f} dB at {LIGHTS[0]:g} e-; a mask that spreads a "
        "laser over the frame lets a strong one fill pixels that a filter keeps."
    )


def _interval(values: Sequence[float], form: str) -> str:
    return f"{format(float(np.median(values)), form)} ({_ends(values, form)})"


def _ends(values: Any, form: str) -> str:
    low, up = np.quantile(values, [0.05, 0.95], method="nearest")
    return f"{format(float(low), form)} to {format(float(up), form)}"


def sections(result: ProtectionResult, pictures: Mapping[str, bytes], notes: Sequence[str]) -> list[Section]:
    """Return the sections of the page."""
    return [
        _region(result, pictures["region"]),
        _quiet(result, pictures["gain"]),
        Section("NEQ by frequency", "Noise equivalent quanta, (light |OTF|)^2 over the noise, of each rival in a quiet "
                "frame. A value counts as many photons as an ideal sensor would need.", picture=pictures["neq"]),
        _attack(result, pictures["attack"]),
        _fields(result),
        _rivals(result),
        Section("What is assumed", "\n\n".join(notes)),
    ]  # fmt: skip


def _region(result: ProtectionResult, picture: bytes) -> Section:
    text = f"""Gain in dB of the mask, with the best stop and filter of its own, over the best stop-and-filter without a
        mask, at equal protection. Hatched: the mask wins. The dashed line is the protection of the mask alone,
        {result.own:.3g}. Above this line the mask protects more than is asked, and still costs its contrast."""
    return Section("Where the mask wins", text, picture=picture)


def _quiet(result: ProtectionResult, picture: bytes) -> Section:
    text = """Insured: the laser may come, and the frame is quiet. The gain of the mask at its own protection. Error:
        error variance of the Wiener-filtered picture of a natural scene. Detection: d' of an ideal observer who knows
        place and shape. Shaded: the middle 90 % of the draws, with a filter that does not know defocus and dirt. On the
        right, the bound of every mask of this peak (Parseval): it holds for one wavelength, for the unweighted mean NEQ
        over the whole lens band and without glare, and not for a part of the band."""
    columns = ("scene light (e-)", *(f"{name} (dB)" for name in MEASURES), "rival by error")
    rows = [(n, *(round(result.gain[result.own][n][m], 2) for m in MEASURES), result.stops[n].said) for n in LIGHTS]
    return Section("Question 1: the everyday picture", text, columns, rows, picture)


def _attack(result: ProtectionResult, picture: bytes) -> Section:
    text = f"""The laser is there, and the scene has {ATTACKED_AT:g} e- a pixel. A strength of 1 fills one pixel behind
        the open lens. A pixel that scene and glare fill holds no information; in every other pixel glare adds shot
        noise, fixed-pattern noise and what is wrong when glare is subtracted. Lines are medians of the draws, bands the
        middle 90 %."""
    columns = ("protection", "strength that halves the information", "5 %", "95 %")
    rows = [(name, float(np.median(x)), *map(float, np.quantile(x, [0.05, 0.95]))) for name, x in result.lost.items()]
    return Section("Question 2: under attack", text, columns, rows, picture)


def _fields(result: ProtectionResult) -> Section:
    text = """Share of the pixels in % that are not full, for a laser in the middle of fields of several sizes. A wider
        field is left out where the samples of the recipe's pupil do not carry it: `optics=neusee` carries 2048."""
    at = (4, 8, 11)
    strengths = [10 ** (0.75 * i) for i in at]
    columns = ("protection", "field (pixels)", *(f"strength {s:.0e}" for s in strengths))
    rows = [(name, side, *(round(100 * seen[i], 2) for i in at)) for name, one in result.fields.items()
            for side, seen in one.items()]  # fmt: skip
    return Section("Fields", text, columns, rows)


def _rivals(result: ProtectionResult) -> Section:
    text = """Each rival of the mask, with the error of the filtered picture (dB below the contrast of the scene, more
        is better). The notch protects at one wavelength only. Tint: the largest share of light that a channel receives
        over the smallest."""
    columns = ("rival", "made of", *(f"error at {n:g} e- (dB)" for n in LIGHTS[::2]), "tint")
    rows = [
        (name, rival.said, *(round(result.quiet[name][n]["error"], 2) for n in LIGHTS[::2]), result.tint[name])
        for name, rival in result.rivals.items()
    ]
    return Section("Rivals of the same protection", text, columns, rows)
