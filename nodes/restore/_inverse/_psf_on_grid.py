"""A PSF on the periodic grid of a picture, and how far it reaches."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import pad

_LIGHT = 0.999  #: share of the light that the unknown border around the picture is wide enough for


def edge(kernels: Tensor, picture: tuple[int, int]) -> tuple[int, int]:
    """Return the radii (y, x) that hold 99.9 % of the PSF, at most the larger of 256 pixels and half the picture."""
    reach = []
    for dim, size in ((-1, picture[0]), (-2, picture[1])):
        profile = kernels.detach().sum((0, dim)).double()
        radius = (torch.arange(len(profile), device=profile.device) - len(profile) // 2).abs()
        inside = profile.new_zeros(int(radius.max()) + 1).index_add(0, radius, profile).cumsum(0)
        reach.append(min(int((inside < _LIGHT * inside[-1]).sum()), max(256, size // 2), size))
    return reach[0], reach[1]


def bordered(reach: tuple[int, int], border: float) -> tuple[int, int]:
    """Return the width (y, x) of the unknown border around a picture, ``border`` times the reach of the PSF."""
    return math.ceil(border * reach[0]), math.ceil(border * reach[1])


def wrapped(kernels: Tensor, size: tuple[int, int]) -> Tensor:
    """Return PSFs centred on the first sample of a periodic grid; a PSF wider than the grid wraps around."""
    (m, n), (y, x) = kernels.shape[-2:], size
    rows, columns = -(-m // y), -(-n // x)
    around = pad(kernels, (0, columns * x - n, 0, rows * y - m))
    if rows * columns > 1:
        around = around.reshape(-1, rows, y, columns, x).sum((1, 3))
    return around.roll((-(m // 2), -(n // 2)), (-2, -1))
