"""The result of the protection study: quiet frames by scene light and protection, and frames under
attack.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from neusee.nodes import metrics
from neusee.nodes.metrics import Attack, PixelNoise, attacked_picture, largest_glare
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
    Condition,
    Front,
    FrontBench,
    FrontMeasures,
    refuse_no_mask,
    usual_condition,
)

#: for each measure: the best value over candidates, and its rival
Best = Mapping[str, tuple[float, Rival]]

LIGHTS = (10.0, 30.0, 100.0, 300.0, 1e3, 3e3, 1e4)  #: e- a pixel
LEVELS = (1e-1, 3e-2, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4)  #: share of the clear lens's peak, or heat
#: wells in the brightest pixel, open lens
STRENGTHS = tuple(float(10.0**k) for k in np.arange(0, 9.76, 0.75))
ATTACKED_AT = 300.0  #: e- a pixel
SHOWN_AT = 30.0  #: e- a pixel, scene light for the NEQ by frequency
DRAWN = ("error", "NEQ", "text")  #: measures that are computed for each draw
_DIAMETER_RATIO = 0.85  #: ratio of two successive stop diameters
_MASK_STOPS = (1.0, 0.8, 0.6)
_SMALL_PSF = (8, 8)  #: pixels, window of a PSF of which only the values for the clear lens are used
#: a picture counts as lost if less than this share of the quiet frame's information remains
_LOST_SHARE = 0.5


@dataclass(frozen=True)
class ProtectionResult:
    """The data shown on the page, in the table and in the figures of the protection study."""

    own: float  #: protection of the mask alone
    rivals: Mapping[str, Rival]  #: rivals with the protection of the mask alone, by name
    #: dB by rival, scene light and measure
    quiet: Mapping[str, Mapping[float, Mapping[str, float]]]
    stops: Mapping[float, Rival]  #: best stop with filter by the measure ``error``, by scene light
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
    #: share of unsaturated pixels for each strength, by rival and field
    fields: Mapping[str, Mapping[int, Sequence[float]]]
    #: strength that halves the information, by rival and draw
    lost: Mapping[str, Sequence[float]]
    #: ratio of the largest to the smallest share of light among the channels, by rival
    tint: Mapping[str, float]


def measure_protection(
    bench: FrontBench,
    conditions: Sequence[Condition],
    pixel: PixelNoise,
    progress: Callable[[str], None],
) -> ProtectionResult:
    """Measure mask, filters and stops at equal protection, in quiet frames and under attack, for
    each condition.
    """
    usual_values = usual_condition()

    def candidate(front: Front, condition: Condition = usual_values) -> Candidate:
        # the harm is that at the usual condition, because the filter is chosen in advance
        measures, harm = bench.measure(front, condition), bench.measure(front, usual_values)
        protection = harm.peak if bench.settings.dwell is None else harm.heat
        return Candidate(front, measures, protection)

    mask = candidate(Front(True))
    own_protection = mask.protection
    refuse_no_mask(own_protection)
    progress(
        f"the mask lowers the harm of a laser to {own_protection:.3g} of that behind the clear lens"
    )
    clear_fronts = [
        candidate(Front(False, diameter)) for diameter in _diameters(bench, own_protection)
    ]
    masked_fronts = [candidate(Front(True, diameter)) for diameter in _MASK_STOPS]
    progress(f"{len(clear_fronts)} stops and {len(masked_fronts)} stops with the mask are measured")
    gain = {
        level: _gains(masked_fronts, clear_fronts, level, pixel)
        for level in (own_protection, *LEVELS)
    }
    stops = {
        scene_light: best(clear_fronts, own_protection, scene_light, pixel, "stop and filter")[
            "error"
        ][1]
        for scene_light in LIGHTS
    }
    rivals = _rivals(clear_fronts, masked_fronts, own_protection, pixel, stops)
    # a notch at the usual wavelength that transmits as much as the mask's peak
    rivals["notch"] = Rival(
        "notch", Front(False, 1.0, usual_values.wavelength, 1 - own_protection), 1.0
    )
    measured = {name: candidate(rival.front) for name, rival in rivals.items()}
    quiet = _quiet_frames(rivals, measured, pixel)
    quiet["best stop and filter"] = _best_quiet(clear_fronts, own_protection, pixel)
    best_fronts = {
        scene_light: (
            best(masked_fronts, own_protection, scene_light, pixel),
            best(clear_fronts, own_protection, scene_light, pixel),
        )
        for scene_light in LIGHTS
    }
    drawn_gains = _drawn_gains(conditions, candidate, best_fronts, pixel, progress)
    attack, half_strengths = _attacks(conditions, candidate, rivals, pixel, progress)
    bound, forbidden = _bounds(bench, pixel)
    return ProtectionResult(
        own=own_protection,
        rivals=rivals,
        quiet=quiet,
        stops=stops,
        gain=gain,
        drawn=drawn_gains,
        curves=_curves(rivals, measured, pixel),
        radius=[float(frequency) for frequency in mask.found.radius],
        bound=bound,
        forbidden=forbidden,
        attack=attack,
        fields=_fields(rivals, measured, pixel),
        lost=half_strengths,
        tint={
            name: colour_shift(measured_candidate.found)
            for name, measured_candidate in measured.items()
        },
    )


def _quiet_frames(
    rivals: Mapping[str, Rival], measured: Mapping[str, Candidate], pixel: PixelNoise
) -> dict[str, dict[float, dict[str, float]]]:
    """Return the measures of frames without a laser, by rival."""
    return {
        name: _quiet(measured[name].found, rival.transmittance, pixel)
        for name, rival in rivals.items()
    }


def _curves(
    rivals: Mapping[str, Rival], measured: Mapping[str, Candidate], pixel: PixelNoise
) -> dict[str, list[float]]:
    """Return the NEQ in rings of frequency, by rival."""
    return {
        name: neq_curve(measured[name].found, rival.transmittance, SHOWN_AT, pixel)
        for name, rival in rivals.items()
    }


def _gains(
    masked: Sequence[Candidate], clear: Sequence[Candidate], level: float, pixel: PixelNoise
) -> dict[float, dict[str, float]]:
    """Return the gain of the mask by scene light, at one level of protection."""
    return {scene_light: gains(masked, clear, level, scene_light, pixel) for scene_light in LIGHTS}


def _quiet(
    measures: FrontMeasures, transmittance: float, pixel: PixelNoise
) -> dict[float, dict[str, float]]:
    """Return the measures of a frame without a laser, by scene light."""
    return {
        scene_light: quiet_picture(measures, transmittance, scene_light, pixel)
        for scene_light in LIGHTS
    }


def _best_quiet(
    clear: Sequence[Candidate], own: float, pixel: PixelNoise
) -> dict[float, dict[str, float]]:
    """Return the best value of each measure over all stops and filters, by scene light."""
    values = {}
    for scene_light in LIGHTS:
        leaders = best(clear, own, scene_light, pixel)
        values[scene_light] = {measure: value for measure, (value, _) in leaders.items()}
    return values


def _diameters(bench: FrontBench, own: float) -> list[float]:
    """Return relative stop diameters: a series from the open lens down, and for each level the stop
    that suffices without a filter.

    The best rival is often a stop without a filter, so that each level needs such a stop.
    """
    stops_alone = {_stop_alone(bench, level) for level in (own, *LEVELS)}
    series = {
        _DIAMETER_RATIO**step for step in range(40) if _DIAMETER_RATIO**step > min(stops_alone)
    }
    return sorted(stops_alone | series, reverse=True)


def _stop_alone(bench: FrontBench, level: float) -> float:
    """Return the diameter of the stop that brings peak or heat to ``level`` without a filter."""
    if bench.settings.dwell is not None:
        # the heat of a spot is proportional to the third power of the diameter
        return math.pow(level, 1 / 3)
    small_psf = bench.camera.psf(False, 1.0, bench.camera.laser_bands, shape=_SMALL_PSF)
    return float(metrics.stop_diameter(small_psf, level).min())


def _rivals(
    clear: Sequence[Candidate],
    masked: Sequence[Candidate],
    own: float,
    pixel: PixelNoise,
    stops: Mapping[float, Rival],
) -> dict[str, Rival]:
    """Return the rivals with the protection of the mask alone, and the open lens without
    protection.
    """
    # the smallest stop that does not protect more than the mask
    stop_alone = min(
        (candidate for candidate in clear if candidate.protection >= own),
        key=lambda c: c.protection,
    )
    mask_and_stop = best(masked, own, ATTACKED_AT, pixel)["error"][1]
    rivals = {
        "open lens": Rival("open lens", Front(False), 1.0),
        "grey filter": Rival("grey filter", Front(False), min(1.0, own / clear[0].protection)),
        "smaller stop": Rival("smaller stop", stop_alone.front, stop_alone.transmittance(own)),
        "stop and filter": stops[ATTACKED_AT],
        "mask": Rival("mask", Front(True), 1.0),
    }
    return (
        rivals if mask_and_stop.front == Front(True) else {**rivals, "mask and stop": mask_and_stop}
    )


def _drawn_gains(
    conditions: Sequence[Condition],
    candidate: Callable[[Front, Condition], Candidate],
    pairs: Mapping[float, tuple[Best, Best]],
    pixel: PixelNoise,
    progress: Callable[[str], None],
) -> dict[float, dict[str, list[float]]]:
    """Return the gain of the mask in each draw; ``pairs`` has the best front with and without the
    mask at each light, chosen at the usual condition.
    """

    def value(rival: Rival, condition: Condition, n: float, measure: str) -> float:
        measures = candidate(rival.front, condition).found
        return quiet_picture(measures, rival.transmittance, n, pixel)[measure]

    drawn: dict[float, dict[str, list[float]]] = {
        scene_light: {m: [] for m in DRAWN} for scene_light in LIGHTS
    }
    for number, condition in enumerate(conditions, 1):
        for scene_light, (best_masked, best_plain) in pairs.items():
            for measure in DRAWN:
                masked_value = value(best_masked[measure][1], condition, scene_light, measure)
                drawn[scene_light][measure].append(
                    masked_value - value(best_plain[measure][1], condition, scene_light, measure)
                )
        progress(f"draw {number} of {len(conditions)}: quiet frames")
    return drawn


def _attacks(
    conditions: Sequence[Condition],
    candidate: Callable[[Front, Condition], Candidate],
    rivals: Mapping[str, Rival],
    pixel: PixelNoise,
    progress: Callable[[str], None],
) -> tuple[dict[str, dict[str, list[list[float]]]], dict[str, list[float]]]:
    """Return the quality of the picture under attack, in each draw.

    The first result maps each rival to error, information and share of unsaturated pixels (draw,
    strength), the second to the strength at which half of its information is lost (draw,).
    """
    names = [name for name in rivals if name != "notch"]
    attack: dict[str, dict[str, list[list[float]]]] = {
        rival_name: {"error": [], "information": [], "seen": []} for rival_name in names
    }
    lost: dict[str, list[float]] = {name: [] for name in names}
    for number, condition in enumerate(conditions, 1):
        for name in names:
            measures = candidate(rivals[name].front, condition).found
            # the field of the recipe; wider ones are only for a laser on the axis
            field_side = min(measures.glare)
            under_attack = attacked_picture(
                measures.spectrum,
                measures.glare[field_side],
                pixel,
                Attack(torch.tensor(STRENGTHS, dtype=torch.float64), measures.colour),
                electrons=ATTACKED_AT,
                transmittance=rivals[name].transmittance,
            )
            for quantity, values in under_attack._asdict().items():
                attack[name][quantity].append(values.tolist())
            # convert dB to bits per pixel
            quiet_bits = 10 ** (
                quiet_picture(measures, rivals[name].transmittance, ATTACKED_AT, pixel)[
                    "information"
                ]
                / 10
            )
            lost[name].append(
                _crossing([bits / quiet_bits for bits in under_attack.information.tolist()])
            )
        progress(f"draw {number} of {len(conditions)}: under attack")
    return attack, lost


def _crossing(share: Sequence[float]) -> float:
    """Return the strength at which the share of information falls below `_LOST_SHARE`, limited to
    the range of `STRENGTHS`.
    """
    if share[0] < _LOST_SHARE:
        return float(STRENGTHS[0])
    for index in range(1, len(share)):
        if share[index] < _LOST_SHARE:
            fraction = (share[index - 1] - _LOST_SHARE) / (share[index - 1] - share[index])
            # linear in the logarithm of the strength
            return float(
                STRENGTHS[index - 1] * (STRENGTHS[index] / STRENGTHS[index - 1]) ** fraction
            )
    return float(STRENGTHS[-1])


def _fields(
    rivals: Mapping[str, Rival], measured: Mapping[str, Candidate], pixel: PixelNoise
) -> dict[str, dict[int, list[float]]]:
    """Return the share of unsaturated pixels for each strength, by rival and by side length of the
    field.
    """
    shares: dict[str, dict[int, list[float]]] = {}
    for name, rival in rivals.items():
        measures = measured[name].found
        for side, glare in measures.glare.items():
            under_attack: Any = attacked_picture(
                measures.spectrum,
                glare,
                pixel,
                Attack(torch.tensor(STRENGTHS, dtype=torch.float64), measures.colour),
                electrons=ATTACKED_AT,
                transmittance=rival.transmittance,
            )
            shares.setdefault(name, {})[side] = under_attack.seen.tolist()
    return shares


def _bounds(
    bench: FrontBench, pixel: PixelNoise
) -> tuple[dict[float, tuple[float, float]], dict[float, float]]:
    """Return gain and bound of the mean NEQ over the lens band at the middle wavelength, and the
    glare above which no mask wins.
    """
    bands = bench.camera.bands
    middle_band = len(bands.centres) // 2
    # only the middle band
    psf = bench.camera.psf(
        True, 1.0, type(bands)(*(values[middle_band : middle_band + 1] for values in bands))
    )
    bound = {}
    for scene_light in LIGHTS:
        protection_bounds = metrics.protection_bounds(
            psf, electrons=scene_light, read_noise=pixel.read_noise
        )
        bound[scene_light] = (
            float(protection_bounds.over_both),
            float(protection_bounds.over_both_bound),
        )
    peak = float(metrics.lsr(psf))
    return bound, {
        scene_light: largest_glare(peak, scene_light, pixel.read_noise) for scene_light in LIGHTS
    }
