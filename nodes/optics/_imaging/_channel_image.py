"""Weighted sums over the bands of an image, from few convolutions because bands are summed before the convolution."""

import math
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, ErrorBound, TensorStats, node
from neusee.nodes.optics._imaging._band_image import Border, image, reach
from neusee.nodes.optics._imaging._collapsed_plan import Given, choose, with_windows
from neusee.nodes.optics._imaging._convolve_plan import cells, convolved, guessed, majorant, majorant_by_cell, rounding
from neusee.nodes.optics._imaging._psf_energy import Passed, passed, spread
from neusee.nodes.values import Channels, FewBands, LowRankCube, Psf

Share = Annotated[float, Field(ge=0, le=1)]  #: as a share of the brightest pixel
_QUICKLY = 0.25  #: share of the error up to which the bound of the brightest pixel may come from cells of pixels
_DARKEST = 1e-3  #: expected brightness of the darkest pixel; photographs have 1e-2, scenes at night 2e-5
_LARGE = 512  #: pixels along the sides of an image from which cells of pixels save time
_TRIES = 3  #: plans tried: with the brightest pixels estimated, then measured, then with nothing omitted


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
    """Compute weighted sums over the bands of the image, with few convolutions instead of one convolution for each
    band.

    Plane i is the sum over k of planes[k] convolved with sum_b rows[i, b] basis[b, k] psf[b]: three planes and three
    rows take 15 transforms where 31 bands take 93. Planes, kernels, bands and the tails of the PSF are omitted as far
    as the root mean square error `within` allows, whichever saves the most time; 0 omits nothing. With `largest` only
    the error of the low-rank cube is allowed, and the error of the brightest pixel is bounded as well. With `few`, the
    PSFs are those of few bands, and the PSF of every other band is interpolated between two of these.

    Shapes: radiance k planes (y, x), psf.intensity (band, any, any), rows (row, band) -> planes (row, y, x).
    Units:  those of the radiance times those of the rows.
    Error:  `bound`, as a share of the brightest pixel of each row. Proved upper bounds: the residual of the cube,
            by the sum of each PSF (Young's inequality, as for the root mean square; where the border reflects, three
            times that of the scene); of the brightest pixel, the image of the largest residual of each pixel;
            tails, by Young's inequality; kernels, by the sum of their residuals. Estimated, not proved: round-off of
            the transforms, from the powers of planes and kernels, never less than was measured; and `estimated`, the
            error by few bands.
            Planes and PSF receive gradients; basis and rows are constants.
    Raises: ValueError where scene, PSF and rows have different bands, or the scene is a batch.
    Source: linearity of incoherent imaging, Goodman, Introduction to Fourier Optics, 4th ed., ch. 7.
    """
    share = None if few is None or few.share.shape[0] == few.share.shape[1] else few.share.double().cpu()
    planes, intensity = _fitted(radiance, psf, rows, share)
    unit = rows.detach().abs().amax(1).double().cpu()
    unit = unit.where(unit > 0, 1.0)
    scaled = rows.detach().double().cpu() / unit[:, None]
    given = _given(radiance, planes, scaled, border, spread(passed(intensity.detach()), share), share)
    result, bound, kept = _formed(planes, intensity, given, 0.0 if largest else within)
    top = _top(result, radiance, intensity, given, within * _QUICKLY) if largest else math.inf
    brightest = torch.tensor(top, dtype=torch.float64)
    scale = unit.to(result)[:, None, None]
    result = result * scale if result.requires_grad else result.mul_(scale)
    estimated = torch.zeros(2, dtype=torch.float64) if few is None else torch.stack([few.error, few.largest]).cpu()
    return Channels(result, rows.detach().double(), bound, kept, brightest, estimated)


