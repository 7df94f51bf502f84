"""The scaled Fourier transform by FFTs: chirps (Bluestein), or Kaiser-Bessel windows."""

import copy
import functools
import math
from collections.abc import Callable
from itertools import chain
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.optics._transform._sample_axis import (
    Axis,
    Sink,
    Source,
    Workspace,
    centred,
    last_type,
    row_chunks,
    unit_phasor,
)

# --- chirp transform ------------------------------------------------------------------------------

# The scaled Fourier transform by chirps (Bluestein): two FFTs for each line, exact up to round-off.


class _Chirps(NamedTuple):
    """The phase factors of the chirp transform, from ``jk = (j^2 + k^2 - (j - k)^2) / 2``, one
    for each term.
    """

    before: Tensor
    spectrum: Tensor
    behind: Tensor
    length: int


@functools.lru_cache(maxsize=32)
def _chirps(axis: Axis, dtype: torch.dtype, device: torch.device) -> _Chirps:
    a = axis.sign * axis.alpha / 2
    j, k = centred(axis.n_in, device), centred(axis.n_out, device)
    span = axis.n_in + axis.n_out - 1
    length = smooth(span)
    lag = torch.arange(span, dtype=torch.float64, device=device) + (k[0] - j[-1])
    kernel = torch.zeros(length, dtype=torch.complex128, device=device)
    kernel[:span] = unit_phasor(lag.square_().mul_(-a), torch.float64)
    spectrum = torch.fft.fft(kernel).to(dtype.to_complex())
    before, behind = (
        unit_phasor(j.square_().mul_(a), dtype),
        unit_phasor(k.square_().mul_(a), dtype),
    )
    return _Chirps(before, spectrum, behind, length)


def bluestein(rows: Axis, columns: Axis, source: Source, sink: Sink, work: Workspace) -> None:
    """Compute the scaled Fourier transform of a field by chirps, along rows and then along
    columns, in small chunks.
    """
    kind = work.dtype.to_complex()
    along_x, along_y = (_chirps(axis, work.dtype, work.device) for axis in (columns, rows))
    half = work.take("half", columns.n_out, rows.n_in, dtype=kind)
    for start, stop in row_chunks(rows.n_in, along_x.length):
        planes = work.take("planes", 2, stop - start, columns.n_in)
        source(start, stop, planes)
        line = torch.complex(
            planes[0], planes[1], out=work.take("field", stop - start, columns.n_in, dtype=kind)
        )
        half[:, start:stop] = _convolve(line, along_x, columns, work).T
    for start, stop in row_chunks(columns.n_out, along_y.length):
        patch = _convolve(half[start:stop], along_y, rows, work)
        sink(slice(0, rows.n_out), slice(start, stop), torch.view_as_real(patch).permute(2, 1, 0))


def _convolve(lines: Tensor, chirps: _Chirps, axis: Axis, work: Workspace) -> Tensor:
    """Return the chirp transform along the last dimension, in a buffer that the next call
    overwrites.
    """
    padded = work.take("padded", lines.shape[0], chirps.length, dtype=lines.dtype)
    torch.mul(lines, chirps.before, out=padded[:, : axis.n_in])
    padded[:, axis.n_in :] = 0
    product = torch.fft.fft(padded, dim=1).mul_(chirps.spectrum)
    window: Tensor = torch.fft.ifft(product, dim=1)[:, axis.n_in - 1 : axis.n_in - 1 + axis.n_out]
    return window.mul_(chirps.behind)


@functools.lru_cache(maxsize=256)
def smooth(n: int, even: bool = False) -> int:
    """Return the smallest FFT length of at least ``n`` without prime factors above 5, for which
    FFTs are fast.
    """
    n += even and n % 2
    while _rough(n):
        n += 1 + even
    return n


def _rough(n: int) -> bool:
    for p in (2, 3, 5):
        while n % p == 0:
            n //= p
    return n > 1


# --- banded matrix --------------------------------------------------------------------------------

# Banded matrices stored as batches of small dense matrices, so that interpolation is a matrix
# product.


_SLACK = 8  #: columns of zeros that let blocks of unequal spacing share one stride


class _Run(NamedTuple):
    """A range of matrix blocks whose first columns are equally spaced: start, start + stride and
    so on.
    """

    first: int
    blocks: int
    start: int
    stride: int

    @property
    def starts(self) -> list[int]:
        return [self.start + i * self.stride for i in range(self.blocks)]


