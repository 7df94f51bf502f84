"""Weighted sums over the bands of an image; bands are summed before the convolution."""

import math
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d, pad

from neusee.nodes import Check, ErrorBound, TensorStats, node
from neusee.nodes.optics._band_image import Border, image, within_reach
from neusee.nodes.optics._convolution_plan import (
    ImageFacts,
    Mix,
    Placement,
    Plan,
    PsfLight,
    central_window,
    cheapest_plan,
    fft_lengths,
    mean_psf_light,
    psf_light,
    summed,
    with_windows,
)
from neusee.nodes.values import Channels, FewBands, LowRankCube, Psf

# --- convolve plan --------------------------------------------------------------------------------

# The convolution of a scene with PSFs by a chosen plan: borders, kernels, and an estimate of the
# round-off.


#: side in pixels of the cells for the fast bound of the largest error of a pixel
_CELL_SIDE = 8
_SLAB_ROWS = 16  #: number of PSF rows that are summed at a time: those of 31 bands fit in the cache


def convolved(planes: Tensor, intensity: Tensor, facts: ImageFacts, plan: Plan) -> Tensor:
    """Return weighted sums (row, y, x) over the bands of the image, computed with the basis images
    and kernels of ``plan``.
    """
    scene = bordered(planes[: plan.planes], facts, plan.window)
    return summed(
        scene, _plan_kernels(intensity, facts, plan), plan.mix, _placement(facts, plan.window)
    )


