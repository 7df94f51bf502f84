"""Statistics and error bounds of tensors, which an engine reads in place of the tensors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch import Tensor

_FEW = 64  #: up to this many elements, a loop in Python is faster than five calls of torch
_PART, _ROW = 1 << 17, 1 << 10  #: elements of one part, and elements that are summed in the precision of the tensor
_SUMMED = 1e-4  #: relative round-off of a sum, which float32 rows of 1024 elements keep far below


@dataclass(frozen=True, slots=True)
class TensorStats:
    """Statistics of a tensor, such as range and sum, which are stored so that the tensor need not be loaded."""

    shape: tuple[int, ...]
    dtype: str
    min: float
    max: float
    sum: float
    support: int  #: elements that are not zero
    finite: bool

    @classmethod
    def of(cls, value: Any) -> TensorStats | None:
        """Return the statistics of a tensor, or of the first tensor in a named tuple; return None for other values."""
        from torch import Tensor  # here, so that a command that computes nothing need not import torch

        if isinstance(value, tuple | list) and value:
            return cls.of(value[0])
        if not isinstance(value, Tensor):
            return None
        x = value.detach()
        shape, dtype = tuple(x.shape), str(x.dtype).removeprefix("torch.")
        if x.numel() == 0:
            return cls(shape, dtype, math.nan, math.nan, 0.0, 0, True)
        x = x.abs() if x.is_complex() else x
        few = x.reshape(-1).tolist() if x.numel() <= _FEW else []
        if few and math.isfinite(total := float(sum(few))):
            return cls(shape, dtype, float(min(few)), float(max(few)), total, sum(v != 0 for v in few), True)
        low, high, total, support = _measure(x.reshape(-1))
        finite = all(map(math.isfinite, (low, high, total)))
        return cls(shape, dtype, low, high, total, support, finite)

    @property
    def largest_rms(self) -> float:
        """Return the largest root mean square that a tensor of this count, minimum, maximum and sum can have.

        The squares are largest where all elements but one are at an end of the range. Without a finite sum, every
        element may be at the farther end.
        """
        low, high, count = self.min, self.max, math.prod(self.shape)
        farthest = max(abs(low), abs(high))
        if count == 0 or high <= low or not math.isfinite(self.sum):
            return farthest
        at_top = min(max((self.sum - count * low) / (high - low), 0.0), count)
        between = low + (at_top - math.floor(at_top)) * (high - low)
        at_bottom = max(count - math.floor(at_top) - 1, 0)
        squares = math.floor(at_top) * high**2 + between**2 + at_bottom * low**2
        return min(farthest, math.sqrt(squares / count) * (1 + _SUMMED))


def _measure(flat: Tensor) -> tuple[float, float, float, int]:
    """Return minimum, maximum, sum and number of nonzero elements of a flat tensor, in parts for the CPU cache."""
    import torch

    small = flat.dtype == torch.bool or (flat.is_floating_point() and flat.element_size() < 4)
    parts = []
    for part in torch.split(flat, _PART):
        part = part.float() if small else part
        rows = part.view(-1, _ROW) if part.numel() % _ROW == 0 else part[None]
        parts.append((*torch.aminmax(part), rows.sum(1).sum(dtype=torch.float64), torch.count_nonzero(part)))
    lows, highs, sums, counts = (torch.stack(each) for each in zip(*parts, strict=True))
    low, high, total = (float(x) for x in (lows.min(), highs.max(), sums.sum()))
    if math.isinf(total) and math.isfinite(low) and math.isfinite(high):  # the sum of a row overflowed
        total = float(sum(part.sum(dtype=torch.float64) for part in torch.split(flat, _PART)))
    return low, high, total, int(counts.sum())


@dataclass(frozen=True, slots=True)
class ErrorBound:
    """A bound, or an estimate, of the error of an input of a node, with the statistics of this input."""

    rms: float  #: bound of the root mean square error over the elements, in the unit of the input
    stats: TensorStats | None = None
    #: bound of the error of the largest element, as a share of this element; None if it is unknown
    peak: float | None = None
    estimated: bool = False  #: True if the error counts an estimate; else it is a proved upper bound
    #: part of `rms` that changes from element to element like noise; the other part is like the light itself
    scattered: float = 0.0

    @property
    def top(self) -> float:
        """Return the largest absolute element of the input, or 0 if nothing is known of the input."""
        return max(abs(self.stats.min), abs(self.stats.max)) if self.stats else 0.0

    @property
    def share(self) -> float:
        """Return the bound of the rms error of a node input, relative to the largest absolute element of the input."""
        if self.rms == 0.0:
            return 0.0
        return self.rms / self.top if self.top > 0 else math.inf

    @property
    def largest(self) -> float:
        """Return the bound of the relative error of the largest element of a node input, or inf if unknown."""
        return 0.0 if self.rms == 0.0 else math.inf if self.peak is None else self.peak
