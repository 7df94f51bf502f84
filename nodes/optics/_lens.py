"""What a lens passes: its f-number, notch filters and its spatial frequencies."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes import ParameterError
from neusee.nodes.optics._pixel_average import unit_nodes
from neusee.nodes.values import Psf, Pupil

# --- f number -------------------------------------------------------------------------------------

# Refusal of lenses that are faster than any lens in air.


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

# The share of the light that notch filters let through at each wavelength of a pupil.


def passed_by_notches(pupil: Pupil) -> Tensor:
    """Return the share of the light that the notch filters of a pupil let through: (band,) float64.

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

# The spatial frequencies that the clear aperture passes, and what its pixels average away, from a
# PSF alone.


_NODES = 96  #: of the radius and of a quarter of the azimuth
_STEPS = 8  #: of the iteration for the diameter of a stop, each at least 10 times as near


def cut_off(psf: Psf) -> Tensor:
    """Return the highest spatial frequency that the clear aperture passes, in cycles per pixel:
    (band,) float64.

    A PSF that does not name the frequency counts as that of a round aperture, sampled at points:
    sqrt(4 p0 / pi).
    """
    if psf.cut_off.numel():
        return psf.cut_off.double()
    return (psf.clear_peak.double() * (4.0 / math.pi)).sqrt()


def averaging(psf: Psf) -> Tensor:
    """Return the side in pixels of the square over which each pixel averages, 0 for points:
    (band,) float64.
    """
    return (
        psf.averaged.double()
        if psf.averaged.numel()
        else torch.zeros_like(psf.clear_peak, dtype=torch.float64)
    )


class RoundLens(NamedTuple):
    """What a round aperture without aberrations gives, on average over the frequencies that it
    passes.
    """

    peak: Tensor  #: brightest pixel over its value at a point
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
    nodes, weights = unit_nodes(_NODES)
    # a quadrature over the disc of frequencies: a quarter of it, for symmetry
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
    """Return the diameter of the stop with the peak ``lsr``, as a share of that of the lens: (...)
    float64.

    The brightest pixel falls with the fourth power of the diameter, but for what pixels average
    away. ``frequency`` is the cut-off of the lens, and ``side`` that of the square over which a
    pixel averages, as in `round_lens`.
    """
    # a first guess: without an average the peak is width^4
    clear_peak, width = round_lens(frequency, side).peak, lsr**0.25
    for _ in range(_STEPS):
        width = (lsr * clear_peak / round_lens(width * frequency, side).peak) ** 0.25
    return width
