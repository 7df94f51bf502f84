"""Weighted sums of convolutions, and the cheapest plan with a bounded error."""

import math
from collections.abc import Iterator
from itertools import chain, pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

from neusee.nodes.optics.transform._fft_transforms import fft_length
from neusee.nodes.precision import one_by_one

# --- psf energy -----------------------------------------------------------------------------------

# The light of a PSF inside and outside of windows around its centre.


_WINDOW_SHARES = (1.0, 0.75, 0.5, 0.375, 0.25, 0.1875, 0.125, 0.0625, 0.03125, 0.015625)
#: relative round-off of a float32 sum: a few nested sums of a few dozen additions each
_SUM_ROUND_OFF = 4e-6


class PsfLight(NamedTuple):
    """Sums and maxima of the PSF of each band, inside and outside of windows, as float64 tensors
    on the CPU.
    """

    windows: list[tuple[int, int]]  #: the largest first
    total: Tensor  #: (band,) sum of |PSF|
    peak: Tensor  #: (band,) maximum of |PSF|
    beyond: Tensor  #: (window, band) sum of |PSF| outside the window
    above: Tensor  #: (window, band) maximum of |PSF| outside the window
    signed: bool  #: the PSF is negative somewhere


def psf_light(intensity: Tensor) -> PsfLight:
    """Return the sums and maxima of PSFs (band, y, x), with the whole PSF as the only window."""
    # band by band: a maximum over several dimensions takes three times as long
    extremes = [torch.aminmax(band) for band in intensity]
    low, high = (torch.stack(columns).double().cpu() for columns in zip(*extremes, strict=True))
    signed = not bool((low >= 0).all())  # True for NaN too
    rows = (intensity.abs() if signed else intensity).sum(2)
    total = rows.sum(1, dtype=torch.float64).cpu() * (1 + _SUM_ROUND_OFF)
    zeros = torch.zeros_like(total)[None]
    window = (intensity.shape[1], intensity.shape[2])
    return PsfLight([window], total, torch.maximum(high, -low), zeros, zeros, signed)


def psf_light_by_window(intensity: Tensor, signed: bool) -> PsfLight:
    """Return the sums and maxima of PSFs (band, y, x) for nested windows.

    The edges of the windows divide each PSF into rectangular pieces, and each piece is read once.
    """
    m, n = intensity.shape[1:]
    windows = list(
        dict.fromkeys((max(1, round(m * f)), max(1, round(n * f))) for f in _WINDOW_SHARES)
    )
    row_spans, column_spans = (
        [_central_span(length, w[axis]) for w in windows] for axis, length in enumerate((m, n))
    )
    size = intensity.abs() if signed else intensity
    row_edges, column_edges = _span_edges(row_spans), _span_edges(column_spans)
    sums, maxima = _piece_sums_and_maxima(size, row_edges, column_edges)
    beyond, above = torch.zeros(2, len(windows), len(intensity), dtype=torch.float64)
    for j, (y, x) in enumerate(zip(row_spans, column_spans, strict=True)):
        is_outside = ~torch.outer(
            _intervals_inside(y, row_edges), _intervals_inside(x, column_edges)
        )
        if bool(is_outside.any()):
            beyond[j], above[j] = sums[:, is_outside].sum(1), maxima[:, is_outside].amax(1)
    return PsfLight(windows, sums.sum((1, 2)), maxima.amax((1, 2)), beyond, above, signed)


def mean_psf_light(of: PsfLight, share: Tensor | None) -> PsfLight:
    """Return upper bounds of the sums and maxima of PSFs that are weighted means of the PSFs
    ``of``, with the weights ``share`` (band, j).
    """
    if share is None:
        return of
    beyond, above = of.beyond @ share.T, of.above @ share.T
    return PsfLight(of.windows, share @ of.total, share @ of.peak, beyond, above, of.signed)


def central_window(stack: Tensor, window: tuple[int, int]) -> Tensor:
    """Return the samples of each PSF in a window about the central sample n // 2."""
    (top, bottom), (left, right) = (
        _central_span(n, w) for n, w in zip(stack.shape[1:], window, strict=True)
    )
    return stack[:, top:bottom, left:right]


