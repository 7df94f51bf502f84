"""The likelihood of a frame given lasers and lamps: whitened residual, clipped pixels, maximum
likelihood fit and intervals.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

from neusee.nodes.optics.transform._fft_transforms import fft_length
from neusee.nodes.restore.lasers._components import NANOMETRE, Lamp, Laser

# --- whitening ------------------------------------------------------------------------------------

# A linear filter that makes the residual of a frame nearly white, so that half its sum of squares
# is a negative log likelihood.
#
# Clipped pixels are filled from their neighbours, a short filter removes the smooth part of the
# scene, and each pixel is divided by a local standard deviation of noise and of details of the
# scene. The same filter acts on every pattern, so that the filling causes no error of the model.
# "Seen" pixels are those that are not clipped.

_FILTER_RADIUS = 8  #: radius of the filter, pixels
_DETAIL_WINDOW = 9  #: side in pixels of the window for the local variance of details
_NOISE_WINDOW = 5  #: side in pixels of the window for the local mean, the variance of photon noise
_UNSEEN_VARIANCE = 1e12  #: e-^2, variance of a clipped pixel, which gives it no weight
FILLED_VARIANCE = 0.3  #: variance of a filled pixel, relative to the variance of its channel
_LEAST_DETAIL = 0.05  #: smallest variance of details at a pixel, relative to the mean of the frame


class Weights(NamedTuple):
    """The inverse square root of the covariance of the channels in each pixel.

    The covariance is a diagonal matrix (noise) plus a matrix of rank one: details of the scene that
    all channels share, in one colour.
    """

    diagonal: Tensor  #: (channel, y, x), 1 / standard deviation of the diagonal part
    grey: Tensor  #: (channel, y, x), standard deviation of the shared details, times ``diagonal``
    share: Tensor  #: (1, y, x), factor of the matrix ``grey grey^T`` in the inverse square root

    def __call__(self, filtered: Tensor) -> Tensor:
        """Return filtered pictures (..., channel, y, x), scaled to mean 0 and variance 1."""
        scaled = self.diagonal * filtered
        # (D^2 + s s^T)^(-1/2), up to a rotation: D is diagonal, s is the shared colour
        return scaled - self.grey * (self.share * (self.grey * scaled).sum(-3, keepdim=True))

    def twice(self, filtered: Tensor) -> Tensor:
        """Return W^T W applied to filtered pictures, where W are these weights: the inverse
        covariance.
        """
        white = self(filtered)
        return self.diagonal * (
            white - self.grey * (self.share * (self.grey * white).sum(-3, keepdim=True))
        )

    def pair(self, first: int, other: int) -> Tensor:
        """Return the element of the inverse covariance for two channels, for each pixel (y, x)."""
        shared_square = self.grey.square().sum(0)
        shared_part = (
            (2.0 - self.share[0] * shared_square)
            * self.share[0]
            * self.grey[first]
            * self.grey[other]
        )
        return self.diagonal[first] * self.diagonal[other] * (float(first == other) - shared_part)


class Filter(NamedTuple):
    """A filter that fills clipped pixels from their neighbours, then removes the smooth part."""

    seen: Tensor  #: (channel, y, x), 1 or 0
    kernel: Tensor  #: (side, side), symmetric

    def __call__(self, pictures: Tensor) -> Tensor:
        """Return filtered pictures (..., channel, y, x); a picture (..., 1, y, x) has the same
        values in each channel.
        """
        return self.sharp(filled(pictures, self.seen))

    def sharp(self, pictures: Tensor) -> Tensor:
        """Return pictures (..., y, x) of any size without their smooth part; no pixel is filled."""
        return _convolved(pictures, self.kernel.to(pictures))

    def squared(self, variances: Tensor) -> Tensor:
        """Return the variance (channel, y, x) of the filtered pixels, from the variance of
        independent pixels.
        """
        return _convolved(variances, self.kernel.to(variances).square())


def _convolved(pictures: Tensor, kernel: Tensor) -> Tensor:
    """Return the convolution of pictures (..., y, x) with a symmetric kernel of odd sides; the
    pictures are mirrored at their edges.
    """
    flat = pictures.reshape(-1, *pictures.shape[-2:])
    rim = len(kernel) // 2
    padded = pad(flat, (rim,) * 4, mode="reflect")
    size = [fft_length(n) for n in padded.shape[-2:]]
    product = torch.fft.rfft2(padded, s=size) * torch.fft.rfft2(kernel, s=size)
    y, x = pictures.shape[-2:]
    # the offset of the result is `rim` for the middle of the kernel and `rim` for the padding
    inner: Tensor = torch.fft.irfft2(product, s=size)[
        :, 2 * rim : 2 * rim + y, 2 * rim : 2 * rim + x
    ]
    return inner.reshape(pictures.shape)


def filled(pictures: Tensor, unclipped: Tensor) -> Tensor:
    """Return pictures (..., channel, y, x) in which clipped pixels are interpolated from the
    pixels around them.
    """
    pictures_by_channel = pictures.expand(*pictures.shape[:-3], *unclipped.shape)
    if bool(unclipped.all()):
        return pictures_by_channel
    return _from_coarse(pictures_by_channel.reshape(-1, *unclipped.shape), unclipped).view(
        pictures_by_channel.shape
    )


def _from_coarse(pictures: Tensor, unclipped: Tensor) -> Tensor:
    """Return pictures (picture, channel, y, x) whose clipped pixels are filled from the means of
    2 x 2 pixels; if all of these are clipped, from the means of 4 x 4 pixels, and so on.
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


