"""A linear filter that makes the residual of a frame nearly white, so that squares of it can be
compared.

Clipped pixels are filled from their neighbours, a short filter removes the smooth part of the
scene, and each pixel is divided by what its neighbourhood says of noise and of details of the
scene. The same filter acts on every pattern, so that filling makes no error of its own.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

_RADIUS = 8  #: pixels, of the filter
_AROUND = 9  #: pixels a side, over which the variance of details is averaged
_MEAN = 5  #: pixels a side, over which the mean that photon noise follows is averaged
_UNSEEN = 1e12  #: e-^2, variance that stands for a pixel that is not seen
LOST = 0.3  #: variance of a filled pixel, as a share of that of the channel
_LEAST = 0.05  #: variance of details at a pixel, as a share of that of the frame


class Weights(NamedTuple):
    """The inverse root of the covariance of the three channels in each pixel: diagonal, and one
    colour of details.
    """

    diagonal: Tensor  #: (channel, y, x), 1 / standard deviation of each channel by itself
    grey: Tensor  #: (channel, y, x), details that all channels share, over the former
    share: Tensor  #: (1, y, x), factor of the product of the two

    def __call__(self, filtered: Tensor) -> Tensor:
        """Return filtered pictures (..., channel, y, x) as numbers of mean 0 and variance 1."""
        scaled = self.diagonal * filtered
        # (D^2 + s s')^(-1/2) applied for all channels, up to a rotation: one shared colour s
        return scaled - self.grey * (self.share * (self.grey * scaled).sum(-3, keepdim=True))

    def twice(self, filtered: Tensor) -> Tensor:
        """Return the product of these weights' transpose and of what they make of filtered
        pictures.
        """
        white = self(filtered)
        return self.diagonal * (
            white - self.grey * (self.share * (self.grey * white).sum(-3, keepdim=True))
        )

    def pair(self, first: int, other: int) -> Tensor:
        """Return the element (y, x) of the inverse covariance for two channels."""
        shared_square = self.grey.square().sum(0)
        shared_part = (
            (2.0 - self.share[0] * shared_square)
            * self.share[0]
            * self.grey[first]
            * self.grey[other]
        )
        return self.diagonal[first] * self.diagonal[other] * (float(first == other) - shared_part)


class Filter(NamedTuple):
    """Fill the pixels that are not seen from their neighbours, then remove what is smooth."""

    seen: Tensor  #: (channel, y, x), 1 or 0
    kernel: Tensor  #: (side, side), symmetric

    def __call__(self, pictures: Tensor) -> Tensor:
        """Return pictures (..., channel, y, x), or (..., 1, y, x) of the same values in each
        channel, filtered.
        """
        return self.sharp(filled(pictures, self.seen))

    def sharp(self, pictures: Tensor) -> Tensor:
        """Return whole pictures (..., y, x) of any size without what is smooth."""
        return _convolved(pictures, self.kernel.to(pictures))

    def squared(self, variances: Tensor) -> Tensor:
        """Return the variance of filtered pictures, given that of independent pixels: (channel,
        y, x).
        """
        return _convolved(variances, self.kernel.to(variances).square())


def _convolved(pictures: Tensor, kernel: Tensor) -> Tensor:
    """Return pictures (..., y, x), continued as in a mirror, convolved with a symmetric kernel
    of odd sides.
    """
    flat = pictures.reshape(-1, *pictures.shape[-2:])
    rim = len(kernel) // 2
    padded = pad(flat, (rim,) * 4, mode="reflect")
    size = [fast_size(n) for n in padded.shape[-2:]]
    product = torch.fft.rfft2(padded, s=size) * torch.fft.rfft2(kernel, s=size)
    y, x = pictures.shape[-2:]
    # the kernel's middle is `rim` in, and the padding another `rim`
    inner: Tensor = torch.fft.irfft2(product, s=size)[
        :, 2 * rim : 2 * rim + y, 2 * rim : 2 * rim + x
    ]
    return inner.reshape(pictures.shape)


def fast_size(n: int) -> int:
    """Return the least number from ``n`` that has no prime factor above 5."""
    while 30**32 % n:
        n += 1
    return n


def filled(pictures: Tensor, unclipped: Tensor) -> Tensor:
    """Return pictures (..., channel, y, x) in which pixels that are not seen follow the pixels
    around them.
    """
    pictures_by_channel = pictures.expand(*pictures.shape[:-3], *unclipped.shape)
    if bool(unclipped.all()):
        return pictures_by_channel
    return _from_coarse(pictures_by_channel.reshape(-1, *unclipped.shape), unclipped).view(
        pictures_by_channel.shape
    )


def _from_coarse(pictures: Tensor, unclipped: Tensor) -> Tensor:
    """Return pictures (picture, channel, y, x) whose clipped pixels are filled from the means over
    two by two pixels; where none of these is seen, from the means over four by four, and so on.
    """
    y, x = unclipped.shape[-2:]
    if bool(unclipped.all()) or max(y, x) < 2:
        return pictures
    odd_padding = (0, x % 2, 0, y % 2)
    seen_share = avg_pool2d(pad(unclipped, odd_padding), 2)
    block_means = avg_pool2d(pad(pictures * unclipped, odd_padding), 2) / seen_share.clamp_min(0.1)
    filled_from_coarse = interpolate(
        _from_coarse(block_means, (seen_share > 0).to(unclipped)), scale_factor=2, mode="bilinear"
    )
    return torch.where(unclipped > 0, pictures, filled_from_coarse[..., :y, :x])


def box(pictures: Tensor, side: int) -> Tensor:
    """Return the mean over squares of ``side`` pixels, an odd number; beyond the edge there is
    nothing.
    """
    flat = pictures.reshape(-1, 1, *pictures.shape[-2:])
    for window, rim in (((side, 1), (side // 2, 0)), ((1, side), (0, side // 2))):
        flat = avg_pool2d(flat, window, stride=1, padding=rim, count_include_pad=False)
    return flat.reshape(pictures.shape)


def filter_of(picture: Tensor, noise: Tensor, unclipped: Tensor) -> Filter:
    """Return the filter that makes a scene with the spectrum of this picture, and its noise,
    nearly white.
    """
    grey = filled(picture, unclipped).mean(0)
    y_window, x_window = (
        torch.hann_window(n, periodic=False, dtype=grey.dtype, device=grey.device)
        for n in grey.shape
    )
    window = y_window[:, None] * x_window
    grey = (grey - (grey * window).sum() / window.sum()) * window
    power = torch.fft.rfft2(grey).abs().square() / window.square().sum()
    fy, fx = torch.fft.fftfreq(grey.shape[0]).to(grey), torch.fft.rfftfreq(grey.shape[1]).to(grey)
    frequency = torch.hypot(fy[:, None], fx)
    noise_level = noise.mean() / len(noise)
    middle_frequencies = (frequency > 0.05) & (frequency < 0.2)
    # a scene has the power strength / f^3, and the powers of a periodogram are exponential, with a
    # median of ln 2 times the mean
    scene_strength = ((power - noise_level) * frequency**3)[middle_frequencies].median() / 0.69
    side = 2 * _RADIUS + 1
    kernel_frequencies = torch.fft.fftfreq(64).to(grey)
    kernel_frequency = torch.hypot(kernel_frequencies[:, None], torch.fft.rfftfreq(64).to(grey))
    # 1 / sqrt(strength / f^3 + noise): what makes the sum white
    spectrum = (
        kernel_frequency**3
        / (scene_strength.clamp_min(1e-6 * noise_level) + noise_level * kernel_frequency**3)
    ).sqrt()
    kernel = torch.fft.irfft2(spectrum, s=(64, 64)).roll((_RADIUS, _RADIUS), (0, 1))[:side, :side]
    taper = torch.hann_window(side + 2, periodic=False, dtype=grey.dtype, device=grey.device)[1:-1]
    taper = taper[:, None] * taper
    kernel = kernel * taper
    # of sum 0, so that it passes no mean
    kernel = kernel - taper * (kernel.sum() / taper.sum())
    return Filter(unclipped, kernel / kernel.square().sum().sqrt())


def noise_of(electrons: Tensor, unclipped: Tensor, read_noise: float) -> Tensor:
    """Return the variance of the noise of each pixel: its local mean, and the read noise."""
    return box(filled(electrons, unclipped), _MEAN).clamp_min(1.0) + read_noise**2


def weights_of(filtered: Tensor, use: Filter, noise: Tensor, picture: Tensor) -> Weights:
    """Return what each pixel of a filtered residual is divided by: noise, and the details around
    that pixel.
    """
    unclipped = use.seen
    spread = masked_variance(picture, unclipped)
    noise_variance = use.squared(noise) + LOST * spread * use.squared(1.0 - unclipped)
    scene_colour = (picture * unclipped).sum((-2, -1)) / unclipped.sum((-2, -1)).clamp_min(1.0)
    scene_colour = (scene_colour / scene_colour.abs().max().clamp_min(1e-9)).clamp_min(0.05)[
        :, None, None
    ]
    seen_precision = unclipped / noise_variance
    precision = (scene_colour.square() * seen_precision).sum(0, keepdim=True)
    # the most likely detail that has the scene's colour in all channels
    grey_details = (scene_colour * seen_precision * filtered).sum(
        0, keepdim=True
    ) / precision.clamp_min(1e-30)
    any_seen = (precision > 0).to(unclipped)
    # their mean square, less the variance that noise gives them
    detail_variance = _around(grey_details.square(), any_seen) - _around(
        1.0 / precision.clamp_min(1e-12), any_seen
    )
    detail_variance = detail_variance.clamp_min(0.0)
    detail_variance = torch.maximum(
        detail_variance, _LEAST * (detail_variance * any_seen).sum() / any_seen.sum().clamp_min(1.0)
    )
    colour_variance = _around((filtered - scene_colour * grey_details).square(), unclipped)
    variance = torch.where(unclipped > 0, torch.maximum(noise_variance, colour_variance), _UNSEEN)
    diagonal = variance.rsqrt()
    shared_deviation = scene_colour * detail_variance.sqrt() * diagonal
    shared_square = shared_deviation.square().sum(0, keepdim=True)
    # (1 + s s')^(-1/2) = 1 - s s' (1 - (1 + |s|^2)^(-1/2)) / |s|^2
    share = (1.0 - (1.0 + shared_square).rsqrt()) / shared_square.clamp_min(1e-30)
    return Weights(diagonal, shared_deviation, share)


def _around(values: Tensor, unclipped: Tensor) -> Tensor:
    """Return the mean over the pixels of a square around each pixel that are not clipped."""
    return box(values * unclipped, _AROUND) / box(unclipped.expand_as(values), _AROUND).clamp_min(
        1e-9
    )


def masked_variance(picture: Tensor, unclipped: Tensor) -> Tensor:
    """Return the variance of the pixels that are seen, of each channel: (channel, 1, 1)."""
    count = unclipped.sum((-2, -1), keepdim=True).clamp_min(1.0)
    mean = (picture * unclipped).sum((-2, -1), keepdim=True) / count
    return ((picture - mean).square() * unclipped).sum((-2, -1), keepdim=True) / count
