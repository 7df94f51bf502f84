"""Saturation irradiance, largest signal-to-noise ratio and dynamic range of a sensor."""

import math
from typing import Annotated, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.constants import PLANCK, SPEED_OF_LIGHT
from neusee.nodes.units import Electrons, PositiveLength, Time
from neusee.nodes.values import Bands

Efficiency = Annotated[float, Field(gt=0, le=1)]  #: electrons per photon
Well = Annotated[Electrons, Field(gt=0)]  #: electrons that fill a pixel


class Limits(NamedTuple):
    """Limits of a sensor: photons that fill a pixel, largest signal-to-noise ratio, and dynamic range."""

    photons: Tensor  #: () float64, photons that fill a pixel
    snr: Tensor  #: () float64, signal-to-noise ratio at saturation
    dynamic_range: Tensor  #: () float64, dB


def photons_per_joule(centres: Tensor) -> Tensor:
    """Return the number of photons in one joule of light of each wavelength: wavelength / (h c)."""
    return centres.double() / (PLANCK * SPEED_OF_LIGHT)


def photons_that_fill(full_well: float, quantum_efficiency: float) -> float:
    """Return the number of photons that fill the well of a pixel: full well / quantum efficiency."""
    return full_well / quantum_efficiency


@node(rtol=1e-12)
def saturation(
    bands: Bands, *, full_well: Well, quantum_efficiency: Efficiency, pixel_pitch: PositiveLength, exposure: Time
) -> Tensor:
    """Compute the saturation irradiance at each wavelength, which fills a pixel within one exposure.

    Shapes: bands (band,) -> (band,) float64.
    Units:  result W/m2.
    Error:  exact for a fill factor of 1 and an efficiency that does not depend on wavelength. The paper's rounded
            constants give 0.13 % more.
    Source: NeuSee, Eq. (ThresSat).
    """
    joules = photons_that_fill(full_well, quantum_efficiency) / photons_per_joule(bands.centres)
    return joules / (exposure * pixel_pitch**2)


@saturation.check
def _(result: Tensor, bands: Bands, **params: object) -> list[Check]:
    low, high = float(result.min()), float(result.max())
    return [Check(f"saturation irradiance from {low:.3e} to {high:.3e} W/m2", math.isfinite(low + high) and low > 0)]


@node(rtol=1e-12)
def limits(*, full_well: Well, quantum_efficiency: Efficiency, read_noise: Electrons) -> Limits:
    """Compute the photons that fill a pixel, the signal-to-noise ratio at saturation, and the dynamic range.

    Shapes: -> three scalars, float64.
    Units:  photons; signal-to-noise ratio 1; dynamic range in dB, 20 log10(well / read noise).
    Error:  shot noise alone at the top and read noise alone at the bottom; a read noise under 1 e- counts as 1 e-.
    Source: EMVA Standard 1288, release 4.0 (SNR_max = sqrt(saturation capacity)).
    """
    decibels = 20.0 * math.log10(full_well / max(read_noise, 1.0))
    values = (photons_that_fill(full_well, quantum_efficiency), math.sqrt(full_well), decibels)
    return Limits(*(torch.tensor(v, dtype=torch.float64) for v in values))


@limits.check
def _(result: Limits, **params: object) -> list[Check]:
    text = f"{float(result.photons):.0f} photons, SNR {float(result.snr):.1f}, {float(result.dynamic_range):.1f} dB"
    return [Check(text, float(result.dynamic_range) > 0)]
