"""What an ideal linear filter leaves of a picture: noise equivalent quanta, error and information.

All spectra are half spectra, as `torch.fft.rfft2` returns them. A natural scene has a power spectrum 1 / frequency^2.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.restore._inverse._masked_blur import times

_DARK = 1e-30  #: ratio of light below which a band counts as dark
_RADII = 8192  #: of a table of contrast by frequency, up to the corner of the spectrum


class Exposure(NamedTuple):
    """The light and the noise of a pixel behind the clear lens."""

    light: float  #: e-, mean of the scene
    read: float  #: e-, standard deviation
    veil: float  #: e-, even light of the laser
    passed: float  #: share of the light that the pupil of the mask lets through


def frequencies(size: tuple[int, int], like: Tensor) -> Tensor:
    """Return the absolute value of each frequency of half a spectrum in cycles per pixel."""
    fy = torch.fft.fftfreq(size[0], dtype=torch.float64, device=like.device)
    fx = torch.fft.rfftfreq(size[1], dtype=torch.float64, device=like.device)
    return torch.hypot(fy[:, None], fx)


def natural_spectrum(size: tuple[int, int], contrast: float, like: Tensor) -> Tensor:
    """Return the power 1 / frequency^2 of the contrast of a scene; its mean over all frequencies is ``contrast``."""
    at = frequencies(size, like)
    power = torch.where(at > 0, at, torch.inf).pow(-2.0)
    whole = (power.sum(0) * times(size, power)).sum() / (size[0] * size[1])
    return power * (contrast / whole.where(whole > 0, 1.0))


def quanta(passed: Tensor, exposure: Exposure, filtered: Tensor) -> Tensor:
    """Return the noise equivalent quanta (T n MTF)^2 / (T n + veil + read^2) behind a filter of transmittance T.

    ``passed`` is the squared modulus of the OTF, 1 at frequency 0 if all light reaches the window.
    """
    counts = filtered * exposure.light
    noise = counts * exposure.passed + filtered * exposure.veil + exposure.read**2
    return counts.square() * passed / noise.clamp_min(_DARK)


def mean_of(values: Tensor, size: tuple[int, int], counted: Tensor) -> Tensor:
    """Return the mean of half a spectrum over the whole spectrum, at the frequencies ``counted``."""
    weights = counted * times(size, values)
    total: Tensor = (values * weights).sum((-2, -1)) / weights.sum()
    return total


def error_share(snr: Tensor, spectrum: Tensor, size: tuple[int, int], counted: Tensor) -> Tensor:
    """Return the error variance after a Wiener filter, over the variance of the scene, at some frequencies."""
    return mean_of(spectrum / (1 + snr), size, counted) / mean_of(spectrum, size, counted)


def bits(snr: Tensor, size: tuple[int, int], counted: Tensor) -> Tensor:
    """Return the mean of log2(1 + SNR) over some frequencies."""
    return mean_of(torch.log2(1 + snr), size, counted)


def peak_share(intensity: Tensor, clear_peak: Tensor, power: float | None) -> Tensor:
    """Return the largest LSR of any band; a norm of exponent ``power`` over pixels and bands stands for the maximum."""
    ratio = intensity.double() / clear_peak.to(intensity.device).double()[:, None, None]
    top = ratio.detach().amax()
    if power is None:
        return ratio.amax()
    scale = torch.where(top > _DARK, top, 1.0)  # without light, the peak is 0 and has no gradient
    sums = (ratio / scale).pow(power).sum()
    norm: Tensor = torch.where(top > _DARK, sums, 1.0).pow(1 / power) * torch.where(top > _DARK, top, 0.0)
    return norm


def filter_of(peak: Tensor, limit: float | None) -> Tensor:
    """Return the transmittance of the grey filter that lowers a peak to ``limit``; 1 where the peak is lower."""
    if limit is None:
        return torch.ones_like(peak)
    return (limit / peak.clamp_min(_DARK)).clamp_max(1.0)


def round_mtf(at: Tensor, cuts: Tensor, shares: Tensor) -> Tensor:
    """Return the MTF of a round aperture for each channel, at the frequencies ``at``, from the cut-offs of its bands.

    ``shares`` (channel, band) are those of the bands in the channels. Between radii of a fine table it is linear.
    """
    radii = torch.linspace(0.0, 0.75, _RADII, dtype=torch.float64)
    share = (radii / cuts[:, None]).clamp_max(1.0)
    table = shares @ ((torch.acos(share) - share * (1 - share.square()).sqrt()) * (2 / math.pi))
    place = at * ((_RADII - 1) / 0.75)
    below = place.long().clamp_max(_RADII - 2)
    return torch.lerp(table[:, below], table[:, below + 1], (place - below).expand(len(shares), *at.shape))
