"""The scaled transform by two griddings about one short FFT: exact to the kernel's chosen error.

The window needs only ``alpha n_in n_out`` samples of information (800 for 2160 -> 2048 at 550 nm),
so the pupil is gathered onto a grid 1.5 times finer than that, and the FFT is 1.5 times as long
again, where a chirp needs n_in + n_out. All weights are real: both grids are centred by signs.
"""

import functools
import math
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.optics._axis import Axis, Sink, Source, row_chunks
from neusee.nodes.optics._banded import Banded
from neusee.nodes.optics._bluestein import smooth
from neusee.nodes.optics._workspace import Workspace


class _Kernel(NamedTuple):
    """Kaiser-Bessel kernel of full ``width`` samples for a grid ``oversampling`` times as fine as needed."""

    width: int
    oversampling: float

    @property
    def peak(self) -> float:
        """Scale that keeps weights near one."""
        return self.width * math.sinh(self.beta) / self.beta

    @property
    def beta(self) -> float:
        return math.pi * self.width * (1 - 0.5 / self.oversampling)

    def __call__(self, x: Tensor) -> Tensor:
        return torch.special.i0((1 - (2 * x / self.width).square()).clamp_(min=0).sqrt_().mul_(self.beta))

    def transform(self, f: Tensor) -> Tensor:
        root = (self.beta**2 - (math.pi * self.width * f).square()).sqrt()
        return self.width * torch.sinh(root) / root


_SINGLE, _DOUBLE = _Kernel(9, 1.5), _Kernel(18, 2.0)


class Plan(NamedTuple):
    """One axis: gather (n_in -> points), FFT of ``length`` about the middle, keep ``kept``, interpolate (-> n_out)."""

    gather: Banded
    spread: Banded
    points: int
    length: int
    kept: int
    sign: int

    @property
    def padded(self) -> int:
        """Where the gathered points stand in the FFT's input."""
        return self.length // 2 - (self.points - 1) // 2

    @property
    def cropped(self) -> int:
        return self.length // 2 - (self.kept - 1) // 2


@functools.lru_cache(maxsize=64)
def plan(axis: Axis, dtype: torch.dtype, device: torch.device) -> Plan:
    """Grids and weights of one axis; equal axes and later calls share them."""
    kernel = _SINGLE if dtype == torch.float32 else _DOUBLE
    pitch = 1 / (axis.alpha * axis.n_out * kernel.oversampling)
    points = _odd(math.ceil((axis.n_in - 1) / pitch) + kernel.width)
    length = smooth(math.ceil(max(points, 3 * kernel.width) * kernel.oversampling), even=True)
    kept = _odd(math.ceil((axis.n_out - 1) * axis.alpha * pitch * length) + kernel.width)
    gather = _gather(axis, kernel, pitch, points, length).to(dtype, device)
    spread = _spread(axis, kernel, pitch, kept, length).to(dtype, device)
    return Plan(gather, spread, points, length, kept, axis.sign)


