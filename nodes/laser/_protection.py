"""What a filter, a notch filter and a stop do to the light of a laser, and what they take from
the picture.
"""

from __future__ import annotations

import math

from neusee.nodes import ParameterError
from neusee.nodes.constants import PLANCK, SPEED_OF_LIGHT
from neusee.nodes.spectra._cie_tables import daylight

_WHITE = (400e-9, 700e-9)  #: m, over which the white light of the picture counts
_DAYLIGHT = 6504.0  #: K
EDGE = 0.01  #: of the wavelength, on each side: what a real notch blocks beside its band
_GREEN = 550e-9  #: m


def optical_density(factor: float) -> float:
    """Return the optical density that divides light by a factor: its decimal logarithm; 0 for a
    factor up to 1.
    """
    return math.log10(factor) if factor > 1 else 0.0


def passing(density: float) -> float:
    """Return the transmittance of a filter of an optical density."""
    return math.pow(10, -density)


def notch_wavelength(centre: float, angle: float, index: float) -> float:
    """Return the wavelength in m that a notch filter blocks for light at an angle in rad from its
    normal.

    lambda(theta) = lambda_0 sqrt(1 - sin^2(theta) / n^2): an interference filter moves to shorter
    wavelengths. ``centre`` is the wavelength in m at normal incidence, ``index`` the effective
    index of the filter.

    Raises ParameterError for an index below 1, and for an angle that is not below 90 degrees.
    Source: Macleod, Thin-Film Optical Filters, on tilted narrow-band filters, from memory; by the
            phase of a layer.
    """
    if not index >= 1:
        raise ParameterError(
            "index", f"{index:g} is no effective index of a filter: give a number from 1"
        )
    if not abs(angle) < math.pi / 2:
        raise ParameterError("angle", f"{math.degrees(angle):g} deg: give an angle below 90 deg")
    return centre * math.sqrt(1 - (math.sin(angle) / index) ** 2)


def notch_band(shortest: float, longest: float, angle: float, index: float) -> tuple[float, float]:
    """Return the ends in m of the band, at normal incidence, of a notch that covers a laser over
    the whole field.

    The laser has some wavelength from ``shortest`` to ``longest`` in m, and comes from any angle up
    to ``angle`` in rad. At that angle the band has moved to shorter wavelengths, so that it has to
    begin at the shortest and to end at the wavelength that moves to the longest.
    """
    return shortest, longest / notch_wavelength(1.0, angle, index)


def white_share(low: float, high: float, edge: float = EDGE) -> float:
    """Return the share of the photons of daylight from 400 to 700 nm in a band from ``low`` to
    ``high`` m.

    ``edge`` widens the band by a share of its ends, because a real notch has no vertical edges. The
    sensor counts photons with one efficiency from 400 to 700 nm.

    Source: CIE daylight of 6504 K (CIE 15:2004) by way of colour-science.
    """
    import torch

    wavelengths = (
        # every 0.5 nm; the added 0.25 nm keeps the end in despite rounding
        torch.arange(_WHITE[0] * 1e9, _WHITE[1] * 1e9 + 0.25, 0.5, dtype=torch.float64) * 1e-9
    )
    # power of daylight times wavelength is proportional to photons
    photons = daylight(_DAYLIGHT).at(wavelengths)[0] * wavelengths
    total = torch.trapezoid(photons, wavelengths)
    band_start, band_end = max(low * (1 - edge), _WHITE[0]), min(high * (1 + edge), _WHITE[1])
    if not band_end > band_start:
        return 0.0
    band_ends = torch.tensor([band_start, band_end], dtype=torch.float64)
    # the ends of the band stand beside the table's wavelengths
    inside_wavelengths = torch.cat(
        [
            band_ends[:1],
            wavelengths[(wavelengths > band_start) & (wavelengths < band_end)],
            band_ends[1:],
        ]
    )
    # share of photons, by the same rule as the total
    return float(
        torch.trapezoid(
            daylight(_DAYLIGHT).at(inside_wavelengths)[0] * inside_wavelengths, inside_wavelengths
        )
        / total
    )


def field_angle(shape: tuple[int, int], pixel_pitch: float, focal_length: float) -> float:
    """Return the angle in rad from the axis to the corner of a sensor of ``shape`` (y, x)
    pixels.
    """
    return math.atan(math.hypot(*shape) * pixel_pitch / 2 / focal_length)


def stopped_share(diameter: float, stopped: float) -> float:
    """Return the share of the light of the scene that a lens of ``diameter`` m passes when
    stopped down to another.
    """
    return min(1.0, stopped / diameter) ** 2


def diffraction_cutoff(
    focal_length: float, diameter: float, pixel_pitch: float, wavelength: float = _GREEN
) -> float:
    """Return the finest detail that diffraction leaves, in cycles a pixel: pixel pitch /
    (wavelength x f-number).

    Below 0.5 diffraction takes detail that the pixels could hold.
    """
    return pixel_pitch * diameter / (wavelength * focal_length)


def feature_snr(
    background: float, veil: float, *, contrast: float, feature: float, read_noise: float = 0.0
) -> float:
    """Return the signal-to-noise ratio of a feature under a veil: C n sqrt(A) / sqrt(n + v +
    sigma^2).

    The feature of the Weber contrast C covers A = ``feature`` x ``feature`` pixels on a
    ``background`` of n electrons; v is the ``veil`` in electrons a pixel, and sigma the read noise.
    It is the ratio of `veil_limit` with the rule snr.
    """
    noise = background + veil + read_noise**2
    return contrast * background * feature / math.sqrt(noise) if noise > 0 else 0.0


def photons_in_joule(wavelength: float) -> float:
    """Return the number of photons in one joule of light of a wavelength in m: wavelength / (h
    c).
    """
    return wavelength / (PLANCK * SPEED_OF_LIGHT)
