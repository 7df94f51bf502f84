"""Rivals of equal protection: the grey filter and the stop that protect as well as a mask."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes import metrics
from neusee.nodes.metrics import (
    TARGETS,
    PixelNoise,
    decibels,
    detection_snr,
    information_bits,
    mean_log_neq,
    noise_variance,
    remaining_error,
)
from neusee.workflows.protection.protection_camera import (
    Front,
    FrontBench,
    FrontMeasures,
    FrontSettings,
    ProtectionCamera,
    usual_condition,
)
from neusee.workflows.store.result_store import Store

# --- equal rivals ---------------------------------------------------------------------------------

# Rivals of equal protection: each front gets the grey filter that brings the harm by the laser to
# the same value.


#: measures of a picture without a laser, with their descriptions
MEASURES: Mapping[str, str] = {
    "error": "error of the filtered picture",
    "information": "information",
    "NEQ": "mean log NEQ at low frequencies",
    **{
        name: f"detection of {'an' if name == 'edge' else 'a'} {name}"
        for name in TARGETS
        if name != "text"
    },
    "text": "detection of a line of text",
}
CONTRAST = 0.2  #: contrast of the targets


@dataclass(frozen=True)
class Candidate:
    """A front with its measurements."""

    front: Front
    found: FrontMeasures
    protection: float  #: harm relative to the clear lens: peak, or heat

    def transmittance(self, protection: float) -> float:
        """Return the transmittance, at most 1, of the grey filter that brings this front to
        ``protection``.
        """
        return min(1.0, protection / self.protection)


@dataclass(frozen=True)
class Rival:
    """A front with a grey filter, and its name on the page."""

    name: str
    front: Front
    transmittance: float

    @property
    def said(self) -> str:
        """Return the parts of the rival as text, such as ``mask, stop 0.61, filter 0.33``."""
        parts = ["mask"] if self.front.masked else []
        if self.front.notch is not None:
            parts.append(f"notch at {self.front.notch * 1e9:.0f} nm")
        if self.front.diameter < 1:
            parts.append(f"stop {self.front.diameter:.3g}")
        if self.transmittance < 1:
            parts.append(f"filter {self.transmittance:.2g}")
        return ", ".join(parts) or "open lens"


def quiet_picture(
    measures: FrontMeasures, transmittance: float, electrons: float, pixel: PixelNoise
) -> dict[str, float]:
    """Return each of `MEASURES` in dB (more is better) for a frame without a laser; ``electrons``
    is the scene light in e- per pixel.
    """
    amplitude = electrons * transmittance
    # second argument 0.0: no glare
    noise: Tensor = noise_variance(
        amplitude * measures.spectrum.light, 0.0, pixel.read_noise, pixel.prnu
    )[None]
    bits = float(information_bits(measures.spectrum, amplitude, noise).mean())
    values = {
        "error": -decibels(float(remaining_error(measures.spectrum, amplitude, noise).mean())),
        "information": decibels(max(bits, 1e-30)),
        # convert a natural logarithm to dB
        "NEQ": float(mean_log_neq(measures.spectrum, amplitude, noise).mean()) * decibels(math.e),
    }
    for name, energy in measures.energy.items():
        # an SNR is an amplitude ratio: 20 log10
        values[name] = 2 * decibels(
            max(float(detection_snr(energy, amplitude, CONTRAST, noise)), 1e-30)
        )
    return values


def best(
    candidates: Sequence[Candidate],
    protection: float,
    electrons: float,
    pixel: PixelNoise,
    name: str = "",
) -> dict[str, tuple[float, Rival]]:
    """Return the best value of each of `MEASURES` over candidates at equal protection, with its
    rival.
    """
    leaders: dict[str, tuple[float, Rival]] = {}
    for candidate in candidates:
        transmittance = candidate.transmittance(protection)
        for measure, value in quiet_picture(
            candidate.found, transmittance, electrons, pixel
        ).items():
            if measure not in leaders or value > leaders[measure][0]:
                leaders[measure] = value, Rival(name, candidate.front, transmittance)
    return leaders


def gains(
    masked: Sequence[Candidate],
    plain: Sequence[Candidate],
    protection: float,
    electrons: float,
    pixel: PixelNoise,
) -> dict[str, float]:
    """Return, by measure, the gain in dB of the best front with the mask over the best stop with
    filter, at equal protection.
    """
    best_masked, best_plain = (
        best(candidates, protection, electrons, pixel) for candidates in (masked, plain)
    )
    return {measure: best_masked[measure][0] - best_plain[measure][0] for measure in MEASURES}


def neq_curve(
    measures: FrontMeasures, transmittance: float, electrons: float, pixel: PixelNoise
) -> list[float]:
    """Return the NEQ (noise equivalent quanta) in electrons in rings of frequency, averaged over
    directions.
    """
    amplitude = electrons * transmittance
    noise = float(
        noise_variance(
            amplitude * measures.spectrum.light.mean(), 0.0, pixel.read_noise, pixel.prnu
        )
    )
    # NEQ = (light |OTF|)^2 / noise, without glare (0.0 above)
    curve: Tensor = amplitude**2 * measures.square / noise
    return [float(neq) for neq in torch.clamp(curve, min=1e-12)]


def colour_shift(measures: FrontMeasures) -> float:
    """Return the ratio of the largest to the smallest share of light among the channels; 1 means no
    tint.
    """
    light_of_channels = measures.spectrum.light
    return float(light_of_channels.max() / light_of_channels.min().clamp_min(1e-12))


# --- equal shade ----------------------------------------------------------------------------------

# The grey filter and the stop that lower the peak of a laser behind a lens, with or without a mask,
# to a requested share.
#
# A filter of transmittance t lowers the peak to t at every wavelength; for the same loss of light a
# stop lowers it more.


#: additions to a lens: stop and filter, a filter alone, or a stop alone
WAYS = ("best", "filter", "stop")
_LEAST_SAMPLES = 16  #: least number of pupil samples across the diameter of the smallest stop
_HALVINGS = 12  #: bisection steps of the search for the diameter of a stop
_OPEN_FILTER = 0.995  #: filters with a higher transmittance are not mentioned
_DIAMETER_RATIO = 0.85  #: ratio of two successive stop diameters


class EqualProtection(NamedTuple):
    """The requested peak of a laser relative to the plain lens, and the way to reach it."""

    level: float  #: at the worst wavelength
    way: str = WAYS[0]  #: one of `WAYS`


@dataclass(frozen=True)
class EqualShade:
    """A stop and a grey filter that, together with a mask, lower the peak to the
    requested share.
    """

    alone: float  #: peak with the mask alone, relative to the clear lens, at the worst wavelength
    diameter: float = 1.0  #: diameter of the stop relative to the lens
    transmittance: float = 1.0  #: transmittance of the filter

    @property
    def said(self) -> str:
        """Return stop and filter as text, such as `` + stop 0.56 + filter 0.1``; parts without
        effect are omitted.
        """
        stop = f" + stop {self.diameter:.3g}" if self.diameter < 1 else ""
        return stop + (
            f" + filter {self.transmittance:.2g}" if self.transmittance < _OPEN_FILTER else ""
        )

    @property
    def brightness(self) -> float:
        """Return the factor that makes a picture behind stop and filter as bright as
        without them.
        """
        return 1.0 / (self.transmittance * self.diameter**2)

    @property
    def words(self) -> list[str]:
        """Return the recipe arguments that add stop and filter to the arm ``mask``.

        The developed picture is brightened to the exposure without stop and filter.
        """
        values = f"transmittance: {self.transmittance!r}, diameter: {self.diameter!r}"
        return [
            "+arms.plain.shade=null",
            "+arms.mask.shade=shade",
            f"+steps.shade={{node: doe.shade, from: stop, with: {{{values}}}}}",
            "+steps.pupil.from.shade=${item.shade}",
            "+steps.laser_pupil.from.shade=${each.arms.shade}",
            "+arms.plain.brightness=1",
            f"+arms.mask.brightness={self.brightness!r}",
            "+steps.developed.with={brightness: '${item.brightness}'}",
        ]


def stop_diameter(camera: ProtectionCamera, level: float) -> float:
    """Return the relative diameter of the smallest stop whose peak, with the mask if any, is not
    below ``level``.

    Raises: ValueError if the samples of the pupil carry no stop that is small enough.
    """

    def peak(diameter: float) -> float:
        return float(metrics.lsr(camera.psf(True, diameter, camera.bands)).max())

    # bracket of relative diameters; a smaller stop has a lower peak
    too_small, large_enough = _LEAST_SAMPLES / int(camera.stop.samples), 1.0
    if (smallest := peak(too_small)) > level:
        raise ValueError(
            f"needs a smaller stop than the samples of the pupil carry: ask for {smallest:.2g} or"
            " more, or take filters with --by filter"
        )
    for _ in range(_HALVINGS):
        middle = (too_small + large_enough) / 2
        too_small, large_enough = (
            (too_small, middle) if peak(middle) >= level else (middle, large_enough)
        )
    return large_enough


def best_diameter(camera: ProtectionCamera, store: Store, level: float, electrons: float) -> float:
    """Return the relative diameter of the stop with the least error of the filtered picture, at the
    grey filter needed for ``level``.

    ``electrons`` is the mean scene light behind the plain lens, in e- per pixel.
    """
    window_side = min(int(pixels) for pixels in camera.lens["shape"])
    # contrast variance 0.1, NEQ up to 0.12 cycles per pixel, targets 14 pixels high, one field as
    # wide as the window, and None: the harm is the peak, not the heat
    bench = FrontBench(
        camera, store, FrontSettings(0.1, 0.12, min(14.0, window_side / 4), (window_side,), None)
    )
    usual_values, smallest = usual_condition(), stop_diameter(camera, level)
    # from the open lens down; 40 steps are more than any pupil sampling allows
    diameters = [_DIAMETER_RATIO**step for step in range(40) if _DIAMETER_RATIO**step > smallest]
    fronts = [Front(True, diameter) for diameter in (*diameters, smallest)]
    measured = [bench.measure(front, usual_values) for front in fronts]
    candidates = [
        Candidate(front, measures, measures.peak)
        for front, measures in zip(fronts, measured, strict=True)
    ]
    # element 1 of (value, rival)
    return best(candidates, level, electrons, camera.pixel(0.0, 0.0))["error"][1].front.diameter


def shade_equally(
    camera: ProtectionCamera,
    store: Store,
    level: float,
    way: str,
    electrons: Callable[[], float],
    peak_of: Callable[[EqualShade], float],
) -> EqualShade:
    """Return the stop and the filter, by one of the `WAYS`, that bring the peak to ``level``.

    ``electrons`` returns the mean scene light behind the plain lens, in e- per pixel. ``peak_of``
    returns the peak behind a shade at the worst of all wavelengths, relative to the clear lens.
    """
    alone = peak_of(EqualShade(1.0))
    # 1e-6 is rounding
    if level > alone * (1 + 1e-6):
        raise ValueError(
            f"lowers the peak to {alone:.4g} already: ask for at most that, or leave this mask out"
        )
    diameter = 1.0
    if way == "stop":
        diameter = stop_diameter(camera, level)
    elif way == "best":
        diameter = best_diameter(camera, store, level, electrons())
    peak_with_stop = alone if diameter == 1 else peak_of(EqualShade(alone, diameter))
    return EqualShade(alone, diameter, min(1.0, level / peak_with_stop))
