"""The light of a PSF inside and outside of windows about the centre of the PSF."""

from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

_LADDER = (1.0, 0.75, 0.5, 0.375, 0.25, 0.1875, 0.125, 0.0625, 0.03125, 0.015625)
_ROUNDED = 4e-6  #: relative round-off of a float32 sum: a few nested sums of a few dozen additions each


class Passed(NamedTuple):
    """Sums and maxima of the PSF of each band, inside and outside of windows, as float64 tensors on the CPU."""

    windows: list[tuple[int, int]]  #: the largest first
    total: Tensor  #: (band,) sum of |PSF|
    peak: Tensor  #: (band,) maximum of |PSF|
    beyond: Tensor  #: (window, band) sum of |PSF| outside the window
    above: Tensor  #: (window, band) maximum of |PSF| outside the window
    signed: bool  #: the PSF is negative somewhere


def passed(intensity: Tensor) -> Passed:
    """Return the sums and maxima of PSFs (band, y, x), with the whole PSF as the only window."""
    ends = [torch.aminmax(band) for band in intensity]  # a maximum over several dimensions takes three times as long
    low, high = (torch.stack(found).double().cpu() for found in zip(*ends, strict=True))
    signed = not bool((low >= 0).all())  # True for NaN too
    rows = (intensity.abs() if signed else intensity).sum(2)
    total = rows.sum(1, dtype=torch.float64).cpu() * (1 + _ROUNDED)
    nothing = torch.zeros_like(total)[None]
    window = (intensity.shape[1], intensity.shape[2])
    return Passed([window], total, torch.maximum(high, -low), nothing, nothing, signed)


def by_window(intensity: Tensor, signed: bool) -> Passed:
    """Return the sums and maxima of PSFs (band, y, x) for nested windows.

    The edges of the windows cut each PSF into pieces, and each piece is read once.
    """
    m, n = intensity.shape[1:]
    windows = list(dict.fromkeys((max(1, round(m * f)), max(1, round(n * f))) for f in _LADDER))
    tall, wide = ([_inside(whole, w[axis]) for w in windows] for axis, whole in enumerate((m, n)))
    sums, tops = _pieces(intensity.abs() if signed else intensity, _cuts(tall), _cuts(wide))
    beyond, above = torch.zeros(2, len(windows), len(intensity), dtype=torch.float64)
    for j, (y, x) in enumerate(zip(tall, wide, strict=True)):
        outside = ~torch.outer(_covered(y, _cuts(tall)), _covered(x, _cuts(wide)))
        if bool(outside.any()):
            beyond[j], above[j] = sums[:, outside].sum(1), tops[:, outside].amax(1)
    return Passed(windows, sums.sum((1, 2)), tops.amax((1, 2)), beyond, above, signed)


def spread(of: Passed, share: Tensor | None) -> Passed:
    """Return bounds for bands whose PSFs are weighted means, with weights ``share`` (band, j), of the measured PSFs."""
    if share is None:
        return of
    beyond, above = of.beyond @ share.T, of.above @ share.T
    return Passed(of.windows, share @ of.total, share @ of.peak, beyond, above, of.signed)


def centred(stack: Tensor, window: tuple[int, int]) -> Tensor:
    """Return the samples of each PSF in a window about the central sample n // 2."""
    (top, bottom), (left, right) = (_inside(n, w) for n, w in zip(stack.shape[1:], window, strict=True))
    return stack[:, top:bottom, left:right]


def _inside(whole: int, window: int) -> tuple[int, int]:
    first = whole // 2 - window // 2
    return first, first + window


def _cuts(spans: list[tuple[int, int]]) -> list[int]:
    return sorted({edge for span in spans for edge in span})


def _covered(span: tuple[int, int], cuts: list[int]) -> Tensor:
    """Return True for each interval between two neighbouring cuts that lies inside the span."""
    return torch.tensor([span[0] <= cut < span[1] for cut in cuts[:-1]])


def _pieces(size: Tensor, rows: list[int], columns: list[int]) -> tuple[Tensor, Tensor]:
    """Return the sum, rounded up, and the maximum of each rectangular piece of a PSF, both (band, rows, columns).

    A few large calls are faster than many small calls, each of which waits for other work on the machine.
    """
    along = [(size[:, a:b].sum(1), size[:, a:b].amax(1)) for a, b in pairwise(rows)]
    sums, tops = (torch.stack(found, 1).double().cpu() for found in zip(*along, strict=True))
    total = torch.stack([sums[..., a:b].sum(-1) for a, b in pairwise(columns)], -1) * (1 + _ROUNDED)
    return total, torch.stack([tops[..., a:b].amax(-1) for a, b in pairwise(columns)], -1)
