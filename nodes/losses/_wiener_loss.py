"""The Wiener loss of a mask: the share of a picture that a Wiener filter cannot recover behind
the mask.
"""

from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import node
from neusee.nodes.losses._mask_losses import HighestFrequency
from neusee.nodes.precision import single
from neusee.nodes.restore._inverse._masked_blur import effective_psf, grey_shares, variance
from neusee.nodes.restore._inverse._wiener_prior import fall
from neusee.nodes.values import Bands, Psf

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
    signal = (fall((y, x)) / noise).to(intensity)  # signal over noise, by frequency
    counted_signal = signal * _counted((y, x), up_to).to(signal)
    bands_otf, error_shares = torch.fft.rfft2(intensity), list[Tensor]()
    for channel_otf, share in zip(torch.fft.rfft2(channel_psfs), shares, strict=True):
        signal_behind = signal * _square(channel_otf)
        # signal times the square of the filter
        signal_filtered = signal * signal_behind / (signal_behind + 1).square()
        band_difference = torch.tensordot(share, _square(bands_otf - channel_otf), 1)
        error_variance = 1 / (signal_behind + 1) + colour * signal_filtered * band_difference
        # relative to the variance of the picture, at the frequencies that count
        error_shares.append(
            variance(error_variance * counted_signal, (y, x)) / variance(counted_signal, (y, x))
        )
    result: Tensor = torch.stack(error_shares).clamp_min(1e-30).log().mean()
    return result


def _square(spectrum: Tensor) -> Tensor:
    """Return |spectrum|^2."""
    return spectrum.real.square() + spectrum.imag.square()


def _counted(size: tuple[int, int], up_to: float | None) -> Tensor:
    """Return True at the spatial frequencies above 0 and up to ``up_to``, in the layout of
    `torch.fft.rfft2`.
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
