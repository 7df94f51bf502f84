"""Loss functions of a mask: the peak of a laser, scattered scene light, lost image contrast, and
the error of a picture after a Wiener filter.
"""

import math
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import node
from neusee.nodes.metrics import bsr
from neusee.nodes.optics._lens import cut_off
from neusee.nodes.precision import single
from neusee.nodes.restore.inverse._masked_blur import effective_psf, grey_shares, variance
from neusee.nodes.restore.inverse._wiener_prior import fall
from neusee.nodes.values import Bands, Psf

# --- mask losses ----------------------------------------------------------------------------------

# Loss functions of a mask: the remaining peak of a laser, and the scene light that the mask
# scatters out of the field.


_DARK = 1e-30  #: light or ratio below which a band counts as dark


@node()
def suppression_loss(
    psf: Psf, *, power: Annotated[float, Field(ge=8, le=64)] = 8.0, log: bool = False
) -> Tensor:
    """Sum the laser suppression ratio over the bands, with a p-norm over pixels as a smooth
    maximum.

    The p-norm of PSF / clear peak stands for the maximum over pixels: its gradient reaches every
    bright pixel, while the gradient of the maximum reaches a single pixel. With ``log`` each band
    counts by its logarithm, so that a factor counts alike at 1e-3 and at 1.

    Shapes: psf.intensity (band, y, x) -> ().
    Units:  none.
    Error:  the p-norm of n equal pixels is n^(1/p) times their peak and never below the peak: 1 %
            at p = 8 and one bright pixel. float32: 1e-5; with ``log`` 1e-6 per band, a larger share
            of a sum near 0. A band without light counts as the logarithm of 1e-30, and has no
            gradient.
    Source: NeuSee, section Two-Stage Training (L_DOE); p-norm for the maximum is ours.
    """
    ratio = single(psf.intensity) / psf.clear_peak.to(single(psf.intensity))[:, None, None]
    largest_ratio = ratio.detach().amax((-2, -1), keepdim=True)
    is_dark = largest_ratio <= _DARK  # false for NaN, so that NaN reaches the result
    scale = largest_ratio.where(~is_dark, 1.0)
    # 1 in dark bands, since the root has no finite gradient at 0
    power_sums = (ratio / scale).pow(power).sum((-2, -1)).where(~is_dark[:, 0, 0], 1.0)
    # the p-norm is at least the maximum, and close to it for a large power
    norm = power_sums.pow(1.0 / power).where(~is_dark[:, 0, 0], 0.0)
    peaks = scale[:, 0, 0] * norm
    loss: Tensor = (peaks + _DARK).log().sum() if log else peaks.sum()
    return loss


@suppression_loss.reference
def _(psf: Psf, *, power: float = 8.0, log: bool = False) -> Tensor:
    ratio = (psf.intensity.double() / psf.clear_peak[:, None, None]).flatten(1)
    is_dark = ratio.detach().amax(1, keepdim=True) <= _DARK
    log_ratios = ratio.where(~is_dark, 1.0).clamp_min(1e-300).log()
    peaks = ((power * log_ratios).logsumexp(1) / power).exp().where(~is_dark[:, 0], 0.0)
    loss: Tensor = (peaks + _DARK).log().sum() if log else peaks.sum()
    return loss


@node()
def background_loss(psf: Psf, radiance: Tensor | None = None) -> Tensor:
    """Sum over the bands the inverse of the background suppression ratio, which `metrics.bsr`
    computes.

    Light that the mask scatters out of the field or out of the window of the PSF makes the loss
    larger, whatever the border of the image is. Without a scene, the loss is that of a point on the
    axis.

    Shapes: psf.intensity (band, any, any), radiance (..., band, y, x) -> ().
    Units:  none; the number of bands where no light is lost, and more where light is lost.
    Error:  compares energy in the field and ignores sharpness. A band without light counts as 1.
    Raises: ValueError where scene and PSF have different bands.
    Source: NeuSee, section Two-Stage Training (L_DOE), as a ratio of energies.
    """
    share = bsr(psf, radiance)
    is_dark = share <= _DARK  # false for NaN, so that NaN reaches the result
    ratios: Tensor = torch.where(is_dark, 1.0, 1.0 / share.where(~is_dark, 1.0))
    return ratios.sum().to(single(psf.intensity).dtype)


# --- contrast loss --------------------------------------------------------------------------------

# The contrast loss preserves the image contrast of a mask while another loss lowers the laser peak.


ContrastFloor = Annotated[float, Field(gt=0, le=0.1)]
HighestFrequency = Annotated[float, Field(gt=0, le=0.5)]  #: cycles per pixel