def _gather(axis: Axis, kernel: _Kernel, pitch: float, points: int, length: int) -> Banded:
    """Field onto the grid of ``points``, divided by what the interpolation behind the FFT will multiply by."""
    j0, l0 = (axis.n_in - 1) / 2, (points - 1) // 2
    band = Banded(points, axis.n_in, j0 - pitch * l0, pitch, pitch * kernel.width / 2, 16)

    def weigh(row: Tensor, column: Tensor) -> Tensor:
        at = (row - l0).clamp_(max=l0)
        scale = _alternating(at + length // 2) * (kernel.peak / kernel.transform(at / length))
        return kernel((column - j0) / pitch - at) / kernel.peak * scale

    return band.fill(weigh)


def _spread(axis: Axis, kernel: _Kernel, pitch: float, kept: int, length: int) -> Banded:
    """The kept frequencies onto the window, divided by the transform of the kernel that gathered."""
    k0, q0, fine = (axis.n_out - 1) / 2, (kept - 1) // 2, axis.alpha * pitch * length
    band = Banded(axis.n_out, kept, q0 - fine * k0, fine, kernel.width / 2, 32)

    def weigh(row: Tensor, column: Tensor) -> Tensor:
        at = (row - k0).clamp_(max=k0)
        return _alternating(column - q0) * kernel(fine * at - (column - q0)) / kernel.transform(axis.alpha * pitch * at)

    return band.fill(weigh)


def _alternating(index: Tensor) -> Tensor:
    """(-1)^index: the middle of a grid becomes the origin of its FFT."""
    return 1 - 2 * index.remainder(2)


def _odd(n: int) -> int:
    return n + 1 - n % 2


def kaiser_bessel(rows: Axis, columns: Axis, source: Source, sink: Sink, work: Workspace) -> None:
    """Gather, short FFT, interpolate: columns first, in chunks of rows that stay in cache."""
    along_x, along_y = (plan(axis, work.dtype, work.device) for axis in (columns, rows))
    half = _rows_to_frequencies(along_x, rows.n_in, columns.n_in, source, work)
    spectrum = _columns_to_frequencies(along_y, half, work)
    _interpolate(rows, columns, spectrum, sink, work)


def _rows_to_frequencies(x: Plan, n_rows: int, n_columns: int, source: Source, work: Workspace) -> Tensor:
    complex_dtype = work.dtype.to_complex()
    half = work.take("half", n_rows, x.kept, dtype=complex_dtype)
    for start, stop in row_chunks(n_rows, n_columns):
        n = stop - start
        planes = work.take("planes", 2, n, n_columns)
        source(start, stop, planes)
        blocks = work.take("blocks", x.gather.count, 2 * n, x.gather.block)
        x.gather.right(planes.view(2 * n, n_columns), blocks)
        line = work.take("line", n, x.length, dtype=complex_dtype)
        _place(blocks, line, x)
        half[start:stop] = _fft(line, 1, x.sign)[:, x.cropped : x.cropped + x.kept]
    return half


def _place(blocks: Tensor, line: Tensor, x: Plan) -> None:
    """Put gathered (re, im) blocks in the middle of zeroed complex lines."""
    count, block, n = x.gather.count, x.gather.block, line.shape[0]
    line[:, : x.padded] = 0
    line[:, x.padded + x.points :] = 0
    whole = x.points // block
    parts = torch.view_as_real(line)[:, x.padded : x.padded + x.points]
    source = blocks.view(count, 2, n, block)
    parts[:, : whole * block].unflatten(1, (whole, block)).copy_(source[:whole].permute(2, 0, 3, 1))
    if whole < count:
        parts[:, whole * block :] = source[whole, :, :, : x.points - whole * block].permute(1, 2, 0)


def _columns_to_frequencies(y: Plan, half: Tensor, work: Workspace) -> Tensor:
    """Gather along v straight into the zero-padded columns, and transform them."""
    wide = half.shape[1]
    columns = work.take("columns", y.length + y.gather.block, wide, dtype=half.dtype)
    top = columns[y.padded : y.padded + y.gather.n_rows]
    y.gather.left(_flat(half), _flat(top))
    columns[: y.padded] = 0
    columns[y.padded + y.points : y.length] = 0
    return _fft(columns[: y.length], 0, y.sign)[y.cropped : y.cropped + y.kept]


def _interpolate(rows: Axis, columns: Axis, spectrum: Tensor, sink: Sink, work: Workspace) -> None:
    x, y = (plan(axis, work.dtype, work.device) for axis in (columns, rows))
    per_chunk = max(1, (1 << 17) // (columns.n_out * y.spread.block))
    for first in range(0, y.spread.count, per_chunk):
        last = min(first + per_chunk, y.spread.count)
        start, stop = first * y.spread.block, min(last * y.spread.block, rows.n_out)
        tall = (last - first) * y.spread.block
        line = work.take("stripe", tall, x.kept, dtype=spectrum.dtype)
        y.spread.part(first, last).left(_flat(spectrum), _flat(line))
        planes = work.take("stripes", 2, tall, x.kept)
        planes.copy_(torch.view_as_real(line).movedim(2, 0))
        blocks = work.take("tiles", x.spread.count, 2 * tall, x.spread.block)
        x.spread.right(planes.view(2 * tall, x.kept), blocks)
        patch = work.take("patch", 2, tall, x.spread.n_rows)
        patch.view(2, tall, x.spread.count, x.spread.block).copy_(blocks.view(x.spread.count, 2, tall, x.spread.block).permute(1, 2, 0, 3))
        sink(slice(start, stop), slice(0, columns.n_out), patch[:, : stop - start, : columns.n_out])


def _flat(x: Tensor) -> Tensor:
    """Complex (r, c) as real (r, 2 c): what a real matrix from the left may act on."""
    return torch.view_as_real(x).flatten(1)


def _fft(x: Tensor, dim: int, sign: int) -> Tensor:
    return torch.fft.fft(x, dim=dim) if sign < 0 else torch.fft.ifft(x, dim=dim, norm="forward")
