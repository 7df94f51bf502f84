"""The power spectrum of a scene, fitted to a blurred and noisy frame of it: how fast it falls, and how strong it is."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.restore._inverse._masked_blur import Blurred, Size
from neusee.nodes.restore._inverse._masked_blur import variance as variance_of
from neusee.nodes.restore._inverse._scene_level import SceneDoubt

_SLOPES = (2.0, 4.0, 9)  #: first, last and number of the exponents that are tried; scenes have 2 to 4
_POWERS = (-7.0, 1.0, 25)  #: of e, times the variance that explains the whole frame
_NOISES = tuple(2.0**n for n in range(8))  #: times the variance of the noise that the filter assumes
_MOST = 20_000  #: frequencies that count, at most
_LOWEST = 3.0  #: cycles in the picture, below which the window mixes frequencies
_SURE = 0.75  #: quantile of the weights of pixels, above which a pixel counts fully
_SAMPLE = 1 << 20  #: pixels from which this quantile is taken, at most
_PRIOR = 1.0  #: standard deviation of the logarithm of the variance of a scene, over that of the filter
_ALIKE = 4.0  #: frequencies of a window that tell the same


class FrameLaw(NamedTuple):
    """The law of a frame: the power spectrum of its scene, and its noise."""

    power: Tensor  #: half a spectrum of the torus
    noise: float  #: variance of the noise over the variance that the filter assumes
    low: float = 1.0  #: factor of the power, at least 1, by which the variance is not below that of the prior


def fitted_law(problem: Blurred, doubt: SceneDoubt | None = None) -> FrameLaw:
    """Return the law of a frame of the highest debiased Whittle likelihood.

    The power of the scene is A (f^2 + 1 / pixels)^(-b / 2), as the prior of the filter, whose b is 3. The likelihood
    compares the periodogram of the frame with its exact expectation: the correlation of the blurred scene times that of
    the window. So light that the window or a hole moves to other frequencies, such as the zeros of a PSF, is expected
    there. The window falls to the edges and, with the weight of a pixel, near glare that is not known. ``doubt`` says
    what is not known of mean and variance of the scene; without it the variance is nearly 1 before the frame is seen.
    Source: Sykulski, Olhede, Guillaumin, Lilly and Early, Biometrika 106, 251 (2019).
    """
    window = _window(problem)
    size = (window.shape[-2], window.shape[-1])
    area = window.square().sum((-2, -1), keepdim=True)
    picture = problem.picture.detach()
    contrast = picture - (picture * window).sum((-2, -1), keepdim=True) / window.sum((-2, -1), keepdim=True)
    far = _squared(size).to(window) > (_LOWEST / min(size)) ** 2
    step = max(1, int(far.sum()) * len(window) // _MOST)
    found = _sampled(torch.fft.rfft2(contrast * window).abs().square() / area, far, step)
    variance = torch.where(problem.weight > 0, 1.0 / problem.weight.clamp_min(1e-30), 0.0).detach()
    noise = (window.square() * variance).sum((-2, -1), keepdim=True) / area
    level = _sampled(noise.expand(-1, *far.shape), far, step)
    twice = (2 * size[0], 2 * size[1])
    lags = torch.fft.irfft2(torch.fft.rfft2(window, s=twice).abs().square(), s=twice) / area
    best, slope, strength, factor = float("inf"), 3.0, 0.0, 1.0
    for exponent in torch.linspace(*_SLOPES[:2], int(_SLOPES[2])).tolist():
        law = _sampled(_expected(problem, exponent, lags), far, step)
        unit = float(found.sum() / law.sum().clamp_min(1e-30))
        loss, times, extra = _likeliest(found, unit * law, level, _before(problem, doubt, exponent) - math.log(unit))
        if loss < best:
            best, slope, strength, factor = loss, exponent, unit * times, extra
    power = strength * _law(problem, slope)
    low = max(1.0, math.exp(_before(problem, doubt, slope)) / max(strength, 1e-30))
    power[0, 0] += doubt.mean * problem.torus[0] * problem.torus[1] if doubt else 0.0
    return FrameLaw(power, factor, low)


def _before(problem: Blurred, doubt: SceneDoubt | None, slope: float) -> float:
    """Return the logarithm of the strength of a law that gives a scene the variance it is expected to have."""
    expected = doubt.contrast if doubt else 1.0
    return math.log(expected / float(variance_of(_law(problem, slope), problem.torus)))


def _window(problem: Blurred) -> Tensor:
    """Return the window (channel, y, x) of the periodogram."""
    y, x = problem.picture.shape[-2:]
    weight = problem.weight.detach()
    falling = (torch.hann_window(n + 2, periodic=False)[1:-1].to(weight) for n in (y, x))
    sure = []
    for each in weight:
        seen = each[each > 0]
        sure.append(torch.quantile(seen[:: max(1, len(seen) // _SAMPLE)], _SURE))
    own = weight / torch.stack(sure)[:, None, None]
    rows, columns = falling
    return rows[:, None] * columns * own / (1.0 + own)


def _expected(problem: Blurred, slope: float, lags: Tensor) -> Tensor:
    """Return the expected periodogram of a blurred scene of power 1 / f^slope, given the correlation of the window."""
    through = problem.transfer.detach().abs().square()
    correlation = torch.fft.irfft2(_law(problem, slope) * through, s=problem.torus)
    down, right = (_lags(n).to(lags.device) % side for n, side in zip(lags.shape[-2:], problem.torus, strict=True))
    whole: Tensor = torch.fft.rfft2(correlation[:, down[:, None], right] * lags).real
    return whole[:, ::2, ::2].clamp_min(0.0)


def _lags(size: int) -> Tensor:
    return (torch.arange(size) + size // 2) % size - size // 2


def _law(problem: Blurred, slope: float) -> Tensor:
    y, x = problem.picture.shape[-2:]
    law: Tensor = (_squared(problem.torus).to(problem.picture) + 1.0 / (y * x)) ** (-slope / 2)
    return law


def _sampled(spectrum: Tensor, far: Tensor, step: int) -> Tensor:
    sampled: Tensor = spectrum[:, far].flatten()[::step].double()
    return sampled


def _likeliest(found: Tensor, law: Tensor, noise: Tensor, middle: float) -> tuple[float, float, float]:
    """Return the least loss of a law, its strength, and the factor of the noise, which grows while the loss falls.

    The logarithm of the strength has the mean ``middle`` before the frame is seen.
    """
    best = (float("inf"), 0.0, 1.0)
    many = len(found) / _ALIKE
    for factor in _NOISES:
        here = (float("inf"), 0.0, factor)
        for strength in torch.linspace(*_POWERS[:2], int(_POWERS[2])).exp().tolist():
            expected = strength * law + factor * noise
            loss = float((expected.log() + found / expected).mean())
            loss += ((math.log(strength) - middle) / _PRIOR) ** 2 / many
            here = min(here, (loss, strength, factor))
        if here[0] >= best[0]:
            break
        best = here
    return best


def _squared(size: Size) -> Tensor:
    """Return the squared frequencies in cycles per pixel, half a spectrum."""
    fy, fx = torch.fft.fftfreq(size[0]), torch.fft.rfftfreq(size[1])
    squared: Tensor = fy[:, None].square() + fx.square()
    return squared
