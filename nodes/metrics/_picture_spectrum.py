"""The spectrum of a picture as a histogram, from which errors at any light, filter and noise follow in microseconds.

A grey filter scales the whole spectrum, and the light scales the scene: no PSF is computed again for another
transmittance, another scene light or another glare.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.metrics._filtered_picture import channel_psf, low_frequencies, natural_power
from neusee.nodes.values import Bands, Psf

_LEAST, _MOST, _EACH = -20, 8, 40  #: decades of the bins, and bins a decade, which give an error of 1e-4


class PictureSpectrum(NamedTuple):
    """Sums over the frequencies of a picture with like power p, by channel of the sensor.

    The Wiener filter knows the OTF ``known``, and p is the power of the scene times |known|**2. The picture has the
    OTF ``true``. Both OTFs are equal without mismatch.
    """

    power: Tensor  #: (channel, bin) mean of p
    signal: Tensor  #: (channel, bin) share of the scene's variance
    real: Tensor  #: (channel, bin) the same, times the real part of true / known
    square: Tensor  #: (channel, bin) the same, times the square of |true / known|
    strength: Tensor  #: (channel, bin) mean of scene power times |true OTF|**2
    rate: Tensor  #: (channel, bin) share of the frequencies with this strength
    contrast: Tensor  #: (channel,) mean of log(|true OTF|**2) up to a highest frequency
    light: Tensor  #: (channel,) share of the scene's light in the picture


def picture_spectrum(
    true: Psf,
    known: Psf,
    illuminant: Tensor,
    responses: Tensor,
    bands: Bands,
    variance: float = 0.1,
    up_to: float = 0.12,
) -> PictureSpectrum:
    """Sort the frequencies of a picture by their power; ``known`` is the PSF that the filter takes for the true one."""
    otf, guess = (torch.fft.fft2(channel_psf(one, illuminant, responses, bands)) for one in (true, known))
    scene = natural_power(tuple(otf.shape[-2:]), variance)
    low = low_frequencies(tuple(otf.shape[-2:]), up_to)
    share = scene / scene.sum()
    rows = []
    for one, other in zip(otf, guess, strict=True):
        square = other.abs().square()
        ratio = torch.where(square > 0, one * other.conj() / square.clamp_min(1e-300), 0.0)
        weights = (share, share * ratio.real, share * ratio.abs().square())
        power, *sums = _binned(scene * square, *weights)
        strength, count = _binned(scene * one.abs().square(), torch.full_like(scene, 1.0 / scene.numel()))
        contrast = one.abs().square()[low].clamp_min(1e-30).log().mean()
        rows.append((power, *sums, strength, count, contrast, one[0, 0].real))
    return PictureSpectrum(*(torch.stack(column) for column in zip(*rows, strict=True)))


def _binned(value: Tensor, *weights: Tensor) -> list[Tensor]:
    """Return the mean of ``value`` in each bin, weighted by the first of ``weights``, and the sums of all weights."""
    at = ((value.clamp_min(1e-300).log10() - _LEAST) * _EACH).long().clamp(0, (_MOST - _LEAST) * _EACH - 1).flatten()
    empty = torch.zeros((_MOST - _LEAST) * _EACH, dtype=torch.float64)
    sums = [empty.index_add(0, at, weight.flatten()) for weight in weights]
    whole = empty.index_add(0, at, (value * weights[0]).flatten())
    return [torch.where(sums[0] > 0, whole / sums[0].clamp_min(1e-300), 0.0), *sums]


def remaining_error(spectrum: PictureSpectrum, amplitude: float, noise: Tensor) -> Tensor:
    """Return the error after the filter over the variance of the scene, (noise, channel).

    ``amplitude`` is the scene light in e- times the transmittance of a filter; ``noise`` (noise, channel) the variance
    of a pixel in e-**2. With u = a**2 p / (a**2 p + noise) at amplitude a, the filter passes u ratio of the scene; the
    ratio is true / known. The error is the sum of signal |1 - u ratio|**2 and of the filtered noise, signal u (1 - u).
    """
    strength = amplitude**2 * spectrum.power
    u = strength / (strength + noise[:, :, None])
    error = spectrum.signal - 2 * u * spectrum.real + u.square() * spectrum.square + u * (1 - u) * spectrum.signal
    return error.sum(-1)


def information_bits(spectrum: PictureSpectrum, amplitude: float, noise: Tensor) -> Tensor:
    """Return the bits a pixel, mean of log2(1 + NEQ S) / 2 over all frequencies, (noise, channel)."""
    ratio = amplitude**2 * spectrum.strength / noise[:, :, None]
    return (spectrum.rate * torch.log2(1 + ratio)).sum(-1) / 2


def mean_log_neq(spectrum: PictureSpectrum, amplitude: float, noise: Tensor) -> Tensor:
    """Return the mean of log(NEQ) over low frequencies, (noise, channel)."""
    return spectrum.contrast + torch.log(amplitude**2 / noise)


def radial_contrast(
    psf: Psf, illuminant: Tensor, responses: Tensor, bands: Bands, rings: int = 40
) -> tuple[Tensor, Tensor]:
    """Return frequencies up to 1/2 cycle per pixel, and the mean of |OTF|**2 in a ring about each: (ring,) each.

    The mean is over directions and channels, and the square of the light that passes is included.
    """
    square = torch.fft.fft2(channel_psf(psf, illuminant, responses, bands)).abs().square().mean(0)
    fy, fx = (torch.fft.fftfreq(n, dtype=torch.float64) for n in square.shape)
    radius = torch.hypot(fy[:, None], fx)
    inside = (radius > 0) & (radius < 0.5)
    at = (radius[inside] * 2 * rings).long()
    empty = torch.zeros(rings, dtype=torch.float64)
    count = empty.index_add(0, at, torch.ones_like(radius[inside])).clamp_min(1)
    middle = (torch.arange(rings, dtype=torch.float64) + 0.5) / (2 * rings)
    return middle, empty.index_add(0, at, square[inside]) / count
