"""The prior of the Wiener filter: noise, power spectrum, and the level of the scene."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Generator, Tensor
from torch.nn.functional import avg_pool2d

from neusee.nodes.restore.inverse._conjugate_gradients import pieces
from neusee.nodes.restore.inverse._glare import Light, average
from neusee.nodes.restore.inverse._masked_blur import Blurred, Size, variance
from neusee.nodes.restore.inverse._masked_blur import variance as variance_of

# --- picture scale --------------------------------------------------------------------------------

# Scaling of a picture before its deconvolution: variance of its noise, power spectrum of the prior,
# and the variance that the prior predicts.


#: the power spectrum of pictures falls as 1 / frequency to this power, like that of edges
_FALL = 3.0
_NO_LIGHT = 1e-12  #: a PSF with a smaller sum counts as a PSF without light
#: trust in a channel at which its own level has the same weight as that of the other channels
_TOLD = 0.05


def picture_noise(electrons: Tensor, mean: Tensor, read: float) -> Tensor:
    """Return the noise variance (e-^2) of each pixel: photon noise plus read noise.

    The variance of photon noise is the local mean or the mean of the picture, whichever is larger.
    """
    local_mean = electrons[None]
    # mean over 9 x 9 pixels, one axis after the other
    for window, rim in (((9, 1), (4, 0)), ((1, 9), (0, 4))):
        local_mean = avg_pool2d(local_mean, window, stride=1, padding=rim, count_include_pad=False)
    return (torch.maximum(local_mean[0], mean) + read**2).clamp_min(1e-3)


def expected_variance(transfer: Tensor, power: Tensor, size: Size) -> Tensor:
    """Return the expected variance (channel, 1, 1) of a blurred picture; the sum over frequencies
    takes a few rows at a time.
    """
    total = power.new_zeros(len(transfer))
    for rows in pieces(transfer):
        transfer_rows = transfer[:, rows]
        total = total + variance(
            (transfer_rows.real.square() + transfer_rows.imag.square()) * power[rows], size
        )
    return total[:, None, None]


def fall(size: Size, period: Size | None = None) -> Tensor:
    """Return the power spectrum of the prior of the scene, as a half spectrum of mean 1.

    Below one cycle in ``period`` pixels it is nearly constant; the default is the size of the
    torus.
    """
    fy, fx = (torch.fft.fftfreq(n, dtype=torch.float64) for n in size)
    squared = (
        fy[:, None].square()
        + fx[None, : size[1] // 2 + 1].square()
        + 1.0 / math.prod(period or size)
    )
    power: Tensor = squared.pow_(-_FALL / 2.0)
    power /= variance(power, size)
    return power


def about_mean(power: Tensor, frame: Size, torus: Size) -> Tensor:
    """Return a half power spectrum on a periodic grid, without the variance of the mean over a
    frame.
    """
    rows, columns = (torch.ones(n, dtype=power.dtype, device=power.device) / n for n in frame)
    # share of each frequency in the variance of the mean: |FFT of a window of height 1 / size|^2
    share = (
        torch.fft.fft(rows, torus[0]).abs().square()[:, None]
        * torch.fft.rfft(columns, torus[1]).abs().square()
    )
    varying_power: Tensor = power * (1.0 - share)
    return varying_power


def power_of_two(x: Tensor) -> Tensor:
    """Return the powers of two nearest to ``x`` in ratio; 1 for a PSF without light, whose
    derivatives would overflow.
    """
    return torch.where(x > _NO_LIGHT, x, 1.0).log2().round().exp2()


def shared_level(level: Tensor, trust: Tensor, white: Tensor) -> Tensor:
    """Return the mean or the contrast (channel, 1, 1) of each channel, taken from the other
    channels where ``trust`` is small.

    ``trust`` is the share of the pixels of a channel in which noise exceeds the uncertainty of the
    glare. ``white`` is the signal of a grey scene in each channel.
    """
    grey = level / white
    weight = trust.clamp_min(1e-12)
    common_grey = ((weight * grey.log()).sum() / weight.sum()).exp()
    own_share = trust / (trust + _TOLD)
    shared: Tensor = white * (own_share * grey.log() + (1.0 - own_share) * common_grey.log()).exp()
    return shared


# --- scene level ----------------------------------------------------------------------------------

# Uncertainty of a scene behind glare, besides its details: its mean, its contrast, and blotches
# (correlated errors over some pixels) of the glare.
#
# The glare is estimated and subtracted. Its error has the same sign in all pixels, and is an error
# of the mean of the picture. Where glare covers most pixels, this error exceeds the light of the
# scene. Then a prior decides: the mean of a scene is usually a seventh of the brightest pixel
# (within a factor of three), and its standard deviation is 0.8 of its mean (within a factor of
# 1.6). The colour of the mean is nearly grey.


#: median of (mean of a scene / brightest pixel), and standard deviation of its logarithm
_EXPOSED, _EXPOSURE = 0.15, math.log(3.0)
#: median of (standard deviation of a scene / mean), and standard deviation of its logarithm
_CONTRAST, _CONTRASTS = 0.8, 0.5
_COLOUR = 0.3  #: standard deviation of the mean of a channel, relative to that of a grey scene
_TINT = 0.2  #: standard deviation of the contrast of a channel, relative to that of a grey scene
_ONE_CHANNEL_SHARE = 0.1  #: share of the variance of an error that is independent in each channel
_VARIANCE_ERROR = 0.1  #: relative error of a variance that is estimated from one picture
_GRID_POINTS = 241  #: number of grid points in the shared logarithm
_GRID_DEVIATIONS = 4.0  #: half width of this grid, in standard deviations of the prior
_BLOTCHES = 0.3  #: standard deviation of a blotch, relative to that of scattered light in a pixel
BLOTCH_PIXELS = 16  #: distance between neighbouring blotches in pixels


class Told(NamedTuple):
    """An estimate of a quantity of each channel from a picture, with its errors."""

    value: Tensor  #: (channel, 1, 1)
    #: (error, channel, 1, 1), standard deviations; each error has the same sign in all channels
    errors: Tensor


class Level(NamedTuple):
    """Mean or variance of each channel of a scene, with its standard deviation: (channel, 1, 1)
    each.
    """

    value: Tensor
    deviation: Tensor


class SceneDoubt(NamedTuple):
    """The uncertainty of a scene behind glare, in units of the scale of the filter."""

    mean: float  #: expected square of the error of the mean
    contrast: float  #: expected variance of the scene
    blotches: Tensor  #: (channel, y, x), standard deviation of light correlated over some pixels


@torch.no_grad()
def scene_doubt(
    mean_and_scale: tuple[Tensor, Tensor],
    evidence: tuple[Told, Told],
    white: Tensor | None,
    full: float,
    light: Light,
) -> SceneDoubt | None:
    """Return the uncertainty of mean, contrast and glare of a scene; None if the glare is known
    exactly.

    ``mean_and_scale`` (channel, 1, 1) are those of the filter, ``evidence`` the estimates of mean
    and variance from the picture. ``white`` is the signal of a grey scene in each channel; without
    it, mean and scale count as known.
    """
    if not light.modes:
        return None
    mean, scale = mean_and_scale
    blotches = _BLOTCHES * light.variance.sqrt() / scale
    if white is None:
        return SceneDoubt(0.0, 1.0, blotches)
    level, variance = level_and_variance(*evidence, white, full)
    mean_square_error = (level.deviation.square() + (level.value - mean).square()) / scale.square()
    return SceneDoubt(
        float(mean_square_error.mean()), float((variance.value / scale.square()).mean()), blotches
    )


def told_of_scene(
    mean: Tensor, variance: Tensor, wrong: Tensor, light: Light, weights: Tensor, unseen: Tensor
) -> tuple[Told, Told]:
    """Return the estimates of the mean and the variance of a scene, from a picture without glare.

    ``wrong`` (channel, 1, 1) is the part of the variance that may be glare, ``weights`` are the
    weights of the pixels in the mean, and ``unseen`` is the possible light of a channel without
    known pixels.
    """
    errors = torch.stack([*(average(mode, weights) for mode in light.modes), unseen])
    return Told(mean, errors), Told(variance, (wrong + unseen.square())[None])


def level_and_variance(
    mean: Told, variance: Told, white: Tensor, full: float
) -> tuple[Level, Level]:
    """Return the mean and the variance of a scene in each channel, with their standard deviations.

    ``white`` (channel, 1, 1) is the signal of a grey scene in each channel, ``full`` the light of
    the brightest pixel.
    """
    grey = white.flatten().double()
    level, log_exposure, log_deviation = _likely(
        mean, grey, math.log(_EXPOSED * full), _EXPOSURE, _COLOUR
    )
    # log(variance) = 2 log(standard deviation)
    log_variance = 2.0 * (log_exposure + math.log(_CONTRAST))
    log_variance_deviation = 2.0 * math.hypot(log_deviation, _CONTRASTS)
    variance_level, _, _ = _likely(
        variance, grey.square(), log_variance, log_variance_deviation, 2.0 * _TINT, _VARIANCE_ERROR
    )
    return level, variance_level


def drawn_blotches(blotches: Tensor, rng: Generator) -> Tensor:
    """Return a random field of light (channel, y, x) that is correlated over some pixels and has
    one colour.
    """
    y_hats, x_hats = (_hats(n).to(blotches) for n in blotches.shape[-2:])
    drawn = torch.randn(
        len(y_hats), len(x_hats), generator=rng, device=rng.device, dtype=blotches.dtype
    ).to(blotches)
    field: Tensor = blotches * (y_hats.T @ drawn @ x_hats)
    return field


def _hats(size: int) -> Tensor:
    """Return the weights (blotch, pixel) of the blotches along one axis; the squares of the weights
    of a pixel sum to 1.
    """
    # triangle functions: 1 at the centre of a blotch, 0 at the centres of its neighbours
    position = torch.arange(size) / BLOTCH_PIXELS
    hats = (1.0 - (position - torch.arange(size // BLOTCH_PIXELS + 2)[:, None]).abs()).clamp_min(
        0.0
    )
    return hats / hats.square().sum(0).sqrt()


def _likely(
    evidence: Told, grey: Tensor, middle: float, width: float, own: float, rough: float = 0.0
) -> tuple[Level, float, float]:
    """Return the posterior of a quantity in each channel, and the posterior mean and standard
    deviation of the logarithm of its shared value.

    The prior of the logarithm is normal with mean ``middle`` and standard deviation ``width``. A
    channel has ``grey`` times the shared value, with the relative standard deviation ``own``.
    ``rough`` is the relative error of the evidence. The posterior is a sum over a grid of the
    logarithm.
    """
    value, errors = evidence.value.flatten().double(), evidence.errors.flatten(1).double()
    error_covariance = errors.T @ errors
    # a share of the variance is independent in each channel; 1 keeps the matrix positive definite
    error_covariance = (
        error_covariance + (_ONE_CHANNEL_SHARE * error_covariance.diagonal() + 1.0).diag()
    )
    logs = (
        torch.linspace(
            -_GRID_DEVIATIONS,
            _GRID_DEVIATIONS,
            _GRID_POINTS,
            dtype=torch.float64,
            device=value.device,
        )
        * width
        + middle
    )
    expected = logs.exp()[:, None] * grey
    channel_variance = (own * expected).square()
    covariance = error_covariance + (channel_variance + (rough * expected).square()).diag_embed()
    deviation = value - expected
    lower_factor = torch.linalg.cholesky(covariance)
    solved_deviation = torch.cholesky_solve(deviation[..., None], lower_factor)[..., 0]
    log_prior = -0.5 * ((logs - middle) / width).square() - lower_factor.diagonal(
        dim1=-2, dim2=-1
    ).log().sum(-1)
    # posterior probability of each grid point: prior times Gaussian density of the evidence
    probability = torch.softmax(log_prior - 0.5 * (deviation * solved_deviation).sum(-1), 0)[
        :, None
    ]
    posterior_mean = (expected + channel_variance * solved_deviation).clamp_min(0.0)
    posterior_variance = channel_variance - channel_variance.square() * torch.cholesky_inverse(
        lower_factor
    ).diagonal(dim1=-2, dim2=-1)
    mean = (probability * posterior_mean).sum(0)
    variance = (
        probability * (posterior_variance.clamp_min(0.0) + (posterior_mean - mean).square())
    ).sum(0)
    log_mean = float((probability[:, 0] * logs).sum())
    log_deviation = float((probability[:, 0] * (logs - log_mean).square()).sum().sqrt())
    value_and_deviation = (x[:, None, None].to(evidence.value) for x in (mean, variance.sqrt()))
    return Level(*value_and_deviation), log_mean, log_deviation


# --- frame spectrum -------------------------------------------------------------------------------

# The power spectrum of a scene, fitted to a blurred and noisy frame: its exponent and its strength.


#: smallest, largest and number of the exponents that are tried; scenes have 2 to 4
_SLOPES = (2.0, 4.0, 9)
#: smallest, largest and number of the logarithms of the strength that are tried, relative to the
#: strength that explains the whole frame
_POWERS = (-7.0, 1.0, 25)
#: factors of the noise variance that are tried, relative to the assumption of the filter
_NOISES = tuple(2.0**n for n in range(8))
_MOST_FREQUENCIES = 20_000  #: approximate number of frequencies in the likelihood
#: lowest frequency in the likelihood, cycles in the picture: the window mixes lower ones
_LOWEST = 3.0
#: quantile of the weights of pixels: a pixel with a much larger weight has the full window
_FULL_WEIGHT_QUANTILE = 0.75
_QUANTILE_PIXELS = 1 << 20  #: approximate number of pixels from which this quantile is estimated
#: prior standard deviation of the logarithm of the variance of a scene
_PRIOR = 1.0
_LIKE_FREQUENCIES = 4.0  #: number of neighbouring frequencies that the window correlates


class FrameLaw(NamedTuple):
    """The fitted model of a frame: the power spectrum of its scene, and its noise."""

    power: Tensor  #: (fy, fx), half spectrum on the torus
    noise: float  #: variance of the noise, relative to the assumption of the filter
    #: factor >= 1 that raises the power to the variance that the prior expects
    low: float = 1.0


def fitted_law(problem: Blurred, doubt: SceneDoubt | None = None) -> FrameLaw:
    """Return the power spectrum and noise of a frame with the highest debiased Whittle likelihood.

    The power of the scene is A (f^2 + 1 / pixels)^(-b / 2), as in the prior of the filter, whose b
    is 3. The likelihood compares the periodogram of the frame with its exact expectation: the
    Fourier transform of the correlation of the blurred scene times the correlation of the window.
    So it includes the light that the window or a hole moves to other frequencies, for example to
    the zeros of a PSF. The window falls to 0 at the edges, and where the weight of a pixel is low
    because of uncertain glare. ``doubt`` is the uncertainty of mean and variance of the scene;
    without it the prior of the variance is near 1.
    Source: Sykulski, Olhede, Guillaumin, Lilly and Early, Biometrika 106, 251 (2019).
    """
    window = _window(problem)
    size = (window.shape[-2], window.shape[-1])
    area = window.square().sum((-2, -1), keepdim=True)
    picture = problem.picture.detach()
    contrast = picture - (picture * window).sum((-2, -1), keepdim=True) / window.sum(
        (-2, -1), keepdim=True
    )
    # low frequencies are left out, because the window mixes them with the mean
    counted = _squared(size).to(window) > (_LOWEST / min(size)) ** 2
    step = max(1, int(counted.sum()) * len(window) // _MOST_FREQUENCIES)
    periodogram = _sampled(torch.fft.rfft2(contrast * window).abs().square() / area, counted, step)
    variance = torch.where(problem.weight > 0, 1.0 / problem.weight.clamp_min(1e-30), 0.0).detach()
    noise = (window.square() * variance).sum((-2, -1), keepdim=True) / area
    noise_level = _sampled(noise.expand(-1, *counted.shape), counted, step)
    twice_size = (2 * size[0], 2 * size[1])
    window_correlation = (
        torch.fft.irfft2(torch.fft.rfft2(window, s=twice_size).abs().square(), s=twice_size) / area
    )
    best, slope, strength, factor = float("inf"), 3.0, 0.0, 1.0
    for exponent in torch.linspace(*_SLOPES[:2], int(_SLOPES[2])).tolist():
        expected = _sampled(_expected(problem, exponent, window_correlation), counted, step)
        scale = float(periodogram.sum() / expected.sum().clamp_min(1e-30))
        loss, strength_over_scale, noise_factor = _likeliest(
            periodogram,
            scale * expected,
            noise_level,
            _expected_strength(problem, doubt, exponent) - math.log(scale),
        )
        if loss < best:
            best, slope, strength, factor = (
                loss,
                exponent,
                scale * strength_over_scale,
                noise_factor,
            )
    power = strength * _law(problem, slope)
    low = max(1.0, math.exp(_expected_strength(problem, doubt, slope)) / max(strength, 1e-30))
    # the uncertainty of the mean is added at frequency 0
    power[0, 0] += doubt.mean * problem.torus[0] * problem.torus[1] if doubt else 0.0
    return FrameLaw(power, factor, low)


def _expected_strength(problem: Blurred, doubt: SceneDoubt | None, slope: float) -> float:
    """Return the logarithm of the strength A for which a scene with the exponent ``slope`` has its
    expected variance.
    """
    expected = doubt.contrast if doubt else 1.0
    return math.log(expected / float(variance_of(_law(problem, slope), problem.torus)))


def _window(problem: Blurred) -> Tensor:
    """Return the window (channel, y, x) of the periodogram.

    It falls to 0 at the edges, and where the weight of a pixel is far below the quantile
    `_FULL_WEIGHT_QUANTILE` of its channel.
    """
    y, x = problem.picture.shape[-2:]
    weight = problem.weight.detach()
    edge_windows = (torch.hann_window(n + 2, periodic=False)[1:-1].to(weight) for n in (y, x))
    certain_weights = []
    for channel_weight in weight:
        unclipped = channel_weight[channel_weight > 0]
        certain_weights.append(
            torch.quantile(
                unclipped[:: max(1, len(unclipped) // _QUANTILE_PIXELS)], _FULL_WEIGHT_QUANTILE
            )
        )
    relative_weight = weight / torch.stack(certain_weights)[:, None, None]
    rows, columns = edge_windows
    return rows[:, None] * columns * relative_weight / (1.0 + relative_weight)


def _expected(problem: Blurred, slope: float, lags: Tensor) -> Tensor:
    """Return the expected periodogram of a blurred scene with the power 1 / f^slope; ``lags`` is
    the autocorrelation of the window.
    """
    squared_transfer = problem.transfer.detach().abs().square()
    scene_correlation = torch.fft.irfft2(_law(problem, slope) * squared_transfer, s=problem.torus)
    row_lags, column_lags = (
        _lags(n).to(lags.device) % side
        for n, side in zip(lags.shape[-2:], problem.torus, strict=True)
    )
    spectrum: Tensor = torch.fft.rfft2(
        scene_correlation[:, row_lags[:, None], column_lags] * lags
    ).real
    # the grid of lags is twice as wide, so every second frequency is one of the periodogram
    return spectrum[:, ::2, ::2].clamp_min(0.0)


def _lags(size: int) -> Tensor:
    """Return the lags (size,) in FFT order: from 0 upwards, then the negative ones."""
    return (torch.arange(size) + size // 2) % size - size // 2


def _law(problem: Blurred, slope: float) -> Tensor:
    """Return the power (fy, fx) of a scene, (f^2 + 1 / pixels)^(-slope / 2), of strength 1."""
    y, x = problem.picture.shape[-2:]
    law: Tensor = (_squared(problem.torus).to(problem.picture) + 1.0 / (y * x)) ** (-slope / 2)
    return law


def _sampled(spectrum: Tensor, far: Tensor, step: int) -> Tensor:
    """Return every ``step``-th of the frequencies in the mask ``far``, of all channels, as one
    float64 row.
    """
    sampled: Tensor = spectrum[:, far].flatten()[::step].double()
    return sampled


def _likeliest(
    periodogram: Tensor, law: Tensor, noise: Tensor, middle: float
) -> tuple[float, float, float]:
    """Return the smallest loss, with its strength and factor of the noise; larger factors are tried
    as long as the loss falls.

    The loss is the mean of log(expected) + periodogram / expected (Whittle), plus the prior of the
    strength, whose logarithm has the prior mean ``middle``.
    """
    best_of_all = (float("inf"), 0.0, 1.0)
    independent_count = len(periodogram) / _LIKE_FREQUENCIES
    for factor in _NOISES:
        best_of_factor = (float("inf"), 0.0, factor)
        for strength in torch.linspace(*_POWERS[:2], int(_POWERS[2])).exp().tolist():
            expected = strength * law + factor * noise
            loss = float((expected.log() + periodogram / expected).mean())
            loss += ((math.log(strength) - middle) / _PRIOR) ** 2 / independent_count
            best_of_factor = min(best_of_factor, (loss, strength, factor))
        if best_of_factor[0] >= best_of_all[0]:
            break
        best_of_all = best_of_factor
    return best_of_all


def _squared(size: Size) -> Tensor:
    """Return the squared frequencies (fy, fx) of a half spectrum, in (cycles per pixel)^2."""
    fy, fx = torch.fft.fftfreq(size[0]), torch.fft.rfftfreq(size[1])
    squared: Tensor = fy[:, None].square() + fx.square()
    return squared
