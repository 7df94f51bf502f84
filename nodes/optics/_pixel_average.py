"""The PSF averaged over each square pixel: its intensity on a finer grid, and a short filter behind.

The intensity |U|^2 of a pupil that is N samples wide has a bandwidth of B = N alpha cycles a pixel, with alpha the
pitch of the pupil times that of the pixel over wavelength and focal length. More than 2 B samples a pixel hold all of
the intensity, and `_pixel_filter` averages them over each pixel. A window within the alias-free field has at most N / B
pixels, so that the fine grid has a little over 2 N samples a side in the worst case, whatever the f-number.

Rule: along each axis the grid has more than 2 B samples a pixel, the multiple of a quarter (a whole number above 8)
that needs the fewest samples, where a tap of the filter counts as one more sample. It is the same on every machine.
Memory: strips of pixel rows with at most `FINE_SAMPLES` samples of the fine grid, 64 MiB in float32.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.optics._pixel_filter import FineAxis, averaged, fine_axis, unit_nodes
from neusee.nodes.optics._psf_definition import Geometry
from neusee.nodes.optics._transform._intensity import Sampling, intensity_of
from neusee.nodes.optics._transform._pupil_field import View
from neusee.nodes.optics._transform._sample_axis import Axis, centred
from neusee.nodes.optics._transform._scaled_transform import Method
from neusee.nodes.torch_func import plain
from neusee.nodes.values import Pupil

#: nominal error of the filter by the type of the PSF; a fringe errs by up to 1e-8 and 1e-12 of the clear peak
FILTER_ERROR = {torch.float32: 5e-10, torch.float64: 5e-15}
FINE_SAMPLES = 1 << 24  #: of the fine grid at a time, unless one row of pixels needs more
_STRIPE = 1 << 17  #: samples of the aperture that are converted to float64 at a time


class GridAxis(NamedTuple):
    """Equally spaced places along one axis of the sensor."""

    samples: int
    per_pixel: float  #: samples a pixel
    middle: float  #: pixels from the spot to the middle of the grid


def turns_per_pixel(pupil: Pupil, camera: Geometry, band: int) -> float:
    """Return alpha, the turns of phase between neighbouring pupil samples for each pixel off the axis."""
    return float(pupil.pitch) * camera.pixel_pitch / (float(pupil.wavelengths[band]) * camera.focal_length)


def spot(camera: Geometry) -> list[float]:
    """Return the position (y, x) of the spot on the sensor, in pixels."""
    return [
        n // 2 + camera.focal_length * a / camera.pixel_pitch for n, a in zip(camera.shape, camera.angle, strict=True)
    ]


def view_of(
    pupil: Pupil, camera: Geometry, band: int, grid: tuple[GridAxis, GridAxis], light: float, dtype: torch.dtype
) -> View:
    """Return the intensity on a grid, as the share of the light in a pixel; ``light`` divides by the clear pupil."""
    alpha, wavelength = turns_per_pixel(pupil, camera, band), float(pupil.wavelengths[band])
    rows, columns = (
        Axis(n, axis.samples, alpha / axis.per_pixel) for n, axis in zip(pupil.height.shape, grid, strict=True)
    )
    tilt = (-alpha * grid[0].middle, -alpha * grid[1].middle)
    envelope = _envelopes(grid, alpha, dtype, pupil.height.device) if camera.pixel == "zoh" else None
    turns_height = float(pupil.index[band]) / wavelength
    return View(band, rows, columns, turns_height, 1 / wavelength, tilt, light * alpha**2, envelope)


def _envelopes(
    grid: tuple[GridAxis, GridAxis], alpha: float, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor]:
    """Return the diffraction envelope of square pupil samples along both axes."""
    y, x = (
        plain(torch.sinc((centred(axis.samples, device) / axis.per_pixel + axis.middle) * alpha).square().to(dtype))
        for axis in grid
    )
    return y, x


def fine_grid(pupil: Pupil, camera: Geometry, band: int, dtype: torch.dtype) -> tuple[FineAxis, FineAxis]:
    """Return the grid along each axis on which the intensity of a band is computed before it is averaged."""
    alpha = turns_per_pixel(pupil, camera, band)
    return fine_axes((pupil.height.shape[0], pupil.height.shape[1]), camera.shape, alpha, dtype)


def fine_axes(
    samples: tuple[int, int], shape: tuple[int, int], alpha: float, dtype: torch.dtype
) -> tuple[FineAxis, FineAxis]:
    """Return the fine grid of a window of ``shape`` pixels for a pupil of ``samples``."""
    y, x = (fine_axis(k, n * alpha, FILTER_ERROR[dtype]) for n, k in zip(samples, shape, strict=True))
    return y, x


def strips(rows: FineAxis, columns: FineAxis) -> list[tuple[int, int]]:
    """Return the first and the last row, exclusive, of each strip of pixels whose fine grid is computed at a time."""
    most = FINE_SAMPLES // columns.samples - rows.taps
    height = max(1, math.floor(most / rows.per_pixel))
    count = -(-rows.pixels // height)
    ends = [rows.pixels * i // count for i in range(count + 1)]
    return list(pairwise(ends))


class Optics(NamedTuple):
    """How the intensity is computed: type, method of the transform, and whether focal fields are stored."""

    dtype: torch.dtype
    method: Method
    keep: bool


def band_average(pupil: Pupil, camera: Geometry, band: int, light: float, optics: Optics) -> list[Tensor]:
    """Return the share of the light in each pixel of one band, in strips of rows (y, x)."""
    rows, columns = fine_grid(pupil, camera, band, optics.dtype)
    middles = [(n - 1) / 2 - at for n, at in zip(camera.shape, spot(camera), strict=True)]
    across = GridAxis(columns.samples, columns.per_pixel, middles[1])
    averages = []
    for start, stop in strips(rows, columns):
        part = rows.part(stop - start)
        below = (start + stop - camera.shape[0]) / 2
        along = GridAxis(part.samples, part.per_pixel, middles[0] + below)
        view = view_of(pupil, camera, band, (along, across), light, optics.dtype)
        sampling = Sampling((replace(view, band=0),), optics.dtype, optics.method, optics.keep)
        fine = intensity_of(pupil.amplitude, pupil.height, pupil.path, sampling)[0]
        averages.append(averaged(fine, part, columns))
    return averages


def fine_samples(pupil: Pupil, camera: Geometry, dtype: torch.dtype) -> int:
    """Return the number of samples of the fine grids of all bands."""
    count = 0
    for band in range(pupil.wavelengths.numel()):
        rows, columns = fine_grid(pupil, camera, band, dtype)
        count += rows.samples * columns.samples
    return count


def clear_averages(aperture: Tensor, alphas: list[float], square_samples: bool) -> list[float]:
    """Return the average of |U|^2 alpha^2 over the pixel on the axis, for a pupil without phase, at each alpha.

    Within a pixel the field is a smooth function of the pupil's coordinates. The aperture is therefore projected on
    polynomials in these coordinates, and then summed over Gauss-Legendre nodes of the pixel. Bands share a projection
    where their own numbers of polynomials are equal, so that no result depends on the other bands.
    With ``square_samples`` the field has the envelope of square pupil samples.
    """
    projections: dict[tuple[int, ...], tuple[list[Tensor], Tensor]] = {}
    averages = []
    for alpha in alphas:
        degrees = tuple(_degrees(n, alpha) for n in aperture.shape)
        if degrees not in projections:
            bases = [_polynomials(n, d, aperture.device) for n, d in zip(aperture.shape, degrees, strict=True)]
            projections[degrees] = bases, _projected(aperture, *bases)
        bases, moments = projections[degrees]
        averages.append(_axis_average(moments, bases, alpha, square_samples))
    return averages


def _degrees(samples: int, alpha: float) -> int:
    """Return the number of polynomials that hold all phases across a pixel to 1e-13, a multiple of 8."""
    radians = math.pi * alpha * samples / 2  # of phase, from the middle of pupil and pixel to their edges
    return min(samples, 8 * math.ceil((radians + 5 * math.cbrt(radians) + 10) / 8))


def _polynomials(samples: int, degrees: int, device: torch.device) -> Tensor:
    """Return orthonormal polynomials (sample, degree) on the samples of the pupil."""
    import numpy as np

    at = (np.arange(samples) - (samples - 1) / 2) * (2 / samples)
    polynomials: Tensor = torch.from_numpy(np.polynomial.legendre.legvander(at, degrees - 1)).to(device)
    orthonormal: Tensor = torch.linalg.qr(polynomials).Q
    return orthonormal


def _projected(aperture: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    step = max(1, _STRIPE // aperture.shape[1])
    moments = rows.new_zeros(rows.shape[1], columns.shape[1])
    for start in range(0, len(aperture), step):
        part = slice(start, start + step)
        moments += rows[part].T @ (aperture[part].detach().double() @ columns)
    return moments


def _axis_average(moments: Tensor, bases: list[Tensor], alpha: float, square_samples: bool) -> float:
    waves, weights = [], []
    for basis in bases:
        nodes, shares = unit_nodes(10 + math.ceil(2 * alpha * len(basis)))
        turns = torch.outer(centred(len(basis), basis.device), nodes.to(basis.device) * alpha)
        phases = torch.complex(torch.cos(2 * math.pi * turns), -torch.sin(2 * math.pi * turns))
        waves.append(basis.T.to(phases.dtype) @ phases)
        envelope = torch.sinc(nodes * alpha).square() if square_samples else 1.0
        weights.append((shares * envelope).to(basis.device))
    field = waves[0].T @ moments.to(waves[0].dtype) @ waves[1]
    return float(weights[0] @ field.abs().square() @ weights[1]) * alpha**2
