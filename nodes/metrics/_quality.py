"""How close a restored picture is to the truth."""

import math
from typing import Annotated, Literal, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node

_WINDOW = 11


class Quality(NamedTuple):
    """Three ways to compare two pictures, over all channels together."""

    l1: Tensor  #: () float64, mean absolute difference
    psnr: Tensor  #: () float64, dB, for a white of 1; 200 dB for equal pictures
    ssim: Tensor  #: () float64, at most 1


@node(rtol=1e-4)
def quality(
    estimate: Tensor,
    truth: Tensor,
    *,
    border: Annotated[int, Field(ge=0)] = 0,
    domain: Literal["linear", "encoded"] = "encoded",
) -> Quality:
    """Compare a picture with the truth: mean absolute difference, PSNR and SSIM.

    Both are clipped to [0, 1], the range a display shows. `encoded` compares them as sRGB encodes them, the way
    photographs are published and compared; `linear` compares light. SSIM is the Gaussian form (11 x 11, sigma 1.5)
    of each RGB channel over the pixels whose window lies inside the picture.

    Shapes: estimate and truth (3, y, x), linear sRGB -> three scalars, float64.
    Units:  none; PSNR dB. ``border`` pixels at each side do not count.
    Error:  PSNR 2e-5 dB and SSIM 1e-5 against scikit-image.
    Raises: ValueError for pictures of different shape, or smaller than the window of SSIM.
    Source: Wang et al., IEEE Trans. Image Process. 13, 600 (2004); sRGB as IEC 61966-2-1.
    """
    if estimate.shape != truth.shape:
        raise ValueError(
            f"estimate {tuple(estimate.shape)} and truth {tuple(truth.shape)} differ: crop the truth alike"
        )
    a, b = (_shown(x, border, domain) for x in (estimate, truth))
    if min(a.shape[-2:]) < _WINDOW:
        raise ValueError(f"{tuple(a.shape[-2:])} pixels inside the border: SSIM needs {_WINDOW} x {_WINDOW}")
    difference = (a - b).double()
    psnr = -10.0 * difference.square().mean().clamp_min(1e-20).log10()
    return Quality(difference.abs().mean(), psnr, _ssim(a, b))


@quality.check
def _(result: Quality, *inputs: Tensor, **params: object) -> list[Check]:
    l1, psnr, ssim = (float(x) for x in result)
    return [Check(f"L1 {l1:.4f}, PSNR {psnr:.2f} dB, SSIM {ssim:.3f}", math.isfinite(psnr))]


def _shown(picture: Tensor, border: int, domain: str) -> Tensor:
    from kornia.color import linear_rgb_to_rgb

    y, x = picture.shape[-2:]
    inside = picture[..., border : max(y - border, border), border : max(x - border, border)].clamp(0, 1)
    return linear_rgb_to_rgb(inside) if domain == "encoded" and inside.numel() else inside


def _ssim(a: Tensor, b: Tensor) -> Tensor:
    from kornia.metrics import ssim

    return torch.as_tensor(ssim(a[None], b[None], _WINDOW, 1.0, padding="valid")).double().mean()
