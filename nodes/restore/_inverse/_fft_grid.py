"""The periodic grid on which a picture is deblurred: unknown pixels around the picture, fast FFTs, PSFs on it."""

import math

import torch
from torch import Tensor
from torch.nn.functional import pad

from neusee.nodes.restore._inverse._masked_blur import Size

_LIGHT = 0.999  #: share of the light that the unknown border around the picture is wide enough for
DENSE = 20  #: pixels a side, up to which a picture is solved exactly


def torus(picture: Size, edge: Size) -> Size:
    """Return the size of a periodic grid for the picture and `edge` unknown pixels on each side."""
    whole = 2 ** halvings(picture)
    y, x = (whole * _smooth(-(-(n + 2 * e) // whole)) for n, e in zip(picture, edge, strict=True))
    return y, x


def _smooth(n: int) -> int:
    """Return the least whole number of at least ``n`` without prime factors above 7, for which FFTs are fast."""
    while 210**32 % n:
        n += 1
    return n


def halvings(picture: Size) -> int:
    """Return how often the grid of a picture is halved until the picture is small enough to be solved exactly."""
    return max(0, math.ceil(math.log2(max(picture) / DENSE)))


def edge(kernels: Tensor, picture: tuple[int, int]) -> tuple[int, int]:
    """Return the radii (y, x) that hold 99.9 % of the PSF, at most the larger of 256 pixels and half the picture."""
    reach = []
    for dim, size in ((-1, picture[0]), (-2, picture[1])):
        profile = kernels.detach().sum((0, dim)).double()
        radius = (torch.arange(len(profile), device=profile.device) - len(profile) // 2).abs()
        inside = profile.new_zeros(int(radius.max()) + 1).index_add(0, radius, profile).cumsum(0)
        reach.append(min(int((inside < _LIGHT * inside[-1]).sum()), max(256, size // 2), size))
    return reach[0], reach[1]


def wrapped(kernels: Tensor, size: tuple[int, int]) -> Tensor:
    """Return PSFs centred on the first sample of a periodic grid; a PSF wider than the grid wraps around."""
    (m, n), (y, x) = kernels.shape[-2:], size
    rows, columns = -(-m // y), -(-n // x)
    around = pad(kernels, (0, columns * x - n, 0, rows * y - m))
    if rows * columns > 1:
        around = around.reshape(-1, rows, y, columns, x).sum((1, 3))
    return around.roll((-(m // 2), -(n // 2)), (-2, -1))
