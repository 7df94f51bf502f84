"""The PSF averaged over square pixels: intensity on a finer grid, then a short filter."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

from neusee.nodes.optics._psf_definition import Geometry
from neusee.nodes.optics.transform._intensity import Sampling, intensity_of
from neusee.nodes.optics.transform._pupil_field import View
from neusee.nodes.optics.transform._sample_axis import Axis, centred
from neusee.nodes.optics.transform._scaled_transform import Method
from neusee.nodes.precision import one_by_one, plain
from neusee.nodes.values import Pupil

# --- pixel filter ---------------------------------------------------------------------------------

# The filter that averages an intensity, sampled on a finer grid, over square pixels.
#
# The intensity of a pupil of finite width is band-limited. Sampled at more than twice its
# bandwidth, it is known between the samples, so that its average over a pixel is a weighted sum of
# samples. The weights are those of a low-pass filter, averaged over a pixel; the filter passes the
# band of the intensity and stops its spectral replicas.


#: the number of samples per pixel is a multiple of this, or an integer above `_WHOLE_SAMPLES_FROM`
_SAMPLES_STEP = 0.25
_WHOLE_SAMPLES_FROM = 8
_PLACE_PERIOD = 4  #: period in pixels of the position of a pixel relative to the samples
_BLOCK_PIXELS = 16  #: number of pixels whose weights form one dense matrix


@dataclass(frozen=True, slots=True)
class FineAxis:
    """A grid along one axis of a window that resolves the intensity, with the length of the filter
    on this grid.

    Grid and window have the same middle.
    """

    pixels: int
    bandwidth: float  #: bandwidth of the intensity, cycles per pixel
    per_pixel: float  #: number of samples per pixel
    error: float  #: error of the filter, relative to the brightest sample within its length
    taps: int  #: number of samples that the filter weights

    @property
    def samples(self) -> int:
        """Return the number of samples; they extend beyond the window by half a filter on each
        side.
        """
        return math.ceil(self.per_pixel * (self.pixels - 1)) + self.taps

    def part(self, pixels: int) -> FineAxis:
        """Return the grid of a part of the window."""
        return FineAxis(pixels, self.bandwidth, self.per_pixel, self.error, self.taps)


def fine_axis(pixels: int, bandwidth: float, error: float) -> FineAxis:
    """Return the grid with the smallest number of samples plus filter taps, which stand for time.

    The grid has more than ``2 bandwidth`` samples per pixel, and at least one. The number of
    samples already includes the taps once.
    """
    grids = (_grid_of(pixels, bandwidth, m, error) for m in _samples_per_pixel(2 * bandwidth))
    return min(grids, key=lambda grid: grid.samples + grid.taps)


def _samples_per_pixel(lowest: float) -> list[float]:
    """Return the numbers of samples per pixel above ``lowest`` that are tried, in rising order."""
    step = _SAMPLES_STEP if lowest < _WHOLE_SAMPLES_FROM else 1.0
    first_multiple = max(math.floor(lowest / step) + 1, math.ceil(1 / step))
    count = 8 + math.ceil(0.5 * lowest / step)
    return [step * (first_multiple + i) for i in range(count)]


def _grid_of(pixels: int, bandwidth: float, per_pixel: float, error: float) -> FineAxis:
    """Return the grid of a window with ``per_pixel`` samples per pixel; ``bandwidth`` is in cycles
    per pixel, ``error`` is the error of the filter.
    """
    taps = math.ceil(per_pixel * (1 + _filter_width(per_pixel - 2 * bandwidth, error))) + 1
    return FineAxis(pixels, bandwidth, per_pixel, error, taps)


def _decibels(error: float) -> float:
    """Return an error as the attenuation of a filter in decibels."""
    return -20 * math.log10(error)


def _filter_width(gap: float, error: float) -> float:
    """Return the width in pixels of a low-pass filter with a transition band of ``gap`` cycles per
    pixel.

    Source: Kaiser, Proc. IEEE Int. Symp. Circuits and Systems (1974), the length of a filter by its
            window.
    """
    return (_decibels(error) - 7.95) / (14.36 * gap)


def _filter_weights(grid: FineAxis, away: Tensor) -> Tensor:
    """Return the weights of samples at distances ``away`` (pixels) from the centre of a pixel."""
    places, place_shares = unit_nodes(12 + math.ceil(2 * grid.per_pixel))
    width = _filter_width(grid.per_pixel - 2 * grid.bandwidth, grid.error)
    # shape parameter of the Kaiser window for this attenuation
    beta = 0.1102 * (_decibels(grid.error) - 8.7)
    distance = away[..., None] + places
    window = torch.special.i0(beta * (1 - (2 * distance / width).square()).clamp_min(0).sqrt())
    # ideal low-pass filter times Kaiser window, averaged over the pixel
    low_pass = torch.sinc(grid.per_pixel * distance) * window.where(
        distance.abs() <= width / 2, 0.0
    )
    weights: Tensor = (
        low_pass @ place_shares / float(torch.special.i0(torch.tensor(beta, dtype=torch.float64)))
    )
    return weights


def unit_nodes(count: int) -> tuple[Tensor, Tensor]:
    """Return Gauss-Legendre nodes between -1/2 and 1/2, and their weights, which sum to one."""
    # the cache has plain numbers, because transforms of `torch.func` wrap new tensors
    nodes, weights = _nodes(count)
    return torch.tensor(nodes, dtype=torch.float64), torch.tensor(weights, dtype=torch.float64)


@functools.lru_cache(maxsize=64)
def _nodes(count: int) -> tuple[list[float], list[float]]:
    """Return Gauss-Legendre nodes between -1/2 and 1/2, and their weights, which sum to one, as
    lists.
    """
    import numpy as np

    nodes, weights = np.polynomial.legendre.leggauss(count)
    return (nodes / 2).tolist(), (weights / 2).tolist()


@dataclass(frozen=True, slots=True, eq=False)
class _AxisFilter:
    """The filter along one axis: weights of a block of pixels, which repeat in each block, and the
    places of the blocks.
    """

    block: Tensor  #: (pixel, sample) weights
    first: int  #: first sample of the first block
    stride: int  #: number of samples from one block to the next
    pixels: int
    samples: int

    def spans(self) -> list[tuple[slice, slice, Tensor]]:
        """Return for each block its pixels, its samples and the weights (pixel, sample)."""
        rows = len(self.block)
        spans = []
        for index in range(-(-self.pixels // rows)):
            pixels = slice(index * rows, min((index + 1) * rows, self.pixels))
            start = self.first + index * self.stride
            samples = slice(start, min(start + self.block.shape[1], self.samples))
            weights = self.block[: pixels.stop - pixels.start, : samples.stop - samples.start]
            spans.append((pixels, samples, weights))
        return spans


@functools.lru_cache(maxsize=256)
def _axis_filter(grid: FineAxis, dtype: torch.dtype, device: torch.device) -> _AxisFilter:
    """Return the filter along one axis of a fine grid, in blocks of pixels."""
    pixel_offsets = torch.arange(_BLOCK_PIXELS, dtype=torch.float64) - (grid.pixels - 1) / 2
    middles = (grid.samples - 1) / 2 + grid.per_pixel * pixel_offsets
    first_samples = (middles - grid.taps / 2).ceil()
    samples = first_samples[:, None] + torch.arange(grid.taps, dtype=torch.float64)
    weights = _filter_weights(
        grid, (samples[:_PLACE_PERIOD] - middles[:_PLACE_PERIOD, None]) / grid.per_pixel
    )
    first = int(first_samples[0])
    block = torch.zeros(
        _BLOCK_PIXELS, int(first_samples[-1]) - first + grid.taps, dtype=torch.float64
    )
    for row, start in enumerate(first_samples.int().tolist()):
        block[row, start - first : start - first + grid.taps] = weights[row % _PLACE_PERIOD]
    stride = round(_BLOCK_PIXELS * grid.per_pixel)
    return _AxisFilter(block.to(device, dtype), first, stride, grid.pixels, grid.samples)


class PixelFilter:
    """The average over pixels of an intensity on a fine grid (along y, then along x), and the
    adjoint operator.
    """

    def __init__(self, rows: FineAxis, columns: FineAxis, like: Tensor) -> None:
        """Get the weights in the type and on the device of ``like``, a tensor that no transform of
        `torch.func` wraps.
        """
        self.rows, self.columns = (
            _axis_filter(grid, like.dtype, like.device) for grid in (rows, columns)
        )

    def average(self, fine: Tensor) -> Tensor:
        """Return the average (y, x) over each pixel of an intensity on the fine grid."""
        row_filter, column_filter = self.rows, self.columns
        rows_averaged, averaged = (
            fine.new_empty(row_filter.pixels, column_filter.samples),
            fine.new_empty(row_filter.pixels, column_filter.pixels),
        )
        for pixels, samples, weights in row_filter.spans():
            torch.mm(weights, fine[samples], out=rows_averaged[pixels])
        for pixels, samples, weights in column_filter.spans():
            torch.mm(rows_averaged[:, samples], weights.T, out=averaged[:, pixels])
        return averaged

    def spread(self, light: Tensor) -> Tensor:
        """Return the adjoint of `average`, on the fine grid."""
        row_filter, column_filter = self.rows, self.columns
        columns_spread, spread = (
            light.new_zeros(row_filter.pixels, column_filter.samples),
            light.new_zeros(row_filter.samples, column_filter.samples),
        )
        for pixels, samples, weights in column_filter.spans():
            columns_spread[:, samples].addmm_(light[:, pixels], weights)
        for pixels, samples, weights in row_filter.spans():
            spread[samples].addmm_(weights.T, columns_spread[pixels])
        return spread


def averaged(fine: Tensor, rows: FineAxis, columns: FineAxis) -> Tensor:
    """Return the average over pixels of an intensity on the fine grid, with derivatives of any
    order.
    """
    result: Tensor = _Averaged.apply(fine, rows, columns, False)  # type: ignore[no-untyped-call]
    return result


class _Averaged(torch.autograd.Function):
    """The average over pixels or its adjoint; both are linear, so that the gradient of each is the
    other.
    """

    @staticmethod
    def forward(light: Tensor, rows: FineAxis, columns: FineAxis, adjoint: bool) -> Tensor:
        pixel_filter = PixelFilter(rows, columns, light)
        return pixel_filter.spread(light) if adjoint else pixel_filter.average(light)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.grids, ctx.adjoint = inputs[1:3], inputs[3]

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None, None]:
        return _Averaged.apply(grad.contiguous(), *ctx.grids, not ctx.adjoint), None, None, None  # type: ignore[no-untyped-call]

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, *_: Any) -> Any:
        return _Averaged.apply(tangent, *ctx.grids, ctx.adjoint)  # type: ignore[no-untyped-call]

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *inputs: Any) -> Any:
        return one_by_one(_Averaged.apply, info.batch_size, in_dims, inputs)


# --- pixel average --------------------------------------------------------------------------------

# The PSF averaged over each square pixel: intensity on a finer grid, then a short filter.
#
# The intensity |U|^2 of a pupil that is N samples wide has a bandwidth of B = N alpha cycles per
# pixel, with alpha = pupil pitch x pixel pitch / (wavelength x focal length). More than 2 B samples
# per pixel determine the intensity completely, and the filter above averages them over each pixel.
# A window within the alias-free field has at most N / B pixels. So the fine grid has at most a
# little over 2 N samples a side, for any f-number.
#
# Rule: along each axis the grid has more than 2 B samples per pixel. The number is a multiple of
# 1/4 (an integer above 8), the one with the fewest samples, where a tap of the filter counts as one
# more sample. It is the same on every machine.
# Memory: strips of pixel rows with at most `FINE_SAMPLES` samples of the fine grid, 64 MiB in
#         float32.


#: nominal error of the filter for each type of the PSF; a fringe has an error of up to 1e-8 and
#: 1e-12 of the clear peak
FILTER_ERROR = {torch.float32: 5e-10, torch.float64: 5e-15}
FINE_SAMPLES = 1 << 24  #: largest number of fine samples at a time, unless one pixel row needs more
_STRIPE_SAMPLES = 1 << 17  #: number of aperture samples that are converted to float64 at a time


class GridAxis(NamedTuple):
    """Equally spaced points along one axis of the sensor."""

    samples: int
    per_pixel: float  #: number of samples per pixel
    middle: float  #: position of the middle of the grid relative to the spot, pixels


def turns_per_pixel(pupil: Pupil, camera: Geometry, band: int) -> float:
    """Return alpha: the phase difference in turns between neighbouring pupil samples, per pixel of
    distance from the axis.
    """
    return (
        float(pupil.pitch)
        * camera.pixel_pitch
        / (float(pupil.wavelengths[band]) * camera.focal_length)
    )


def spot_position(camera: Geometry) -> list[float]:
    """Return the position (y, x) of the spot on the sensor, in pixels."""
    return [
        n // 2 + camera.focal_length * a / camera.pixel_pitch
        for n, a in zip(camera.shape, camera.angle, strict=True)
    ]


def view_on_grid(
    pupil: Pupil,
    camera: Geometry,
    band: int,
    grid: tuple[GridAxis, GridAxis],
    light: float,
    dtype: torch.dtype,
) -> View:
    """Return the settings for the intensity of a band on a grid, as the share of the clear pupil's
    light in a pixel; ``light`` is 1 over the light of the clear pupil.
    """
    alpha, wavelength = turns_per_pixel(pupil, camera, band), float(pupil.wavelengths[band])
    rows, columns = (
        Axis(n, axis.samples, alpha / axis.per_pixel)
        for n, axis in zip(pupil.height.shape, grid, strict=True)
    )
    tilt = (-alpha * grid[0].middle, -alpha * grid[1].middle)
    envelope = (
        _envelopes(grid, alpha, dtype, pupil.height.device) if camera.pixel == "zoh" else None
    )
    turns_height = float(pupil.index[band]) / wavelength
    return View(band, rows, columns, turns_height, 1 / wavelength, tilt, light * alpha**2, envelope)


def _envelopes(
    grid: tuple[GridAxis, GridAxis], alpha: float, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor]:
    """Return the diffraction envelope (sinc^2) of square pupil samples along both axes."""
    row_envelope, column_envelope = (
        plain(
            torch.sinc((centred(axis.samples, device) / axis.per_pixel + axis.middle) * alpha)
            .square()
            .to(dtype)
        )
        for axis in grid
    )
    return row_envelope, column_envelope


def fine_grid(
    pupil: Pupil, camera: Geometry, band: int, dtype: torch.dtype
) -> tuple[FineAxis, FineAxis]:
    """Return the fine grid along each axis on which the intensity of a band is computed before the
    average.
    """
    alpha = turns_per_pixel(pupil, camera, band)
    return fine_axes((pupil.height.shape[0], pupil.height.shape[1]), camera.shape, alpha, dtype)


def fine_axes(
    samples: tuple[int, int], shape: tuple[int, int], alpha: float, dtype: torch.dtype
) -> tuple[FineAxis, FineAxis]:
    """Return the fine grid of a window of ``shape`` pixels for a pupil of ``samples``."""
    y, x = (
        fine_axis(k, n * alpha, FILTER_ERROR[dtype]) for n, k in zip(samples, shape, strict=True)
    )
    return y, x


def pixel_strips(rows: FineAxis, columns: FineAxis) -> list[tuple[int, int]]:
    """Return the first row and the end row (exclusive) of each strip of pixels; the fine grid is
    computed strip by strip.
    """
    rows_of_samples = FINE_SAMPLES // columns.samples - rows.taps
    height = max(1, math.floor(rows_of_samples / rows.per_pixel))
    count = -(-rows.pixels // height)
    ends = [rows.pixels * i // count for i in range(count + 1)]
    return list(pairwise(ends))


class IntensityOptions(NamedTuple):
    """Options for the intensity: type, method of the transform, and whether focal fields are
    stored.
    """

    dtype: torch.dtype
    method: Method
    keep: bool


def band_average(
    pupil: Pupil, camera: Geometry, band: int, light: float, optics: IntensityOptions
) -> list[Tensor]:
    """Return the share of the clear pupil's light in each pixel of one band, as strips of rows (y,
    x).
    """
    rows, columns = fine_grid(pupil, camera, band, optics.dtype)
    # pixels from the spot to the middle of the window, along both axes
    middles = [
        (n - 1) / 2 - place for n, place in zip(camera.shape, spot_position(camera), strict=True)
    ]
    column_axis = GridAxis(columns.samples, columns.per_pixel, middles[1])
    averages = []
    for start, stop in pixel_strips(rows, columns):
        strip = rows.part(stop - start)
        offset_of_strip = (start + stop - camera.shape[0]) / 2
        row_axis = GridAxis(strip.samples, strip.per_pixel, middles[0] + offset_of_strip)
        view = view_on_grid(pupil, camera, band, (row_axis, column_axis), light, optics.dtype)
        sampling = Sampling((replace(view, band=0),), optics.dtype, optics.method, optics.keep)
        fine_intensity = intensity_of(pupil.amplitude, pupil.height, pupil.path, sampling)[0]
        averages.append(averaged(fine_intensity, strip, columns))
    return averages


def fine_samples(pupil: Pupil, camera: Geometry, dtype: torch.dtype) -> int:
    """Return the number of samples of the fine grids of all bands."""
    count = 0
    for band in range(pupil.wavelengths.numel()):
        rows, columns = fine_grid(pupil, camera, band, dtype)
        count += rows.samples * columns.samples
    return count


def clear_averages(aperture: Tensor, alphas: list[float], square_samples: bool) -> list[float]:
    """Return the average of |U|^2 alpha^2 over the pixel on the axis, for a pupil without phase, at
    each alpha.

    Within a pixel the phase is a smooth function of the pupil coordinates. The aperture is
    therefore projected on polynomials in these coordinates, and the intensity is summed over
    Gauss-Legendre nodes in the pixel. Bands share a projection only if they need the same number of
    polynomials, so that no result depends on the other bands. With ``square_samples`` the field has
    the envelope of square pupil samples.
    """
    projections: dict[tuple[int, ...], tuple[list[Tensor], Tensor]] = {}
    averages = []
    for alpha in alphas:
        degrees = tuple(_polynomial_count(n, alpha) for n in aperture.shape)
        if degrees not in projections:
            bases = [
                _polynomials(n, d, aperture.device)
                for n, d in zip(aperture.shape, degrees, strict=True)
            ]
            projections[degrees] = bases, _moments(aperture, *bases)
        bases, moments = projections[degrees]
        averages.append(_axis_average(moments, bases, alpha, square_samples))
    return averages


def _polynomial_count(samples: int, alpha: float) -> int:
    """Return the number of polynomials, a multiple of 8, that represent all plane waves within a
    pixel to 1e-13.
    """
    # largest phase in radians, at the edge of pupil and pixel
    radians = math.pi * alpha * samples / 2
    # a plane wave of phase r needs r + O(r^(1/3)) polynomials
    return min(samples, 8 * math.ceil((radians + 5 * math.cbrt(radians) + 10) / 8))


def _polynomials(samples: int, degrees: int, device: torch.device) -> Tensor:
    """Return orthonormal polynomials (sample, degree) on the samples of the pupil."""
    import numpy as np

    positions = (np.arange(samples) - (samples - 1) / 2) * (2 / samples)
    polynomials: Tensor = torch.from_numpy(
        np.polynomial.legendre.legvander(positions, degrees - 1)
    ).to(device)
    orthonormal: Tensor = torch.linalg.qr(polynomials).Q
    return orthonormal


def _moments(aperture: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """Return the moments (row degree, column degree) of an aperture for orthonormal polynomials,
    summed in float64 a stripe of rows at a time.
    """
    step = max(1, _STRIPE_SAMPLES // aperture.shape[1])
    moments = rows.new_zeros(rows.shape[1], columns.shape[1])
    for start in range(0, len(aperture), step):
        stripe = slice(start, start + step)
        moments += rows[stripe].T @ (aperture[stripe].detach().double() @ columns)
    return moments


def _axis_average(
    moments: Tensor, bases: list[Tensor], alpha: float, square_samples: bool
) -> float:
    """Return the average of |U|^2 alpha^2 over the pixel on the axis, from the moments of the
    pupil.
    """
    wave_by_degree, weights = [], []
    for basis in bases:
        nodes, node_shares = unit_nodes(10 + math.ceil(2 * alpha * len(basis)))
        turns = torch.outer(centred(len(basis), basis.device), nodes.to(basis.device) * alpha)
        phases = torch.complex(torch.cos(2 * math.pi * turns), -torch.sin(2 * math.pi * turns))
        wave_by_degree.append(basis.T.to(phases.dtype) @ phases)
        envelope = torch.sinc(nodes * alpha).square() if square_samples else 1.0
        weights.append((node_shares * envelope).to(basis.device))
    focal_field = wave_by_degree[0].T @ moments.to(wave_by_degree[0].dtype) @ wave_by_degree[1]
    return float(weights[0] @ focal_field.abs().square() @ weights[1]) * alpha**2
