"""Quality of a restored picture, measured by comparison with the true picture."""

import math
from typing import Annotated, Literal, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.precision import exact_convolutions, single

_WINDOW = 11  #: width in pixels of the Gaussian window of SSIM
_STRIPE = 118  #: rows that are compared at a time: 128 with the margin of the window


class Quality(NamedTuple):
    """Three measures of the difference between two pictures, each over all channels together."""

    l1: Tensor  #: () float64, mean absolute difference
    psnr: Tensor  #: () float64, dB, for a white of 1; 200 dB for equal pictures
    ssim: Tensor  #: () float64, at most 1


@node(rtol=3e-4)
def quality(
    estimate: Tensor,
    truth: Tensor,
    *,
    border: Annotated[int, Field(ge=0, le=10**6)] = 0,
    domain: Literal["linear", "encoded"] = "encoded",
) -> Quality:
    """Compare a picture with the true picture by mean absolute difference, PSNR and SSIM.

    Both pictures are clipped to [0, 1], the range of a display. `encoded` compares sRGB-encoded
    values, as is usual for published photographs; `linear` compares light. SSIM is that of kornia
    (Gaussian window, 11 x 11, sigma 1.5), averaged over the RGB channels and over the pixels whose
    window lies inside the picture. The term 1e-12 of kornia's denominator is left out: with this
    term two black pictures have an SSIM of 0.99999. Kornia's PSNR of two equal pictures is
    infinite, and 200 dB here, so that a mean over pictures stays finite.

    Shapes: estimate and truth (3, y, x), linear sRGB -> three scalars, float64.
    Units:  none; PSNR dB. ``border`` pixels at each side do not count.
    Error:  PSNR 2e-5 dB and SSIM 1e-5 against scikit-image. Round-off of SSIM is 1e-7, also where
            an SSIM near 0 is the small sum of positive and negative terms, but up to 3e-4 of an
            SSIM of flat, bright pictures: a variance is the difference of two squares near 1, four
            roundings of 6e-8, beside the constant 9e-4.
    Raises: ValueError for pictures of different shapes, and for pictures smaller than the window of
            SSIM.
    Source: Wang et al., IEEE Trans. Image Process. 13, 600 (2004); sRGB as IEC 61966-2-1.
    """
    require_same_shape(estimate, truth)
    a, b = (_inside(x, border) for x in (estimate, truth))
    if min(a.shape[-2:]) < _WINDOW:
        size = f"{_WINDOW} x {_WINDOW}"
        raise ValueError(
            f"SSIM needs {size} pixels, not {tuple(a.shape[-2:])} inside the border: give a larger"
            " picture"
        )
    absolute_sum, square_sum, ssim_sum = _sums(a, b, domain)
    psnr = -10.0 * (square_sum / a.numel()).clamp_min(1e-20).log10()
    window_count = a[..., _WINDOW - 1 :, _WINDOW - 1 :].numel()
    return Quality(absolute_sum / a.numel(), psnr, ssim_sum / window_count)


@quality.check
def _(result: Quality, *inputs: Tensor, **params: object) -> list[Check]:
    l1, psnr, ssim = (float(x) for x in result)
    return [Check(f"L1 {l1:.4f}, PSNR {psnr:.2f} dB, SSIM {ssim:.3f}", math.isfinite(psnr))]


def require_same_shape(
    estimate: Tensor, truth: Tensor, fix: str = "crop the truth to the estimate"
) -> None:
    """Raise ValueError unless the estimate and the true values have the same shape."""
    if estimate.shape != truth.shape:
        raise ValueError(
            f"estimate {tuple(estimate.shape)} and truth {tuple(truth.shape)} differ in shape:"
            f" {fix}"
        )


def _inside(picture: Tensor, border: int) -> Tensor:
    """Return a picture without a border of so many pixels, at least float32."""
    y, x = picture.shape[-2:]
    return single(picture)[..., border : max(y - border, border), border : max(x - border, border)]


def _shown(picture: Tensor, domain: str) -> Tensor:
    """Return a picture as a display shows it, clipped to [0, 1] and encoded in sRGB unless
    ``domain`` is linear.
    """
    from kornia.color import linear_rgb_to_rgb

    displayable = picture.clamp(0, 1)
    if domain == "linear":
        return displayable
    encoded: Tensor = linear_rgb_to_rgb(displayable)
    # float32 rounds 1.055 - 0.055 to less than 1
    return encoded.where(displayable < 1, encoded - encoded.detach() + 1)


def _sums(a: Tensor, b: Tensor, domain: str) -> tuple[Tensor, Tensor, Tensor]:
    """Return the sums of absolute difference, squared difference and SSIM over all pixels, in
    stripes that fit the CPU cache.
    """
    absolute_sum, square_sum, ssim_sum = (
        torch.zeros((), dtype=torch.float64, device=a.device) for _ in range(3)
    )
    rows = a.shape[-2] - _WINDOW + 1
    for first in range(0, rows, _STRIPE):
        last = min(first + _STRIPE, rows)
        estimate_stripe, truth_stripe = (
            _shown(picture[..., first : last + _WINDOW - 1, :], domain) for picture in (a, b)
        )
        # the next stripe counts the remaining rows
        counted_rows = None if last == rows else last - first
        difference = (estimate_stripe - truth_stripe)[..., :counted_rows, :]
        absolute_sum = absolute_sum + difference.abs().sum(-1).sum(dtype=torch.float64)
        square_sum = square_sum + difference.square().sum(-1).sum(dtype=torch.float64)
        ssim_sum = ssim_sum + _ssim(estimate_stripe, truth_stripe).sum(-1).sum(dtype=torch.float64)
    return absolute_sum, square_sum, ssim_sum


def _ssim(p: Tensor, q: Tensor) -> Tensor:
    """Return the structural similarity (SSIM) at each pixel whose window lies inside the
    picture.
    """
    from kornia.metrics import ssim

    pictures = (x.reshape(1, -1, *x.shape[-2:]) for x in (p, q))
    with exact_convolutions(p):
        similarity: Tensor = ssim(*pictures, _WINDOW, eps=0.0, padding="valid")
    return similarity
