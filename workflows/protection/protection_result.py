"""The result of the protection study: quiet frames over scene light and protection, and frames
under attack.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from neusee.nodes import metrics
from neusee.nodes.metrics import PixelNoise, attacked_picture, largest_glare
from neusee.workflows.protection.equal_rivals import (
    Candidate,
    Rival,
    best,
    colour_shift,
    gains,
    neq_curve,
    quiet_picture,
)
from neusee.workflows.protection.protection_camera import (
    Front,
    FrontBench,
    FrontMeasures,
    refuse_no_mask,
)
from neusee.workflows.protection.unknown_conditions import Condition, usual_condition

#: by measure, the best value over candidates and the rival that has it
Best = Mapping[str, tuple[float, Rival]]

LIGHTS = (10.0, 30.0, 100.0, 300.0, 1e3, 3e3, 1e4)  #: e- a pixel
LEVELS = (1e-1, 3e-2, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4)  #: share of the clear lens's peak, or heat
#: wells in the brightest pixel, open lens
STRENGTHS = tuple(float(10.0**k) for k in np.arange(0, 9.76, 0.75))
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
    #: dB by rival, scene light and measure
    quiet: Mapping[str, Mapping[float, Mapping[str, float]]]
    stops: Mapping[float, Rival]  #: best stop-and-filter for the error, by scene light
    #: dB by protection, scene light and measure
    gain: Mapping[float, Mapping[float, Mapping[str, float]]]
    #: dB by scene light and measure, one for each draw
    drawn: Mapping[float, Mapping[str, Sequence[float]]]
    curves: Mapping[str, Sequence[float]]  #: NEQ by rival
    radius: Sequence[float]  #: cycles per pixel
    #: gain in mean NEQ over the lens band and its bound, by scene light
    bound: Mapping[float, tuple[float, float]]
    #: glare in e- above which no mask wins by mean NEQ, by scene light
    forbidden: Mapping[float, float]
    #: by rival and quantity, (draw, strength)
    attack: Mapping[str, Mapping[str, Sequence[Sequence[float]]]]
    #: share of pixels seen by rival and field, by strength
    fields: Mapping[str, Mapping[int, Sequence[float]]]
    #: strength that halves the information, by rival, one for each draw
    lost: Mapping[str, Sequence[float]]
    tint: Mapping[str, float]  #: largest over smallest share of light of the channels, by rival


def measure_protection(
    bench: FrontBench,
    conditions: Sequence[Condition],
    pixel: PixelNoise,
    progress: Callable[[str], None],
) -> ProtectionResult:
    """Measure mask, filters and stops of equal protection, in quiet frames and under attack, for
    each condition.
    """
    usual = usual_condition()

    def candidate(front: Front, condition: Condition = usual) -> Candidate:
        measures, harm = bench.measure(front, condition), bench.measure(front, usual)
        protection = harm.peak if bench.settings.dwell is None else harm.heat
        return Candidate(front, measures, protection)

    mask = candidate(Front(True))
    own = mask.protection
    refuse_no_mask(own)
    progress(f"the mask lowers the harm of a laser to {own:.3g} of that behind the clear lens")
    clear = [candidate(Front(False, d)) for d in _diameters(bench, own)]
    masked = [candidate(Front(True, d)) for d in _MASK_STOPS]
    progress(f"{len(clear)} stops and {len(masked)} stops with the mask are measured")
    gain = {level: _gains(masked, clear, level, pixel) for level in (own, *LEVELS)}
    stops = {n: best(clear, own, n, pixel, "stop and filter")["error"][1] for n in LIGHTS}
    rivals = _rivals(clear, masked, own, pixel, stops)
    rivals["notch"] = Rival("notch", Front(False, 1.0, usual.wavelength, 1 - own), 1.0)
    measured = {name: candidate(rival.front) for name, rival in rivals.items()}
    quiet = _quiet_frames(rivals, measured, pixel)
    quiet["best stop and filter"] = _best_quiet(clear, own, pixel)
    pairs = {n: (best(masked, own, n, pixel), best(clear, own, n, pixel)) for n in LIGHTS}
    drawn = _drawn_gains(conditions, candidate, pairs, pixel, progress)
    attack, lost = _attacks(conditions, candidate, rivals, pixel, progress)
    bound, forbidden = _bounds(bench, pixel)
    return ProtectionResult(
        own=own,
        rivals=rivals,
        quiet=quiet,
        stops=stops,
        gain=gain,
        drawn=drawn,
        curves=_curves(rivals, measured, pixel),
        radius=[float(x) for x in mask.found.radius],
        bound=bound,
        forbidden=forbidden,
        attack=attack,
        fields=_fields(rivals, measured, pixel),
        lost=lost,
        tint={name: colour_shift(judged.found) for name, judged in measured.items()},
    )


def _quiet_frames(
    rivals: Mapping[str, Rival], measured: Mapping[str, Candidate], pixel: PixelNoise
) -> dict[str, dict[float, dict[str, float]]]:
    """Return what each rival does to frames without a laser."""
    return {
        name: _quiet(measured[name].found, rival.transmittance, pixel)
        for name, rival in rivals.items()
    }


def _curves(
    rivals: Mapping[str, Rival], measured: Mapping[str, Candidate], pixel: PixelNoise
) -> dict[str, list[float]]:
    """Return the NEQ of each rival in the rings of frequency."""
    return {
        name: neq_curve(measured[name].found, rival.transmittance, SHOWN_AT, pixel)
        for name, rival in rivals.items()
    }


def _gains(
    masked: Sequence[Candidate], clear: Sequence[Candidate], level: float, pixel: PixelNoise
) -> dict[float, dict[str, float]]:
    """Return the gain of the mask at each light, at one level of protection."""
    return {n: gains(masked, clear, level, n, pixel) for n in LIGHTS}


def _quiet(
    measures: FrontMeasures, transmittance: float, pixel: PixelNoise
) -> dict[float, dict[str, float]]:
    """Return the measures of a frame without a laser at each light."""
    return {n: quiet_picture(measures, transmittance, n, pixel) for n in LIGHTS}


def _best_quiet(
    clear: Sequence[Candidate], own: float, pixel: PixelNoise
) -> dict[float, dict[str, float]]:
    """Return the best of each measure over all stops and filters, at each light."""
    values = {}
    for n in LIGHTS:
        leaders = best(clear, own, n, pixel)
        values[n] = {measure: value for measure, (value, _) in leaders.items()}
    return values


def _diameters(bench: FrontBench, own: float) -> list[float]:
    """Return the relative diameters of stops: a series from the open lens, and the stop that alone
    protects as wanted.

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
    """Return the rivals whose protection is that of the mask alone, and the open lens, which
    protects nothing.
    """
    alone = min((c for c in clear if c.protection >= own), key=lambda c: c.protection)
    both = best(masked, own, ATTACKED_AT, pixel)["error"][1]
    rivals = {
        "open lens": Rival("open lens", Front(False), 1.0),
        "grey filter": Rival("grey filter", Front(False), min(1.0, own / clear[0].protection)),
        "smaller stop": Rival("smaller stop", alone.front, alone.transmittance(own)),
        "stop and filter": stops[ATTACKED_AT],
        "mask": Rival("mask", Front(True), 1.0),
    }
    return rivals if both.front == Front(True) else {**rivals, "mask and stop": both}