@image_channels.reference
def _(
    radiance: LowRankCube, psf: Psf, rows: Tensor, few: FewBands | None = None, *, border: Border = "zero", **_: Any
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
    error, top = result.estimated.tolist()
    return float(result.bound) + error, float(result.largest) + top


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
    """Return the error by what was left out of the PSF, which `Channels.bound` does not count.

    The share of the PSF is that of each pixel of a picture relative to its brightest pixel, as `flare.stray_light`
    states it. The error by few bands is in `Channels.estimated`, and is not counted a second time.
    """
    if radiance.rms or (rows is not None and rows.rms):
        return math.inf
    share = psf.share
    peak = share / (1.0 - share) if share < 1.0 else math.inf
    return ErrorBound(share * max(abs(result.min), abs(result.max)), peak=peak)


@image_channels.expected_range
def _(*inputs: Any, **params: Any) -> tuple[float, float]:
    """Return the range of an image whose brightest pixel counts as 1, as `nodes/sensor/_expected_ranges.py` says."""
    return _DARKEST, 1.0


@image_channels.check
def _(result: Channels, *inputs: Any, within: float = 0.0, **params: Any) -> list[Check]:
    planes, kernels, bands, y, x = result.kept.tolist()
    text = (
        f"{planes} planes and {kernels} kernels of {y} x {x} for {result.rows.shape[1]} bands, "
        f"{result.rows.shape[1] - bands} left out, within {float(result.bound):.2g}"
    )
    if float(result.estimated[0]):
        text = f"{text}; PSFs of few bands, estimated error {float(result.estimated[0]):.2g}"
    return [Check(text, within == 0 or float(result.bound) <= within)]


def _fitted(radiance: LowRankCube, psf: Psf, rows: Tensor, share: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return the basis images of the scene, and the part of the PSF that reaches the scene, in the same precision."""
    count = len(psf.intensity)
    known = count if share is None else len(share) if share.shape[1] == count else -1
    bands = {len(radiance.basis), known, rows.shape[-1]}
    if len(bands) > 1 or radiance.planes.ndim != 3 or psf.intensity.ndim != 3 or rows.ndim != 2:
        raise ValueError(
            f"radiance of {len(radiance.basis)} bands in planes {tuple(radiance.planes.shape)}, PSF "
            f"{tuple(psf.intensity.shape)} and rows {tuple(rows.shape)} must have the same bands, without a batch: "
            "compute all three from the same `bands` step"
        )
    planes, dtype = radiance.planes, torch.promote_types(radiance.planes.dtype, psf.intensity.dtype)
    kernel = reach(reach(psf.intensity, -2, planes.shape[-2]), -1, planes.shape[-1])
    dtype = torch.promote_types(dtype, torch.float32)
    return planes.to(dtype), kernel.to(dtype)


def _given(
    radiance: LowRankCube, planes: Tensor, rows: Tensor, border: Border, through: Passed, share: Tensor | None
) -> Given:
    flat = planes.detach().flatten(1)
    gram = (flat @ flat.T).double().cpu()
    copies = 9 if border == "reflect" else 1
    if radiance.residual_rms.numel():
        rest = radiance.residual_rms.double().cpu() * math.sqrt(copies)
        most = (gram.diagonal() * (1.001 * copies / flat.shape[1])).clamp_min(0).sqrt()
    else:
        rest, most = radiance.residual_max.double().cpu(), torch.maximum(flat.amax(1), -flat.amin(1)).double().cpu()
    return Given(
        rows,
        radiance.basis.detach().double().cpu(),
        rest,
        most,
        gram,
        copies,
        through,
        (planes.shape[1], planes.shape[2]),
        border == "reflect",
        share,
    )


def _formed(planes: Tensor, intensity: Tensor, given: Given, within: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return the summed image, its error bound, and the sizes of the first convolution plan of error at most
    ``within``.
    """
    eps = torch.finfo(planes.dtype).eps
    brightest, allowed = given.rows.new_zeros(len(given.rows)), within / (1 + within) - 16 * eps
    if within > 0:
        brightest = guessed(planes.detach(), given)
        given = with_windows(given, intensity.detach(), brightest, allowed)
    for attempt in range(_TRIES):
        plan = choose(given, brightest, allowed if attempt < _TRIES - 1 else 0.0)
        result = convolved(planes, intensity, given, plan)
        found = result.detach().abs().amax((1, 2)).double().cpu()
        lost = rounding(given, plan, found, eps)
        bound = _share(plan.off + lost, found)
        if plan.whole or bound <= within:
            break
        brightest = (found - plan.off - lost).clamp_min(0)
        allowed = within / (1 + within) - _share(lost, found) - eps
    return result, torch.tensor(bound, dtype=torch.float64), torch.tensor(plan.kept)


def _top(result: Tensor, radiance: LowRankCube, intensity: Tensor, given: Given, quickly: float) -> float:
    """Return the largest relative error of the brightest pixel over all weighted sums of the image bands.

    All bands together form the image of the cube's largest residual at each pixel. The true image differs from the
    computed image by at most that image of the residual. The true maximum is therefore at most the maximum of computed
    image plus residual. The true maximum is at least the computed maximum less the residual at the same pixel, and this
    second error is never the larger one. In a large image, a bound of at most ``quickly``
    comes from cells of 8 x 8 pixels.
    """
    if not radiance.residual_map.numel():
        return math.inf
    found, rest = result.detach(), radiance.residual_map.to(result)
    low, most = (torch.stack(ends).double().cpu() for ends in zip(*map(torch.aminmax, found), strict=True))
    lost = rounding(given, choose(given, most, 0.0), torch.maximum(most, -low), torch.finfo(found.dtype).eps)
    if quickly > 0 and min(found.shape[1:]) >= _LARGE:
        above = (cells(found) + majorant_by_cell(rest, intensity.detach(), given)).amax((1, 2)).double().cpu()
        if (top := _share(above - most + lost, most)) <= quickly:
            return top
    lacks = majorant(rest, intensity.detach(), given)
    room = torch.empty_like(lacks)
    above = torch.stack([torch.add(row, lacks, out=room).amax() for row in found]).double().cpu()
    return _share(above - most + lost, most)


def _share(off: Tensor, found: Tensor) -> float:
    """Return the largest relative error of the brightest pixels, given computed values ``found`` and error bounds
    ``off``.
    """
    share = torch.where(off > 0, torch.where(off < found, off / (found - off), math.inf), 0.0)
    worst = float(share.amax()) if bool(torch.isfinite(off + found).all()) else math.inf
    return worst


image.channel_sum_form = image_channels
