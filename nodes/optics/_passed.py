"""What a stack of PSFs lets through inside and outside of windows about its centre."""

from typing import NamedTuple

import torch
from torch import Tensor

_SAMPLES = 1 << 16  #: of a band at a time: those of 31 bands stay in the cache
_LADDER = (1.0, 0.75, 0.5, 0.375, 0.25, 0.1875, 0.125, 0.0625, 0.03125, 0.015625)


class Passed(NamedTuple):
    """By window, the largest first, and band; on the CPU, float64."""

    windows: list[tuple[int, int]]
    total: Tensor  #: (band,) sum of |PSF|
    peak: Tensor  #: (band,) its largest
    beyond: Tensor  #: (window, band) sum of |PSF| outside
    above: Tensor  #: (window, band) the largest outside


def passed(intensity: Tensor, cut: bool) -> Passed:
    """Measure (band, y, x); without ``cut`` the whole is the only window."""
    m, n = intensity.shape[1:]
    steps = _LADDER if cut else _LADDER[:1]
    windows = list(dict.fromkeys((max(1, round(m * f)), max(1, round(n * f))) for f in steps))
    sums, tops = [torch.zeros(len(intensity), dtype=torch.float64)], [torch.zeros(len(intensity), dtype=torch.float64)]
    inside = intensity
    for window in windows[1:]:
        inner = centred(inside, window)
        parts = [_measured(strip) for strip in _around(inside, window)]
        sums.append(sums[-1] + sum(part[0] for part in parts))
        tops.append(torch.stack([tops[-1], *(part[1] for part in parts)]).amax(0))
        inside = inner
    core, top = _measured(inside)
    return Passed(windows, sums[-1] + core, torch.maximum(tops[-1], top), torch.stack(sums), torch.stack(tops))


def centred(stack: Tensor, window: tuple[int, int]) -> Tensor:
    """The samples of a window about the centre, sample n // 2, which is then the window's own."""
    top, left = _corner(stack, window)
    return stack[:, top : top + window[0], left : left + window[1]]


def _corner(stack: Tensor, window: tuple[int, int]) -> tuple[int, int]:
    return stack.shape[1] // 2 - window[0] // 2, stack.shape[2] // 2 - window[1] // 2


def _around(stack: Tensor, window: tuple[int, int]) -> list[Tensor]:
    """What lies outside the window, in four strips."""
    (top, left), (h, w) = _corner(stack, window), window
    middle = stack[:, top : top + h]
    return [stack[:, :top], stack[:, top + h :], middle[..., :left], middle[..., left + w :]]


def _measured(strip: Tensor) -> tuple[Tensor, Tensor]:
    """Sum and largest of |samples|, by band; the sum a little above what rounding may have lost."""
    if strip.shape[1] == 0 or strip.shape[2] == 0:
        zero = torch.zeros(len(strip), dtype=torch.float64)
        return zero, zero
    step = strip.shape[1] if strip.is_cuda else max(1, _SAMPLES // strip.shape[2])
    parts = [_looked_at(strip[:, y : y + step]) for y in range(0, strip.shape[1], step)]
    total, top = (torch.stack(found) for found in zip(*parts, strict=True))
    return total.sum(0).cpu() * (1 + 1e-6), top.amax(0).double().cpu()


def _looked_at(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Sum and largest of |samples| of some rows, which are read from memory once."""
    low, high = rows.amin(-1).amin(-1), rows.amax(-1).amax(-1)  # `aminmax` takes three times as long
    size = rows if bool((low >= 0).all()) else rows.abs()
    return size.sum(-1).sum(-1, dtype=torch.float64), torch.maximum(high, -low)