def _placement(facts: ImageFacts, window: tuple[int, int]) -> Placement:
    """Return the positions of scene and kernel, and the window of their convolution that is the
    image.
    """
    (m, n), zero = window, (0, 0)
    # first pixel of the image in the full convolution: half a PSF from the edge, or a whole PSF if
    # the scene has a mirrored border
    corner = (m - 1, n - 1) if facts.reflect else (m // 2, n // 2)
    return Placement(zero, zero, corner, facts.size, fft_lengths(facts, window))


def majorant(scene_error: Tensor, intensity: Tensor, facts: ImageFacts) -> Tensor:
    """Return an upper bound (y, x) of the error of the image for an error of at most
    ``scene_error`` (y, x) in every band of the scene.
    """
    window, kernel = (intensity.shape[1], intensity.shape[2]), _largest_weight_psf(intensity, facts)
    reached = summed(
        bordered(scene_error[None], facts, window),
        kernel,
        Mix(None, None, None),
        _placement(facts, window),
    )
    return reached[0].clamp_min_(0)


def majorant_by_cell(scene_error: Tensor, intensity: Tensor, facts: ImageFacts) -> Tensor:
    """Return an upper bound of `majorant` in each cell of 8 x 8 pixels: (cell, cell) float64. It is
    much faster.

    The part of the kernel in one cell brings light to the pixels of an image cell from four
    neighbouring cells of the scene. The largest error in these cells is an upper bound for each
    pixel.
    """
    window, kernel = (
        (intensity.shape[1], intensity.shape[2]),
        _largest_weight_psf(intensity, facts)[0],
    )
    corner = _placement(facts, window).window_corner
    padding_before = [
        -k % _CELL_SIDE for k in corner
    ]  # so that a cell begins at the middle of the kernel
    padding_after = [-(k + b) % _CELL_SIDE for k, b in zip(window, padding_before, strict=True)]
    padded_kernel = pad(
        kernel.double(), (padding_before[1], padding_after[1], padding_before[0], padding_after[0])
    )
    cell_light = avg_pool2d(padded_kernel[None], _CELL_SIDE)[0] * _CELL_SIDE**2
    # maximum over 2 x 2 cells, because a shift by a part of a cell overlaps two along each axis
    cell_error = max_pool2d(
        pad(cells(bordered(scene_error[None], facts, window))[None], (1, 1, 1, 1)), 2, 1
    )[0, 0].to(cell_light)
    length = [a + b for a, b in zip(cell_light.shape, cell_error.shape, strict=True)]
    product = torch.fft.irfft2(
        torch.fft.rfft2(cell_light, length) * torch.fft.rfft2(cell_error, length), length
    )
    first_cell = [(k + b) // _CELL_SIDE for k, b in zip(corner, padding_before, strict=True)]
    y, x = (slice(f, f + -(-n // _CELL_SIDE)) for f, n in zip(first_cell, facts.size, strict=True))
    image_cells: Tensor = product[y, x]
    return image_cells.clamp_min_(0)


def cells(planes: Tensor) -> Tensor:
    """Return the maximum (k, cell, cell) in each cell of planes (k, y, x); the last cells may be
    smaller.
    """
    largest: Tensor = max_pool2d(planes[None], _CELL_SIDE, ceil_mode=True)
    return largest[0]


def _largest_weight_psf(intensity: Tensor, facts: ImageFacts) -> Tensor:
    """Return the sum (1, y, x) of the absolute PSFs of all bands, each with its largest absolute
    weight in any row.
    """
    heaviest = facts.rows.abs().amax(0).to(intensity)
    weights = heaviest[None] if facts.share is None else heaviest[None] @ facts.share.to(heaviest)
    return _summed_bands(weights, intensity, facts.light.signed)


def bordered(planes: Tensor, facts: ImageFacts, window: tuple[int, int]) -> Tensor:
    """Return the basis images of the scene, with a mirrored border if ``facts.reflect`` is set."""
    if not facts.reflect:
        return planes
    m, n = window
    # left, right, top, bottom: the reach of a PSF of odd or even side
    padding = (n - 1 - n // 2, n // 2, m - 1 - m // 2, m // 2)
    padded: Tensor = pad(planes, padding, mode="reflect")
    return padded


def _plan_kernels(intensity: Tensor, facts: ImageFacts, plan: Plan) -> Tensor:
    """Return the kernels (kernel, y, x) of a plan: the PSFs themselves, or weighted sums of
    PSFs.
    """
    stack = central_window(intensity, plan.window)
    if plan.kernels is None:
        return stack if plan.kernel_count == len(stack) else stack[plan.bands.to(stack.device)]
    weights = plan.kernels.new_zeros(len(plan.kernels), len(facts.basis))
    # the columns of omitted bands stay 0
    weights = weights.index_copy_(1, plan.bands, plan.kernels)
    weights = weights if facts.share is None else weights @ facts.share
    return _summed_bands(weights.to(stack), stack)


def _summed_bands(weights: Tensor, stack: Tensor, absolute: bool = False) -> Tensor:
    """Return weighted sums (kernel, y, x) over the bands of a PSF, or of its absolute values.

    If a copy of the PSF is needed, a few rows are copied at a time.
    """
    if stack.requires_grad or (stack.is_contiguous() and not absolute):
        return (weights @ stack.flatten(1)).view(-1, *stack.shape[1:])
    sums = stack.new_empty(len(weights), *stack.shape[1:])
    for y in range(0, stack.shape[1], _SLAB_ROWS):
        rows = stack[:, y : y + _SLAB_ROWS]
        rows = rows.abs() if absolute else rows
        sums[:, y : y + _SLAB_ROWS] = (weights @ rows.flatten(1)).view(-1, *rows.shape[1:])
    return sums


def estimated_brightest(planes: Tensor, facts: ImageFacts) -> Tensor:
    """Return an estimate of the brightest pixel of each weighted sum over the image bands.

    The estimate is the smaller of two numbers: a quarter of the brightest pixel without blur, and
    half of an upper bound of the brightest pixel with blur.
    """
    passed_light = facts.light.total
    brightness, unblurred = planes.new_empty(planes[0].numel()), torch.zeros_like(facts.rows[:, 0])
    for i, weights in enumerate((facts.rows * passed_light @ facts.basis).to(planes)):
        pixel_sum = torch.mv(planes.flatten(1).T, weights, out=brightness)
        unblurred[i] = torch.maximum(pixel_sum.amax(), -pixel_sum.amin())
    band_power = ((facts.basis @ facts.gram) * facts.basis).sum(1).clamp_min(0) * facts.copies
    blurred = facts.rows.abs() @ (band_power * passed_light * facts.light.peak).sqrt()
    # `unblurred` and `blurred` are upper bounds; 1/4 and 1/2 as in the docstring
    return torch.minimum(unblurred / 4, blurred / 2)


def fft_round_off(facts: ImageFacts, plan: Plan, brightest: Tensor, eps: float) -> Tensor:
    """Return an estimate of the largest FFT round-off in each weighted sum over the image bands.

    The round-off is close to white: a share eps sqrt(log2 N) / 2 of the power, spread over all N
    samples. The estimate takes eight standard deviations of that noise. It adds ten roundings of
    the brightest pixel for errors that are not spread: sums over the bands, planes and rows of a
    PSF, of which five roundings were measured.
    """
    transform_size = math.prod(fft_lengths(facts, plan.window))
    result_of_term, term_of_plane, term_of_kernel, _ = plan.mix
    plane_norm = facts.gram.diagonal()[: plan.planes].clamp_min(0).sqrt() * math.sqrt(facts.copies)
    kernel_norm = (facts.light.total * facts.light.peak).sqrt()
    if plan.kernels is not None:
        kernel_norm = plan.kernels.abs() @ kernel_norm[plan.bands]
    else:  # the band of each PSF, or the band in which a PSF has the weight 1
        kernel_norm = kernel_norm[plan.bands if facts.share is None else facts.share.argmax(0)]
    terms = (plane_norm if term_of_plane is None else term_of_plane.abs() @ plane_norm) * (
        kernel_norm if term_of_kernel is None else term_of_kernel.abs() @ kernel_norm
    )
    term_norm = terms[None].sum(1) if result_of_term is None else result_of_term.abs() @ terms
    return eps * (
        8 * math.sqrt(math.log2(transform_size + 1)) * term_norm / math.sqrt(transform_size)
        + 10 * brightest
    )


# --- channel image --------------------------------------------------------------------------------

# Weighted sums over the bands of an image, from few convolutions because bands are summed before
# the convolution.


Share = Annotated[float, Field(ge=0, le=1)]  #: relative to the brightest pixel
#: largest bound of the brightest pixel that may come from cells, relative to the allowed error
_CELLS_ERROR_SHARE = 0.25
#: expected brightness of the darkest pixel; photographs have 1e-2, scenes at night 2e-5
_DARKEST_PIXEL = 1e-3
_LARGE_SIDE = 512  #: smallest side in pixels of an image for which the bound by cells saves time
#: number of plans tried: with estimated brightest pixels, with measured ones, with nothing omitted
_PLANS_TRIED = 3


@node(rtol=1e-5)
def image_channels(
    radiance: LowRankCube,
    psf: Psf,
    rows: Tensor,
    few: FewBands | None = None,
    *,
    border: Border = "zero",
    within: Share = 0.0,
    largest: bool = False,
) -> Channels:
    """Compute weighted sums over the bands of the image, with few convolutions instead of one
    convolution for each band.

    Plane i is the sum over k of planes[k] convolved with sum_b rows[i, b] basis[b, k] psf[b]: three
    planes and three rows take 15 transforms where 31 bands take 93. Planes, kernels, bands and the
    tails of the PSF are omitted as far as the root mean square error `within` allows, whichever
    saves the most time; 0 omits nothing. With `largest` only the error of the low-rank cube is
    allowed, and the error of the brightest pixel is bounded as well. With `few`, the PSFs are those
    of few bands, and the PSF of every other band is interpolated between two of these.

    Shapes: radiance k planes (y, x), psf.intensity (band, any, any), rows (row, band) -> planes
            (row, y, x).
    Units:  those of the radiance times those of the rows.
    Error:  `bound`, as a share of the brightest pixel of each row. Proved upper bounds: the
            residual of the cube, by the sum of each PSF (Young's inequality, as for the root mean
            square; where the border reflects, three times that of the scene); of the brightest
            pixel, the image of the largest residual of each pixel; tails, by Young's inequality;
            kernels, by the sum of their residuals. Estimated, not proved: round-off of the
            transforms, from the powers of planes and kernels, never less than was measured; and
            `estimated`, the error by few bands. Planes and PSF receive gradients; basis and rows
            are constants.
    Raises: ValueError where scene, PSF and rows have different bands, or the scene is a batch.
    Source: linearity of incoherent imaging, Goodman, Introduction to Fourier Optics, 4th ed., ch.
            7.
    """
    share = (
        None
        # no weights are needed if each band has its own PSF
        if few is None or few.share.shape[0] == few.share.shape[1]
        else few.share.double().cpu()
    )
    planes, intensity = _planes_and_psf(radiance, psf, rows, share)
    largest_weight = rows.detach().abs().amax(1).double().cpu()
    largest_weight = largest_weight.where(largest_weight > 0, 1.0)
    scaled_rows = rows.detach().double().cpu() / largest_weight[:, None]
    facts = _image_facts(
        radiance,
        planes,
        scaled_rows,
        border,
        mean_psf_light(psf_light(intensity.detach()), share),
        share,
    )
    allowed_error = 0.0 if largest else within
    result, bound, sizes = _summed_image(planes, intensity, facts, allowed_error)
    # relative error of the brightest pixel, only computed for `largest`
    brightest_error = (
        _brightest_pixel_error(result, radiance, intensity, facts, within * _CELLS_ERROR_SHARE)
        if largest
        else math.inf
    )
    brightest = torch.tensor(brightest_error, dtype=torch.float64)
    row_scale = largest_weight.to(result)[:, None, None]
    result = result * row_scale if result.requires_grad else result.mul_(row_scale)
    estimated = (
        torch.zeros(2, dtype=torch.float64)
        if few is None
        else torch.stack([few.error, few.largest]).cpu()
    )
    return Channels(result, rows.detach().double(), bound, sizes, brightest, estimated)


@image_channels.reference
def _(
    radiance: LowRankCube,
    psf: Psf,
    rows: Tensor,
    few: FewBands | None = None,
    *,
    border: Border = "zero",
    **_: Any,
) -> Channels:
    assert image.hooks.reference is not None
    if few is not None:
        psf = psf._replace(intensity=torch.einsum("bj,jyx->byx", few.share, psf.intensity.double()))
    cube = torch.tensordot(radiance.basis.double(), radiance.planes.double(), 1)
    bands = image.hooks.reference(cube, psf, border=border)
    zero = torch.zeros((), dtype=torch.float64)
    return Channels(torch.tensordot(rows.double(), bands, 1), rows.double(), zero)


@image_channels.approximation_error
def _(result: Channels) -> tuple[float, float]:
    # relative errors, in root mean square and of the brightest pixel
    error, brightest_error = result.estimated.tolist()
    return float(result.bound) + error, float(result.largest) + brightest_error


@image.propagate_error
@image_channels.propagate_error
def _(
    radiance: ErrorBound,
    psf: ErrorBound,
    rows: ErrorBound | None = None,
    few: ErrorBound | None = None,
    *,
    result: TensorStats,
    **params: Any,
) -> float | ErrorBound:
    """Return the error due to the light that is missing in the PSF, which `Channels.bound` does not
    include.

    The share of the PSF is the error of each pixel of a picture relative to its brightest pixel, as
    in `flare.stray_light`. The error due to few bands is in `Channels.estimated` and is not counted
    again.
    """
    if radiance.rms or (rows is not None and rows.rms):
        return math.inf
    share = psf.share
    peak = share / (1.0 - share) if share < 1.0 else math.inf
    return ErrorBound(share * max(abs(result.min), abs(result.max)), peak=peak)


@image_channels.expected_range
def _(*inputs: Any, **params: Any) -> tuple[float, float]:
    """Return the expected range of an image relative to its brightest pixel, see
    `nodes/sensor/_expected_ranges.py`.
    """
    return _DARKEST_PIXEL, 1.0


@image_channels.check
def _(result: Channels, *inputs: Any, within: float = 0.0, **params: Any) -> list[Check]:
    # in the order of `Plan.kept`
    planes, kernels, bands, y, x = result.kept.tolist()
    text = (
        f"{planes} planes and {kernels} kernels of {y} x {x} for {result.rows.shape[1]} bands, "
        f"{result.rows.shape[1] - bands} left out, within {float(result.bound):.2g}"
    )
    if float(result.estimated[0]):
        text = f"{text}; PSFs of few bands, estimated error {float(result.estimated[0]):.2g}"
    return [Check(text, within == 0 or float(result.bound) <= within)]


def _planes_and_psf(
    radiance: LowRankCube, psf: Psf, rows: Tensor, share: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Return the basis images of the scene (k, y, x) and the PSF (band, y, x), cropped to its
    largest reach within the scene, in the same precision.
    """
    psf_bands = len(psf.intensity)
    if share is not None:
        psf_bands = len(share) if share.shape[1] == psf_bands else -1
    band_counts = {len(radiance.basis), psf_bands, rows.shape[-1]}
    if (
        len(band_counts) > 1
        or radiance.planes.ndim != 3
        or psf.intensity.ndim != 3
        or rows.ndim != 2
    ):
        raise ValueError(
            f"radiance of {len(radiance.basis)} bands in planes {tuple(radiance.planes.shape)}, PSF"
            f" {tuple(psf.intensity.shape)} and rows {tuple(rows.shape)} must have the same bands,"
            " without a batch: compute all three from the same `bands` step"
        )
    planes, dtype = radiance.planes, torch.promote_types(radiance.planes.dtype, psf.intensity.dtype)
    cropped_psf = within_reach(
        within_reach(psf.intensity, -2, planes.shape[-2]), -1, planes.shape[-1]
    )
    dtype = torch.promote_types(dtype, torch.float32)
    return planes.to(dtype), cropped_psf.to(dtype)


def _image_facts(
    radiance: LowRankCube,
    planes: Tensor,
    rows: Tensor,
    border: Border,
    through: PsfLight,
    share: Tensor | None,
) -> ImageFacts:
    """Return the properties of scene, PSF and weights from which a plan is chosen, in float64 on
    the CPU.
    """
    flat_planes = planes.detach().flatten(1)
    plane_products = (flat_planes @ flat_planes.T).double().cpu()
    # with mirrored borders, a point of the scene occurs at most 3 x 3 times
    copy_count = 9 if border == "reflect" else 1
    # residuals as root mean squares if the cube has them, otherwise as maxima
    if radiance.residual_rms.numel():
        residual = radiance.residual_rms.double().cpu() * math.sqrt(copy_count)
        plane_norms = (
            (plane_products.diagonal() * (1.001 * copy_count / flat_planes.shape[1]))
            .clamp_min(0)
            .sqrt()
        )
    else:
        residual, plane_norms = (
            radiance.residual_max.double().cpu(),
            torch.maximum(flat_planes.amax(1), -flat_planes.amin(1)).double().cpu(),
        )
    return ImageFacts(
        rows,
        radiance.basis.detach().double().cpu(),
        residual,
        plane_norms,
        plane_products,
        copy_count,
        through,
        (planes.shape[1], planes.shape[2]),
        border == "reflect",
        share,
    )


def _summed_image(
    planes: Tensor, intensity: Tensor, facts: ImageFacts, within: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the summed image, its relative error bound, and the sizes (`Plan.kept`) of the first
    convolution plan with an error of at most ``within``.
    """
    eps = torch.finfo(planes.dtype).eps
    # `within` relative to the true pixel is within / (1 + within) relative to the computed pixel
    brightest, allowed_error = (
        facts.rows.new_zeros(len(facts.rows)),
        within / (1 + within) - 16 * eps,
    )
    if within > 0:
        brightest = estimated_brightest(planes.detach(), facts)
        facts = with_windows(facts, intensity.detach(), brightest, allowed_error)
    for attempt in range(_PLANS_TRIED):
        if attempt == _PLANS_TRIED - 1:
            allowed_error = 0.0  # the last try omits nothing
        plan = cheapest_plan(facts, brightest, allowed_error)
        result = convolved(planes, intensity, facts, plan)
        brightest_found = result.detach().abs().amax((1, 2)).double().cpu()
        round_off = fft_round_off(facts, plan, brightest_found, eps)
        bound = _largest_relative_error(plan.omitted_light + round_off, brightest_found)
        if plan.complete or bound <= within:
            break
        brightest = (brightest_found - plan.omitted_light - round_off).clamp_min(0)
        allowed_error = (
            within / (1 + within) - _largest_relative_error(round_off, brightest_found) - eps
        )
    return result, torch.tensor(bound, dtype=torch.float64), torch.tensor(plan.kept)


def _brightest_pixel_error(
    result: Tensor, radiance: LowRankCube, intensity: Tensor, facts: ImageFacts, quickly: float
) -> float:
    """Return the largest relative error of the brightest pixel over all weighted sums of the image
    bands.

    The largest residual of the cube at each pixel is convolved with the PSFs of all bands. The true
    image differs from the computed image by at most this residual image. The true maximum is
    therefore at most the maximum of (computed image + residual image). It is at least the computed
    maximum minus the residual image at the same pixel, and this second error is never the larger
    one. For a large image, the faster bound from cells of 8 x 8 pixels is returned if it is at most
    ``quickly``.
    """
    if not radiance.residual_map.numel():
        return math.inf
    image, residual = result.detach(), radiance.residual_map.to(result)
    lowest, highest = (
        torch.stack(ends).double().cpu() for ends in zip(*map(torch.aminmax, image), strict=True)
    )
    round_off = fft_round_off(
        facts,
        cheapest_plan(facts, highest, 0.0),
        torch.maximum(highest, -lowest),
        torch.finfo(image.dtype).eps,
    )
    if quickly > 0 and min(image.shape[1:]) >= _LARGE_SIDE:
        highest_possible = (
            (cells(image) + majorant_by_cell(residual, intensity.detach(), facts))
            .amax((1, 2))
            .double()
            .cpu()
        )
        if (
            largest_error := _largest_relative_error(
                highest_possible - highest + round_off, highest
            )
        ) <= quickly:
            return largest_error
    residual_image = majorant(residual, intensity.detach(), facts)
    sum_buffer = torch.empty_like(residual_image)
    highest_possible = (
        torch.stack([torch.add(row, residual_image, out=sum_buffer).amax() for row in image])
        .double()
        .cpu()
    )
    return _largest_relative_error(highest_possible - highest + round_off, highest)


def _largest_relative_error(error_bound: Tensor, peak: Tensor) -> float:
    """Return the largest error of the brightest pixels relative to their true values, from computed
    values ``peak`` and error bounds ``error_bound``.
    """
    relative_errors = torch.where(
        error_bound > 0,
        torch.where(error_bound < peak, error_bound / (peak - error_bound), math.inf),
        0.0,
    )
    if not bool(torch.isfinite(error_bound + peak).all()):
        return math.inf
    return float(relative_errors.amax())


image.channel_sum_form = image_channels
