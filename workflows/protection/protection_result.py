"""The result of the protection study: quiet frames over scene light and protection, and frames under attack."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from neusee.nodes import metrics
from neusee.nodes.metrics import PixelNoise, attacked_picture, largest_glare
from neusee.workflows.protection.camera_parts import refuse_no_mask
from neusee.workflows.protection.equal_rivals import (
    Candidate,
    Rival,
    best,
    colour_shift,
    gains,
    neq_curve,
    quiet_picture,
)
from neusee.workflows.protection.front_optics import Front, FrontBench
from neusee.workflows.protection.unknown_conditions import Condition, usual_condition

LIGHTS = (10.0, 30.0, 100.0, 300.0, 1e3, 3e3, 1e4)  #: e- a pixel
LEVELS = (1e-1, 3e-2, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4)  #: share of the clear lens's peak, or heat
STRENGTHS = tuple(float(10.0**k) for k in np.arange(0, 9.76, 0.75))  #: wells in the brightest pixel, open lens
ATTACKED_AT = 300.0  #: e- a pixel
SHOWN_AT = 30.0  #: e- a pixel, of the NEQ by frequency
DRAWN = ("error", "NEQ", "text")  #: measures that are repeated for each draw
_RATIO = 0.85  #: between two diameters of stops
_MASK_STOPS = (1.0, 0.8, 0.6)
_SMALL = (8, 8)  #: pixels of a PSF of which only the lens counts
_HALF = 0.5  #: share of the information of the quiet frame below which a picture counts as lost


@dataclass(frozen=True)
class ProtectionResult:
    """What the page, the table and the figures of the protection study show."""

    own: float  #: protection of the mask alone
    rivals: Mapping[str, Rival]  #: of the mask's own protection, by name
    quiet: Mapping[str, Mapping[float, Mapping[str, float]]]  #: dB by rival, scene light and measure
    stops: Mapping[float, Rival]  #: best stop-and-filter for the error, by scene light
    gain: Mapping[float, Mapping[float, Mapping[str, float]]]  #: dB by protection, scene light and measure
    drawn: Mapping[float, Mapping[str, Sequence[float]]]  #: dB by scene light and measure, one for each draw
    curves: Mapping[str, Sequence[float]]  #: NEQ by rival
    radius: Sequence[float]  #: cycles per pixel
    bound: Mapping[float, tuple[float, float]]  #: gain in mean NEQ over the lens band and its bound, by scene light
    forbidden: Mapping[float, float]  #: glare in e- above which no mask wins by mean NEQ, by scene light
    attack: Mapping[str, Mapping[str, Sequence[Sequence[float]]]]  #: by rival and quantity, (draw, strength)
    fields: Mapping[str, Mapping[int, Sequence[float]]]  #: share of pixels seen by rival and field, by strength
    lost: Mapping[str, Sequence[float]]  #: strength that halves the information, by rival, one for each draw
    tint: Mapping[str, float]  #: largest over smallest share of light of the channels, by rival


def measure_protection(
    bench: FrontBench, conditions: Sequence[Condition], pixel: PixelNoise, progress: Callable[[str], None]
) -> ProtectionResult:
    """Measure mask, filters and stops of equal protection, in quiet frames and under attack, for each condition."""
    usual = usual_condition()

    def candidate(front: Front, at: Condition = usual) -> Candidate:
        found, harm = bench.measure(front, at), bench.measure(front, usual)
        return Candidate(front, found, harm.peak if bench.settings.dwell is None else harm.heat)

    mask = candidate(Front(True))
    own = mask.protection
    refuse_no_mask(own)
    progress(f"the mask lowers the harm of a laser to {own:.3g} of that behind the clear lens")
    clear = [candidate(Front(False, d)) for d in _diameters(bench, own)]
    masked = [candidate(Front(True, d)) for d in _MASK_STOPS]
    progress(f"{len(clear)} stops and {len(masked)} stops with the mask are measured")
    gain = {level: {n: gains(masked, clear, level, n, pixel) for n in LIGHTS} for level in (own, *LEVELS)}
    stops = {n: best(clear, own, n, pixel, "stop and filter")["error"][1] for n in LIGHTS}
    rivals = _rivals(clear, masked, own, pixel, stops)
    rivals["notch"] = Rival("notch", Front(False, 1.0, usual.wavelength, 1 - own), 1.0)
    known = {name: candidate(rival.front) for name, rival in rivals.items()}
    quiet = {
        name: {n: quiet_picture(known[name].found, rival.transmittance, n, pixel) for n in LIGHTS}
        for name, rival in rivals.items()
    }
    quiet["best stop and filter"] = {n: {m: v for m, (v, _) in best(clear, own, n, pixel).items()} for n in LIGHTS}
    drawn = _drawn_gains(conditions, candidate, masked, clear, own, pixel, progress)
    attack, lost = _attacks(conditions, candidate, rivals, pixel, progress)
    curves = {name: neq_curve(known[name].found, r.transmittance, SHOWN_AT, pixel) for name, r in rivals.items()}
    tint = {name: colour_shift(one.found) for name, one in known.items()}
    radius = [float(x) for x in mask.found.radius]
    fields = _fields(rivals, known, pixel)
    bound, forbidden = _bounds(bench, pixel, own)
    return ProtectionResult(own, rivals, quiet, stops, gain, drawn, curves, radius, bound, forbidden, attack, fields,
                            lost, tint)  # fmt: skip


def _diameters(bench: FrontBench, own: float) -> list[float]:
    """Return the relative diameters of stops: a series from the open lens, and the stop that alone protects as wanted.

    The best rival is often a stop without a filter, so that each wanted protection has such a stop.
    """
    alone = {_stop_alone(bench, level) for level in (own, *LEVELS)}
    series = {_RATIO**k for k in range(40) if _RATIO**k > min(alone)}
    return sorted(alone | series, reverse=True)


def _stop_alone(bench: FrontBench, level: float) -> float:
    """Return the diameter of the stop whose peak, or heat, is ``level`` without a filter."""
    if bench.settings.dwell is not None:
        return math.pow(level, 1 / 3)
    lens = bench.camera.psf(False, 1.0, bench.camera.laser_bands, shape=_SMALL)
    return float(metrics.stop_diameter(lens, level).min())


def _rivals(
    clear: Sequence[Candidate],
    masked: Sequence[Candidate],
    own: float,
    pixel: PixelNoise,
    stops: Mapping[float, Rival],
) -> dict[str, Rival]:
    """Return the rivals whose protection is that of the mask alone, and the open lens, which protects nothing."""
    alone = min((c for c in clear if c.protection >= own), key=lambda c: c.protection)
    both = best(masked, own, ATTACKED_AT, pixel)["error"][1]
    found = {
        "open lens": Rival("open lens", Front(False), 1.0),
        "grey filter": Rival("grey filter", Front(False), min(1.0, own / clear[0].protection)),
        "smaller stop": Rival("smaller stop", alone.front, alone.transmittance(own)),
        "stop and filter": stops[ATTACKED_AT],
        "mask": Rival("mask", Front(True), 1.0),
    }
    return found if both.front == Front(True) else {**found, "mask and stop": both}


def _drawn_gains(
    conditions: Sequence[Condition],
    candidate: Callable[[Front, Condition], Candidate],
    masked: Sequence[Candidate],
    clear: Sequence[Candidate],
    own: float,
    pixel: PixelNoise,
    progress: Callable[[str], None],
) -> dict[float, dict[str, list[float]]]:
    """Return the gain of the mask in each draw; mask, stop and filter are chosen before, at the usual condition."""
    chosen = {n: (best(masked, own, n, pixel), best(clear, own, n, pixel)) for n in LIGHTS}
    found: dict[float, dict[str, list[float]]] = {n: {m: [] for m in DRAWN} for n in LIGHTS}
    for number, condition in enumerate(conditions, 1):
        for n, pair in chosen.items():
            for measure in DRAWN:
                one, other = (
                    quiet_picture(
                        candidate(rival.front, condition).found, rival.transmittance, n, pixel
                    )[measure] for rival in (pair[0][measure][1], pair[1][measure][1])
                )  # fmt: skip
                found[n][measure].append(one - other)
        progress(f"draw {number} of {len(conditions)}: quiet frames")
    return found


def _attacks(
    conditions: Sequence[Condition],
    candidate: Callable[[Front, Condition], Candidate],
    rivals: Mapping[str, Rival],
    pixel: PixelNoise,
    progress: Callable[[str], None],
) -> tuple[dict[str, dict[str, list[list[float]]]], dict[str, list[float]]]:
    """Return error, information and share of seen pixels by strength in each draw, and when the picture is lost."""
    names = [name for name in rivals if name != "notch"]
    found: dict[str, dict[str, list[list[float]]]] = {n: {"error": [], "information": [], "seen": []} for n in names}
    lost: dict[str, list[float]] = {name: [] for name in names}
    for number, condition in enumerate(conditions, 1):
        for name in names:
            one = candidate(rivals[name].front, condition).found
            field = min(one.glare)
            under = attacked_picture(one.spectrum, one.glare[field], pixel, electrons=ATTACKED_AT,
                                     transmittance=rivals[name].transmittance, colour=one.colour,
                                     strengths=torch.tensor(STRENGTHS, dtype=torch.float64))  # fmt: skip
            for quantity, values in under._asdict().items():
                found[name][quantity].append(values.tolist())
            whole = 10 ** (quiet_picture(one, rivals[name].transmittance, ATTACKED_AT, pixel)["information"] / 10)
            lost[name].append(_crossing([x / whole for x in under.information.tolist()]))
        progress(f"draw {number} of {len(conditions)}: under attack")
    return found, lost


def _crossing(share: Sequence[float]) -> float:
    """Return the strength at which a share of information falls below `_HALF`, from the first to the last strength."""
    if share[0] < _HALF:
        return float(STRENGTHS[0])
    for i in range(1, len(share)):
        if share[i] < _HALF:
            part = (share[i - 1] - _HALF) / (share[i - 1] - share[i])
            return float(STRENGTHS[i - 1] * (STRENGTHS[i] / STRENGTHS[i - 1]) ** part)
    return float(STRENGTHS[-1])


def _fields(
    rivals: Mapping[str, Rival], known: Mapping[str, Candidate], pixel: PixelNoise
) -> dict[str, dict[int, list[float]]]:
    """Return the share of pixels that are not full, by rival and by side of the field, for each strength."""
    found: dict[str, dict[int, list[float]]] = {}
    for name, rival in rivals.items():
        one = known[name].found
        for side, glare in one.glare.items():
            under: Any = attacked_picture(one.spectrum, glare, pixel, electrons=ATTACKED_AT, colour=one.colour,
                                          transmittance=rival.transmittance,
                                          strengths=torch.tensor(STRENGTHS, dtype=torch.float64))  # fmt: skip
            found.setdefault(name, {})[side] = under.seen.tolist()
    return found


def _bounds(
    bench: FrontBench, pixel: PixelNoise, own: float
) -> tuple[dict[float, tuple[float, float]], dict[float, float]]:
    """Return gain and bound of the mean NEQ over the lens band at the middle wavelength, and the forbidding glare."""
    bands = bench.camera.bands
    middle = len(bands.centres) // 2
    one = bench.camera.psf(True, 1.0, type(bands)(*(x[middle : middle + 1] for x in bands)))
    bound = {}
    for n in LIGHTS:
        found = metrics.protection_bounds(one, electrons=n, read_noise=pixel.read_noise)
        bound[n] = float(found.over_both), float(found.over_both_bound)
    peak = float(metrics.lsr(one))
    return bound, {n: largest_glare(peak, n, pixel.read_noise) for n in LIGHTS}