@node()
def contrast(
    psf: Psf, *, floor: ContrastFloor = 1e-4, up_to: HighestFrequency | None = None
) -> Tensor:
    """Sum over the bands the contrast loss -mean(ln sqrt(MTF**2 + floor**2)), with the mean over
    frequencies.

    The mean is over the frequencies that the clear aperture passes, as in `metrics.mtf`, and the
    contrast is the modulus of the OTF over its value at frequency 0. A mean of logarithms is the
    logarithm of the geometric mean and follows the median, whereas a mean of squares follows the
    few frequencies near 0 with high contrast. A factor of contrast counts alike at every contrast
    above ``floor``, as a factor of suppression does in ``losses.suppression_loss`` with ``log``, so
    that the weights of the two losses set the exchange rate. Below ``floor`` the loss hardly
    changes, so that nulls at single frequencies do not dominate. ``up_to`` excludes finer
    frequencies, which a reduced picture loses.

    Shapes: psf.intensity (band, y, x) -> ().
    Units:  none; per band 0 at full contrast and -ln(floor) at none; up_to in cycles per pixel.
    Error:  1e-5 in float32. Light outside the window is not counted; `losses.background_loss`
            counts that light. A band without light (1e-30) counts as contrast 0, and has no
            gradient.
    Source: Goodman, Introduction to Fourier Optics, 4th ed., ch. 7 (OTF, cut-off); the mean of
            logarithms is ours.
    """
    kernels_and_cut_offs = zip(single(psf.intensity), cut_off(psf).tolist(), strict=True)
    return torch.stack(
        [
            _contrast_loss(kernel, cut_off_frequency, floor, up_to)
            for kernel, cut_off_frequency in kernels_and_cut_offs
        ]
    ).sum()


