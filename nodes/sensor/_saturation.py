"""Saturation irradiance of a sensor, and the photons that fill a pixel."""

import math
from typing import Annotated

from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.constants import PLANCK, SPEED_OF_LIGHT
from neusee.nodes.units import Efficiency as Efficiency
from neusee.nodes.units import Electrons, Exposure, PixelPitch
from neusee.nodes.values import Bands

Well = Annotated[Electrons, Field(ge=1)]  #: electrons that fill a pixel


def photons_per_joule(centres: Tensor) -> Tensor:
    """Return the number of photons in one joule of light of each wavelength: wavelength / (h c)."""
    return centres.double() / (PLANCK * SPEED_OF_LIGHT)


def photons_that_fill(full_well: float, quantum_efficiency: float) -> float:
    """Return the number of photons that fill the well of a pixel: full well / quantum efficiency."""
    return full_well / quantum_efficiency


def line_saturation(
    line: Bands,
    responses: Tensor,
    *,
    electrons: float,
    quantum_efficiency: float,
    pixel_pitch: float,
    exposure: float,
) -> float:
    """Return the irradiance of a laser line that fills a pixel of the channel that saturates first.

    A channel c of the response r turns one joule into sum over bands of r_c weight lambda / (h c) times the quantum
    efficiency electrons. A line that no channel sees gives infinity.

    Shapes: line (band,), responses (channel, band) -> ().
    Units:  electrons of a full pixel e-; pixel_pitch m; exposure s; result W/m2 of the whole line.
    Error:  exact for a fill factor of 1.
    Source: EMVA Standard 1288, release 4.0, of the channel whose quantum efficiency is the largest at the line.
    """
    share = line.weights.double() / line.weights.double().sum()
    each = (responses.double() * (share * photons_per_joule(line.centres))).sum(-1) * quantum_efficiency
    largest = float(each.amax())
    return electrons / (largest * exposure * pixel_pitch**2) if largest > 0 else math.inf


@node(rtol=1e-12)
def saturation(
    bands: Bands, *, full_well: Well, quantum_efficiency: Efficiency, pixel_pitch: PixelPitch, exposure: Exposure
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
