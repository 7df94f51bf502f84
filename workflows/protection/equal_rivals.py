"""Rivals of equal protection: each front gets the grey filter with which the laser does as much harm as elsewhere."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

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
from neusee.workflows.protection.front_optics import Front, FrontMeasures

#: what is measured of a quiet picture, with what it means
MEASURES: Mapping[str, str] = {
    "error": "error of the filtered picture",
    "information": "information",
    "NEQ": "mean log NEQ at low frequencies",
    **{name: f"detection of {'an' if name == 'edge' else 'a'} {name}" for name in TARGETS if name != "text"},
    "text": "detection of a line of text",
}
CONTRAST = 0.2  #: of the targets


@dataclass(frozen=True)
class Candidate:
    """A front and what was measured of it."""

    front: Front
    found: FrontMeasures
    protection: float  #: share of the harm of the clear lens: peak, or heat

    def transmittance(self, wanted: float) -> float:
        """Return the transmittance of the grey filter with which this front protects as ``wanted``; at most 1."""
        return min(1.0, wanted / self.protection)


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
        parts += [f"stop {self.front.diameter:.3g}"] if self.front.diameter < 1 else []
        parts += [f"filter {self.transmittance:.2g}"] if self.transmittance < 1 else []
        return ", ".join(parts) or "open lens"


def quiet_picture(found: FrontMeasures, transmittance: float, electrons: float, pixel: PixelNoise) -> dict[str, float]:
    """Return each of `MEASURES` in dB, more is better, for a frame without a laser at a scene light in e- a pixel."""
    amplitude = electrons * transmittance
    noise: Tensor = noise_variance(amplitude * found.spectrum.light, 0.0, pixel.read_noise, pixel.prnu)[None]
    bits = float(information_bits(found.spectrum, amplitude, noise).mean())
    values = {
        "error": -decibels(float(remaining_error(found.spectrum, amplitude, noise).mean())),
        "information": decibels(max(bits, 1e-30)),
        "NEQ": float(mean_log_neq(found.spectrum, amplitude, noise).mean()) * decibels(math.e),
    }
    for name, energy in found.energy.items():
        values[name] = 2 * decibels(max(float(detection_snr(energy, amplitude, CONTRAST, noise)), 1e-30))
    return values


def best(
    candidates: Sequence[Candidate], wanted: float, electrons: float, pixel: PixelNoise, name: str = ""
) -> dict[str, tuple[float, Rival]]:
    """Return the best value of each of `MEASURES` over candidates of equal protection, and the rival with the value."""
    found: dict[str, tuple[float, Rival]] = {}
    for candidate in candidates:
        grey = candidate.transmittance(wanted)
        for measure, value in quiet_picture(candidate.found, grey, electrons, pixel).items():
            if measure not in found or value > found[measure][0]:
                found[measure] = value, Rival(name, candidate.front, grey)
    return found


def gains(
    masked: Sequence[Candidate], plain: Sequence[Candidate], wanted: float, electrons: float, pixel: PixelNoise
) -> dict[str, float]:
    """Return by how many dB the best with the mask exceeds the best stop-and-filter of equal protection, by measure."""
    mask, rival = (best(each, wanted, electrons, pixel) for each in (masked, plain))
    return {measure: mask[measure][0] - rival[measure][0] for measure in MEASURES}


def neq_curve(found: FrontMeasures, transmittance: float, electrons: float, pixel: PixelNoise) -> list[float]:
    """Return the NEQ in the rings of frequency, averaged over directions, in electrons."""
    amplitude = electrons * transmittance
    noise = float(noise_variance(amplitude * found.spectrum.light.mean(), 0.0, pixel.read_noise, pixel.prnu))
    curve: Tensor = amplitude**2 * found.square / noise
    return [float(x) for x in torch.clamp(curve, min=1e-12)]


def colour_shift(found: FrontMeasures) -> float:
    """Return the ratio of the largest to the smallest share of light that the channels receive; 1: no tint."""
    light = found.spectrum.light
    return float(light.max() / light.min().clamp_min(1e-12))