def _central_span(length: int, window: int) -> tuple[int, int]:
    """Return the first and the last sample, exclusive, of a window about the central sample n
    // 2.
    """
    first = length // 2 - window // 2
    return first, first + window


def _span_edges(spans: list[tuple[int, int]]) -> list[int]:
    """Return the different edges of all spans, in rising order."""
    return sorted(set(chain.from_iterable(spans)))


def _intervals_inside(span: tuple[int, int], cuts: list[int]) -> Tensor:
    """Return True for each interval between two neighbouring cuts that lies inside the span."""
    return torch.tensor([span[0] <= cut < span[1] for cut in cuts[:-1]])


def _piece_sums_and_maxima(
    size: Tensor, rows: list[int], columns: list[int]
) -> tuple[Tensor, Tensor]:
    """Return the sum (rounded up) and the maximum of each rectangular piece of a PSF, both (band,
    rows, columns).

    A few large calls are faster than many small ones.
    """
    row_sums_and_maxima = [(size[:, a:b].sum(1), size[:, a:b].amax(1)) for a, b in pairwise(rows)]
    row_sums, row_maxima = (
        torch.stack(row_parts, 1).double().cpu()
        for row_parts in zip(*row_sums_and_maxima, strict=True)
    )
    piece_sums = torch.stack([row_sums[..., a:b].sum(-1) for a, b in pairwise(columns)], -1) * (
        1 + _SUM_ROUND_OFF
    )
    return piece_sums, torch.stack(
        [row_maxima[..., a:b].amax(-1) for a, b in pairwise(columns)], -1
    )


# --- summed convolution ---------------------------------------------------------------------------

# Weighted sums of convolutions of a few pictures with a few kernels, computed in blocks of spectrum
# columns.
#
# Result i is ``sum_s U[i, s] (X a)_s * (Y b)_s`` with planes a, kernels b and the convolution *.
# First all planes and kernels are transformed along their rows. Then a few columns of all spectra
# at a time are transformed, multiplied and transformed back, in memory that fits in the cache. At
# 3072 x 3072 this takes 11 ms for the columns of a plane, on two cores; a transform of all columns
# in place takes 35 ms.


Corner = tuple[int, int]

_COLUMNS_AT_A_TIME = 16  #: number of spectrum columns at a time; on a GPU all columns
#: number of picture rows at a time: memory for whole pictures would cost more time than their FFTs
_ROWS_AT_A_TIME = 64


class Mix(NamedTuple):
    """The matrices that combine pictures and kernels into products, and products into results;
    None is the identity.
    """

    u: Tensor | None  #: (result, s)
    x: Tensor | None  #: (s, plane)
    y: Tensor | None  #: (s, kernel)
    #: number of results if each has its own kernel for each plane (kernels in order of result, then
    #: plane); otherwise 0
    results: int = 0

    def to(self, like: Tensor) -> "Mix":
        """Return the matrices, converted to the precision and the device of the tensor ``like``."""
        u, x, y = (m if m is None else m.to(like) for m in self[:3])
        return Mix(u, x, y, self.results)


class Placement(NamedTuple):
    """The positions of pictures and kernels in zero-padded arrays, and the window of the
    convolution to return.
    """

    picture_corner: Corner
    kernel_corner: Corner
    window_corner: Corner
    size: Corner
    length: Corner
    conjugate: bool = False  #: use the conjugate spectrum of the kernel: correlation


