"""Spot of a laser on the sensor: its size, and the mean power of a frame in which at least one pulse falls."""

import math
from typing import TypeVar

from torch import Tensor

from neusee.nodes.laser._beam import Beam, beam_radius, even_density, underfilled
from neusee.nodes.laser._damage_distances import airy_diameter
from neusee.nodes.laser._spot_heat import spot_heat

Number = TypeVar("Number", float, Tensor)


def frame_power(beam: Beam, exposure: float) -> float:
    """Return the mean power in W of a laser during an exposure in s, in which at least one pulse falls.

    A continuous laser has its power, a single pulse its energy over the exposure. A pulse train has its mean power, or
    that of one pulse if the exposure is shorter than the period: the frame that catches a pulse is the one that counts.
    """
    if beam.pulse_energy is None:
        assert beam.power is not None
        return beam.power
    return max(beam.power or 0.0, beam.pulse_energy / exposure)


def spot_in_pixels(wavelength: float, focal_length: float, diameter: float, pixel_pitch: float) -> float:
    """Return the size of a diffraction-limited spot in pixels: wavelength times f-number over pixel pitch."""
    return wavelength * focal_length / diameter / pixel_pitch


def heated_diameter(beam: Beam, distance: Number, diameter: Number, focal_length: Number) -> Number:
    """Return the 1/e2 diameter in m of the Gaussian spot that heats a sensor as the focused spot of a beam.

    It is `airy_diameter` for a beam that overfills the lens. A narrower beam has a wider spot: for equal power the peak
    is inversely proportional to the area of the spot, so that the diameter grows as the peak's factor `underfilled`
    to the power of -1/2. In the limit of a narrow beam it is 4 % below the diameter of the Gaussian spot.
    """
    filled = diameter**2 / (4 * beam_radius(beam, distance) ** 2)
    overfilled: Number = airy_diameter(beam.wavelength, focal_length / diameter)  # type: ignore[assignment,arg-type]
    wider: Number = underfilled(filled) ** -0.5
    return overfilled * wider


def heated_in_spot(
    beam: Beam, distance: Tensor, diameter: Tensor, focal_length: Tensor, waves: Tensor, density: Tensor
) -> Tensor:
    """Return the 1/e2 diameter in m of the Gaussian spot that heats as the spot behind a clear round lens with defocus.

    ``density`` is what counts as the peak of the spot, as a share of the beam's power per m2 (`density_in_spot`). A
    peak that is stated too high has a spot that is too narrow, and the same heat.
    """
    fill = diameter**2 / (4 * beam_radius(beam, distance) ** 2)
    airy: Tensor = airy_diameter(beam.wavelength, focal_length / diameter)  # type: ignore[assignment,arg-type]
    return airy * spot_heat(fill, waves) * even_density(beam, distance, diameter, focal_length) / density


def widest_heated_diameter(clear: Number, peak_ratio: Number) -> Number:
    """Return an upper bound of the 1/e2 diameter in m of the Gaussian spot that heats as a spot behind a mask.

    ``clear`` is `heated_diameter` of the clear lens, and ``peak_ratio`` the peak behind the mask over that of the clear
    lens. Of all spots with equal power and equal peak, an evenly lit disc heats its centre most: 1.178 times the Airy
    spot, and the inverse root of the peak.

    Source: rearrangement inequality for the integral of E / r over the plane; our derivation.
    """
    airy = 16 / (3 * math.pi**2)  # of the integral of E along a radius, in wavelengths times f-number and peaks
    disc = 2 / math.pi  # radius of the disc of equal power and peak, in the same unit
    wider: Number = clear * (disc / airy) / peak_ratio**0.5
    return wider
