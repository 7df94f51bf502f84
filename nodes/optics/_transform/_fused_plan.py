"""The grids and weights of one axis of the fused transform, in the layout that the C++ reads.

As in `_kaiser_bessel_transform`, but each row has a band of weights of its own, in place of dense blocks for many rows:
the C++ multiplies a third of the numbers that a product of blocks does.
"""

import ctypes
import functools
import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from neusee.nodes.optics._transform._chirp_transform import smooth
from neusee.nodes.optics._transform._kaiser_bessel_transform import DOUBLE, SINGLE, Kernel, alternating, odd
from neusee.nodes.optics._transform._sample_axis import Axis, unit_phasor

_WIDEST = 8  #: the grid divides the input into at least this many parts, however few the window needs
_SHORTEST = 32  #: samples of the shortest FFT
_FACTORS = (8, 5, 3, 4, 2)  #: of the passes of the FFT


class CAxis(ctypes.Structure):
    """The structure ``Axis`` of ``_fft.h``; ``held`` keeps the arrays that it points to."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in ("n_in", "n_out", "points", "length", "padded", "cropped", "kept")),
        *((name, ctypes.c_int64) for name in ("gather_width", "spread_width", "passes")),
        *((name, ctypes.c_void_p) for name in ("factors", "gather_first", "spread_first", "gather", "spread", "turns")),
    )
    held: tuple[Tensor, ...]


@functools.lru_cache(maxsize=64)
def fused_axis(axis: Axis, dtype: torch.dtype, gathered: torch.dtype, kind: torch.dtype) -> CAxis:
    """Return the plan of one axis with the accuracy of ``dtype``, kept for later calls.

    The weights in front of the FFT are of the type ``gathered``, all else of the type ``kind``.
    """
    kernel = SINGLE if dtype == torch.float32 else DOUBLE
    pitch, points, length, fine, kept = _grids(axis, kernel)
    j0, k0, l0, q0 = (axis.n_in - 1) / 2, (axis.n_out - 1) / 2, (points - 1) // 2, (kept - 1) // 2

    def gather(row: Tensor, column: Tensor) -> Tensor:
        at = row - l0
        scale = alternating(at + length // 2) * (kernel.peak / kernel.transform(at / length))
        return kernel((column - j0) / pitch - at) / kernel.peak * scale

    def spread(row: Tensor, column: Tensor) -> Tensor:
        at, near = row - k0, column - q0
        return alternating(near) * kernel(fine * at - near) / kernel.transform(axis.alpha * pitch * at)

    gather_first, gather_weights = _band(points, axis.n_in, j0 - pitch * l0, pitch, pitch * kernel.width / 2, gather)
    spread_first, spread_weights = _band(axis.n_out, kept, q0 - fine * k0, fine, kernel.width / 2, spread)
    turns = torch.view_as_real(unit_phasor(torch.arange(length, dtype=torch.float64) / -length, kind))
    arrays = (torch.tensor(_factors(length)), gather_first, spread_first)
    held = (*arrays, gather_weights.to(gathered), spread_weights.to(kind), turns.contiguous())
    sizes = (axis.n_in, axis.n_out, points, length, length // 2 - l0, length // 2 - q0, kept)
    widths = (gather_weights.shape[1], spread_weights.shape[1], len(held[0]))
    plan = CAxis(*sizes, *widths, *(x.data_ptr() for x in held))
    plan.held = held
    return plan


def expected_seconds(rows: Axis, columns: Axis) -> float:
    """Return the expected seconds of one PSF in single precision on one thread, without a large fixed cost.

    Measured for 128 to 2160 samples and 96 to 2048 pixels a side: within 20 %. The terms are the samples of the pupil
    with their phase, the FFTs along both axes, and the interpolation behind the FFTs.
    """
    transforms = columns.n_in * _fft_steps(rows) + rows.n_out * _fft_steps(columns)
    behind = rows.n_out * (columns.n_in + columns.n_out)
    return 0.11e-3 + 2.3e-9 * rows.n_in * columns.n_in + 0.108e-9 * transforms + 0.41e-9 * behind


def _fft_steps(axis: Axis) -> float:
    length = _grids(axis, SINGLE)[2]
    return length * math.log2(length)


def _grids(axis: Axis, kernel: Kernel) -> tuple[float, int, int, float, int]:
    """Return the pitch and the number of the points before the FFT, and what `_length` returns."""
    pitch = min(1 / (axis.alpha * axis.n_out * kernel.oversampling), max(axis.n_in, _WIDEST) / _WIDEST)
    points = odd(math.ceil((axis.n_in - 1) / pitch) + kernel.width)
    return pitch, points, *_length(axis, kernel, pitch, math.ceil(points * kernel.oversampling))


def _length(axis: Axis, kernel: Kernel, pitch: float, least: int) -> tuple[int, float, int]:
    """Return the FFT length, its samples for each output sample, and the frequencies that are kept of it."""
    length = smooth(max(least, _SHORTEST), even=True)
    while True:
        fine = axis.alpha * pitch * length
        kept = odd(math.ceil((axis.n_out - 1) * fine) + kernel.width)
        if kept <= length:
            return length, fine, kept
        length = smooth(length + length // 4, even=True)


def _band(
    n_rows: int, n_columns: int, origin: float, step: float, reach: float, weigh: Callable[[Tensor, Tensor], Tensor]
) -> tuple[Tensor, Tensor]:
    """Return the first column and the weights of each row, whose band reaches ``reach`` from ``origin + step row``."""
    width = min(math.floor(2 * reach) + 1, n_columns)
    rows = torch.arange(n_rows, dtype=torch.float64)[:, None]
    middle = origin + step * rows
    first = (middle - reach).ceil_().clamp_(0, n_columns - width)
    columns = first + torch.arange(width)
    weights = torch.where((columns - middle).abs() <= reach, weigh(rows, columns), 0.0)
    return first.int().flatten(), weights


def _factors(length: int) -> list[int]:
    factors = []
    for factor in _FACTORS:
        while length % factor == 0:
            factors.append(factor)
            length //= factor
    return factors


def pointer(x: Tensor | None) -> Any:
    """Return the address of the first number of a contiguous tensor, or a null pointer."""
    return ctypes.c_void_p(None if x is None else x.data_ptr())
