"""Contrast (MTF) and encircled energy of a PSF."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.optics._lens_band import cut_off
from neusee.nodes.units import PixelPitch, SensorLength
from neusee.nodes.values import Psf

_DARK = 1e-30  #: share of the light below which a band counts as dark


class Mtf(NamedTuple):
    """Statistics of the contrast over the spatial frequencies that the clear aperture passes."""

    rms: Tensor  #: (band,) float64, root mean square
    median: Tensor  #: (band,) float64
    low: Tensor  #: (band,) float64, the first percentile, which shows deep nulls


@node(rtol=1e-5)
def mtf(psf: Psf) -> Mtf:
    """Compute statistics of the contrast |OTF| / OTF(0) over all frequencies up to the cut-off of the clear aperture.

    The cut-off D / (wavelength x f) in cycles per pixel is that of the PSF, or sqrt(4 p0 / pi) with p0 the peak of the
    clear lens where the PSF does not name it. A PSF that is averaged over pixels has the contrast behind the pixels.
    Parseval: no mask has an rms contrast (over all frequencies that the pixels sample) above sqrt(LSR p0 / light kept).

    Shapes: psf.intensity (band, y, x) -> three of (band,) float64.
    Units:  none.
    Error:  round-off 1e-7, plus the error of the window: light outside the window counts as lost, and the window sets
            the frequencies. The cut-off is that of the round aperture of the same area. Without light (1e-30) the
            contrast is 0. Only `rms` has a gradient: a median depends on one frequency, whose choice among equal
            values is arbitrary.
    Source: Goodman, Introduction to Fourier Optics, 4th ed., ch. 7 (OTF as autocorrelation of the pupil).
    """
    rows = [_contrast(one, cut) for one, cut in zip(psf.intensity, cut_off(psf).tolist(), strict=True)]
    return Mtf(*(torch.stack(column) for column in zip(*rows, strict=True)))


def _contrast(kernel: Tensor, cut: float) -> tuple[Tensor, Tensor, Tensor]:
    y, x = kernel.shape
    fy, fx = (torch.fft.fftfreq(n, dtype=torch.float64, device=kernel.device) for n in (y, x))
    inside = torch.hypot(fy[:, None], fx[None, : x // 2 + 1]) <= cut
    otf = torch.fft.rfft2(kernel.double())
    whole = otf[0, 0].abs()
    dark = whole <= _DARK
    passed = otf[inside].abs() / whole.where(~dark, 1.0)
    contrast = passed.where(~dark, 0.0).clamp_max(1.0)
    ordered = contrast.detach().sort().values
    rms: Tensor = torch.linalg.vector_norm(contrast) / math.sqrt(len(contrast))
    return rms, ordered[(len(ordered) - 1) // 2], ordered[(len(ordered) - 1) // 100]


@mtf.check
def _(result: Mtf, *inputs: Psf) -> list[Check]:
    rms, median = float(result.rms.mean()), float(result.median.mean())
    return [
        Check(
            f"contrast of the PSF over frequencies: rms {rms:.3g}, median {median:.3g}",
            bool((result.rms <= 1.0 + 1e-6).all()),
        )
    ]


@node(rtol=1e-6)
def encircled(psf: Psf, *, pixel_pitch: PixelPitch, radius: SensorLength) -> Tensor:
    """Compute the share of the light, relative to the clear pupil, that falls within a radius around the axis.

    Shapes: psf.intensity (band, y, x) -> (band,) float64.
    Units:  radius m on the sensor; result a share of the light through the clear pupil.
    Error:  whole pixels: a pixel counts where its centre lies within the radius.
    Source: Goodman, Introduction to Fourier Optics, 4th ed.; Born and Wolf, Principles of Optics, 7th ed., ch. 8.
    """
    sizes = psf.intensity.shape[-2:]
    steps = (torch.arange(n, dtype=torch.float64, device=psf.intensity.device) - n // 2 for n in sizes)
    y, x = (step * pixel_pitch for step in steps)
    inside = torch.hypot(y[:, None], x[None, :]) <= radius
    return (psf.intensity * inside).sum(-1).sum(-1, dtype=torch.float64)


@encircled.check
def _(result: Tensor, *inputs: Psf, **params: float) -> list[Check]:
    low, high = float(result.min()), float(result.max())
    return [Check(f"{low:.1%} to {high:.1%} of the light falls within the radius", high <= 1.01)]


# --- as curves --------------------------------------------------------------------------------------------------------


def encircled_curve(light: Tensor) -> Tensor:
    """Return the light of an image (y, x) within 0, 1, 2, … pixels of the optical axis, as (radius,) float64."""
    y, x = (torch.arange(n, dtype=torch.float64) - n // 2 for n in light.shape)
    radius = torch.hypot(y[:, None], x[None, :]).ceil().long().flatten()
    rings = torch.zeros(int(radius.max()) + 1, dtype=torch.float64)
    return rings.index_add_(0, radius, light.detach().double().cpu().flatten()).cumsum(0)


def over_clear_peak(psf: Psf, band: int) -> Tensor:
    """Divide the PSF (y, x) of a band by the peak of the PSF of the clear lens."""
    relative: Tensor = psf.intensity[band] / psf.clear_peak[band]
    return relative