class Summed(torch.autograd.Function):
    """Weighted sums of convolutions; their gradients are sums of the same kind, so that derivatives
    of all orders exist.
    """

    @staticmethod
    def forward(a: Tensor, b: Tensor, mix: Mix, where: Placement) -> Tensor:
        return _summed(a, b, mix, where)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        """Save the inputs for the backward pass outside of `forward`, as `torch.func` requires."""
        ctx.save_for_backward(*inputs[:2])
        ctx.save_for_forward(*inputs[:2])
        ctx.settings = inputs[2:]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        (a, b), (mix, where), grad = ctx.saved_tensors, ctx.settings, grads[0]
        # the gradients use the transposed matrices
        u, x, y = (m if m is None else m.T for m in mix[:3])
        correlation = not where.conjugate
        picture_gradient = kernel_gradient = None
        if ctx.needs_input_grad[0]:
            gradient_where = where._replace(
                picture_corner=where.window_corner,
                window_corner=where.picture_corner,
                size=tuple(a.shape[1:]),
                conjugate=correlation,
            )
            picture_gradient = summed(grad, b, Mix(x, u, mix.y), gradient_where)
        if ctx.needs_input_grad[1]:
            gradient_where = where._replace(
                window_corner=where.kernel_corner, size=tuple(b.shape[1:]), conjugate=True
            )
            if where.conjugate:
                kernel_gradient = summed(
                    a,
                    grad,
                    Mix(y, mix.x, u),
                    gradient_where._replace(kernel_corner=where.window_corner),
                )
            else:
                kernel_gradient = summed(
                    grad,
                    a,
                    Mix(y, u, mix.x),
                    gradient_where._replace(
                        picture_corner=where.window_corner, kernel_corner=where.picture_corner
                    ),
                )
        return picture_gradient, kernel_gradient, None, None

    @staticmethod
    def jvp(ctx: Any, a: Tensor | None, b: Tensor | None, *_: None) -> Any:
        """Return the tangent by the product rule: the change of the first factor, then of the
        second.
        """
        first, second = ctx.saved_tensors
        changes = []
        if a is not None:
            changes.append(Summed.apply(a, second, *ctx.settings))  # type: ignore[no-untyped-call]
        if b is not None:
            changes.append(Summed.apply(first, b, *ctx.settings))  # type: ignore[no-untyped-call]
        return sum(changes[1:], changes[0])

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *inputs: Any) -> Any:
        return one_by_one(Summed.apply, info.batch_size, (*in_dims[:2], None, None), inputs)


def summed(a: Tensor, b: Tensor, mix: Mix, where: Placement) -> Tensor:
    """Return weighted sums (r, y, x) of convolutions of pictures (k, y, x) with kernels (q, y,
    x).
    """
    result: Tensor = Summed.apply(a, b, mix, where)  # type: ignore[no-untyped-call]
    return result


def _summed(a: Tensor, b: Tensor, mix: Mix, where: Placement) -> Tensor:
    """Return weighted sums (result, y, x) of convolutions, a block of spectrum columns at a
    time.
    """
    mix, (tall_length, wide_length) = mix.to(a), where.length
    columns = wide_length // 2 + 1
    step = columns if a.is_cuda else min(columns, _COLUMNS_AT_A_TIME)
    pictures = _Columns(
        _row_spectra(a, where.picture_corner[1], wide_length, step),
        where.picture_corner[0],
        tall_length,
    )
    kernels = _Columns(
        _row_spectra(b, where.kernel_corner[1], wide_length, step),
        where.kernel_corner[0],
        tall_length,
    )
    result = pictures.padded.new_empty(_result_count(mix, a), where.size[0], columns)
    for block_number, first_column in enumerate(range(0, columns, step)):
        picture_spectra = pictures.spectra(block_number)
        kernel_spectra = _matrix_times(mix.y, kernels.spectra(block_number))
        if where.conjugate:
            kernel_spectra = kernel_spectra.conj()
        block = torch.fft.ifft(_mixed_spectra(mix, picture_spectra, kernel_spectra))
        # only the rows of the window are kept
        block = block[
            :,
            : columns - first_column,
            where.window_corner[0] : where.window_corner[0] + where.size[0],
        ]
        result[:, :, first_column : first_column + step] = block.transpose(1, 2)
    return _pictures_of_rows(
        result, wide_length, slice(where.window_corner[1], where.window_corner[1] + where.size[1])
    )


def _result_count(mix: Mix, a: Tensor) -> int:
    """Return the number of results, from the last matrix that is not the identity."""
    return next(len(m) for m in (mix.u, mix.x, a) if m is not None)


def _mixed_spectra(mix: Mix, x: Tensor, y: Tensor) -> Tensor:
    """Return the spectra of the sums of convolutions, from the spectra ``x`` of pictures and
    ``y`` of kernels.
    """
    if not mix.results:
        return _matrix_times(mix.u, _matrix_times(mix.x, x) * y)
    kernels = y.view(mix.results, len(x), *y.shape[1:])
    total = x[0] * kernels[:, 0]
    for k in range(1, len(x)):
        total.addcmul_(x[k], kernels[:, k])
    return total