def _drawn_gains(
    conditions: Sequence[Condition],
    candidate: Callable[[Front, Condition], Candidate],
    pairs: Mapping[float, tuple[Best, Best]],
    pixel: PixelNoise,
    progress: Callable[[str], None],
) -> dict[float, dict[str, list[float]]]:
    """Return the gain of the mask in each draw; mask, stop and filter are chosen before, at the
    usual condition: the best of both at each light, ``pairs``.
    """

    def value(rival: Rival, condition: Condition, n: float, measure: str) -> float:
        measures = candidate(rival.front, condition).found
        return quiet_picture(measures, rival.transmittance, n, pixel)[measure]

    drawn: dict[float, dict[str, list[float]]] = {n: {m: [] for m in DRAWN} for n in LIGHTS}
    for number, condition in enumerate(conditions, 1):
        for n, (masked, plain) in pairs.items():
            for measure in DRAWN:
                own = value(masked[measure][1], condition, n, measure)
                drawn[n][measure].append(own - value(plain[measure][1], condition, n, measure))
        progress(f"draw {number} of {len(conditions)}: quiet frames")
    return drawn


def _attacks(
    conditions: Sequence[Condition],
    candidate: Callable[[Front, Condition], Candidate],
    rivals: Mapping[str, Rival],
    pixel: PixelNoise,
    progress: Callable[[str], None],
) -> tuple[dict[str, dict[str, list[list[float]]]], dict[str, list[float]]]:
    """Return error, information and share of seen pixels by strength in each draw, and when the
    picture is lost.
    """
    names = [name for name in rivals if name != "notch"]
    attack: dict[str, dict[str, list[list[float]]]] = {
        n: {"error": [], "information": [], "seen": []} for n in names
    }
    lost: dict[str, list[float]] = {name: [] for name in names}
    for number, condition in enumerate(conditions, 1):
        for name in names:
            measures = candidate(rivals[name].front, condition).found
            field = min(measures.glare)
            under = attacked_picture(
                measures.spectrum,
                measures.glare[field],
                pixel,
                electrons=ATTACKED_AT,
                transmittance=rivals[name].transmittance,
                colour=measures.colour,
                strengths=torch.tensor(STRENGTHS, dtype=torch.float64),
            )
            for quantity, values in under._asdict().items():
                attack[name][quantity].append(values.tolist())
            quiet = 10 ** (
                quiet_picture(measures, rivals[name].transmittance, ATTACKED_AT, pixel)[
                    "information"
                ]
                / 10
            )
            lost[name].append(_crossing([x / quiet for x in under.information.tolist()]))
        progress(f"draw {number} of {len(conditions)}: under attack")
    return attack, lost


