"""The frequencies of a picture in one line, from the lowest to the highest."""

import functools

import torch
from torch import Tensor


@functools.lru_cache(maxsize=32)
def radial_order(size: tuple[int, int], device: torch.device) -> tuple[Tensor, Tensor]:
    """Where in the half spectrum of a (y, x) picture the frequencies of rising radius stand, and each one's rank.

    Radii in cycles a pixel; those of one radius follow by their angle, from -90 to 90 degrees.
    """
    y, x = size
    with torch.inference_mode(False):  # kept for others, who may learn
        rows = torch.fft.fftfreq(y, 1 / y, dtype=torch.float64).round().long()[:, None] * x
        columns = torch.arange(x // 2 + 1)[None] * y
        radius = (rows * rows + columns * columns).flatten()  # whole numbers: equal where they are
        angle = torch.atan2(rows.double(), columns.double()).flatten()
        order = angle.argsort(stable=True)
        order = order[radius[order].argsort(stable=True)]
        return order.to(device), order.argsort().to(device)
