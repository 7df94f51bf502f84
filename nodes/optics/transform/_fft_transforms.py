"""The scaled Fourier transform by FFTs: chirp transform (Bluestein), or Kaiser-Bessel
interpolation.
"""

import copy
import functools
import math
from collections.abc import Callable
from itertools import chain
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.optics.transform._sample_axis import (
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

# The scaled Fourier transform as a chirp transform (Bluestein): two FFTs for each line, exact up to
# round-off.


class _Chirps(NamedTuple):
    """The factors of the chirp transform, from ``jk = (j^2 + k^2 - (j - k)^2) / 2``: one for each
    term.
    """

    before: Tensor
    spectrum: Tensor
    behind: Tensor
    length: int


@functools.lru_cache(maxsize=32)
def _chirps(axis: Axis, dtype: torch.dtype, device: torch.device) -> _Chirps:
    """Return the phase factors and the transformed kernel of the chirp transform along an axis."""
    half_signed_alpha = axis.sign * axis.alpha / 2
    input_samples, output_samples = centred(axis.n_in, device), centred(axis.n_out, device)
    lag_count = axis.n_in + axis.n_out - 1
    length = fft_length(lag_count)
    lag = torch.arange(lag_count, dtype=torch.float64, device=device) + (
        output_samples[0] - input_samples[-1]
    )
    kernel = torch.zeros(length, dtype=torch.complex128, device=device)
    kernel[:lag_count] = unit_phasor(lag.square_().mul_(-half_signed_alpha), torch.float64)
    spectrum = torch.fft.fft(kernel).to(dtype.to_complex())
    before, behind = (
        unit_phasor(input_samples.square_().mul_(half_signed_alpha), dtype),
        unit_phasor(output_samples.square_().mul_(half_signed_alpha), dtype),
    )
    return _Chirps(before, spectrum, behind, length)


def bluestein(rows: Axis, columns: Axis, source: Source, sink: Sink, work: Workspace) -> None:
    """Compute the scaled Fourier transform of a field by chirps, along rows and then along
    columns, in small chunks.
    """
    complex_type = work.dtype.to_complex()
    column_chirps, row_chirps = (_chirps(axis, work.dtype, work.device) for axis in (columns, rows))
    columns_transformed = work.take("half", columns.n_out, rows.n_in, dtype=complex_type)
    for start, stop in row_chunks(rows.n_in, column_chirps.length):
        planes = work.take("planes", 2, stop - start, columns.n_in)
        source(start, stop, planes)
        line = torch.complex(
            planes[0],
            planes[1],
            out=work.take("field", stop - start, columns.n_in, dtype=complex_type),
        )
        columns_transformed[:, start:stop] = _convolve(line, column_chirps, columns, work).T
    for start, stop in row_chunks(columns.n_out, row_chirps.length):
        patch = _convolve(columns_transformed[start:stop], row_chirps, rows, work)
        sink(slice(0, rows.n_out), slice(start, stop), torch.view_as_real(patch).permute(2, 1, 0))


def _convolve(lines: Tensor, chirps: _Chirps, axis: Axis, work: Workspace) -> Tensor:
    """Return the chirp transform along the last dimension, in a buffer that the next call
    overwrites.
    """
    zero_padded = work.take("padded", lines.shape[0], chirps.length, dtype=lines.dtype)
    torch.mul(lines, chirps.before, out=zero_padded[:, : axis.n_in])
    zero_padded[:, axis.n_in :] = 0
    product = torch.fft.fft(zero_padded, dim=1).mul_(chirps.spectrum)
    window: Tensor = torch.fft.ifft(product, dim=1)[:, axis.n_in - 1 : axis.n_in - 1 + axis.n_out]
    return window.mul_(chirps.behind)


@functools.lru_cache(maxsize=256)
def fft_length(n: int, even: bool = False) -> int:
    """Return the smallest FFT length >= ``n`` without prime factors above 5; FFTs of this length
    are fast.
    """
    n += even and n % 2
    while _has_large_factors(n):
        n += 1 + even
    return n


def _has_large_factors(n: int) -> bool:
    """Return True for a number with prime factors above 5."""
    for prime in (2, 3, 5):
        while n % prime == 0:
            n //= prime
    return n > 1


# --- banded matrix --------------------------------------------------------------------------------

# Banded matrices stored as batches of small dense matrices, so that interpolation is a matrix
# product.


_SLACK_COLUMNS = 8  #: extra columns of zeros, so that unequally spaced blocks can share one stride


class _Run(NamedTuple):
    """A range of matrix blocks with equally spaced first columns: start, start + stride, ..."""

    first: int  #: index of the first block
    blocks: int  #: number of blocks
    start: int  #: first column of the first block
    stride: int  #: columns from one block to the next

    @property
    def starts(self) -> list[int]:
        return [self.start + i * self.stride for i in range(self.blocks)]


class Banded:
    """A banded matrix, whose row ``i`` is nonzero only in the columns within ``reach`` of ``origin
    + step i``.

    ``n_rows`` is rounded up to complete blocks; the extra rows are finite, but have no meaning. The
    other factor of a product needs ``margin`` zeros before and after its ``n_columns`` samples, so
    that all blocks have the same size.
    """

    def __init__(
        self, n_rows: int, n_columns: int, origin: float, step: float, reach: float, block: int
    ) -> None:
        """Define the blocks of a matrix of ``n_rows`` x ``n_columns``, with about ``block`` rows
        each; `fill` sets the weights.
        """
        self.n_columns, self.reach = n_columns, reach
        self.count = -(-n_rows // block)
        self.block = -(-n_rows // self.count)
        self.n_rows = self.count * self.block
        self.origin, self.step = origin, step
        first_columns = [math.ceil(self._at(b * self.block) - reach) for b in range(self.count)]
        last_columns = [
            math.floor(self._at((b + 1) * self.block - 1) + reach) for b in range(self.count)
        ]
        self.width = (
            max(z - a for a, z in zip(first_columns, last_columns, strict=True))
            + 1
            + _SLACK_COLUMNS
        )
        self.runs = _equal_runs(
            [z + 1 - self.width for z in last_columns], first_columns, step * self.block
        )
        block_starts = list(chain.from_iterable(run.starts for run in self.runs))
        # number of columns by which blocks of equal width extend beyond the ends
        self.margin = max(0, -min(block_starts), max(block_starts) + self.width - n_columns)
        self.weights = torch.empty(0)

    def _at(self, row: int) -> float:
        """Return the column in the middle of the band of a row."""
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
        in_band = (columns - (self.origin + self.step * rows)).abs_() <= self.reach
        self.weights = torch.where(in_band, weigh(rows, columns), 0.0)
        return self

    def to(self, dtype: torch.dtype, device: torch.device) -> "Banded":
        """Convert the matrix to ``dtype`` and move the matrix to ``device``."""
        self.weights = self.weights.to(device, dtype)
        return self

    def part(self, first: int, last: int) -> "Banded":
        """Return the part of the banded matrix from block ``first`` up to, but without, block
        ``last``.
        """
        part = copy.copy(self)
        part.count, part.n_rows = last - first, (last - first) * self.block
        part.weights, part.runs = self.weights[first:last], []
        for run in self.runs:
            first_block, last_block = max(run.first, first), min(run.first + run.blocks, last)
            if first_block < last_block:
                part.runs.append(
                    _Run(
                        first_block - first,
                        last_block - first_block,
                        run.start + (first_block - run.first) * run.stride,
                        run.stride,
                    )
                )
        return part

    def left(self, x: Tensor, out: Tensor) -> None:
        """Write ``matrix @ x[margin + n_columns + margin, c]`` to ``out[n_rows, c]``; ``x`` may
        have a row stride.
        """
        column_count, row_stride = x.shape[1], x.stride(0)
        output_blocks = out.view(self.count, self.block, column_count)
        for first, count, start, stride in self.runs:
            offset = (start + self.margin) * row_stride + x.storage_offset()
            # overlapping windows of x, one for each block, without a copy
            overlapping_rows = x.as_strided(
                (count, self.width, column_count), (stride * row_stride, row_stride, 1), offset
            )
            _multiply(
                self.weights[first : first + count],
                overlapping_rows,
                output_blocks[first : first + count],
            )

    def right(self, x: Tensor, out: Tensor) -> None:
        """Write ``x[r, margin + n_columns + margin] @ matrix^T`` to ``out[block, r, i]``, in
        blocks of matrix rows.
        """
        row_count, row_stride = x.shape
        for first, count, start, stride in self.runs:
            offset = start + self.margin + x.storage_offset()
            overlapping_columns = x.as_strided(
                (count, row_count, self.width), (stride, row_stride, 1), offset
            )
            _multiply(
                overlapping_columns,
                self.weights[first : first + count].transpose(1, 2),
                out[first : first + count],
            )


def _multiply(a: Tensor, b: Tensor, out: Tensor) -> None:
    """Write the products of two batches of matrices to ``out``; fewer than 8 products run one after
    another, each on all threads.
    """
    if len(a) >= 8:
        torch.bmm(a, b, out=out)
        return
    for x, y, z in zip(a, b, out, strict=True):
        torch.mm(x, y, out=z)


def _equal_runs(low: list[int], high: list[int], pace: float) -> list[_Run]:
    """Return a small number of runs of matrix blocks whose first columns are equally spaced and lie
    between ``low`` and ``high``.
    """
    runs: list[_Run] = []
    first = 0
    while first < len(low):
        run = max(
            (
                _longest_run(low, high, first, stride)
                for stride in (math.floor(pace), math.ceil(pace))
            ),
            key=lambda r: r.blocks,
        )
        runs.append(run)
        first += run.blocks
    return runs


def _longest_run(low: list[int], high: list[int], first: int, stride: int) -> _Run:
    """Return the longest run with a given stride from block ``first`` on whose first columns lie
    between ``low`` and ``high``.
    """
    least_start, greatest_start, count = low[first], high[first], 0
    while first + count < len(low):
        least_next, greatest_next = (
            max(least_start, low[first + count] - stride * count),
            min(greatest_start, high[first + count] - stride * count),
        )
        if least_next > greatest_next:
            break
        least_start, greatest_start, count = least_next, greatest_next, count + 1
    return _Run(first, count, greatest_start, stride)


# --- kaiser bessel transform ----------------------------------------------------------------------

# The scaled Fourier transform by Kaiser-Bessel interpolation before and after a short FFT, with a
# chosen accuracy.
#
# The window has only ``alpha n_in n_out`` independent samples (800 for 2160 -> 2048 at 550 nm). The
# pupil is therefore interpolated to a grid 1.75 times finer than that, and the FFT is longer by
# another factor of 1.75; a chirp transform needs the length n_in + n_out. All weights are real,
# because alternating signs centre both grids.


class Kernel(NamedTuple):
    """The Kaiser-Bessel interpolation kernel of ``width`` samples, for a grid that is oversampled
    ``oversampling`` times.
    """

    width: int
    oversampling: float

    @property
    def peak(self) -> float:
        """Return the divisor that scales the interpolation weights to about one."""
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


_BLOCK_ROWS = 16
#: smallest number of grid intervals across the input, even if the window needs fewer
_LEAST_PARTS = 8
_COLUMN_BLOCKS = 8
SINGLE, DOUBLE = Kernel(9, 1.75), Kernel(18, 2.0)
#: time along the last axis for each independent sample of the result, relative to a pupil sample
_LAST_AXIS_WORK = 10.0


class Plan(NamedTuple):
    """The transform along one axis: interpolation to ``points`` samples, FFT of ``length``, crop to
    ``kept`` frequencies, interpolation to the output.
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
    point_pitch = min(
        1 / (axis.alpha * axis.n_out * kernel.oversampling),
        max(axis.n_in, _LEAST_PARTS) / _LEAST_PARTS,
    )
    point_count = next_odd(math.ceil((axis.n_in - 1) / point_pitch) + kernel.width)
    length = fft_length(
        math.ceil(max(point_count, 2 * _BLOCK_ROWS) * kernel.oversampling), even=True
    )
    spread = _spread(axis, kernel, point_pitch, length)
    # a longer FFT, until its frequencies contain the output and the margins
    while spread.n_columns + 2 * spread.margin > length:
        length = fft_length(length + length // 4, even=True)
        spread = _spread(axis, kernel, point_pitch, length)
    gather = _gather(axis, kernel, point_pitch, point_count, length).to(kind or dtype, device)
    frequency_count = spread.n_columns + 2 * spread.margin
    return Plan(gather, spread.to(dtype, device), point_count, length, frequency_count, axis.sign)


def _gather(axis: Axis, kernel: Kernel, pitch: float, points: int, length: int) -> Banded:
    """Return the matrix that interpolates the field to the grid of the FFT, corrected for the
    interpolation after the FFT.
    """
    middle_sample, middle_point = (axis.n_in - 1) / 2, (points - 1) // 2
    band = Banded(
        points,
        axis.n_in,
        middle_sample - pitch * middle_point,
        pitch,
        pitch * kernel.width / 2,
        _BLOCK_ROWS,
    )

    def weigh(row: Tensor, column: Tensor) -> Tensor:
        distance_from_middle = (row - middle_point).clamp_(max=middle_point)
        scale = alternating_sign(distance_from_middle + length // 2) * (
            kernel.peak / kernel.transform(distance_from_middle / length)
        )
        return kernel((column - middle_sample) / pitch - distance_from_middle) / kernel.peak * scale

    return band.fill(weigh)


def _spread(axis: Axis, kernel: Kernel, pitch: float, length: int) -> Banded:
    """Return the matrix that interpolates the FFT to the output samples, corrected for the
    interpolation before the FFT.
    """
    middle_output, frequencies_per_output = (axis.n_out - 1) / 2, axis.alpha * pitch * length
    frequency_count = next_odd(math.ceil((axis.n_out - 1) * frequencies_per_output) + kernel.width)
    middle_frequency = (frequency_count - 1) // 2
    band = Banded(
        axis.n_out,
        frequency_count,
        middle_frequency - frequencies_per_output * middle_output,
        frequencies_per_output,
        kernel.width / 2,
        2 * _BLOCK_ROWS,
    )

    def weigh(row: Tensor, column: Tensor) -> Tensor:
        distance_from_middle = (row - middle_output).clamp_(max=middle_output)
        return (
            alternating_sign(column - middle_frequency)
            * kernel(frequencies_per_output * distance_from_middle - (column - middle_frequency))
            / kernel.transform(axis.alpha * pitch * distance_from_middle)
        )

    return band.fill(weigh)


def alternating_sign(index: Tensor) -> Tensor:
    """Return (-1)^index, which moves the origin of an FFT to the middle of its grid."""
    return 1 - 2 * index.remainder(2)


def next_odd(n: int) -> int:
    return n + 1 - n % 2


def kaiser_bessel(rows: Axis, columns: Axis, source: Source, sink: Sink, work: Workspace) -> None:
    """Compute the scaled Fourier transform by interpolation, a short FFT and interpolation, in
    chunks that fit in a cache.
    """
    last_kind = last_type(*work_by_axis(rows, columns), work.dtype)
    column_plan, row_plan = (
        plan(columns, work.dtype, work.device),
        plan(rows, work.dtype, work.device, last_kind),
    )
    row_frequencies = _rows_to_frequencies(
        column_plan, row_plan.gather.margin, rows.n_in, source, work
    )
    spectrum = _columns_to_frequencies(row_plan, row_frequencies, work)
    _interpolate(column_plan, row_plan, (rows.n_out, columns.n_out), spectrum, sink, work)


def work_by_axis(rows: Axis, columns: Axis) -> tuple[float, float]:
    """Return the time along the first and along the last axis, in units of the time for a pupil
    sample.
    """
    return rows.n_in * columns.n_in, _LAST_AXIS_WORK * rows.bandwidth * columns.bandwidth


def _rows_to_frequencies(
    x: Plan, margin: int, n_rows: int, source: Source, work: Workspace
) -> Tensor:
    """Return the cropped FFT of every pupil row, with ``margin`` rows of zeros above and below."""
    complex_type, column_count = work.dtype.to_complex(), x.gather.n_columns
    frequencies = _zero_margins(
        work.take("half", n_rows + 2 * margin, x.kept, dtype=complex_type), 0, margin
    )
    for start, stop in row_chunks(n_rows, column_count):
        chunk_rows = stop - start
        planes = _zero_margins(
            work.take("planes", 2, chunk_rows, column_count + 2 * x.gather.margin),
            2,
            x.gather.margin,
        )
        source(start, stop, planes.narrow(2, x.gather.margin, column_count))
        blocks = work.take("blocks", x.gather.count, 2 * chunk_rows, x.gather.block)
        x.gather.right(planes.flatten(0, 1), blocks)
        fft_input = work.take("line", chunk_rows, x.length, dtype=complex_type)
        _fill_middle(blocks, fft_input, x)
        frequencies[margin + start : margin + stop] = _fft(fft_input, x.sign)[
            :, x.cropped : x.cropped + x.kept
        ]
    return frequencies


def _zero_margins(x: Tensor, dim: int, margin: int) -> Tensor:
    """Write zeros to the first and last ``margin`` places of an axis, and return ``x``."""
    x.narrow(dim, 0, margin).zero_()
    x.narrow(dim, x.shape[dim] - margin, margin).zero_()
    return x


def _fill_middle(blocks: Tensor, line: Tensor, x: Plan) -> None:
    """Copy blocks of interpolated (re, im) samples to the middle of the complex FFT input, and
    set the rest to zero.
    """
    count, block, row_count = x.gather.count, x.gather.block, line.shape[0]
    line[:, : x.padded] = 0
    block_parts = blocks.view(count, 2, row_count, block).permute(1, 2, 0, 3)
    target = line[:, x.padded : x.padded + count * block]
    torch.complex(block_parts[0], block_parts[1], out=target.view(row_count, count, block))
    line[:, x.padded + x.points :] = 0


def _columns_to_frequencies(y: Plan, half: Tensor, work: Workspace) -> Tensor:
    """Interpolate all columns to the grid of the FFT, transform the columns, and return the
    cropped FFT transposed.
    """
    column_count, complex_type = half.shape[1], y.gather.weights.dtype.to_complex()
    field = (
        half
        if complex_type == half.dtype
        else work.take("given", *half.shape, dtype=complex_type).copy_(half)
    )
    columns = work.take("columns", y.length, column_count, dtype=complex_type)
    y.gather.left(_as_real(field), _as_real(columns[y.padded : y.padded + y.gather.n_rows]))
    columns[: y.padded] = 0
    columns[y.padded + y.points :] = 0
    spectrum = work.take("spectrum", column_count, y.kept, dtype=half.dtype)
    # in chunks, so that the FFT allocates little memory
    for start, stop in row_chunks(column_count, y.length):
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
        stripe.left(_as_real(spectrum), _as_real(line))
        planes = work.take("stripes", 2, *line.shape).copy_(torch.view_as_real(line).movedim(2, 0))
        blocks = work.take("tiles", y.spread.count, 2 * stripe.n_rows, y.spread.block)
        y.spread.right(planes.flatten(0, 1), blocks)
        start, stop = (
            first * stripe.block,
            min(first * stripe.block + stripe.n_rows, shape[1]),
        )
        # (re and im, block, row in the block, column)
        tiles = blocks.view(y.spread.count, 2, stripe.n_rows, y.spread.block).permute(1, 0, 3, 2)
        _send_blocks(tiles[..., : stop - start], slice(start, stop), shape[0], sink)


def _send_blocks(tiles: Tensor, columns: slice, n_rows: int, sink: Sink) -> None:
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


def _as_real(x: Tensor) -> Tensor:
    """Return a complex tensor (r, c) as a real tensor (r, 2 c), so that a real matrix can
    multiply from the left.
    """
    return torch.view_as_real(x).flatten(1)


def _fft(x: Tensor, sign: int) -> Tensor:
    """Return the FFT along rows with exp(sign 2 pi i ...), never divided by its length."""
    result: Tensor = (
        torch.fft.fft(x, dim=1) if sign < 0 else torch.fft.ifft(x, dim=1, norm="forward")
    )
    return result