def square_means(pictures: Tensor, side: int) -> Tensor:
    """Return the mean over a square of ``side`` (odd) pixels around each pixel; pixels beyond the
    edge are left out.
    """
    flat = pictures.reshape(-1, 1, *pictures.shape[-2:])
    for window, rim in (((side, 1), (side // 2, 0)), ((1, side), (0, side // 2))):
        flat = avg_pool2d(flat, window, stride=1, padding=rim, count_include_pad=False)
    return flat.reshape(pictures.shape)


def filter_of(picture: Tensor, noise: Tensor, unclipped: Tensor) -> Filter:
    """Return the filter that whitens a scene with the power spectrum of this picture, and its
    noise.
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
    # model of the scene: power = strength / f^3; the powers of a periodogram have an exponential
    # distribution, whose median is 0.69 (ln 2) times its mean
    scene_strength = ((power - noise_level) * frequency**3)[middle_frequencies].median() / 0.69
    side = 2 * _FILTER_RADIUS + 1
    kernel_frequencies = torch.fft.fftfreq(64).to(grey)
    kernel_frequency = torch.hypot(kernel_frequencies[:, None], torch.fft.rfftfreq(64).to(grey))
    # whitening: 1 / sqrt(strength / f^3 + noise)
    spectrum = (
        kernel_frequency**3
        / (scene_strength.clamp_min(1e-6 * noise_level) + noise_level * kernel_frequency**3)
    ).sqrt()
    kernel = torch.fft.irfft2(spectrum, s=(64, 64)).roll((_FILTER_RADIUS, _FILTER_RADIUS), (0, 1))[
        :side, :side
    ]
    taper = torch.hann_window(side + 2, periodic=False, dtype=grey.dtype, device=grey.device)[1:-1]
    taper = taper[:, None] * taper
    kernel = kernel * taper
    # sum 0, so that the mean of a picture is removed
    kernel = kernel - taper * (kernel.sum() / taper.sum())
    return Filter(unclipped, kernel / kernel.square().sum().sqrt())


def noise_of(electrons: Tensor, unclipped: Tensor, read_noise: float) -> Tensor:
    """Return the noise variance (e-^2) of each pixel: photon noise of its local mean, plus read
    noise.
    """
    return square_means(filled(electrons, unclipped), _NOISE_WINDOW).clamp_min(1.0) + read_noise**2


def weights_of(filtered: Tensor, use: Filter, noise: Tensor, picture: Tensor) -> Weights:
    """Return the weights of a filtered residual, from the noise and from the details around each
    pixel.
    """
    unclipped = use.seen
    spread = masked_variance(picture, unclipped)
    noise_variance = use.squared(noise) + FILLED_VARIANCE * spread * use.squared(1.0 - unclipped)
    scene_colour = (picture * unclipped).sum((-2, -1)) / unclipped.sum((-2, -1)).clamp_min(1.0)
    scene_colour = (scene_colour / scene_colour.abs().max().clamp_min(1e-9)).clamp_min(0.05)[
        :, None, None
    ]
    seen_precision = unclipped / noise_variance
    precision = (scene_colour.square() * seen_precision).sum(0, keepdim=True)
    # the most likely detail in each pixel, if its colour is that of the scene
    grey_details = (scene_colour * seen_precision * filtered).sum(
        0, keepdim=True
    ) / precision.clamp_min(1e-30)
    any_seen = (precision > 0).to(unclipped)
    # local variance of the details: their mean square minus the variance due to noise
    detail_variance = _around(grey_details.square(), any_seen) - _around(
        1.0 / precision.clamp_min(1e-12), any_seen
    )
    detail_variance = detail_variance.clamp_min(0.0)
    detail_variance = torch.maximum(
        detail_variance,
        _LEAST_DETAIL * (detail_variance * any_seen).sum() / any_seen.sum().clamp_min(1.0),
    )
    colour_variance = _around((filtered - scene_colour * grey_details).square(), unclipped)
    variance = torch.where(
        unclipped > 0, torch.maximum(noise_variance, colour_variance), _UNSEEN_VARIANCE
    )
    diagonal = variance.rsqrt()
    shared_deviation = scene_colour * detail_variance.sqrt() * diagonal
    shared_square = shared_deviation.square().sum(0, keepdim=True)
    # (1 + s s^T)^(-1/2) = 1 - s s^T (1 - (1 + |s|^2)^(-1/2)) / |s|^2
    share = (1.0 - (1.0 + shared_square).rsqrt()) / shared_square.clamp_min(1e-30)
    return Weights(diagonal, shared_deviation, share)


def _around(values: Tensor, unclipped: Tensor) -> Tensor:
    """Return the mean over the unclipped pixels in a square around each pixel."""
    return square_means(values * unclipped, _DETAIL_WINDOW) / square_means(
        unclipped.expand_as(values), _DETAIL_WINDOW
    ).clamp_min(1e-9)


def masked_variance(picture: Tensor, unclipped: Tensor) -> Tensor:
    """Return the variance of the unclipped pixels of each channel: (channel, 1, 1)."""
    count = unclipped.sum((-2, -1), keepdim=True).clamp_min(1.0)
    mean = (picture * unclipped).sum((-2, -1), keepdim=True) / count
    return ((picture - mean).square() * unclipped).sum((-2, -1), keepdim=True) / count


# --- censored -------------------------------------------------------------------------------------

# Clipped pixels as censored data of a fit: each is only known to have reached the clip level.
#
# The expected light of a clipped pixel is the light of lasers and lamps, plus the scene as
# interpolated from the pixels around it. The probability that the pixel clips is a normal survival
# function; its variance is that of photon noise, read noise and interpolation.


#: probability that the scene alone clips a pixel, without any laser or lamp
_SCENE_CLIPS = 0.01
#: weight of a clipped pixel: the interpolation errors of pixels closer than about 3 are correlated
_CLIPPED_WEIGHT = 1 / 9


class Censored(NamedTuple):
    """The clipped pixels of a frame, and the standard deviation of the light of each."""

    seen: Tensor  #: (channel, y, x), 1 or 0
    spread: Tensor  #: (pixel,), e-, standard deviation of the charge of each clipped pixel

    def misfits(self, residual: Tensor) -> Tensor:
        """Return numbers (pixel,) whose half squares are the negative log likelihood of the clipped
        pixels; ``residual`` is the frame minus all parts, in e-.
        """
        return _root(self._over(residual))[0]

    def slopes(self, residual: Tensor, columns: Tensor) -> Tensor:
        """Return minus the derivative (value, pixel) of each number of `misfits` with respect to
        each fitted value; ``columns`` is `lit` of the derivatives of the light.
        """
        return _root(self._over(residual))[1] * columns / self.spread

    def lit(self, pictures: Tensor) -> Tensor:
        """Return the light of clipped pixels minus its interpolation from their neighbours, in
        pictures (..., channel, y, x); 0 for the other pixels.
        """
        return (pictures - filled(pictures, self.seen)) * (1.0 - self.seen)

    def of(self, pictures: Tensor) -> Tensor:
        """Return the clipped pixels of pictures: (..., pixel)."""
        return pictures[..., self.seen == 0]

    def _over(self, residual: Tensor) -> Tensor:
        return self.of(filled(residual, self.seen) - residual) / self.spread


def _root(over: Tensor) -> tuple[Tensor, Tensor]:
    """Return numbers whose half squares are `_CLIPPED_WEIGHT` times the misfit of clipped pixels,
    and minus their derivatives with respect to ``over``.

    ``over`` is the expected light of a pixel minus the clip level, in standard deviations. The
    misfit is -log(1 - p), where p is the probability that neither the expected light nor the scene
    alone clips the pixel.
    """
    below_full = (1.0 - _SCENE_CLIPS) * torch.special.ndtr(-over)
    root = (-2.0 * torch.log1p(-below_full)).sqrt()
    density = torch.exp(-0.5 * over.square()) / (2.0 * torch.pi) ** 0.5
    # minus the derivative of sqrt(-2 log(1 - p)) with respect to `over`
    slope = (1.0 - _SCENE_CLIPS) * density / ((1.0 - below_full) * root.clamp_min(1e-6))
    return _CLIPPED_WEIGHT**0.5 * root, _CLIPPED_WEIGHT**0.5 * slope


def censored(
    electrons: Tensor, unclipped: Tensor, scene: Tensor, read_noise: float
) -> Censored | None:
    """Return the clipped pixels of a frame, or None if there are none; ``scene`` is the frame minus
    the light of all parts.
    """
    if bool(unclipped.all()):
        return None
    variance = (
        electrons.clamp_min(1.0)
        + read_noise**2
        + FILLED_VARIANCE * masked_variance(scene, unclipped)
    )
    return Censored(unclipped, variance[unclipped == 0].sqrt())


# --- joint fit ------------------------------------------------------------------------------------

# The joint maximum likelihood fit of all lasers and lamps of a frame, by Gauss-Newton steps.


Parts = tuple[Laser | Lamp, ...]
#: factors of the diagonal (Levenberg-Marquardt), tried in this order until a step lowers the misfit
_DAMPINGS = (0.0, 1e-3, 1e-1, 10.0)
_PIECE_NUMBERS = 1 << 16  #: size of a piece whose float64 copies fit in the cache
_LEAST_GAIN = 0.02  #: a step that gains less log likelihood is the last one


class Data(NamedTuple):
    """The data of a fit: a frame, its whitening filter and weights, and its clipped pixels."""

    electrons: Tensor  #: (channel, y, x)
    use: Filter
    weights: Weights
    clipped: Censored | None = None  #: None leaves the clipped pixels out


class Fit(NamedTuple):
    """Fitted lasers and lamps, with misfit, second derivatives and residual."""

    parts: Parts
    #: negative log likelihood: half the sum of squares of ``rest``, plus the prior of the values
    misfit: float
    normal: Tensor  #: (value, value), second derivatives of the misfit (Gauss-Newton)
    #: (value, number), minus the derivatives of ``rest`` with respect to each value
    columns: Tensor
    rest: Tensor  #: (number,), the white residual, then the numbers of `Censored.misfits`


def fitted(data: Data, parts: Sequence[Laser | Lamp], steps: int) -> Fit:
    """Return the fit after at most ``steps`` Gauss-Newton steps, each of which lowers the
    misfit.
    """
    parts_fitted, remainder, white_residual, misfit = _walked(data, tuple(parts), steps)
    columns = _columns(data, parts_fitted, remainder)
    return Fit(parts_fitted, misfit, _normal(parts_fitted, columns), columns, white_residual)


def misfit_of(data: Data, parts: Sequence[Laser | Lamp], steps: int) -> tuple[Parts, float]:
    """Return the parts after at most ``steps`` steps, and their misfit."""
    fitted_parts, _, _, misfit = _walked(data, tuple(parts), steps)
    return fitted_parts, misfit


def _walked(data: Data, now: Parts, steps: int) -> tuple[Parts, Tensor, Tensor, float]:
    """Return the parts after at most ``steps`` steps, the frame minus their light, the numbers that
    are squared, and the misfit.
    """
    remainder, white_residual, misfit = _misfit(data, now)
    for _ in range(steps):
        next_fit = _step(data, now, remainder, white_residual, misfit)
        if next_fit is None:
            break
        # next_fit is (parts, remainder, residual, misfit)
        gain = misfit - next_fit[3]
        now, remainder, white_residual, misfit = next_fit
        if gain < _LEAST_GAIN:
            break
    return now, remainder, white_residual, misfit


def _step(
    data: Data, now: Parts, left: Tensor, white_residual: Tensor, misfit: float
) -> tuple[Parts, Tensor, Tensor, float] | None:
    """Return the parts after one step, with the result of `_misfit` for them; None if no step
    lowers the misfit.
    """
    columns = _columns(data, now, left)
    normal = _normal(now, columns)
    prior_pull = torch.cat([component.values * component.precision for component in now])
    slope = columns @ white_residual - prior_pull
    sizes = [len(component.values) for component in now]
    for damping in _DAMPINGS:
        step = solved(normal + damping * normal.diagonal().diag(), slope).to(slope)
        moved = tuple(
            component.moved(own_step)
            for component, own_step in zip(now, torch.split(step, sizes), strict=True)
        )
        remainder, residual_after, misfit_after = _misfit(data, moved)
        if misfit_after < misfit:
            return moved, remainder, residual_after, misfit_after
    return None


def _columns(data: Data, parts: Parts, left: Tensor) -> Tensor:
    """Return minus the derivatives (value, number) of the numbers that `_misfit` squares."""
    white = torch.cat(
        [data.weights(component.columns(data.use.__call__)).flatten(1) for component in parts]
    )
    if data.clipped is None:
        return white
    clipped_light = torch.cat(
        [data.clipped.of(component.columns(data.clipped.lit)) for component in parts]
    )
    return torch.cat([white, data.clipped.slopes(left, clipped_light)], 1)


def _normal(parts: Parts, columns: Tensor) -> Tensor:
    """Return the Gauss-Newton matrix (value, value) of second derivatives: products of the first
    derivatives, plus the precision of the prior.
    """
    return (
        products(columns) + torch.cat([component.precision for component in parts]).double().diag()
    )


def products(columns: Tensor) -> Tensor:
    """Return the scalar products (value, value) of columns (value, number), summed in float64 piece
    by piece.

    In float32, a sum over a million numbers has a relative error of 1e-4. The difference between
    the effects of strength and of responses is smaller than that.
    """
    total = torch.zeros(len(columns), len(columns), dtype=torch.float64, device=columns.device)
    for first in range(0, columns.shape[1], _PIECE_NUMBERS):
        piece = columns[:, first : first + _PIECE_NUMBERS].double()
        total += piece @ piece.T
    return total


def solved(normal: Tensor, right: Tensor) -> Tensor:
    """Return the solution of a system of normal equations whose values may differ much in scale.

    A small ridge keeps it solvable for values that the data do not determine.
    """
    scale = normal.diagonal().clamp_min(1e-30).rsqrt()
    scaled_matrix = scale[:, None] * normal * scale
    scaled_matrix = scaled_matrix + 1e-12 * torch.eye(len(scaled_matrix)).to(scaled_matrix)
    row_scale = scale if right.ndim == 1 else scale[:, None]
    solution: Tensor = row_scale * torch.linalg.solve(
        scaled_matrix, row_scale * right.to(scaled_matrix)
    )
    return solution


def _misfit(data: Data, parts: Parts) -> tuple[Tensor, Tensor, float]:
    """Return the frame minus the light of the parts, the numbers whose squares are summed, and the
    misfit.
    """
    remainder = data.electrons
    for component in parts:
        remainder = remainder - component.electrons()
    numbers = data.weights(data.use(remainder)).flatten()
    if data.clipped is not None:
        numbers = torch.cat([numbers, data.clipped.misfits(remainder)])
    prior = sum(
        float((component.precision * component.values.square()).sum()) for component in parts
    )
    return remainder, numbers, 0.5 * (float(numbers.double().square().sum()) + prior)


# --- intervals ------------------------------------------------------------------------------------

# The covariance of the values of each laser, from the curvature of the likelihood and the scatter
# of the residual.


NORMAL = 1.6448536269514722  #: standard deviations on each side of a 90 % interval
_BLOCK_SIDE = 8  #: pixels a side of blocks whose residuals count as independent of one another
#: standard deviations of y (pixels), x (pixels) and wavelength (nm) due to dirt and defocus
_MODEL = (0.0036, 0.0036, 0.08)
#: the same due to random scattered light, times the square root of the number of unclipped pixels
_GRAINS = (0.23, 0.23, 5.9)
#: standard deviation of the wavelength due to the unknown shape of a line, relative to its width
_SHAPE = 0.03
_AMOUNT = 0.0015  #: relative standard deviation of the electrons of each channel due to the model


class Spread(NamedTuple):
    """The uncertainty of the fitted values of one laser."""

    covariance: Tensor  #: (value, value), of y, x (pixels), nm, and the electrons of each channel
    #: (channel,) e-, standard deviation of these electrons for a lens that is as its recipe says
    ideal: Tensor


def spreads(fit: Fit, unclipped: Tensor) -> list[Spread]:
    """Return the uncertainty of the values of each laser.

    ``unclipped`` (channel, y, x) is 0 for clipped pixels; the fit holds their numbers after those
    of the residual, or not at all. The covariance is the inverse of the second derivatives. It is
    enlarged where the scores of blocks of the frame scatter more than the model predicts.
    """
    value_count = len(fit.normal)
    inverse = solved(fit.normal, torch.eye(value_count).to(fit.normal))
    # score: contribution of each number to the derivative of the misfit with respect to each value
    scores_by_number = (fit.columns * fit.rest).double()
    pictures = scores_by_number[:, : unclipped.numel()].view(value_count, *unclipped.shape)
    if scores_by_number.shape[1] > unclipped.numel():
        pictures[:, unclipped == 0] = scores_by_number[
            :, unclipped.numel() :
        ]  # a clipped pixel has no residual
    scores = pictures.sum(1)
    # padding to whole blocks
    rows_missing, columns_missing = (-n % _BLOCK_SIDE for n in unclipped.shape[-2:])
    blocks = (
        pad(scores, (0, columns_missing, 0, rows_missing))
        .unfold(1, _BLOCK_SIDE, _BLOCK_SIDE)
        .unfold(2, _BLOCK_SIDE, _BLOCK_SIDE)
        .sum((-2, -1))
        .flatten(1)
    )
    prior = fit.normal - products(fit.columns)
    # sandwich estimator (Huber): the measured scatter of the scores replaces their expectation
    sandwich = inverse @ (blocks @ blocks.T + prior) @ inverse
    deviation_growth = (
        (sandwich.diagonal() / inverse.diagonal().clamp_min(1e-300)).clamp_min(1.0).sqrt()
    )
    covariance = deviation_growth[:, None] * inverse * deviation_growth
    laser_spreads, first_value = [], 0
    for component in fit.parts:
        own_values = slice(first_value, first_value + len(component.values))
        first_value += len(component.values)
        if isinstance(component, Laser):
            pixels = int(unclipped.amin(0).sum())
            covariance_of_laser, ideal_covariance = (
                _of_channels(component, matrix[own_values, own_values], pixels)
                for matrix in (covariance, inverse)
            )
            # index 3 onwards: the electrons of the channels, after y, x and nm
            laser_spreads.append(
                Spread(covariance_of_laser, ideal_covariance.diagonal()[3:].sqrt())
            )
    return laser_spreads


def _of_channels(laser: Laser, own: Tensor, pixels: int) -> Tensor:
    """Return the covariance of place, wavelength and electrons of each channel, including the
    errors of the model (dirt, defocus, shape of the line).

    ``own`` is the covariance of `Laser.values`. ``pixels`` is the number of pixels that are clipped
    in no channel.
    """
    slopes = laser.channel_slopes().to(own)
    # derivatives of y, x, nm and the electrons of each channel with respect to `Laser.values`
    jacobian = torch.zeros(3 + len(slopes), len(own)).to(own)
    jacobian[:3, :3] = torch.eye(3).to(own)
    jacobian[3:] = slopes
    neglected = torch.zeros(len(jacobian)).to(own)
    grain_variance = torch.tensor(_GRAINS).to(own).square() / max(pixels, 1)
    neglected[:3] = torch.tensor(_MODEL).to(own).square() + grain_variance
    neglected[2] += (_SHAPE * laser.fwhm.to(own) / NANOMETRE).square()
    neglected[3:] = (_AMOUNT * laser.channels()).square().to(own)
    return jacobian @ own @ jacobian.T + neglected.diag()
