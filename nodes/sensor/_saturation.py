"""Saturation irradiance of a sensor, and the photons that fill a pixel."""

import math
from typing import Annotated

from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.constants import PLANCK, SPEED_OF_LIGHT
from neusee.nodes.units import Efficiency as Efficiency
from neusee.nodes.units import Electrons, PositiveLength, Time
from neusee.nodes.values import Bands

Well = Annotated[Electrons, Field(gt=0)]  #: electrons that fill a pixel


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
