"""The logarithm of a frame on a coarse grid of cells, from pixels that are not clipped."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

MOST = 12  #: cells along the longer side of a frame
_PIXELS = 2  #: least pixels of a cell along a side
_SEEN = 0.5  #: least share of a cell's pixels that are not clipped
_DARK = 5.0  #: standard deviations of noise, below which the light of a cell has no logarithm to trust


class Cells(NamedTuple):
    """A frame on the coarse grid."""

    log: Tensor  #: (cell,) float64, logarithm of the mean electrons of a cell; 0 where not seen
    seen: Tensor  #: (cell,) bool: False for a cell that is clipped or too dark


def grid(shape: tuple[int, int]) -> tuple[int, int]:
    """Return the numbers of cells along y and x, which are nearly squares."""
    pixels = max(_PIXELS, *(-(-n // MOST) for n in shape))
    y, x = (max(2, round(n / pixels)) for n in shape)
    return y, x


def cells_of(electrons: Tensor, clipped: Tensor, read_noise: float) -> Cells:
    """Return the logarithm of the mean light in each cell of a frame; a field that is smooth adds its own logarithm.

    Shapes: electrons (channel, y, x), clipped (y, x) bool. Units: e-.
    """
    cells = grid((electrons.shape[-2], electrons.shape[-1]))
    open_ = (~clipped).double()
    light = electrons.double().sum(0) * open_
    noise = (light.clamp_min(0.0) + len(electrons) * read_noise**2) * open_
    count, total, variance = (_summed(each, cells) for each in (open_, light, noise))
    whole = _summed(torch.ones_like(open_), cells)
    seen = (count >= _SEEN * whole) & (total > _DARK * variance.sqrt()) & (count > 0)
    log = torch.where(seen, (total / count.clamp_min(1.0)).clamp_min(1e-300).log(), 0.0)
    return Cells(log.flatten(), seen.flatten())


def _summed(values: Tensor, cells: tuple[int, int]) -> Tensor:
    """Sum a picture (y, x) over its cells."""
    rows, columns = (_numbers(n, k, values) for n, k in zip(values.shape, cells, strict=True))
    found = values.new_zeros(cells[0], values.shape[1]).index_add_(0, rows, values)
    return values.new_zeros(cells).index_add_(1, columns, found)


def _numbers(pixels: int, cells: int, like: Tensor) -> Tensor:
    return torch.arange(pixels, device=like.device) * cells // pixels


def at_pixels(values: Tensor, shape: tuple[int, int]) -> Tensor:
    """Interpolate values (y, x) at the centres of the cells to all pixels, by cubic splines through these values."""
    for axis, pixels in enumerate(shape):
        values = torch.tensordot(_spline(values.shape[axis], pixels), values.movedim(axis, 0), 1).movedim(0, axis)
    return values


def _spline(cells: int, pixels: int) -> Tensor:
    """Return the matrix (pixel, cell) of the cubic spline through the centres of cells, constant beyond the ends."""
    from scipy.interpolate import CubicSpline

    edges = torch.arange(cells + 1, dtype=torch.float64) * pixels / cells
    centres = (edges.ceil()[1:] + edges.ceil()[:-1] - 1) / 2
    places = torch.arange(pixels, dtype=torch.float64).clamp(centres[0], centres[-1])
    found = CubicSpline(centres.numpy(), torch.eye(cells, dtype=torch.float64).numpy(), bc_type="clamped")(places)
    return torch.from_numpy(found)