def _contrast_loss(kernel: Tensor, passed: float, floor: float, up_to: float | None) -> Tensor:
    """Return -mean(ln sqrt(MTF^2 + floor^2)) of one band over the frequencies up to ``passed``, the
    cut-off of the lens, and up to ``up_to``, both in cycles per pixel.
    """
    y, x = kernel.shape
    fy, fx = (torch.fft.fftfreq(n, dtype=torch.float64, device=kernel.device) for n in (y, x))
    highest = min(passed, up_to or math.inf)  # cycles per pixel
    in_band = torch.hypot(fy[:, None], fx[None, : x // 2 + 1]) <= highest
    light = kernel.sum()
    is_dark = light.detach() <= _DARK  # false for NaN, so that NaN reaches the result
    # float64: in float32 the round-off of the transform would dominate the gradient where the
    # contrast is near the floor
    otf = torch.fft.rfft2(kernel.double() / light.double().where(~is_dark, 1.0))[in_band]
    squared_mtf = (otf.real.square() + otf.imag.square()).where(~is_dark, 0.0)
    contrast_loss: Tensor = -0.5 * (squared_mtf + floor**2).log().mean()
    return contrast_loss.to(kernel)


@contrast.reference
def _(psf: Psf, *, floor: float = 1e-4, up_to: float | None = None) -> Tensor:
    total = torch.zeros((), dtype=torch.float64)
    for kernel, cut in zip(psf.intensity.double(), cut_off(psf).tolist(), strict=True):
        y, x = kernel.shape
        otf = torch.fft.fft2(kernel)[:, : x // 2 + 1]
        fy, fx = (
            torch.fft.fftfreq(y, dtype=torch.float64),
            torch.fft.rfftfreq(x, dtype=torch.float64),
        )
        in_band = fy[:, None].square() + fx.square() <= cut**2
        if up_to is not None:
            in_band &= fy[:, None].square() + fx.square() <= up_to**2
        passed_light = otf[0, 0].real
        is_dark = bool(passed_light.detach() <= _DARK)
        squared_mtf = (
            torch.zeros(int(in_band.sum()))
            if is_dark
            else otf[in_band].abs().square() / passed_light**2
        )
        total = total - (squared_mtf + floor**2).sqrt().log().mean()
    return total


# --- wiener loss ----------------------------------------------------------------------------------

OneBandShare = Annotated[float, Field(ge=0, le=1)]
NoiseVariance = Annotated[float, Field(ge=1e-12, le=1e12)]


@node()
def wiener(
    psf: Psf,
    illuminant: Tensor,
    responses: Tensor,
    bands: Bands,
    *,
    noise: NoiseVariance = 1e-3,
    colour: OneBandShare = 1.0,
    up_to: HighestFrequency | None = None,
) -> Tensor:
    """Average over channels the logarithm of (error variance after a Wiener filter) / (variance of
    the picture).

    The power of the pictures falls with frequency as in the prior of `restore.wiener`. The filter
    uses the PSF of a channel for a grey scene. The error at a frequency has two parts: the part of
    the picture that noise hides, and, for the share ``colour`` of the variance, which belongs to
    one band alone, the difference of the PSF of that band from the PSF of the channel. ``up_to``
    excludes finer frequencies, which a reduced picture loses.

    Shapes: psf.intensity (band, y, x), responses (channel, band) -> ().
    Units:  none; ``noise``: variance of a pixel's noise over the picture's variance; up_to in
            cycles per pixel.
    Error:  1e-5 in float32. Clipped pixels, the edges and the dependence of noise on light are
            neglected: the loss compares masks and does not predict an error.
    Raises: ValueError where the inputs differ in the number of bands.
    Source: Wiener filter as in Goodman, Introduction to Fourier Optics, 4th ed., ch. 8; the share
            of one band is ours.
    """
    y, x = psf.intensity.shape[-2:]
    intensity = single(psf.intensity)
    channel_psfs = effective_psf(psf, illuminant, responses, bands).to(intensity)
    shares = grey_shares(illuminant, responses, bands).to(intensity)
    # ratio of signal power to noise power at each frequency
    signal = (fall((y, x)) / noise).to(intensity)
    counted_signal = signal * _counted_frequencies((y, x), up_to).to(signal)
    bands_otf, error_shares = torch.fft.rfft2(intensity), list[Tensor]()
    for channel_otf, share in zip(torch.fft.rfft2(channel_psfs), shares, strict=True):
        signal_behind = signal * _squared_modulus(channel_otf)
        # signal power times the squared modulus of the filter
        signal_filtered = signal * signal_behind / (signal_behind + 1).square()
        band_difference = torch.tensordot(share, _squared_modulus(bands_otf - channel_otf), 1)
        error_variance = 1 / (signal_behind + 1) + colour * signal_filtered * band_difference
        # relative to the variance of the picture, both over the counted frequencies
        error_shares.append(
            variance(error_variance * counted_signal, (y, x)) / variance(counted_signal, (y, x))
        )
    result: Tensor = torch.stack(error_shares).clamp_min(1e-30).log().mean()
    return result


def _squared_modulus(spectrum: Tensor) -> Tensor:
    """Return |spectrum|^2."""
    return spectrum.real.square() + spectrum.imag.square()


def _counted_frequencies(size: tuple[int, int], up_to: float | None) -> Tensor:
    """Return a mask of the spatial frequencies above 0 and up to ``up_to`` cycles per pixel, in the
    layout of `torch.fft.rfft2`.
    """
    fy, fx = (
        torch.fft.fftfreq(size[0], dtype=torch.float64),
        torch.fft.rfftfreq(size[1], dtype=torch.float64),
    )
    squared_frequency = fy[:, None].square() + fx.square()
    counted: Tensor = (squared_frequency > 0) & (
        squared_frequency <= (1.0 if up_to is None else up_to**2)
    )
    return counted


@wiener.reference
def _(
    psf: Psf,
    illuminant: Tensor,
    responses: Tensor,
    bands: Bands,
    *,
    noise: float = 1e-3,
    colour: float = 1.0,
    up_to: float | None = None,
) -> Tensor:
    y, x = psf.intensity.shape[-2:]
    fy, fx = torch.fft.fftfreq(y, dtype=torch.float64), torch.fft.fftfreq(x, dtype=torch.float64)
    squared_frequency = fy[:, None].square() + fx.square()
    power = (squared_frequency + 1 / (x * y)) ** -1.5
    signal = power / power.mean() / noise
    counted = (squared_frequency > 0) & (squared_frequency <= (up_to or 1.0) ** 2)
    bands_otf = torch.fft.fft2(psf.intensity.double())
    sensitivity = responses.double() * (illuminant.double() * bands.centres)
    logs = []
    for share in sensitivity / sensitivity.sum(-1, keepdim=True):
        channel_otf = (share[:, None, None] * bands_otf).sum(0)
        filter_transfer = signal * channel_otf.conj() / (signal * channel_otf.abs().square() + 1)
        error_variance = (
            signal * (1 - filter_transfer * channel_otf).abs().square()
            + filter_transfer.abs().square()
        )
        for weight, band in zip(share, bands_otf, strict=True):
            error_variance = (
                error_variance
                + colour * weight * signal * (filter_transfer * (band - channel_otf)).abs().square()
            )
        logs.append((error_variance[counted].sum() / signal[counted].sum()).clamp_min(1e-30).log())
    return torch.stack(logs).mean()
