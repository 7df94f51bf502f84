"""What scales a picture before its deconvolution: the variance of its noise, the prior, and what the prior expects."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from neusee.nodes.restore._inverse._conjugate_gradients import pieces
from neusee.nodes.restore._inverse._masked_blur import Size, variance

_FALL = 3.0  #: the power spectrum of pictures falls with frequency to this power, like that of edges
_NO_LIGHT = 1e-12  #: share of the light below which a PSF counts as one without light
_TOLD = 0.05  #: trust in a channel, at which its own level counts as much as that of the other channels


def picture_noise(electrons: Tensor, mean: Tensor, read: float) -> Tensor:
    """Return the noise variance of each pixel, from the larger of the local mean and the mean of the picture."""
    around = electrons[None]
    for window, rim in (((9, 1), (4, 0)), ((1, 9), (0, 4))):
        around = avg_pool2d(around, window, stride=1, padding=rim, count_include_pad=False)
    return (torch.maximum(around[0], mean) + read**2).clamp_min(1e-3)


def expected_variance(transfer: Tensor, power: Tensor, size: Size) -> Tensor:
    """Return the expected variance (channel, 1, 1) of a blurred picture, summed over a few spectrum rows at a time."""
    total = power.new_zeros(len(transfer))
    for rows in pieces(transfer):
        through = transfer[:, rows]
        total = total + variance((through.real.square() + through.imag.square()) * power[rows], size)
    return total[:, None, None]


def fall(size: Size, period: Size | None = None) -> Tensor:
    """Return the power spectrum that the prior of the scene assumes, as half a spectrum of mean 1.

    Below one cycle in ``period`` pixels, those of the torus without a number, it hardly rises.
    """
    fy, fx = (torch.fft.fftfreq(n, dtype=torch.float64) for n in size)
    squared = fy[:, None].square() + fx[None, : size[1] // 2 + 1].square() + 1.0 / math.prod(period or size)
    power: Tensor = squared.pow_(-_FALL / 2.0)
    power /= variance(power, size)
    return power


def about_mean(power: Tensor, frame: Size, torus: Size) -> Tensor:
    """Return half a power spectrum on a periodic grid, without the variance that the mean over a frame has."""
    rows, columns = (torch.ones(n, dtype=power.dtype, device=power.device) / n for n in frame)
    share = torch.fft.fft(rows, torus[0]).abs().square()[:, None] * torch.fft.rfft(columns, torus[1]).abs().square()
    left: Tensor = power * (1.0 - share)
    return left


def power_of_two(x: Tensor) -> Tensor:
    """Return the powers of two nearest to ``x`` by ratio; 1 for a PSF without light, whose slopes overflow."""
    return torch.where(x > _NO_LIGHT, x, 1.0).log2().round().exp2()


def shared_level(level: Tensor, trust: Tensor, white: Tensor) -> Tensor:
    """Return the mean or the contrast of each channel, (channel, 1, 1), with that of others where trust is small.

    ``trust`` is the share of a channel that noise, not glare, rules; ``white`` what the channels see of a grey scene.
    """
    grey = level / white
    known = trust.clamp_min(1e-12)
    common = ((known * grey.log()).sum() / known.sum()).exp()
    own = trust / (trust + _TOLD)
    shared: Tensor = white * (own * grey.log() + (1.0 - own) * common.log()).exp()
    return shared
