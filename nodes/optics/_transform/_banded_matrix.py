"""Banded matrices stored as batches of small dense matrices, so that interpolation is a matrix product."""

import copy
import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

_SLACK = 8  #: columns of zeros that let blocks of unequal spacing share one stride


class _Run(NamedTuple):
    """A range of matrix blocks whose first columns are equally spaced: start, start + stride and so on."""

    first: int
    blocks: int
    start: int
    stride: int

    @property
    def starts(self) -> list[int]:
        return [self.start + i * self.stride for i in range(self.blocks)]


class Banded:
    """A banded matrix, whose row ``i`` is nonzero only in the columns within ``reach`` of ``origin + step i``.

    ``n_rows`` is rounded up to whole blocks; the extra rows are finite and meaningless. The other factor of a product
    needs ``margin`` zeros before and behind its ``n_columns`` samples, so that all blocks have the same size.
    """

    def __init__(self, n_rows: int, n_columns: int, origin: float, step: float, reach: float, block: int) -> None:
        self.n_columns, self.reach = n_columns, reach
        self.count = -(-n_rows // block)
        self.block = -(-n_rows // self.count)
        self.n_rows = self.count * self.block
        self.origin, self.step = origin, step
        first = [math.ceil(self._at(b * self.block) - reach) for b in range(self.count)]
        last = [math.floor(self._at((b + 1) * self.block - 1) + reach) for b in range(self.count)]
        self.width = max(z - a for a, z in zip(first, last, strict=True)) + 1 + _SLACK
        self.runs = _runs([z + 1 - self.width for z in last], first, step * self.block)
        starts = [start for run in self.runs for start in run.starts]
        self.margin = max(0, -min(starts), max(starts) + self.width - n_columns)
        self.weights = torch.empty(0)

    def _at(self, row: int) -> float:
        return self.origin + self.step * row

    def fill(self, weigh: Callable[[Tensor, Tensor], Tensor]) -> "Banded":
        """Set the matrix to ``weigh(row, column)`` within the band and to zero outside; the indices are float64."""
        starts = [start for run in self.runs for start in run.starts]
        columns = torch.tensor(starts, dtype=torch.float64)[:, None, None] + torch.arange(self.width)
        rows = torch.arange(self.n_rows, dtype=torch.float64).view(self.count, self.block, 1)
        near = (columns - (self.origin + self.step * rows)).abs_() <= self.reach
        self.weights = torch.where(near, weigh(rows, columns), 0.0)
        return self

    def to(self, dtype: torch.dtype, device: torch.device) -> "Banded":
        """Convert the matrix to ``dtype`` and move the matrix to ``device``."""
        self.weights = self.weights.to(device, dtype)
        return self

    def part(self, first: int, last: int) -> "Banded":
        """Return the part of the banded matrix from block ``first`` up to, but without, block ``last``."""
        part = copy.copy(self)
        part.count, part.n_rows = last - first, (last - first) * self.block
        part.weights, part.runs = self.weights[first:last], []
        for run in self.runs:
            a, z = max(run.first, first), min(run.first + run.blocks, last)
            if a < z:
                part.runs.append(_Run(a - first, z - a, run.start + (a - run.first) * run.stride, run.stride))
        return part

    def left(self, x: Tensor, out: Tensor) -> None:
        """Write ``matrix @ x[margin + n_columns + margin, c]`` to ``out[n_rows, c]``; ``x`` may have a row stride."""
        wide, pitch = x.shape[1], x.stride(0)
        blocks = out.view(self.count, self.block, wide)
        for first, count, start, stride in self.runs:
            at = (start + self.margin) * pitch + x.storage_offset()
            view = x.as_strided((count, self.width, wide), (stride * pitch, pitch, 1), at)
            _multiply(self.weights[first : first + count], view, blocks[first : first + count])

    def right(self, x: Tensor, out: Tensor) -> None:
        """Write ``x[r, margin + n_columns + margin] @ matrix^T`` to ``out[block, r, i]``, in blocks of matrix rows."""
        tall, wide = x.shape
        for first, count, start, stride in self.runs:
            at = start + self.margin + x.storage_offset()
            view = x.as_strided((count, tall, self.width), (stride, wide, 1), at)
            _multiply(view, self.weights[first : first + count].transpose(1, 2), out[first : first + count])


def _multiply(a: Tensor, b: Tensor, out: Tensor) -> None:
    """Multiply two batches of matrices; fewer than 8 products run one after another, each on all threads."""
    if len(a) >= 8:
        torch.bmm(a, b, out=out)
        return
    for x, y, z in zip(a, b, out, strict=True):
        torch.mm(x, y, out=z)


def _runs(low: list[int], high: list[int], pace: float) -> list[_Run]:
    """Return a few runs of matrix blocks with equally spaced first columns, each column from ``low`` to ``high``."""
    runs: list[_Run] = []
    first = 0
    while first < len(low):
        run = max(
            (_longest(low, high, first, stride) for stride in (math.floor(pace), math.ceil(pace))),
            key=lambda r: r.blocks,
        )
        runs.append(run)
        first += run.blocks
    return runs


def _longest(low: list[int], high: list[int], first: int, stride: int) -> _Run:
    a, z, count = low[first], high[first], 0
    while first + count < len(low):
        lower, upper = max(a, low[first + count] - stride * count), min(z, high[first + count] - stride * count)
        if lower > upper:
            break
        a, z, count = lower, upper, count + 1
    return _Run(first, count, z, stride)
