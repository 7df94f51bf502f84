"""Rivals of equal protection: the grey filter and the stop that protect like a mask."""

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

# Rivals of equal protection: each front gets the grey filter with which the laser does as much harm
# as elsewhere.


#: what is measured of a quiet picture, with what it means
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
CONTRAST = 0.2  #: of the targets


@dataclass(frozen=True)
class Candidate:
    """A front and what was measured of it."""

    front: Front
    found: FrontMeasures
    protection: float  #: share of the harm of the clear lens: peak, or heat

    def transmittance(self, protection: float) -> float:
        """Return the transmittance of the grey filter with which this front has a
        ``protection``; at most 1.
        """
        return min(1.0, protection / self.protection)


@dataclass(frozen=True)
class Rival:
    """A front with a grey filter, and the name by which the page calls both."""

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
    """Return each of `MEASURES` in dB, more is better, for a frame without a laser at a scene
    light in e- a pixel.
    """
    amplitude = electrons * transmittance
    # 0.0: no glare
    noise: Tensor = noise_variance(
        amplitude * measures.spectrum.light, 0.0, pixel.read_noise, pixel.prnu
    )[None]
    bits = float(information_bits(measures.spectrum, amplitude, noise).mean())
    values = {
        "error": -decibels(float(remaining_error(measures.spectrum, amplitude, noise).mean())),
        "information": decibels(max(bits, 1e-30)),
        # a natural logarithm in dB
        "NEQ": float(mean_log_neq(measures.spectrum, amplitude, noise).mean()) * decibels(math.e),
    }
    for name, energy in measures.energy.items():
        # an SNR is an amplitude: 20 log10
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
    """Return the best value of each of `MEASURES` over candidates of equal protection, and the
    rival with the value.
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
    """Return by how many dB the best with the mask exceeds the best stop-and-filter of equal
    protection, by measure.
    """
    best_masked, best_plain = (
        best(candidates, protection, electrons, pixel) for candidates in (masked, plain)
    )
    return {measure: best_masked[measure][0] - best_plain[measure][0] for measure in MEASURES}


def neq_curve(
    measures: FrontMeasures, transmittance: float, electrons: float, pixel: PixelNoise
) -> list[float]:
    """Return the NEQ in the rings of frequency, averaged over directions, in electrons."""
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
    """Return the ratio of the largest to the smallest share of light that the channels receive;
    1: no tint.
    """
    light_of_channels = measures.spectrum.light
    return float(light_of_channels.max() / light_of_channels.min().clamp_min(1e-12))


# --- equal shade ----------------------------------------------------------------------------------

# The grey filter and the stop with which a lens, with or without a mask, lowers the peak of a laser
# to a wanted share.
#
# A filter of transmittance t lowers the peak to t at every wavelength; a stop lowers it more per
# light that it takes.


#: what is added to a lens: stop and filter, a filter alone, or a stop alone
WAYS = ("best", "filter", "stop")
_LEAST_SAMPLES = 16  #: of the pupil, along the diameter of the smallest stop
_HALVINGS = 12  #: of the interval in which the diameter of a stop is looked for
_OPEN_FILTER = 0.995  #: transmittance from which a filter is not named
_DIAMETER_RATIO = 0.85  #: between two diameters of stops


class EqualProtection(NamedTuple):
    """The peak of a laser that is wanted, as a share of that behind the plain lens, and what is
    added to reach it.
    """

    level: float  #: at the worst wavelength
    way: str = WAYS[0]  #: one of `WAYS`


@dataclass(frozen=True)
class EqualShade:
    """A stop and a grey filter, which together with a mask lower the peak to the wanted share."""

    alone: float  #: peak with the mask alone, relative to the clear lens, at the worst wavelength
    diameter: float = 1.0  #: of the stop, relative to the lens
    transmittance: float = 1.0  #: of the filter

    @property
    def said(self) -> str:
        """Return stop and filter as text, such as `` + stop 0.56 + filter 0.1``; parts without
        effect are left out.
        """
        stop = f" + stop {self.diameter:.3g}" if self.diameter < 1 else ""
        return stop + (
            f" + filter {self.transmittance:.2g}" if self.transmittance < _OPEN_FILTER else ""
        )

    @property
    def brightness(self) -> float:
        """Return the factor that gives a picture behind stop and filter the exposure of one
        without them.
        """
        return 1.0 / (self.transmittance * self.diameter**2)

    @property
    def words(self) -> list[str]:
        """Return the arguments that add stop and filter to the arm ``mask`` of a recipe.

        The developed picture behind them has an exposure of its own: it is as bright as without
        them.
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
    """Return the diameter of the smallest stop whose peak, with the mask if there is one, is not
    below ``level``.

    Raises: ValueError if the samples of the pupil carry no stop that is small enough.
    """

    def peak(diameter: float) -> float:
        return float(metrics.lsr(camera.psf(True, diameter, camera.bands)).max())

    # relative diameters: the peak falls with the diameter
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
    """Return the diameter of the stop whose filtered picture has the least error, with the filter
    that it then needs.

    ``electrons`` is the mean light of the scene in e- a pixel behind the plain lens.
    """
    window_side = min(int(pixels) for pixels in camera.lens["shape"])
    # contrast variance 0.1, NEQ up to 0.12 cycles a pixel, targets 14 pixels high, one field as
    # wide as the window, and the peak as the harm (no heat)
    bench = FrontBench(
        camera, store, FrontSettings(0.1, 0.12, min(14.0, window_side / 4), (window_side,), None)
    )
    usual_values, smallest = usual_condition(), stop_diameter(camera, level)
    # 40 steps are more than any pupil carries: from the open lens down
    diameters = [_DIAMETER_RATIO**step for step in range(40) if _DIAMETER_RATIO**step > smallest]
    fronts = [Front(True, diameter) for diameter in (*diameters, smallest)]
    measured = [bench.measure(front, usual_values) for front in fronts]
    candidates = [
        Candidate(front, measures, measures.peak)
        for front, measures in zip(fronts, measured, strict=True)
    ]
    # the rival of least error: (value, rival)
    return best(candidates, level, electrons, camera.pixel(0.0, 0.0))["error"][1].front.diameter


def shade_equally(
    camera: ProtectionCamera,
    store: Store,
    level: float,
    way: str,
    electrons: Callable[[], float],
    peak_of: Callable[[EqualShade], float],
) -> EqualShade:
    """Return the stop and the filter of one of the `WAYS` with which the peak is ``level``.

    ``electrons`` returns the mean light of the scene, in e- a pixel behind the plain lens.
    ``peak_of`` returns the peak behind a shade at the worst of all wavelengths, relative to the
    clear lens.
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
