"""Restoration of a picture in tiles of the size that a network was trained on, joined without seams."""

import math
from collections.abc import Callable
from itertools import product

import torch
from torch import Tensor

_OVERLAP = 0.25  #: least share of a tile's side that overlaps the next tile


def tiled(change: Callable[[Tensor], Tensor], picture: Tensor, side: int) -> Tensor:
    """Apply ``change`` to a picture (n, 3, y, x) tile by tile, and return the weighted mean where tiles overlap.

    Weights fall linearly towards an edge beyond which another tile continues, so that tiles join without a step. Tiles
    lie inside the picture; a picture that is no larger than a tile is changed as a whole.
    """
    size = (picture.shape[-2], picture.shape[-1])
    if max(size) <= side:
        return change(picture)
    total, weights = torch.zeros_like(picture), picture.new_zeros(size)
    rows, columns = (_starts(n, side) for n in size)
    for top, left in product(rows, columns):
        part = (..., slice(top, top + side), slice(left, left + side))
        weight = torch.outer(*(_ramp(start, side, n, picture) for start, n in zip((top, left), size, strict=True)))
        total[part] += change(picture[part]) * weight
        weights[part] += weight
    return total / weights


def _starts(length: int, side: int) -> list[int]:
    """Return the first pixel of each tile along an axis, for the fewest even tiles that overlap by `_OVERLAP`."""
    if length <= side:
        return [0]
    count = 1 + math.ceil((length - side) / (side * (1 - _OVERLAP)))
    return [round(i * (length - side) / (count - 1)) for i in range(count)]


def _ramp(start: int, side: int, length: int, like: Tensor) -> Tensor:
    """Return the blending weights of a tile along one axis: 1, falling to almost 0 at tile edges inside the picture."""
    side = min(side, length)
    at = torch.arange(side, dtype=like.dtype, device=like.device) + 0.5
    rise = (at / (side * _OVERLAP)).clamp(max=1.0)
    ramp = torch.ones_like(at)
    if start > 0:
        ramp = ramp * rise
    if start + side < length:
        ramp = ramp * rise.flip(0)
    return ramp
