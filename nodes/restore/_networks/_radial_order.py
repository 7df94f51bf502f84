"""The order of a picture's frequencies from the lowest to the highest."""

import functools

import torch
from torch import Tensor


@functools.lru_cache(maxsize=32)
def radial_order(size: tuple[int, int], device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the positions in the half spectrum of a (y, x) picture by rising radius, and the rank of each position.

    Radii are in cycles per pixel. Equal radii are ordered by angle, from -90 to 90 degrees.
    """
    y, x = size
    with torch.inference_mode(False):  # the cache may serve a caller that trains
        rows = torch.fft.fftfreq(y, 1 / y, dtype=torch.float64).round().long()[:, None] * x
        columns = torch.arange(x // 2 + 1)[None] * y
        radius = (rows * rows + columns * columns).flatten()  # whole numbers, so that equal radii compare equal
        angle = torch.atan2(rows.double(), columns.double()).flatten()
        order = angle.argsort(stable=True)
        order = order[radius[order].argsort(stable=True)]
        return order.to(device), order.argsort().to(device)
