"""The contrast loss, which keeps the image contrast of a mask while another loss lowers the laser peak."""

import math
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import node
from neusee.nodes._half_precision import single
from neusee.nodes.optics._lens_band import cut_off
from neusee.nodes.values import Psf

_DARK = 1e-30  #: share of the light below which a band counts as dark

ContrastFloor = Annotated[float, Field(gt=0, le=0.1)]
HighestFrequency = Annotated[float, Field(gt=0, le=0.5)]  #: cycles per pixel


@node()
def contrast(psf: Psf, *, floor: ContrastFloor = 1e-4, up_to: HighestFrequency | None = None) -> Tensor:
    """Sum over the bands the contrast loss -mean(ln sqrt(MTF**2 + floor**2)), with the mean over frequencies.

    The mean is over the frequencies that the clear aperture passes, as in `metrics.mtf`, and the contrast is the
    modulus of the OTF over its value at frequency 0. A mean of logarithms is the logarithm of the geometric mean and
    follows the median, whereas a mean of squares follows the few frequencies near 0 with high contrast. A factor of
    contrast counts alike at every contrast above ``floor``, as a factor of suppression does in
    ``losses.suppression_loss`` with ``log``, so that the weights of the two losses set the exchange rate. Below
    ``floor`` the loss hardly changes, so that nulls at single frequencies do not dominate. ``up_to`` excludes finer
    frequencies, which a reduced picture loses.

    Shapes: psf.intensity (band, y, x) -> ().
    Units:  none; per band 0 at full contrast and -ln(floor) at none; up_to in cycles per pixel.
    Error:  1e-5 in float32. Light outside the window is not counted; `losses.background_loss` counts that light. A
            band without light (1e-30) counts as contrast 0, and has no gradient.
    Source: Goodman, Introduction to Fourier Optics, 4th ed., ch. 7 (OTF, cut-off); the mean of logarithms is ours.
    """
    bands = zip(single(psf.intensity), cut_off(psf).tolist(), strict=True)
    return torch.stack([_lost(kernel, cut, floor, up_to) for kernel, cut in bands]).sum()


def _lost(kernel: Tensor, passed: float, floor: float, up_to: float | None) -> Tensor:
    y, x = kernel.shape
    fy, fx = (torch.fft.fftfreq(n, dtype=torch.float64, device=kernel.device) for n in (y, x))
    cut = min(passed, up_to or math.inf)  # cycles per pixel
    inside = torch.hypot(fy[:, None], fx[None, : x // 2 + 1]) <= cut
    light = kernel.sum()
    dark = light.detach() <= _DARK  # false for NaN, so that NaN reaches the result
    # in float32, the round-off of the transform turns the gradient where the contrast is near the floor
    otf = torch.fft.rfft2(kernel.double() / light.double().where(~dark, 1.0))[inside]
    square = (otf.real.square() + otf.imag.square()).where(~dark, 0.0)
    lost: Tensor = -0.5 * (square + floor**2).log().mean()
    return lost.to(kernel)


@contrast.reference
def _(psf: Psf, *, floor: float = 1e-4, up_to: float | None = None) -> Tensor:
    total = torch.zeros((), dtype=torch.float64)
    for kernel, cut in zip(psf.intensity.double(), cut_off(psf).tolist(), strict=True):
        y, x = kernel.shape
        otf = torch.fft.fft2(kernel)[:, : x // 2 + 1]
        fy, fx = torch.fft.fftfreq(y, dtype=torch.float64), torch.fft.rfftfreq(x, dtype=torch.float64)
        inside = fy[:, None].square() + fx.square() <= cut**2
        if up_to is not None:
            inside &= fy[:, None].square() + fx.square() <= up_to**2
        whole = otf[0, 0].real
        dark = bool(whole.detach() <= _DARK)
        passed = torch.zeros(int(inside.sum())) if dark else otf[inside].abs().square() / whole**2
        total = total - (passed + floor**2).sqrt().log().mean()
    return total
