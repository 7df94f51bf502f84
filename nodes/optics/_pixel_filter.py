"""The filter that averages an intensity over square pixels, given the intensity on a finer grid.

The intensity of a pupil of finite width is band-limited. On a grid of more than twice its bandwidth the intensity
between the samples is known, so that its average over a pixel is a short sum of samples. The weights of this sum are
the average over a pixel of a low-pass filter, which passes the band of the intensity and stops its repetitions.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from neusee.nodes.torch_func import one_by_one

_STEP = 0.25  #: samples a pixel are a multiple of this, and whole numbers from `_WHOLE` on
_WHOLE = 8
_PERIOD = 4  #: pixels after which the places of the pixels between the samples repeat
_ROWS = 16  #: pixels whose weights form one dense matrix


@dataclass(frozen=True, slots=True)
class FineAxis:
    """A grid along one axis of a window, fine enough for the intensity, and the length of the filter on this grid.

    The middle of the grid is the middle of the window.
    """

    pixels: int
    bandwidth: float  #: of the intensity, in cycles a pixel
    per_pixel: float  #: samples a pixel
    error: float  #: of the filter, relative to the brightest sample that it reaches
    taps: int

    @property
    def samples(self) -> int:
        """Return the number of samples, which reach beyond the window by half a filter on each side."""
        return math.ceil(self.per_pixel * (self.pixels - 1)) + self.taps

    def part(self, pixels: int) -> FineAxis:
        """Return the grid of a part of the window."""
        return FineAxis(pixels, self.bandwidth, self.per_pixel, self.error, self.taps)


def fine_axis(pixels: int, bandwidth: float, error: float) -> FineAxis:
    """Return the grid with the fewest samples, each tap of the filter counted twice, for its products.

    The grid has more than ``2 bandwidth`` samples a pixel, and at least one.
    """
    grids = (_grid(pixels, bandwidth, m, error) for m in _samples_per_pixel(2 * bandwidth))
    return min(grids, key=lambda grid: grid.samples + grid.taps)


def _samples_per_pixel(least: float) -> list[float]:
    step = _STEP if least < _WHOLE else 1.0
    first = max(math.floor(least / step) + 1, math.ceil(1 / step))
    count = 8 + math.ceil(0.5 * least / step)
    return [step * (first + i) for i in range(count)]


def _grid(pixels: int, bandwidth: float, per_pixel: float, error: float) -> FineAxis:
    taps = math.ceil(per_pixel * (1 + _width(per_pixel - 2 * bandwidth, error))) + 1
    return FineAxis(pixels, bandwidth, per_pixel, error, taps)


def _decibels(error: float) -> float:
    return -20 * math.log10(error)


def _width(gap: float, error: float) -> float:
    """Return the width in pixels of a low-pass filter whose pass and stop band are ``gap`` cycles a pixel apart.

    Source: Kaiser, Proc. IEEE Int. Symp. Circuits and Systems (1974), the length of a filter by its window.
    """
    return (_decibels(error) - 7.95) / (14.36 * gap)


def _weights(grid: FineAxis, away: Tensor) -> Tensor:
    """Return the weights of samples at distances ``away`` in pixels from the middle of a pixel."""
    nodes, shares = unit_nodes(12 + math.ceil(2 * grid.per_pixel))
    width = _width(grid.per_pixel - 2 * grid.bandwidth, grid.error)
    beta = 0.1102 * (_decibels(grid.error) - 8.7)
    at = away[..., None] + nodes
    window = torch.special.i0(beta * (1 - (2 * at / width).square()).clamp_min(0).sqrt())
    low_pass = torch.sinc(grid.per_pixel * at) * window.where(at.abs() <= width / 2, 0.0)
    weights: Tensor = low_pass @ shares / float(torch.special.i0(torch.tensor(beta, dtype=torch.float64)))
    return weights


def unit_nodes(count: int) -> tuple[Tensor, Tensor]:
    """Return Gauss-Legendre nodes between -1/2 and 1/2, and their weights, which sum to one."""
    nodes, weights = _nodes(count)  # kept as numbers, because a transform of `torch.func` wraps new tensors
    return torch.tensor(nodes, dtype=torch.float64), torch.tensor(weights, dtype=torch.float64)


@functools.lru_cache(maxsize=64)
def _nodes(count: int) -> tuple[list[float], list[float]]:
    import numpy as np

    x, w = np.polynomial.legendre.leggauss(count)
    return (x / 2).tolist(), (w / 2).tolist()


@dataclass(frozen=True, slots=True, eq=False)
class _AxisFilter:
    """The weights of a block of pixels, the same for every block, and the first sample of each block."""

    block: Tensor  #: (pixel, sample)
    first: int  #: sample of the first block
    stride: int  #: samples between blocks
    pixels: int
    samples: int

    def spans(self) -> list[tuple[slice, slice, Tensor]]:
        """Return the pixels and the samples of each block, and the weights between them."""
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
    pixels = torch.arange(_ROWS, dtype=torch.float64) - (grid.pixels - 1) / 2
    middles = (grid.samples - 1) / 2 + grid.per_pixel * pixels
    firsts = (middles - grid.taps / 2).ceil()
    samples = firsts[:, None] + torch.arange(grid.taps, dtype=torch.float64)
    weights = _weights(grid, (samples[:_PERIOD] - middles[:_PERIOD, None]) / grid.per_pixel)
    first = int(firsts[0])
    block = torch.zeros(_ROWS, int(firsts[-1]) - first + grid.taps, dtype=torch.float64)
    for row, start in enumerate(firsts.int().tolist()):
        block[row, start - first : start - first + grid.taps] = weights[row % _PERIOD]
    stride = round(_ROWS * grid.per_pixel)
    return _AxisFilter(block.to(device, dtype), first, stride, grid.pixels, grid.samples)


class PixelFilter:
    """The average over pixels of an intensity on a fine grid, along y and then along x, and its adjoint."""

    def __init__(self, rows: FineAxis, columns: FineAxis, like: Tensor) -> None:
        """Take the weights in the type and on the device of ``like``, which no transform of `torch.func` wraps."""
        self.rows, self.columns = (_axis_filter(grid, like.dtype, like.device) for grid in (rows, columns))

    def average(self, fine: Tensor) -> Tensor:
        """Return the average (y, x) over each pixel of an intensity on the fine grid."""
        y, x = self.rows, self.columns
        half, out = fine.new_empty(y.pixels, x.samples), fine.new_empty(y.pixels, x.pixels)
        for pixels, samples, weights in y.spans():
            torch.mm(weights, fine[samples], out=half[pixels])
        for pixels, samples, weights in x.spans():
            torch.mm(half[:, samples], weights.T, out=out[:, pixels])
        return out

    def spread(self, light: Tensor) -> Tensor:
        """Return the adjoint of `average`, on the fine grid."""
        y, x = self.rows, self.columns
        half, out = light.new_zeros(y.pixels, x.samples), light.new_zeros(y.samples, x.samples)
        for pixels, samples, weights in x.spans():
            half[:, samples].addmm_(light[:, pixels], weights)
        for pixels, samples, weights in y.spans():
            out[samples].addmm_(weights.T, half[pixels])
        return out


def averaged(fine: Tensor, rows: FineAxis, columns: FineAxis) -> Tensor:
    """Return the average over pixels of an intensity on the fine grid, with derivatives of any order."""
    result: Tensor = _Averaged.apply(fine, rows, columns, False)  # type: ignore[no-untyped-call]
    return result


class _Averaged(torch.autograd.Function):
    """The average over pixels or its adjoint, both linear, so that each is the derivative of the other."""

    @staticmethod
    def forward(light: Tensor, rows: FineAxis, columns: FineAxis, adjoint: bool) -> Tensor:
        over = PixelFilter(rows, columns, light)
        return over.spread(light) if adjoint else over.average(light)

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