def _row_spectra(x: Tensor, left: int, wide: int, step: int) -> Tensor:
    """Return the FFT of each picture row after ``left`` zeros, as (plane, block, row, ``step``
    columns).

    A block of columns is contiguous in memory: in rows 12 kB apart, each element would lie in
    another memory page.
    """
    count, row_count, width = x.shape
    full_blocks, remainder = divmod(wide // 2 + 1, step)
    chunk = _rows_at_a_time(x, row_count)
    zero_padded = x.new_zeros(chunk, wide)
    blocks = zero_padded.new_empty(
        count, full_blocks + (remainder > 0), row_count, step, dtype=x.dtype.to_complex()
    )
    if remainder:
        # the last block is padded with zeros
        blocks[:, full_blocks, :, remainder:] = 0.0
    for plane, block in zip(x, blocks, strict=True):
        for y in range(0, row_count, chunk):
            rows = slice(y, min(y + chunk, row_count))
            padded_rows = zero_padded[: rows.stop - y]
            padded_rows[:, left : left + width] = plane[rows]
            spectrum: Tensor = torch.fft.rfft(padded_rows)
            block[:full_blocks, rows] = (
                spectrum[:, : full_blocks * step]
                .view(len(padded_rows), full_blocks, step)
                .transpose(0, 1)
            )
            block[full_blocks:, rows, :remainder] = spectrum[:, full_blocks * step :]
    return blocks


def _pictures_of_rows(spectrum: Tensor, wide: int, columns: slice) -> Tensor:
    """Return the given columns of pictures, from the spectrum of each row."""
    size = spectrum.shape[1]
    pixels = spectrum.real.new_empty(*spectrum.shape[:2], columns.stop - columns.start)
    chunk = _rows_at_a_time(spectrum, size)
    for plane, rows in zip(pixels, spectrum, strict=True):
        for y in range(0, size, chunk):
            plane[y : y + chunk] = torch.fft.irfft(rows[y : y + chunk], n=wide)[:, columns]
    return pixels


def _rows_at_a_time(x: Tensor, count: int) -> int:
    """Return the number of rows that are transformed at a time: those that fit in the cache; on a
    GPU all.
    """
    return count if x.is_cuda else min(count, _ROWS_AT_A_TIME)


class _Columns:
    """Blocks of spectrum columns, transformed in reused memory, because allocation takes longer
    than the FFTs.
    """

    def __init__(self, blocks: Tensor, top: int, high: int) -> None:
        self.blocks = blocks
        self.padded = blocks.new_zeros(len(blocks), blocks.shape[3], high)
        self.padded_picture = self.padded[..., top : top + blocks.shape[2]]
        self.spectrum = torch.empty_like(self.padded)

    def spectra(self, block: int) -> Tensor:
        """Return the FFT along each column of one block of columns: (plane, column, frequency)."""
        self.padded_picture.copy_(self.blocks[:, block].transpose(1, 2))
        torch.fft.fft(self.padded, out=self.spectrum)
        return self.spectrum


def _matrix_times(matrix: Tensor | None, spectra: Tensor) -> Tensor:
    """Return the product of a real matrix and complex spectra; None is the identity."""
    if matrix is None:
        return spectra
    real_and_imaginary = torch.view_as_real(spectra)
    return torch.view_as_complex(
        (matrix @ real_and_imaginary.reshape(len(spectra), -1)).reshape(
            -1, *real_and_imaginary.shape[1:]
        )
    )


# --- collapsed plan -------------------------------------------------------------------------------

# The choice of the fastest way to compute weighted sums over the bands of an image with a bounded
# error.


_WEAK_BANDS_SHARE = 0.05  #: share of the allowed error for the omission of weak bands
_TRIED_PLANE_NUMBERS = 6  #: how many numbers of planes are tried, from the smallest sufficient one
_TESTED_BAND_STEP = 8  #: every 8th band is tested first for a smaller window


class ImageFacts(NamedTuple):
    """The properties of scene, PSF and weights from which a convolution plan is chosen; float64,
    on the CPU.
    """

    rows: Tensor  #: (row, band)
    basis: Tensor  #: (band, k)
    #: (k + 1, band) norm of the residual of each band if it is represented by the first 0, 1, ... k
    #: planes; with 0 planes it is the norm of the band itself
    residual: Tensor
    norm: Tensor  #: (k,) the same norm of each plane
    gram: Tensor  #: (k, k) Gram matrix: scalar products of the planes
    copies: int  #: largest number of copies of a scene point: 9 for a reflecting border, else 1
    light: PsfLight
    size: tuple[int, int]
    reflect: bool
    #: (band, j) weights of the PSFs in each band, if only few bands have a PSF of their own
    share: Tensor | None = None


class Plan(NamedTuple):
    """A way to convolve a scene with a PSF: basis images, kernels, bands and PSF window, with
    error bound and cost.
    """

    planes: int
    bands: Tensor  #: indices of the bands that are not omitted
    window: tuple[int, int]
    kernels: Tensor | None  #: (kernel, bands used); None: each PSF is a kernel
    mix: Mix
    omitted_light: Tensor  #: (row,) upper bound of the light that the plan omits
    kernel_count: int
    cost: float  #: estimated seconds on two cores
    complete: bool  #: nothing but zeros is omitted

    @property
    def kept(self) -> list[int]:
        """Return the numbers of planes, kernels and bands, and the PSF window's size, as in
        `Channels.kept`.
        """
        return [self.planes, self.kernel_count, len(self.bands), *self.window]


class FewKernels(NamedTuple):
    """A small set of convolution kernels, brightest first, whose weighted sums approximate a
    larger set of kernels.
    """

    kernels: Tensor  #: (q, band)
    mixed: Tensor  #: (row x plane, q)
    #: (q - 1, row) upper bound of the light that the first 1, 2, ... kernels omit
    omitted_light: Tensor
    limit: Tensor  #: (row,) most light that may be omitted


def with_windows(
    facts: ImageFacts, intensity: Tensor, brightest: Tensor, within: float
) -> ImageFacts:
    """Return ``facts`` with the light that smaller PSF windows omit, or unchanged if these
    windows omit too much.
    """
    # a test on few bands avoids the sums over all bands if no smaller window fits
    some_bands, signed = slice(_TESTED_BAND_STEP // 2, None, _TESTED_BAND_STEP), facts.light.signed
    if facts.share is None and len(intensity) > _TESTED_BAND_STEP:
        facts_of_some = facts._replace(
            rows=facts.rows[:, some_bands],
            basis=facts.basis[some_bands],
            residual=facts.residual[:, some_bands],
        )
        if not _smaller_window_fits(
            facts_of_some._replace(light=psf_light_by_window(intensity[some_bands], signed)),
            within * brightest,
        ):
            return facts
    return facts._replace(light=mean_psf_light(psf_light_by_window(intensity, signed), facts.share))


def _smaller_window_fits(facts: ImageFacts, limit: Tensor) -> bool:
    """Return True if the second largest PSF window omits little enough light for some number of
    basis images.
    """
    bands, planes = torch.arange(len(facts.basis)), range(1, len(facts.norm) + 1)
    return len(facts.light.windows) > 1 and any(
        bool((facts.rows.abs() @ _tail_light(facts, bands, k, 1) <= limit).all()) for k in planes
    )


def cheapest_plan(facts: ImageFacts, brightest: Tensor, within: float) -> Plan:
    """Return the cheapest convolution plan that omits at most ``within`` of the brightest pixel,
    or a complete plan.
    """
    bands, omitted_light = _strong_bands(facts, brightest, within)
    complete = min(
        _plans(facts, bands, omitted_light, len(facts.norm), 0), key=lambda plan: plan.cost
    )
    cheapest = complete._replace(complete=True)
    if within <= 0:
        return cheapest
    for planes in _sufficient_planes(facts, bands, omitted_light, brightest, within):
        few = _few_kernels(facts, bands, planes, brightest, within)
        for window_number in range(len(facts.light.windows)):
            plans = _plans(facts, bands, omitted_light, planes, window_number, few)
            cheapest = min([cheapest, *plans], key=lambda plan: plan.cost)
    return cheapest


def _strong_bands(facts: ImageFacts, brightest: Tensor, within: float) -> tuple[Tensor, Tensor]:
    """Return the indices of the bands to convolve, and an upper bound of the light of the omitted
    bands in each weighted sum.
    """
    # residual[0], with no plane, is the norm of the whole band
    most_light = facts.rows.abs() * (facts.residual[0] * facts.light.total)
    share = torch.where(
        most_light > 0, most_light / brightest.clamp_min(1e-300)[:, None], 0.0
    ).amax(0)
    rising_order = share.argsort()
    omitted = rising_order[share[rising_order].cumsum(0) <= _WEAK_BANDS_SHARE * max(within, 0.0)]
    bands = torch.ones_like(share, dtype=torch.bool).index_fill_(0, omitted, False)
    if not bool(bands.any()):
        bands[int(share.argmax())] = True
    return bands.nonzero()[:, 0], most_light[:, ~bands].sum(1)


def _sufficient_planes(
    facts: ImageFacts, bands: Tensor, lost: Tensor, brightest: Tensor, within: float
) -> list[int]:
    """Return the smallest numbers of basis images for which the omitted light is at most ``within``
    times the brightest pixel.
    """
    omitted_light = (
        lost + (facts.residual[:, bands] * facts.light.total[bands]) @ facts.rows[:, bands].abs().T
    )
    fits = [
        k
        for k in range(1, len(facts.norm) + 1)
        if bool((omitted_light[k] <= within * brightest).all())
    ]
    return fits[:_TRIED_PLANE_NUMBERS]


def _plans(
    facts: ImageFacts,
    bands: Tensor,
    weak_light: Tensor,
    planes: int,
    window_number: int,
    few: FewKernels | None = None,
) -> Iterator[Plan]:
    """Yield up to three convolution plans that use the first ``planes`` basis images and the PSF
    window number ``window_number``.

    The three plans have one kernel for each plane and row, one kernel for each PSF, and a smaller
    set of kernels that are mixed. ``weak_light`` is the light of the omitted bands.
    """
    rows, basis = facts.rows[:, bands], facts.basis[bands, :planes]
    passed_light = facts.light.total[bands]
    omitted_light = (
        weak_light
        + rows.abs() @ (facts.residual[planes, bands] * passed_light)
        + rows.abs() @ _tail_light(facts, bands, planes, window_number)
    )
    if few is not None and not bool((omitted_light <= few.limit).all()):
        return
    row_count = len(rows)
    # a term is a pair (row, plane): a result sums the terms of its row
    result_of_term = torch.eye(row_count, dtype=torch.float64).repeat_interleave(planes, 1)
    plane_of_term = torch.eye(planes, dtype=torch.float64).repeat(row_count, 1)
    kernel_weights = _kernel_weights(rows, basis)

    def plan(kernels: Tensor | None, mix: Mix, omitted_light: Tensor) -> Plan:
        window = facts.light.windows[window_number]
        psfs = len(bands) if facts.share is None else facts.share.shape[1]
        kernel_count = psfs if kernels is None else len(kernels)
        return Plan(
            planes=planes,
            bands=bands,
            window=window,
            kernels=kernels,
            mix=mix,
            omitted_light=omitted_light,
            kernel_count=kernel_count,
            cost=_expected_seconds(facts, window, planes, psfs, kernels, mix),
            complete=False,
        )

    # a kernel for each plane and row
    yield plan(kernel_weights, Mix(result_of_term, plane_of_term, None, row_count), omitted_light)
    if facts.share is None:
        # a kernel for each band, that is, its PSF
        yield plan(None, Mix(rows, basis, None), omitted_light)
    else:
        psf_weights = kernel_weights @ facts.share[bands]
        mix = Mix(result_of_term, plane_of_term, psf_weights, row_count)
        yield plan(None, mix, omitted_light)
    if few is None:
        return
    # the fewest mixed kernels within the limit
    for q in (few.omitted_light + omitted_light <= few.limit).all(1).nonzero()[:1, 0].tolist():
        mix = Mix(result_of_term, plane_of_term, few.mixed[:, : q + 1], row_count)
        yield plan(few.kernels[: q + 1], mix, omitted_light + few.omitted_light[q])


def _few_kernels(
    facts: ImageFacts, bands: Tensor, k: int, brightest: Tensor, within: float
) -> FewKernels:
    """Return a small set of kernels: the singular vectors of the matrix of kernel weights (row x
    plane, band).
    """
    rows, band_light = facts.rows[:, bands], facts.light.total[bands]
    plane_scale = torch.where(
        brightest[:, None] > 0, facts.norm[:k] / brightest[:, None], 0.0
    ).flatten()
    # scaled to light, so that singular values are errors of the image
    scaled = plane_scale[:, None] * _kernel_weights(rows, facts.basis[bands, :k]) * band_light
    left_vectors, singular_values, right_vectors = torch.linalg.svd(scaled, full_matrices=False)
    omitted_light = [
        (scaled - (left_vectors[:, :q] * singular_values[:q]) @ right_vectors[:q])
        .abs()
        .sum(1)
        .reshape(len(rows), -1)
        .sum(1)
        for q in range(1, len(singular_values))
    ]
    kernels = torch.where(band_light > 0, right_vectors / band_light, 0.0)
    mixed = torch.where(
        plane_scale[:, None] > 0, left_vectors * singular_values / plane_scale[:, None], 0.0
    )
    # infinite for a row whose brightest pixel is 0: `plane_scale` gives it no weight
    unknown = torch.where((brightest == 0) & (rows != 0).any(1), math.inf, 0.0)
    omitted = brightest[None][:0]
    if omitted_light:
        omitted = torch.stack(omitted_light) * brightest + unknown
    return FewKernels(kernels, mixed, omitted, within * brightest)


def _kernel_weights(rows: Tensor, basis: Tensor) -> Tensor:
    """Return the weight (row x plane, band) of each PSF in the kernel for each weighted sum and
    basis image.
    """
    return (rows[:, None, :] * basis.T).flatten(0, 1)


def _tail_light(facts: ImageFacts, bands: Tensor, k: int, j: int) -> Tensor:
    """Return, for each band, an upper bound of the light that the PSF outside the window adds to an
    image pixel.

    The bound is the smaller of two cases of Young's inequality.
    """
    basis = facts.basis[bands, :k]
    beyond, above = facts.light.beyond[j, bands], facts.light.above[j, bands]
    largest_value = facts.residual[0, bands] + facts.residual[k, bands]
    power = ((basis @ facts.gram[:k, :k]) * basis).sum(1).clamp_min(0) * facts.copies
    # max |scene| x sum |PSF|, or root of (scene power x sum |PSF| x max |PSF|)
    return torch.minimum(largest_value * beyond, (power * beyond * above).sqrt() * (1 + 1e-6))


def _expected_seconds(
    facts: ImageFacts, window: tuple[int, int], k: int, bands: int, kernels: Tensor | None, mix: Mix
) -> float:
    """Return the expected time of a convolution plan on two cores in seconds: FFTs, products and
    kernel sums.
    """
    transform_area = math.prod(fft_lengths(facts, window))
    count = bands if kernels is None else len(kernels)
    terms = len(mix.x) if mix.x is not None else k
    products = terms * (k + len(facts.rows) + (count if mix.y is not None else 0) + 8)
    kernel_sums = 0 if kernels is None else count * bands * math.prod(window)
    # measured seconds per sample of transforms, products and kernel sums
    return (
        transform_area * (2e-9 * (k + count + len(facts.rows)) + 3e-11 * products)
        + 1.4e-11 * kernel_sums
    )


def fft_lengths(facts: ImageFacts, window: tuple[int, int]) -> tuple[int, int]:
    """Return the shortest FFT lengths (y, x) for which the convolution has no wrap-around within
    the image.
    """
    if facts.reflect:
        y, x = (fft_length(s + w - 1) for s, w in zip(facts.size, window, strict=True))
    else:
        y, x = (
            fft_length(max(s + w // 2, s + w - 1 - w // 2))
            for s, w in zip(facts.size, window, strict=True)
        )
    return y, x
