"""Losses of a mask: the remaining peak of a laser, and the scene light that the mask scatters out of the field."""

from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import node
from neusee.nodes._half_precision import single
from neusee.nodes.metrics import bsr
from neusee.nodes.values import Psf

_DARK = 1e-30  #: light, or ratio, below which a band counts as dark


@node()
def suppression_loss(psf: Psf, *, power: Annotated[float, Field(ge=8, le=64)] = 8.0, log: bool = False) -> Tensor:
    """Sum the laser suppression ratio over the bands, with a p-norm over pixels as a smooth maximum.

    The p-norm of PSF / clear peak stands for the maximum over pixels: its gradient reaches every bright pixel, while
    the gradient of the maximum reaches a single pixel. With ``log`` each band counts by its logarithm, so that a factor
    counts alike at 1e-3 and at 1.

    Shapes: psf.intensity (band, y, x) -> ().
    Units:  none.
    Error:  the p-norm of n equal pixels is n^(1/p) times their peak and never below the peak: 1 % at p = 8 and one
            bright pixel. float32: 1e-5; with ``log`` 1e-6 per band, a larger share of a sum near 0. A band without
            light counts as the logarithm of 1e-30, and has no gradient.
    Source: NeuSee, section Two-Stage Training (L_DOE); p-norm for the maximum is ours.
    """
    ratio = single(psf.intensity) / psf.clear_peak.to(single(psf.intensity))[:, None, None]
    top = ratio.detach().amax((-2, -1), keepdim=True)
    dark = top <= _DARK  # false for NaN, so that NaN reaches the result
    scale = top.where(~dark, 1.0)
    sums = (ratio / scale).pow(power).sum((-2, -1)).where(~dark[:, 0, 0], 1.0)  # the root has no gradient at 0
    norm = sums.pow(1.0 / power).where(~dark[:, 0, 0], 0.0)
    peaks = scale[:, 0, 0] * norm
    loss: Tensor = (peaks + _DARK).log().sum() if log else peaks.sum()
    return loss


@suppression_loss.reference
def _(psf: Psf, *, power: float = 8.0, log: bool = False) -> Tensor:
    ratio = (psf.intensity.double() / psf.clear_peak[:, None, None]).flatten(1)
    dark = ratio.detach().amax(1, keepdim=True) <= _DARK
    logs = ratio.where(~dark, 1.0).clamp_min(1e-300).log()
    peaks = ((power * logs).logsumexp(1) / power).exp().where(~dark[:, 0], 0.0)
    loss: Tensor = (peaks + _DARK).log().sum() if log else peaks.sum()
    return loss


@node()
def background_loss(psf: Psf, radiance: Tensor | None = None) -> Tensor:
    """Sum over the bands the inverse of the background suppression ratio, which `metrics.bsr` computes.

    Light that the mask scatters out of the field or out of the window of the PSF makes the loss larger, whatever the
    border of the image is. Without a scene, the loss is that of a point on the axis.

    Shapes: psf.intensity (band, any, any), radiance (..., band, y, x) -> ().
    Units:  none; the number of bands where no light is lost, and more where light is lost.
    Error:  compares energy in the field and ignores sharpness. A band without light counts as 1.
    Raises: ValueError where scene and PSF have different bands.
    Source: NeuSee, section Two-Stage Training (L_DOE), as a ratio of energies.
    """
    share = bsr(psf, radiance)
    dark = share <= _DARK  # false for NaN, so that NaN reaches the result
    ratios: Tensor = torch.where(dark, 1.0, 1.0 / share.where(~dark, 1.0))
    return ratios.sum().to(single(psf.intensity).dtype)
