"""Properties of a lens: f-number, transmission of notch filters, cut-off frequency, and the
irradiance of a white surface on the sensor.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.optics._pixel_average import unit_nodes
from neusee.nodes.optics._pupil_grid import clear_area
from neusee.nodes.spectra._illuminant import Kind, luminous_share
from neusee.nodes.units import (
    DataFile,
    FocalLength,
    Illuminance,
    Luminance,
    Temperature,
    Transmittance,
)
from neusee.nodes.values import Bands, Psf, Pupil, Stop

# --- f number -------------------------------------------------------------------------------------

# Refusal of lenses with an f-number below 0.5, which no lens in air has.


def refuse_impossible_f_number(focal_length: float, diameter: float, parameter: str) -> None:
    """Raise ParameterError for a lens whose diameter is more than twice its focal length.

    The sine condition is diameter = 2 n f sin(angle), and no angle has a sine above 1.

    Shapes: scalars.
    Units:  metres.
    Source: Goodman, Introduction to Fourier Optics, 3rd edition, section 6.2; Born and Wolf,
            Principles of Optics, 4.5.
    """
    if diameter > 2 * focal_length * (1 + 1e-9):
        text = (
            f"a diameter of {diameter * 1e3:.6g} mm with a focal length of"
            f" {focal_length * 1e3:.6g} mm"
        )
        raise ParameterError(
            parameter, f"{text} is f/{focal_length / diameter:.3g}: no lens in air is below f/0.5"
        )


# --- notch ----------------------------------------------------------------------------------------

# The transmittance of notch filters at each wavelength of a pupil.


def passed_by_notches(pupil: Pupil) -> Tensor:
    """Return the transmittance of the notch filters of a pupil: (band,) float64.

    A notch of depth d and full width at half maximum w about the centre c passes 1 - d exp(-4 ln 2
    ((x - c) / w)**2) at the wavelength x. Each band is evaluated at its centre.
    """
    if not len(pupil.notches):
        return torch.ones_like(pupil.wavelengths, dtype=torch.float64)
    centres, widths, depths = pupil.notches.to(pupil.wavelengths).unbind(1)
    distance_in_widths = (pupil.wavelengths[:, None] - centres) / widths
    transmitted: Tensor = (
        1.0 - depths * torch.exp(-4.0 * math.log(2.0) * distance_in_widths.square())
    ).prod(1)
    return transmitted


# --- lens band ------------------------------------------------------------------------------------

# The cut-off frequency of the clear aperture, and the loss of contrast by the average over pixels,
# from a PSF alone.


_QUADRATURE_NODES = 96  #: number of nodes in radius, and in a quarter of the azimuth
#: iterations for the diameter of a stop; each reduces the error at least tenfold
_STOP_ITERATIONS = 8


def cut_off(psf: Psf) -> Tensor:
    """Return the highest spatial frequency that the clear aperture passes, in cycles per pixel:
    (band,) float64.

    A PSF without this value counts as that of a round aperture, sampled at points: sqrt(4 p0 / pi)
    with the clear peak p0.
    """
    if psf.cut_off.numel():
        return psf.cut_off.double()
    return (psf.clear_peak.double() * (4.0 / math.pi)).sqrt()


def averaged_side(psf: Psf) -> Tensor:
    """Return the side in pixels of the square over which each pixel averages, 0 for points:
    (band,) float64.
    """
    return (
        psf.averaged.double()
        if psf.averaged.numel()
        else torch.zeros_like(psf.clear_peak, dtype=torch.float64)
    )


class RoundLens(NamedTuple):
    """Peak and contrast of a round aperture without aberrations, as means over the frequencies up
    to its cut-off.
    """

    peak: Tensor  #: brightest pixel, relative to its value for point sampling
    power: Tensor  #: mean of the squared transfer function


def round_lens(frequency: Tensor, side: Tensor) -> RoundLens:
    """Return the peak and the contrast of a round aperture with a cut-off ``frequency``, averaged
    over pixels.

    ``frequency`` is in cycles per pixel, and ``side`` is that of the square over which a pixel
    averages, in pixels.

    Shapes: frequency and side (...) -> two of (...), float64.
    Error: 1e-4 for up to 10 cycles across ``side``.
    Source: Goodman, Introduction to Fourier Optics, 4th ed., ch. 7 (OTF as autocorrelation of the
            pupil).
    """
    nodes, weights = unit_nodes(_QUADRATURE_NODES)
    # quadrature over a quarter of the disc of frequencies, because of the symmetry
    radius, azimuth = (nodes + 0.5)[:, None], (nodes + 0.5) * (math.pi / 2)
    # transfer function of a round pupil without aberrations
    transfer = (torch.acos(radius) - radius * (1 - radius.square()).sqrt()) * (2 / math.pi)
    half_cycles = (side.double() * frequency.double())[..., None, None] * radius
    pixel_transfer = torch.sinc(half_cycles * azimuth.cos()) * torch.sinc(
        half_cycles * azimuth.sin()
    )
    area_share = 2 * radius * weights[:, None] * weights
    peak = (area_share * transfer * pixel_transfer).sum((-2, -1)) / (area_share * transfer).sum()
    return RoundLens(peak, (area_share * (transfer * pixel_transfer).square()).sum((-2, -1)))


def stop_width(lsr: Tensor, frequency: Tensor, side: Tensor) -> Tensor:
    """Return the diameter of the stop whose peak is ``lsr`` times the peak of the open lens,
    relative to the diameter of the lens: (...) float64.

    The brightest pixel falls with the fourth power of the diameter, except for the average over
    pixels. ``frequency`` is the cut-off of the lens, and ``side`` the side of the square over which
    a pixel averages, as in `round_lens`.
    """
    # first guess: for point sampling the peak is proportional to width^4
    clear_peak, width = round_lens(frequency, side).peak, lsr**0.25
    for _ in range(_STOP_ITERATIONS):
        width = (lsr * clear_peak / round_lens(width * frequency, side).peak) ** 0.25
    return width


# --- white irradiance -----------------------------------------------------------------------------

# The brightness of a scene in lux or cd/m2, as the irradiance of a white surface on the sensor.

_EQUAL_WIDTHS = 1e-6  #: largest relative difference of widths of bands that count as equal


@node(rtol=1e-9)
def white_irradiance(
    bands: Bands,
    stop: Stop,
    *,
    illuminance: Illuminance | None = None,
    luminance: Luminance | None = None,
    kind: Kind | DataFile = "daylight",
    temperature: Temperature = 6504.0,
    focal_length: FocalLength,
    lens_transmittance: Transmittance = 1.0,
) -> Tensor:
    """Compute the irradiance of one band on the sensor, for a scene of relative radiance 1 without
    a mask.

    A white surface (reflectance 1, Lambertian) has the luminance illuminance / pi, and the spectrum
    of the illuminant. The lens images its radiance as the area of the clear pupil / focal length^2
    x transmittance.

    Shapes: -> () float64.
    Units:  result W/m2 in a band per unit of the image, whose white has mean 1 over the bands; 0 if
            neither illuminance nor luminance is given.
    Error:  a distant scene, on the axis: the falling off to the corners (cos^4) is left out.
    Raises: ParameterError before the run for an illuminance beside a luminance, for bands of
            different widths, and for a table of light that does not reach over the visible
            wavelengths.
    Source: CIE 18:2019 (683 lm/W); Goodman, Introduction to Fourier Optics, 3rd ed., section 5.3;
            by definition.
    """
    if illuminance is None and luminance is None:
        return torch.zeros((), dtype=torch.float64)
    luminance_of_white = 0.0 if luminance is None else luminance
    if illuminance is not None:
        # Lambertian white surface: luminance = illuminance / pi
        luminance_of_white = illuminance / math.pi
    widths = bands.widths.detach().cpu().double()
    radiance = luminance_of_white * luminous_share(bands, kind, temperature)
    if float(widths.max() / widths.min()) > 1 + _EQUAL_WIDTHS:
        raise ParameterError("illuminance", _UNEQUAL_WIDTHS)
    return torch.as_tensor(
        radiance * clear_area(stop) / focal_length**2 * lens_transmittance, dtype=torch.float64
    )


_UNEQUAL_WIDTHS = (
    "the bands differ in width, so that one unit of the image is another power in each: use the"
    " node spectra.bands"
)


@white_irradiance.unused
def _(params: Mapping[str, Any]) -> Collection[str]:
    # without a brightness the result is 0
    stated = {"illuminance", "luminance"}
    return () if any(params[name] is not None for name in stated) else params.keys() - stated


@white_irradiance.preflight
def _(
    *,
    bands: Bands | None = None,
    illuminance: float | None = None,
    luminance: float | None = None,
    kind: str | Path = "daylight",
    temperature: float = 6504.0,
    focal_length: float,
    lens_transmittance: float = 1.0,
) -> list[str]:
    if illuminance is None and luminance is None:
        return []
    stated = "illuminance" if illuminance is not None else "luminance"
    if illuminance is not None and luminance is not None:
        text = (
            "the brightness of white is stated twice: leave scene.illuminance or"
            " scene.luminance out"
        )
        raise ParameterError("luminance", text)
    if (
        bands is not None
        and not bands.widths.is_meta
        and float(bands.widths.max() / bands.widths.min()) > 1 + _EQUAL_WIDTHS
    ):
        raise ParameterError(stated, _UNEQUAL_WIDTHS)
    if isinstance(kind, Path):
        luminous_share(bands, kind, temperature)
    return []


@white_irradiance.check
def _(
    result: Tensor, bands: Bands, stop: Stop, *, focal_length: float, **params: object
) -> list[Check]:
    if not float(result) > 0:
        return [Check("no brightness in lux or cd/m2")]
    f_number = focal_length / (2 * math.sqrt(clear_area(stop) / math.pi))
    total = float(result) * len(bands.centres)
    return [Check(f"white: {total:.4g} W/m2 on the sensor in all bands, at f/{f_number:.3g}")]
