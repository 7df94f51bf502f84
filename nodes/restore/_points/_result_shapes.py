"""The shape of a measured PSF, and the work of measuring it and of restoring with it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from neusee.nodes.restore._inverse._wiener import wiener
from neusee.nodes.restore._points._by_field import spread_by_field, wiener_by_field
from neusee.nodes.restore._points._measured_psf import measured_psf
from neusee.nodes.restore._points._point_frames import points_in
from neusee.nodes.shape_rules import blank, double
from neusee.nodes.values import MeasuredPsf, Psf

_FITS = 6  #: steps of Gauss and Newton that a fit usually takes, each of as much work as a draw
_HELD = 80.0  #: bytes for each pixel of each window: the points, their slopes and the arrays of a step
_SEEN = 40.0  #: bytes for each pixel of a frame while it is searched for points


@measured_psf.shape
def _(
    responses: Tensor, *, files: Sequence[Path], window: Sequence[int], zones: Sequence[int], draws: int = 24,
    gain: float, offset: float, full_well: float, read_noise: float, bits: int = 16, **params: Any,
) -> MeasuredPsf:  # fmt: skip
    channels, (y, x), (rows, columns) = len(responses), window, zones
    kernels = rows, columns, channels, y, x
    points = points_in(files, (y, x), (gain, offset, full_well, bits, read_noise))
    each = [double(rows, columns) for _ in range(2)]
    return MeasuredPsf(
        double(*kernels), double(*kernels), blank(draws, *kernels), double(points, 4), double(channels),
        double(channels), *each,
    )  # fmt: skip


@measured_psf.work
def _(
    result: MeasuredPsf, *inputs: Any, files: Sequence[Path] = (), shape: Sequence[int], **params: Any
) -> tuple[float, float]:
    """Return the bytes of the windows and a frame, and the products of the shifts of all draws and fits.

    Each node slows the iteration down, because points tell several PSFs at once.
    """
    rows, columns, channels, y, x = result.kernels.shape
    windows = float(len(result.places) * channels * y * x)
    pixels = float(channels * math.prod(shape))
    steps = rows * columns * (_FITS + len(result.draws))
    return _HELD * windows + _SEEN * pixels, steps * windows * (y + x) + len(files) * pixels


@wiener_by_field.work
def _(
    result: Tensor, electrons: Tensor, measured: MeasuredPsf, clipped: Any = None, glare: Any = None,
    nearby: Sequence[Tensor] | None = None, **params: Any,
) -> tuple[float, float]:  # fmt: skip
    """Return the work of the filter on the largest part, and on all parts."""
    rows, columns = (
        _sides(n, count, size)
        for n, count, size in zip(
            electrons.shape[-2:], measured.kernels.shape[:2], measured.kernels.shape[-2:], strict=True
        )
    )
    psf, memory, operations = Psf(measured.kernels[0, 0], measured.fit), 0.0, 0.0
    for y in rows:
        for x in columns:
            part = blank(len(electrons), y, x)
            doubts = [blank(len(each), *part.shape) for each in nearby or ()]
            held, taken = wiener.hooks.work(part, part, psf, None, None, None, None, None, doubts)  # type: ignore[misc]
            memory, operations = max(memory, held), operations + taken
    return memory, operations


@spread_by_field.work
def _(
    result: Tensor, electrons: Tensor, measured: MeasuredPsf, clipped: Any, matrix: Any, *others: Any,
    draws: int = 8, **params: Any,
) -> tuple[float, float]:  # fmt: skip
    memory, operations = wiener_by_field.hooks.work(  # type: ignore[misc]
        result, electrons, measured, clipped, *others[:2]
    )
    return memory, draws * operations


def _sides(size: int, count: int, window: int) -> list[int]:
    """Return the pixels that the parts around each of ``count`` nodes have along one axis, at most."""
    if count == 1:
        return [size]
    ends = math.ceil(1.5 * size / count) + window // 2
    inner = math.ceil(2.0 * size / count) + 2 * (window // 2)
    return [min(side, size) for side in (ends, *[inner] * (count - 2), ends)]
