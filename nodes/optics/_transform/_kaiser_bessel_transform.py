"""The scaled Fourier transform by Kaiser-Bessel interpolation before and after a short FFT, with a chosen accuracy.

The window needs only ``alpha n_in n_out`` samples of information (800 for 2160 -> 2048 at 550 nm).
The pupil is therefore gathered onto a grid 1.75 times finer than that, and the FFT is longer by another
factor of 1.75; a chirp transform needs n_in + n_out. All weights are real, since signs centre both grids.
"""

import functools
import math
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.optics._transform._banded_matrix import Banded
from neusee.nodes.optics._transform._chirp_transform import smooth
from neusee.nodes.optics._transform._sample_axis import Axis, Sink, Source, last_type, row_chunks
from neusee.nodes.optics._transform._workspace import Workspace


class Kernel(NamedTuple):
    """The Kaiser-Bessel interpolation kernel of ``width`` samples, for a grid that is oversampled ``oversampling``
    times.
    """

    width: int
    oversampling: float

    @property
    def peak(self) -> float:
        """Return the divisor that brings the interpolation weights near one."""
        return self.width * math.sinh(self.beta) / self.beta

    @property
    def beta(self) -> float:
        return math.pi * self.width * (1 - 0.5 / self.oversampling)

    def __call__(self, x: Tensor) -> Tensor:
        root = (1 - (2 * x / self.width).square()).clamp_(min=0).sqrt_()
        value: Tensor = torch.special.i0(root.mul_(self.beta))
        return value

    def transform(self, f: Tensor) -> Tensor:
        root = (self.beta**2 - (math.pi * self.width * f).square()).sqrt()
        return self.width * torch.sinh(root) / root


_BLOCK = 16
_WIDEST = 8  #: the grid divides the input into at least this many parts, however few the window needs
_COLUMN_BLOCKS = 8
SINGLE, DOUBLE = Kernel(9, 1.75), Kernel(18, 2.0)
_LAST = 10.0  #: work along the last axis for each independent sample of the result, where a pupil sample has work 1


class Plan(NamedTuple):
    """The transform along one axis: interpolate to ``points``, FFT of ``length``, crop to ``kept``, interpolate."""

    gather: Banded
    spread: Banded
    points: int
    length: int
    kept: int
    sign: int

    @property
    def padded(self) -> int:
        """Return the index of the first interpolated sample in the zero-padded input of the FFT."""
        return self.length // 2 - (self.points - 1) // 2

    @property
    def cropped(self) -> int:
        """Return the index of the first frequency that is kept in the result of the FFT."""
        return self.length // 2 - (self.kept - 1) // 2