class Banded:
    """A banded matrix, whose row ``i`` is nonzero only in the columns within ``reach`` of ``origin
    + step i``.

    ``n_rows`` is rounded up to whole blocks; the extra rows are finite and meaningless. The other
    factor of a product needs ``margin`` zeros before and behind its ``n_columns`` samples, so that
    all blocks have the same size.
    """

    def __init__(
        self, n_rows: int, n_columns: int, origin: float, step: float, reach: float, block: int
    ) -> None:
        self.n_columns, self.reach = n_columns, reach
        self.count = -(-n_rows // block)
        self.block = -(-n_rows // self.count)
        self.n_rows = self.count * self.block
        self.origin, self.step = origin, step
        first = [math.ceil(self._at(b * self.block) - reach) for b in range(self.count)]
        last = [math.floor(self._at((b + 1) * self.block - 1) + reach) for b in range(self.count)]
        self.width = max(z - a for a, z in zip(first, last, strict=True)) + 1 + _SLACK
        self.runs = _runs([z + 1 - self.width for z in last], first, step * self.block)
        starts = list(chain.from_iterable(run.starts for run in self.runs))
        self.margin = max(0, -min(starts), max(starts) + self.width - n_columns)
        self.weights = torch.empty(0)

    def _at(self, row: int) -> float:
        return self.origin + self.step * row

    def fill(self, weigh: Callable[[Tensor, Tensor], Tensor]) -> "Banded":
        """Set the matrix to ``weigh(row, column)`` within the band and to zero outside; the
        indices are float64.
        """
        starts = list(chain.from_iterable(run.starts for run in self.runs))
        columns = torch.tensor(starts, dtype=torch.float64)[:, None, None] + torch.arange(
            self.width
        )
        rows = torch.arange(self.n_rows, dtype=torch.float64).view(self.count, self.block, 1)
        near = (columns - (self.origin + self.step * rows)).abs_() <= self.reach
        self.weights = torch.where(near, weigh(rows, columns), 0.0)
        return self

    def to(self, dtype: torch.dtype, device: torch.device) -> "Banded":
        """Convert the matrix to ``dtype`` and move the matrix to ``device``."""
        self.weights = self.weights.to(device, dtype)
        return self

    def part(self, first: int, last: int) -> "Banded":
        """Return the part of the banded matrix from block ``first`` up to, but without, block
        ``last``.
        """
        cut = copy.copy(self)
        cut.count, cut.n_rows = last - first, (last - first) * self.block
        cut.weights, cut.runs = self.weights[first:last], []
        for run in self.runs:
            a, z = max(run.first, first), min(run.first + run.blocks, last)
            if a < z:
                cut.runs.append(
                    _Run(a - first, z - a, run.start + (a - run.first) * run.stride, run.stride)
                )
        return cut

    def left(self, x: Tensor, out: Tensor) -> None:
        """Write ``matrix @ x[margin + n_columns + margin, c]`` to ``out[n_rows, c]``; ``x`` may
        have a row stride.
        """
        wide, pitch = x.shape[1], x.stride(0)
        blocks = out.view(self.count, self.block, wide)
        for first, count, start, stride in self.runs:
            offset = (start + self.margin) * pitch + x.storage_offset()
            view = x.as_strided((count, self.width, wide), (stride * pitch, pitch, 1), offset)
            _multiply(self.weights[first : first + count], view, blocks[first : first + count])

    def right(self, x: Tensor, out: Tensor) -> None:
        """Write ``x[r, margin + n_columns + margin] @ matrix^T`` to ``out[block, r, i]``, in
        blocks of matrix rows.
        """
        tall, wide = x.shape
        for first, count, start, stride in self.runs:
            offset = start + self.margin + x.storage_offset()
            view = x.as_strided((count, tall, self.width), (stride, wide, 1), offset)
            _multiply(
                view,
                self.weights[first : first + count].transpose(1, 2),
                out[first : first + count],
            )


def _multiply(a: Tensor, b: Tensor, out: Tensor) -> None:
    """Multiply two batches of matrices; fewer than 8 products run one after another, each on all
    threads.
    """
    if len(a) >= 8:
        torch.bmm(a, b, out=out)
        return
    for x, y, z in zip(a, b, out, strict=True):
        torch.mm(x, y, out=z)


def _runs(low: list[int], high: list[int], pace: float) -> list[_Run]:
    """Return a few runs of matrix blocks with equally spaced first columns, each column from
    ``low`` to ``high``.
    """
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
        lower, upper = (
            max(a, low[first + count] - stride * count),
            min(z, high[first + count] - stride * count),
        )
        if lower > upper:
            break
        a, z, count = lower, upper, count + 1
    return _Run(first, count, z, stride)


# --- kaiser bessel transform ----------------------------------------------------------------------

# The scaled Fourier transform by Kaiser-Bessel interpolation before and after a short FFT, with a
# chosen accuracy.
#
# The window needs only ``alpha n_in n_out`` samples of information (800 for 2160 -> 2048 at 550
# nm). The pupil is therefore gathered onto a grid 1.75 times finer than that, and the FFT is longer
# by another factor of 1.75; a chirp transform needs n_in + n_out. All weights are real, since signs
# centre both grids.


class Kernel(NamedTuple):
    """The Kaiser-Bessel interpolation kernel of ``width`` samples, for a grid that is oversampled
    ``oversampling`` times.
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
#: the grid divides the input into at least this many parts, however few the window needs
_WIDEST = 8
_COLUMN_BLOCKS = 8
SINGLE, DOUBLE = Kernel(9, 1.75), Kernel(18, 2.0)
#: work along the last axis for each independent sample of the result, where a pupil sample has work
#: 1
_LAST = 10.0


class Plan(NamedTuple):
    """The transform along one axis: interpolate to ``points``, FFT of ``length``, crop to
    ``kept``, interpolate.
    """

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
def plan(
    axis: Axis, dtype: torch.dtype, device: torch.device, kind: torch.dtype | None = None
) -> Plan:
    """Return the grids and interpolation weights of the transform along one axis, cached for later
    calls.

    The field is interpolated to the grid of the FFT in the type ``kind``, by default ``dtype``.
    """
    kernel = SINGLE if dtype == torch.float32 else DOUBLE
    pitch = min(
        1 / (axis.alpha * axis.n_out * kernel.oversampling), max(axis.n_in, _WIDEST) / _WIDEST
    )
    points = odd(math.ceil((axis.n_in - 1) / pitch) + kernel.width)
    length = smooth(math.ceil(max(points, 2 * _BLOCK) * kernel.oversampling), even=True)
    spread = _spread(axis, kernel, pitch, length)
    while spread.n_columns + 2 * spread.margin > length:
        length = smooth(length + length // 4, even=True)
        spread = _spread(axis, kernel, pitch, length)
    gather = _gather(axis, kernel, pitch, points, length).to(kind or dtype, device)
    frequencies = spread.n_columns + 2 * spread.margin
    return Plan(gather, spread.to(dtype, device), points, length, frequencies, axis.sign)


def _gather(axis: Axis, kernel: Kernel, pitch: float, points: int, length: int) -> Banded:
    """Return the matrix that interpolates the field to the grid of the FFT, corrected for the
    interpolation after the FFT.
    """
    j0, l0 = (axis.n_in - 1) / 2, (points - 1) // 2
    band = Banded(points, axis.n_in, j0 - pitch * l0, pitch, pitch * kernel.width / 2, _BLOCK)

    def weigh(row: Tensor, column: Tensor) -> Tensor:
        place = (row - l0).clamp_(max=l0)
        scale = alternating(place + length // 2) * (kernel.peak / kernel.transform(place / length))
        return kernel((column - j0) / pitch - place) / kernel.peak * scale

    return band.fill(weigh)


def _spread(axis: Axis, kernel: Kernel, pitch: float, length: int) -> Banded:
    """Return the matrix that interpolates the FFT to the output samples, corrected for the
    interpolation before the FFT.
    """
    k0, fine = (axis.n_out - 1) / 2, axis.alpha * pitch * length
    frequencies = odd(math.ceil((axis.n_out - 1) * fine) + kernel.width)
    q0 = (frequencies - 1) // 2
    band = Banded(axis.n_out, frequencies, q0 - fine * k0, fine, kernel.width / 2, 2 * _BLOCK)

    def weigh(row: Tensor, column: Tensor) -> Tensor:
        place = (row - k0).clamp_(max=k0)
        return (
            alternating(column - q0)
            * kernel(fine * place - (column - q0))
            / kernel.transform(axis.alpha * pitch * place)
        )

    return band.fill(weigh)


def alternating(index: Tensor) -> Tensor:
    """Return (-1)^index, which moves the origin of an FFT to the middle of its grid."""
    return 1 - 2 * index.remainder(2)


def odd(n: int) -> int:
    return n + 1 - n % 2


def kaiser_bessel(rows: Axis, columns: Axis, source: Source, sink: Sink, work: Workspace) -> None:
    """Compute the scaled Fourier transform by interpolation, a short FFT and interpolation, in
    chunks that fit in a cache.
    """
    last = last_type(*last_work(rows, columns), work.dtype)
    along_x, along_y = (
        plan(columns, work.dtype, work.device),
        plan(rows, work.dtype, work.device, last),
    )
    half = _rows_to_frequencies(along_x, along_y.gather.margin, rows.n_in, source, work)
    spectrum = _columns_to_frequencies(along_y, half, work)
    _interpolate(along_x, along_y, (rows.n_out, columns.n_out), spectrum, sink, work)


def last_work(rows: Axis, columns: Axis) -> tuple[float, float]:
    """Return the work along the first and along the last axis, where that of a sample of the
    pupil is 1.
    """
    return rows.n_in * columns.n_in, _LAST * rows.bandwidth * columns.bandwidth


def _rows_to_frequencies(
    x: Plan, margin: int, n_rows: int, source: Source, work: Workspace
) -> Tensor:
    """Return the cropped FFT of every pupil row, with ``margin`` rows of zeros above and below."""
    kind, wide = work.dtype.to_complex(), x.gather.n_columns
    half = _zero_margins(work.take("half", n_rows + 2 * margin, x.kept, dtype=kind), 0, margin)
    for start, stop in row_chunks(n_rows, wide):
        n = stop - start
        planes = _zero_margins(
            work.take("planes", 2, n, wide + 2 * x.gather.margin), 2, x.gather.margin
        )
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
    """Copy blocks of interpolated (re, im) samples to the middle of the complex FFT input, and
    set the rest to zero.
    """
    count, block, n = x.gather.count, x.gather.block, line.shape[0]
    line[:, : x.padded] = 0
    parts = blocks.view(count, 2, n, block).permute(1, 2, 0, 3)
    into = line[:, x.padded : x.padded + count * block]
    torch.complex(parts[0], parts[1], out=into.view(n, count, block))
    line[:, x.padded + x.points :] = 0


def _columns_to_frequencies(y: Plan, half: Tensor, work: Workspace) -> Tensor:
    """Interpolate all columns to the grid of the FFT, transform the columns, and return the
    cropped FFT transposed.
    """
    wide, kind = half.shape[1], y.gather.weights.dtype.to_complex()
    field = half if kind == half.dtype else work.take("given", *half.shape, dtype=kind).copy_(half)
    columns = work.take("columns", y.length, wide, dtype=kind)
    y.gather.left(_flat(field), _flat(columns[y.padded : y.padded + y.gather.n_rows]))
    columns[: y.padded] = 0
    columns[y.padded + y.points :] = 0
    spectrum = work.take("spectrum", wide, y.kept, dtype=half.dtype)
    # small chunks keep the memory that the FFT allocates small
    for start, stop in row_chunks(wide, y.length):
        lines = _fft(columns[:, start:stop].T, y.sign)
        spectrum[start:stop] = lines[:, y.cropped : y.cropped + y.kept]
    return spectrum


def _interpolate(
    x: Plan, y: Plan, shape: tuple[int, int], spectrum: Tensor, sink: Sink, work: Workspace
) -> None:
    """Interpolate the FFT (x, y) to the output samples, a few columns at a time, and pass these
    samples to ``sink``.
    """
    for first in range(0, x.spread.count, _COLUMN_BLOCKS):
        stripe = x.spread.part(first, min(first + _COLUMN_BLOCKS, x.spread.count))
        line = work.take("stripe", stripe.n_rows, spectrum.shape[1], dtype=spectrum.dtype)
        stripe.left(_flat(spectrum), _flat(line))
        planes = work.take("stripes", 2, *line.shape).copy_(torch.view_as_real(line).movedim(2, 0))
        blocks = work.take("tiles", y.spread.count, 2 * stripe.n_rows, y.spread.block)
        y.spread.right(planes.flatten(0, 1), blocks)
        start, stop = (
            first * stripe.block,
            min(first * stripe.block + stripe.n_rows, shape[1]),
        )
        tiles = blocks.view(y.spread.count, 2, stripe.n_rows, y.spread.block).permute(1, 0, 3, 2)
        _deliver(tiles[..., : stop - start], slice(start, stop), shape[0], sink)


def _deliver(tiles: Tensor, columns: slice, n_rows: int, sink: Sink) -> None:
    """Pass all complete blocks of output rows to ``sink``, then the rows of the incomplete last
    block.
    """
    block = tiles.shape[2]
    full_blocks = n_rows // block
    if full_blocks:
        sink(slice(0, full_blocks * block), columns, tiles[:, :full_blocks])
    if full_blocks * block < n_rows:
        sink(
            slice(full_blocks * block, n_rows),
            columns,
            tiles[:, full_blocks, : n_rows - full_blocks * block],
        )


def _flat(x: Tensor) -> Tensor:
    """Return a complex tensor (r, c) as a real tensor (r, 2 c), so that a real matrix can
    multiply from the left.
    """
    return torch.view_as_real(x).flatten(1)


def _fft(x: Tensor, sign: int) -> Tensor:
    result: Tensor = (
        torch.fft.fft(x, dim=1) if sign < 0 else torch.fft.ifft(x, dim=1, norm="forward")
    )
    return result