def _crossing(share: Sequence[float]) -> float:
    """Return the strength at which a share of information falls below `_HALF`, from the first to
    the last strength.
    """
    if share[0] < _HALF:
        return float(STRENGTHS[0])
    for i in range(1, len(share)):
        if share[i] < _HALF:
            position = (share[i - 1] - _HALF) / (share[i - 1] - share[i])
            return float(STRENGTHS[i - 1] * (STRENGTHS[i] / STRENGTHS[i - 1]) ** position)
    return float(STRENGTHS[-1])


def _fields(
    rivals: Mapping[str, Rival], measured: Mapping[str, Candidate], pixel: PixelNoise
) -> dict[str, dict[int, list[float]]]:
    """Return the share of pixels that are not full, by rival and by side of the field, for each
    strength.
    """
    shares: dict[str, dict[int, list[float]]] = {}
    for name, rival in rivals.items():
        measures = measured[name].found
        for side, glare in measures.glare.items():
            under: Any = attacked_picture(
                measures.spectrum,
                glare,
                pixel,
                electrons=ATTACKED_AT,
                colour=measures.colour,
                transmittance=rival.transmittance,
                strengths=torch.tensor(STRENGTHS, dtype=torch.float64),
            )
            shares.setdefault(name, {})[side] = under.seen.tolist()
    return shares


def _bounds(
    bench: FrontBench, pixel: PixelNoise
) -> tuple[dict[float, tuple[float, float]], dict[float, float]]:
    """Return gain and bound of the mean NEQ over the lens band at the middle wavelength, and the
    forbidding glare.
    """
    bands = bench.camera.bands
    middle = len(bands.centres) // 2
    psf = bench.camera.psf(True, 1.0, type(bands)(*(x[middle : middle + 1] for x in bands)))
    bound = {}
    for n in LIGHTS:
        limits = metrics.protection_bounds(psf, electrons=n, read_noise=pixel.read_noise)
        bound[n] = float(limits.over_both), float(limits.over_both_bound)
    peak = float(metrics.lsr(psf))
    return bound, {n: largest_glare(peak, n, pixel.read_noise) for n in LIGHTS}