@functools.lru_cache(maxsize=64)
def plan(axis: Axis, dtype: torch.dtype, device: torch.device, kind: torch.dtype | None = None) -> Plan:
    """Return the grids and interpolation weights of the transform along one axis, cached for later calls.

    The field is interpolated to the grid of the FFT in the type ``kind``, by default ``dtype``.
    """
    kernel = SINGLE if dtype == torch.float32 else DOUBLE
    pitch = min(1 / (axis.alpha * axis.n_out * kernel.oversampling), max(axis.n_in, _WIDEST) / _WIDEST)
    points = odd(math.ceil((axis.n_in - 1) / pitch) + kernel.width)
    length = smooth(math.ceil(max(points, 2 * _BLOCK) * kernel.oversampling), even=True)
    spread = _spread(axis, kernel, pitch, length)
    while spread.n_columns + 2 * spread.margin > length:
        length = smooth(length + length // 4, even=True)
        spread = _spread(axis, kernel, pitch, length)
    gather = _gather(axis, kernel, pitch, points, length).to(kind or dtype, device)
    kept = spread.n_columns + 2 * spread.margin
    return Plan(gather, spread.to(dtype, device), points, length, kept, axis.sign)


def _gather(axis: Axis, kernel: Kernel, pitch: float, points: int, length: int) -> Banded:
    """Return the matrix that interpolates the field to the grid of the FFT, corrected for the interpolation after the
    FFT.
    """
    j0, l0 = (axis.n_in - 1) / 2, (points - 1) // 2
    band = Banded(points, axis.n_in, j0 - pitch * l0, pitch, pitch * kernel.width / 2, _BLOCK)

    def weigh(row: Tensor, column: Tensor) -> Tensor:
        at = (row - l0).clamp_(max=l0)
        scale = alternating(at + length // 2) * (kernel.peak / kernel.transform(at / length))
        return kernel((column - j0) / pitch - at) / kernel.peak * scale

    return band.fill(weigh)


def _spread(axis: Axis, kernel: Kernel, pitch: float, length: int) -> Banded:
    """Return the matrix that interpolates the FFT to the output samples, corrected for the interpolation before the
    FFT.
    """
    k0, fine = (axis.n_out - 1) / 2, axis.alpha * pitch * length
    kept = odd(math.ceil((axis.n_out - 1) * fine) + kernel.width)
    q0 = (kept - 1) // 2
    band = Banded(axis.n_out, kept, q0 - fine * k0, fine, kernel.width / 2, 2 * _BLOCK)

    def weigh(row: Tensor, column: Tensor) -> Tensor:
        at = (row - k0).clamp_(max=k0)
        return alternating(column - q0) * kernel(fine * at - (column - q0)) / kernel.transform(axis.alpha * pitch * at)

    return band.fill(weigh)


def alternating(index: Tensor) -> Tensor:
    """Return (-1)^index, which moves the origin of an FFT to the middle of its grid."""
    return 1 - 2 * index.remainder(2)


def odd(n: int) -> int:
    return n + 1 - n % 2


def kaiser_bessel(rows: Axis, columns: Axis, source: Source, sink: Sink, work: Workspace) -> None:
    """Compute the scaled Fourier transform by interpolation, a short FFT and interpolation, in chunks that fit in a
    cache.
    """
    last = last_type(*last_work(rows, columns), work.dtype)
    along_x, along_y = plan(columns, work.dtype, work.device), plan(rows, work.dtype, work.device, last)
    half = _rows_to_frequencies(along_x, along_y.gather.margin, rows.n_in, source, work)
    spectrum = _columns_to_frequencies(along_y, half, work)
    _interpolate(along_x, along_y, (rows.n_out, columns.n_out), spectrum, sink, work)


def last_work(rows: Axis, columns: Axis) -> tuple[float, float]:
    """Return the work along the first and along the last axis, where that of a sample of the pupil is 1."""
    return rows.n_in * columns.n_in, _LAST * rows.bandwidth * columns.bandwidth


def _rows_to_frequencies(x: Plan, margin: int, n_rows: int, source: Source, work: Workspace) -> Tensor:
    """Return the cropped FFT of every pupil row, with ``margin`` rows of zeros above and below."""
    kind, wide = work.dtype.to_complex(), x.gather.n_columns
    half = _zero_margins(work.take("half", n_rows + 2 * margin, x.kept, dtype=kind), 0, margin)
    for start, stop in row_chunks(n_rows, wide):
        n = stop - start
        planes = _zero_margins(work.take("planes", 2, n, wide + 2 * x.gather.margin), 2, x.gather.margin)
        source(start, stop, planes.narrow(2, x.gather.margin, wide))
        blocks = work.take("blocks", x.gather.count, 2 * n, x.gather.block)
        x.gather.right(planes.flatten(0, 1), blocks)
        line = work.take("line", n, x.length, dtype=kind)
        _place(blocks, line, x)
        half[margin + start : margin + stop] = _fft(line, x.sign)[:, x.cropped : x.cropped + x.kept]
    return half


def _zero_margins(x: Tensor, dim: int, margin: int) -> Tensor:
    x.narrow(dim, 0, margin).zero_()
    x.narrow(dim, x.shape[dim] - margin, margin).zero_()
    return x


def _place(blocks: Tensor, line: Tensor, x: Plan) -> None:
    """Copy blocks of interpolated (re, im) samples to the middle of the complex FFT input, and set the rest to zero."""
    count, block, n = x.gather.count, x.gather.block, line.shape[0]
    line[:, : x.padded] = 0
    parts = blocks.view(count, 2, n, block).permute(1, 2, 0, 3)
    into = line[:, x.padded : x.padded + count * block]
    torch.complex(parts[0], parts[1], out=into.view(n, count, block))
    line[:, x.padded + x.points :] = 0


def _columns_to_frequencies(y: Plan, half: Tensor, work: Workspace) -> Tensor:
    """Interpolate all columns to the grid of the FFT, transform the columns, and return the cropped FFT transposed."""
    wide, kind = half.shape[1], y.gather.weights.dtype.to_complex()
    given = half if kind == half.dtype else work.take("given", *half.shape, dtype=kind).copy_(half)
    columns = work.take("columns", y.length, wide, dtype=kind)
    y.gather.left(_flat(given), _flat(columns[y.padded : y.padded + y.gather.n_rows]))
    columns[: y.padded] = 0
    columns[y.padded + y.points :] = 0
    spectrum = work.take("spectrum", wide, y.kept, dtype=half.dtype)
    for start, stop in row_chunks(wide, y.length):  # small chunks keep the memory that the FFT allocates small
        lines = _fft(columns[:, start:stop].T, y.sign)
        spectrum[start:stop] = lines[:, y.cropped : y.cropped + y.kept]
    return spectrum


def _interpolate(x: Plan, y: Plan, shape: tuple[int, int], spectrum: Tensor, sink: Sink, work: Workspace) -> None:
    """Interpolate the FFT (x, y) to the output samples, a few columns at a time, and pass these samples to ``sink``."""
    for first in range(0, x.spread.count, _COLUMN_BLOCKS):
        part = x.spread.part(first, min(first + _COLUMN_BLOCKS, x.spread.count))
        line = work.take("stripe", part.n_rows, spectrum.shape[1], dtype=spectrum.dtype)
        part.left(_flat(spectrum), _flat(line))
        planes = work.take("stripes", 2, *line.shape).copy_(torch.view_as_real(line).movedim(2, 0))
        blocks = work.take("tiles", y.spread.count, 2 * part.n_rows, y.spread.block)
        y.spread.right(planes.flatten(0, 1), blocks)
        start, stop = first * part.block, min(first * part.block + part.n_rows, shape[1])
        tiles = blocks.view(y.spread.count, 2, part.n_rows, y.spread.block).permute(1, 0, 3, 2)
        _deliver(tiles[..., : stop - start], slice(start, stop), shape[0], sink)


def _deliver(tiles: Tensor, columns: slice, n_rows: int, sink: Sink) -> None:
    """Pass all complete blocks of output rows to ``sink``, then the rows of the incomplete last block."""
    block = tiles.shape[2]
    whole = n_rows // block
    if whole:
        sink(slice(0, whole * block), columns, tiles[:, :whole])
    if whole * block < n_rows:
        sink(slice(whole * block, n_rows), columns, tiles[:, whole, : n_rows - whole * block])


def _flat(x: Tensor) -> Tensor:
    """Return a complex tensor (r, c) as a real tensor (r, 2 c), so that a real matrix can multiply from the left."""
    return torch.view_as_real(x).flatten(1)


def _fft(x: Tensor, sign: int) -> Tensor:
    result: Tensor = torch.fft.fft(x, dim=1) if sign < 0 else torch.fft.ifft(x, dim=1, norm="forward")
    return result
