"""The glare of lasers in a picture: strength, scattered light, uncertainty and nearby patterns."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Annotated, Any, NamedTuple

import torch
from pydantic import Field
from torch import Generator, Tensor
from torch.nn.functional import avg_pool2d

from neusee.nodes import Check, node
from neusee.nodes.optics import psf as focus
from neusee.nodes.optics._psf_definition import SensorSampling
from neusee.nodes.optics._pupil import DEFOCUS_WAVELENGTH
from neusee.nodes.precision import single
from neusee.nodes.units import FocalLength, Length, PixelPitch, Waves
from neusee.nodes.values import Bands, Pupil

# --- glare ----------------------------------------------------------------------------------------

# The glare of lasers in a picture: its strength, the variance of its pattern, and alternative
# patterns that are as likely ("nearby" patterns).


#: radii in pixels of the squares around a pixel over which the light of a pattern is averaged
_REACH = (1, 4, 16, 64)
_ROWS = 64  #: number of rows at a time, so that their float64 copies fit in the cache


class Glare(NamedTuple):
    """Patterns of glare with unknown strengths, and for some of them alternative patterns that are
    as likely.
    """

    patterns: list[Tensor]  #: (channel, y, x), each with maximum 1
    nearby: list[Tensor | None]  #: (pattern, channel, y, x), alternatives, in the same unit
    #: (channel, y, x), light around each pixel of each pattern, from `with_light_around`
    around: list[Tensor] | None = None
    peaks: Sequence[float] = ()  #: original maxima of the patterns, by which they are divided
    #: (channel, y, x), each pattern smoothed over each of `RADII`, from `with_smooth`
    smooth: list[list[Tensor]] | None = None


class Light(NamedTuple):
    """An estimate of the glare in a picture, with its uncertainty."""

    sum: Tensor  #: (channel, y, x), e-, estimate of the glare
    variance: Tensor  #: (channel, y, x), e-^2, variance that is independent in each pixel
    #: (channel, y, x), e-; the sum of their outer products is the rest of the covariance
    modes: list[Tensor]


def visible(
    patterns: Sequence[Tensor], nearby: Sequence[Tensor | None], unclipped: Tensor
) -> Glare:
    """Return the glare patterns that are not 0 at every unclipped pixel, each scaled to a maximum
    of 1.
    """
    peaks = [float((pattern.detach().abs() * unclipped).max()) for pattern in patterns]
    visible_patterns = [
        (p / peak, n if n is None else n / peak)
        for p, n, peak in zip(patterns, nearby, peaks, strict=True)
        if peak
    ]
    return Glare(
        [p for p, _ in visible_patterns],
        [n for _, n in visible_patterns],
        peaks=[peak for peak in peaks if peak],
    )


def with_light_around(glare: Glare) -> Glare:
    """Return the glare with the field ``around``: the light around each pixel of its patterns."""
    return glare._replace(around=[light_around(pattern) for pattern in glare.patterns])


def light_around(pattern: Tensor) -> Tensor:
    """Return the light around each pixel of a pattern (channel, y, x), in the unit of the pattern.

    It is the sum of the means over squares of 3, 9, 33 and 129 pixels a side, each divided by the
    radius of its square. A point of light thus spreads as 1 / distance^3, like the rings of a lens
    and the light that edges, dirt and defocus scatter. There is no light beyond the picture.
    """
    exact = pattern.double()
    total = sum((square_mean(exact, radius) / radius for radius in _REACH), torch.zeros_like(exact))
    return total.to(pattern)


def square_mean(picture: Tensor, radius: int) -> Tensor:
    """Return the mean over a square of 2 x ``radius`` + 1 pixels a side around each pixel, by
    cumulative sums.
    """
    for dim in (-2, -1):
        size = picture.shape[dim]
        sums = torch.cat([torch.zeros_like(picture.narrow(dim, 0, 1)), picture.cumsum(dim)], dim)
        index = torch.arange(size, device=picture.device)
        # pixels beyond the picture count as dark, so that the divisor is that of the whole square
        upper, lower = (index + radius + 1).clamp(max=size), (index - radius).clamp(min=0)
        picture = (sums.index_select(dim, upper) - sums.index_select(dim, lower)) / (2 * radius + 1)
    return picture


def doubted(
    electrons: Tensor,
    unclipped: Tensor,
    glare: Glare,
    doubt: float,
    noise: Callable[[Tensor], Tensor],
) -> tuple[Tensor, Light, Tensor]:
    """Return the weights of pixels, an estimate of the glare, and the variance of the glare,
    averaged with these weights.

    A ``doubt`` above 0 needs ``glare.around``. For uncertain patterns the estimate is repeated with
    the weights noise / (noise + variance of the glare). ``noise`` returns the noise variance of
    each pixel, from the mean of the picture without glare.
    """
    light = _estimated(electrons, unclipped, glare, doubt)
    if not (doubt or light.modes) or not glare.patterns:
        return unclipped, light, torch.zeros_like(unclipped[:, :1, :1])
    trusted = unclipped
    for _ in range(2):
        noise_variance = noise(average(electrons - light.sum, trusted))
        trusted = unclipped * noise_variance / (noise_variance + _total(light))
        light = _estimated(electrons, trusted, glare, doubt)
    return trusted, light, average(_total(light), trusted)


def _estimated(electrons: Tensor, weights: Tensor, glare: Glare, doubt: float) -> Light:
    """Return the glare at its fitted strengths, with its uncertainty: a variance of each pixel from
    ``doubt``, and modes from the nearby patterns.
    """
    zeros = torch.zeros_like(electrons)
    strength_of_patterns = strengths(electrons, weights, glare.patterns)
    patterns_in_picture = [
        strength * pattern
        for strength, pattern in zip(strength_of_patterns, glare.patterns, strict=True)
    ]
    strengths_and_light_around = (
        zip(strength_of_patterns, glare.around or (), strict=True) if doubt else ()
    )
    pixel_variance = sum(
        ((doubt * strength * around).square() for strength, around in strengths_and_light_around),
        zeros,
    )
    modes = []
    for strength, pattern, others in zip(
        strength_of_patterns, glare.patterns, glare.nearby, strict=True
    ):
        if others is not None:
            # the sum of the outer products of the modes is the covariance of the nearby patterns
            modes += [strength * (other - pattern) / len(others) ** 0.5 for other in others]
    return Light(sum(patterns_in_picture, zeros), pixel_variance, modes)


def _total(light: Light) -> Tensor:
    """Return the total variance of the glare in each pixel."""
    return sum((mode.square() for mode in light.modes), light.variance)


def average(picture: Tensor, weights: Tensor) -> Tensor:
    """Return the weighted mean of each channel of a picture: (channel, 1, 1)."""
    total: Tensor = (picture * weights).sum((-2, -1), keepdim=True)
    return total / weights.sum((-2, -1), keepdim=True)


def strengths(electrons: Tensor, weights: Tensor, glare: Sequence[Tensor]) -> Tensor:
    """Return the strength of each glare pattern, from a weighted least-squares fit of all patterns
    and a constant in each channel.
    """
    if not glare:
        return electrons.new_zeros(0)
    # subtraction of the weighted means is equivalent to a fit of the constants
    pattern_means = [average(pattern, weights) for pattern in glare]
    normal_equations = torch.zeros(
        len(glare), len(glare) + 1, dtype=torch.float64, device=electrons.device
    )
    for channel in range(len(electrons)):
        for first_row in range(0, electrons.shape[-2], _ROWS):
            block = (channel, slice(first_row, first_row + _ROWS))
            centred_patterns = [
                (p[block] - m[channel]).flatten() for p, m in zip(glare, pattern_means, strict=True)
            ]
            weight = weights[block].flatten()
            patterns_and_picture = torch.stack(
                [*centred_patterns, electrons[block].flatten()]
            ).double()
            # the last column is the right-hand side: products of patterns and picture
            normal_equations += (patterns_and_picture[:-1] * weight) @ patterns_and_picture.T
    fitted: Tensor = (
        torch.linalg.pinv(normal_equations[:, :-1], hermitian=True) @ normal_equations[:, -1]
    )
    return fitted.to(electrons)


# --- glare doubt ----------------------------------------------------------------------------------

# The uncertainty of a glare pattern ("doubt"): its standard deviation relative to the light around
# each pixel, and the most likely value of this ratio.


DOUBTS = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0)  #: doubts that are tried
#: number of variances of the scene that are tried for each doubt, in steps of sqrt(2)
_STEPS = 30
#: approximate number of pixels of a channel from which the variance of the scene is chosen; the
#: doubt is chosen from all pixels
_SAMPLE = 1 << 16


def likeliest_doubt(
    electrons: Tensor,
    unclipped: Tensor,
    glare: Glare,
    noise: Callable[[Tensor], Tensor],
    smallest: float = 0.0,
) -> float:
    """Return the doubt with the highest likelihood for the ``unclipped`` pixels of a picture, at
    least ``smallest``.

    The data are the picture without glare, minus its mean over 3 x 3 pixels. They count as
    independent Gaussian numbers. Their variance is the sum of the variances of noise, of uncertain
    glare, and of a scene, which is the same in all pixels of a channel. The subtraction of the mean
    removes most of the scene, but little of the errors of a pattern, which are sharper.
    """
    if not glare.patterns:
        return 0.0
    interior = _mean_around(unclipped) > 1 - 1e-6  # all of the 3 x 3 pixels are unclipped

    def likelihood(doubt: float) -> float:
        trusted, light, _ = doubted(electrons, unclipped, glare, doubt, noise)
        remainder = electrons - light.sum
        # 8 / 9: variance of white noise minus its mean over 3 x 3 pixels
        variance = 8 / 9 * (noise(average(remainder, trusted)) + light.variance)
        for mode in light.modes:
            variance = variance + _sharp(mode).square()
        channels = zip(_sharp(remainder), variance, interior, strict=True)
        return sum(
            _profile(errors[use].square(), variances[use])
            for errors, variances, use in channels
            if use.any()
        )

    with torch.no_grad():
        return max((smallest, *(doubt for doubt in DOUBTS if doubt > smallest)), key=likelihood)


def _profile(squares: Tensor, variance: Tensor) -> float:
    """Return the log likelihood of squared Gaussian errors, maximized over a constant that is added
    to their variance.
    """
    sample = slice(None, None, max(1, len(squares) // _SAMPLE))
    mean_square = float(squares.mean())
    variances = [mean_square * 2 ** (-n / 2) for n in range(_STEPS)]
    likeliest_constant = max(
        variances, key=lambda scene: _gaussian(squares[sample], variance[sample] + scene)
    )
    return _gaussian(squares, variance + likeliest_constant)


def _gaussian(squares: Tensor, variance: Tensor) -> float:
    return -0.5 * float((variance.log() + squares / variance).double().sum())


def _sharp(picture: Tensor) -> Tensor:
    return picture - _mean_around(picture)


def _mean_around(picture: Tensor) -> Tensor:
    return avg_pool2d(picture[None], 3, stride=1, padding=1, count_include_pad=False)[0]


# --- scattered glare ------------------------------------------------------------------------------

# The glare of a laser behind a lens that deviates from its recipe: part of its light is scattered
# around the pattern.
#
# Dirt, edges and defocus take light out of a pattern and spread it over few pixels (defocus, edges)
# or many (a grain of dirt diffracts like a hole of its size). Laser light is coherent: where
# scattered light of mean d is added to light c of the pattern, the intensity is speckle with the
# mean c + d and the variance d^2 + 2 c d. Smooth light may belong to the scene. Speckle does not,
# and it has the colour of the laser, so that the amount of scattered light is estimated from it.
# Source: Goodman, Speckle Phenomena in Optics, 2007, ch. 3 (speckle with a known phasor).


RADII = (4, 16, 64)  #: radii in pixels over which light is scattered
_RUNNING_MEANS = 3  #: number of successive running means, which together are nearly a Gaussian
#: share of the light of a pattern that is scattered over each radius, for the median lens
_SHARES = (0.1, 0.01, 0.02)
_FACTORS = (3.0, 3.0, 2.0)  #: factor of one standard deviation of each share (lognormal)
_STRENGTH_DEVIATION = 0.5  #: prior standard deviation of the logarithm of the strength
#: share of the variance of speckle (grains of two pixels) that remains after subtraction of the
#: mean over 3 x 3 pixels
_SHARP = 0.5
#: number of pixels in a grain of speckle: the log likelihood of the pixels is divided by it
_ALIKE = 4.0
#: factor of the variance of a pixel by speckle, because grains are wider than pixels
_GRAINY = 2.0
#: relative standard deviations of the scattered light and of the strength of a pattern
_SMOOTH, _SIZE = 1.0, 0.3
_SPECKLE_COLOUR = 0.1  #: variance of speckle independent in each channel, over the common variance
_FILLED_BY_OTHERS = 0.01  #: probability that another source than the patterns clips a pixel
_GLARE_SAMPLE = 1 << 15  #: approximate number of pixels of a frame in the likelihood
_FEW_PIXELS = 300  #: smallest number of known pixels for an estimate
_EVALUATIONS = 160  #: largest number of evaluations of the likelihood


def scattered(
    electrons: Tensor, unclipped: Tensor, glare: Glare, noise: Callable[[Tensor], Tensor]
) -> tuple[Tensor, Light, Tensor]:
    """Return the result of `doubted` (weights, light, mean variance) for glare of which a part is
    scattered; this part is estimated from the picture.
    """
    if glare.smooth is None:
        glare = with_smooth(glare)
    strength, *shares = _likeliest(electrons, unclipped, glare, noise)
    light = _light(glare, strength, shares)
    light_variance = sum((mode.square() for mode in light.modes), light.variance)
    # all pixels of a fully clipped channel count, so that it has a mean
    unclipped = torch.where(unclipped.amax((-2, -1), keepdim=True) > 0, unclipped, 1.0)
    trusted = unclipped
    for _ in range(2):
        noise_variance = noise(average(electrons - light.sum, trusted))
        trusted = unclipped * noise_variance / (noise_variance + light_variance)
    return trusted, light, average(light_variance, trusted)


def speckle(
    electrons: Tensor, unclipped: Tensor, glare: Glare, noise: Callable[[Tensor], Tensor]
) -> Tensor:
    """Return the variance (channel, y, x) of each pixel due to the most likely speckle of the
    glare, in e-^2.
    """
    if not glare.patterns:
        return torch.zeros_like(electrons)
    glare = with_smooth(glare)
    strength, *shares = _likeliest(electrons, unclipped, glare, noise)
    return _light(glare, strength, shares).variance


def with_smooth(glare: Glare) -> Glare:
    """Return the glare with the field ``smooth``: each pattern, smoothed over each of the
    `RADII`.
    """
    return glare._replace(
        smooth=[[_spread(pattern, radius) for radius in RADII] for pattern in glare.patterns]
    )


def _spread(pattern: Tensor, radius: int) -> Tensor:
    """Return a pattern, smoothed over about ``radius`` pixels; there is no light beyond the
    picture.
    """
    spread = pattern.double()
    for _ in range(_RUNNING_MEANS):
        spread = square_mean(spread, max(1, round(radius / _RUNNING_MEANS**0.5)))
    return spread.to(pattern)


def _light(glare: Glare, strength: float, shares: Sequence[float]) -> Light:
    """Return the light of all patterns, with its uncertainty.

    The patterns have ``strength`` times their stated light. ``shares`` are the light that is
    scattered over each of the `RADII`, relative to the stated light.
    """
    light_sum = variance = torch.zeros_like(glare.patterns[0])
    modes: list[Tensor] = []
    sources = zip(glare.patterns, glare.peaks, glare.nearby, glare.smooth or (), strict=True)
    for pattern, peak, others, spread_patterns in sources:
        straight = strength * peak * pattern
        scattered_light = [
            share * peak * spread_light
            for share, spread_light in zip(shares, spread_patterns, strict=True)
        ]
        spread_light = sum(scattered_light, torch.zeros_like(pattern))
        light_sum, variance = (
            light_sum + straight + spread_light,
            # variance of speckle, d^2 + 2 c d, for scattered light d and straight light c
            variance + _GRAINY * (spread_light.square() + 2.0 * straight * spread_light),
        )
        modes += [_SMOOTH * x for x in scattered_light] + [_SIZE * straight]
        if others is not None:
            modes += [strength * peak * (other - pattern) / len(others) ** 0.5 for other in others]
    return Light(light_sum, variance, modes)


# --- estimate of the shares -----------------------------------------------------------------------


class _Pixels(NamedTuple):
    """A sample of the pixels whose 3 x 3 neighbours are all known.

    The shape is (channel, pixel) if the pixels are known in all channels, or (1, pixel) with each
    channel of a pixel counted separately. "Sharp" pictures are without their mean over 3 x 3
    pixels.
    """

    picture: Tensor  #: sharp picture
    parts: Tensor  #: (part, channel, pixel), sharp patterns: straight, then smoothed by each radius
    light: Tensor  #: the same patterns, not sharp
    noise: Tensor  #: variance of the noise in the dark
    whole: Tensor  #: the picture, not sharp
    hidden: _Hidden  #: the clipped pixels


class _Hidden(NamedTuple):
    """A sample of the clipped pixels, whose light is only known to be at least the clip level."""

    light: Tensor  #: (part, pixel), patterns: straight, then smoothed by each radius
    full: Tensor  #: (pixel,), clip level
    channel: Tensor  #: (pixel,), row of the pixel's channel in `_Pixels`


def _likeliest(
    electrons: Tensor, unclipped: Tensor, glare: Glare, noise: Callable[[Tensor], Tensor]
) -> tuple[float, ...]:
    """Return the most likely strength of the patterns, and the light scattered over each of the
    `RADII`, both relative to the stated light.
    """
    from scipy.optimize import minimize

    start = [0.0, *(math.log(share) for share in _SHARES)]
    with torch.no_grad():
        likelihood = _likelihood(electrons, unclipped, glare, noise)
    if likelihood is None:
        return tuple(math.exp(x) for x in start)
    # Nelder-Mead searches the logarithms; a step of 1.2 is a factor of 3.3
    simplex = [
        start,
        *([x + 1.2 * (i == j) for j, x in enumerate(start)] for i in range(len(start))),
    ]
    options = {"maxfev": _EVALUATIONS, "xatol": 0.05, "fatol": 0.1, "initial_simplex": simplex}
    minimum = minimize(
        lambda x: -likelihood(x) / _ALIKE - _prior(x), start, method="Nelder-Mead", options=options
    )
    return tuple(math.exp(x) for x in minimum.x)


def _prior(logs: Sequence[float]) -> float:
    """Return the log prior density of the logarithms of the strength and of the scattered light."""
    ratios = [
        (log - logs[0] - math.log(share)) / math.log(factor)
        for log, share, factor in zip(logs[1:], _SHARES, _FACTORS, strict=True)
    ]
    return -0.5 * ((logs[0] / _STRENGTH_DEVIATION) ** 2 + sum(x * x for x in ratios))


def _likelihood(
    electrons: Tensor, unclipped: Tensor, glare: Glare, noise: Callable[[Tensor], Tensor]
) -> Callable[[Sequence[float]], float] | None:
    """Return the log likelihood, a function of the logarithms of the strength and of the scattered
    light; None for too few known pixels.
    """
    pixels = _pixels(electrons, unclipped, glare, noise)
    if pixels is None:
        return None
    last_scene_variance: list[float] = []

    def likelihood(logs: Sequence[float]) -> float:
        strength_and_shares = torch.tensor([math.exp(x) for x in logs]).to(pixels.picture)[
            :, None, None
        ]
        straight, scattered = (
            strength_and_shares[0] * pixels.light[0],
            (strength_and_shares[1:] * pixels.light[1:]).sum(0),
        )
        speckle = scattered.square() + 2.0 * straight * scattered
        mean = _average(
            pixels.whole - straight - scattered, pixels.noise / (pixels.noise + speckle)
        )
        arguments = (
            pixels.picture - (strength_and_shares * pixels.parts).sum(0),
            # 8 / 9: variance of white noise minus its mean over 3 x 3 pixels
            8 / 9 * torch.maximum(pixels.noise, mean),
            _SHARP * speckle,
            mean / mean.norm(),
        )
        mean_square = float(arguments[0].square().mean())
        # close to the variance of the last call, because a step of the search is small
        scene_variances = (
            [last_scene_variance[-1] * f for f in (0.5, 0.7, 1.0, 1.4, 2.0)]
            if last_scene_variance
            else [mean_square * 0.5**n for n in range(20)]
        )
        density_and_variance = max(
            (_log_density(*arguments, scene), scene) for scene in scene_variances
        )
        last_scene_variance[:] = density_and_variance[1:]
        return density_and_variance[0] + _log_full(
            pixels.hidden, strength_and_shares[:, :, 0], mean[:, 0]
        )

    return likelihood


def _light_by_kind(glare: Glare, electrons: Tensor) -> list[Tensor]:
    """Return the stated light of all patterns: straight, then smoothed over each radius."""
    smooth, zeros = glare.smooth or (), torch.zeros_like(electrons)
    patterns_by_kind = [glare.patterns]
    for number in range(len(RADII)):
        patterns_by_kind.append([widened[number] for widened in smooth])
    lights = []
    for patterns in patterns_by_kind:
        told_light = (peak * x for x, peak in zip(patterns, glare.peaks, strict=True))
        lights.append(sum(told_light, zeros).detach())
    return lights


def _hidden_pixels(
    electrons: Tensor, unclipped: Tensor, lights: Sequence[Tensor], joint: bool
) -> _Hidden:
    """Return a sample of the clipped pixels; with ``joint``, the rows of `_Pixels` are channels."""
    sample_indices = tuple(
        indices[:: max(1, len(indices) // _GLARE_SAMPLE)]
        for indices in (unclipped == 0).nonzero(as_tuple=True)
    )
    channel_rows = sample_indices[0] if joint else torch.zeros_like(sample_indices[0])
    return _Hidden(
        torch.stack([x[sample_indices] for x in lights]), electrons[sample_indices], channel_rows
    )


def _pixels(
    electrons: Tensor, unclipped: Tensor, glare: Glare, noise: Callable[[Tensor], Tensor]
) -> _Pixels | None:
    """Return the pixels of a frame from which speckle is estimated; None for too few known
    pixels.
    """
    lights = _light_by_kind(glare, electrons)
    use = _mean_around(unclipped) > 1 - 1e-6  # all of the 3 x 3 pixels are unclipped
    dark_noise = noise(torch.zeros_like(average(electrons, torch.ones_like(electrons))))
    known_in_all_channels = use.all(0)
    # pixels known in all channels are better, because speckle has the colour of the laser
    joint = int(known_in_all_channels.sum()) >= _FEW_PIXELS
    if not joint and int(use.sum()) < _FEW_PIXELS:
        return None
    sample = slice(
        None, None, max(1, int((known_in_all_channels if joint else use).sum()) // _GLARE_SAMPLE)
    )

    def picked(picture: Tensor) -> Tensor:
        return picture[:, known_in_all_channels][:, sample] if joint else picture[use][None, sample]

    parts, light = (
        torch.stack([picked(x) for x in pictures])
        for pictures in ([_sharp(x) for x in lights], lights)
    )
    hidden = _hidden_pixels(electrons, unclipped, lights, joint)
    return _Pixels(
        picked(_sharp(electrons)), parts, light, picked(dark_noise), picked(electrons), hidden
    )


def _log_density(
    error: Tensor, noise: Tensor, speckle: Tensor, grey: Tensor, scene: float
) -> float:
    """Return the log density of sharp pictures (channel, pixel).

    Speckle has one colour, the square root of its variance in each channel. A scene has the
    variance ``scene`` in each channel, and details of unknown strength with the colour ``grey``,
    which are projected out.
    """
    if len(error) == 1:
        variance = noise + scene + speckle
        return -0.5 * float((variance.log() + error.square() / variance).sum())
    # covariance of the channels of a pixel: D + s s^T, with s = sqrt(variance of speckle). Its
    # inverse (Sherman-Morrison): D^-1 - D^-1 s s^T D^-1 / (1 + s^T D^-1 s)
    inverse_variance, colour = 1.0 / (noise + _SPECKLE_COLOUR * speckle + scene), speckle.sqrt()
    grey = grey.expand_as(error)

    def products(a: Tensor, b: Tensor) -> Tensor:
        return (a * b * inverse_variance).sum(0)

    colour_square, colour_grey = products(colour, colour), products(colour, grey)
    colour_error, speckle_gain = products(colour, error), 1.0 / (1.0 + products(colour, colour))
    # products with this inverse; then the grey part of the error is projected out
    grey_square = products(grey, grey) - speckle_gain * colour_grey.square()
    grey_error = products(grey, error) - speckle_gain * colour_grey * colour_error
    error_square = (
        products(error, error)
        - speckle_gain * colour_error.square()
        - grey_error.square() / grey_square
    )
    return -0.5 * float(
        (
            colour_square.log1p() - inverse_variance.log().sum(0) + grey_square.log() + error_square
        ).sum()
    )


def _log_full(hidden: _Hidden, amounts: Tensor, mean: Tensor) -> float:
    """Return the log probability that the clipped pixels reach the clip level.

    ``amounts`` (part, 1) are the factors of straight and scattered light, ``mean`` is the mean of
    the scene in each channel.
    """
    straight, scattered = amounts[0] * hidden.light[0], (amounts[1:] * hidden.light[1:]).sum(0)
    scene = mean[hidden.channel]
    excess = straight + scattered + scene - hidden.full
    probability_below_full = torch.special.ndtr(
        -excess / (scattered.square() + 2.0 * straight * scattered + scene.square()).sqrt()
    )
    return float(torch.log1p(-(1.0 - _FILLED_BY_OTHERS) * probability_below_full).sum())


def _average(values: Tensor, weights: Tensor) -> Tensor:
    """Return the weighted mean (channel, 1) of the pixels of each channel, at least 1 e-."""
    return ((values * weights).sum(-1, keepdim=True) / weights.sum(-1, keepdim=True)).clamp_min(1.0)


# --- nearby glare ---------------------------------------------------------------------------------

# Random patterns of the glare of a laser whose direction, wavelength and focus are known only
# approximately.


Shift = Annotated[Length, Field(ge=0, le=100e-9)]  #: standard deviation of the wavelength
Patterns = Annotated[int, Field(ge=1, le=256)]
Pixels = Annotated[float, Field(ge=0, le=100)]


@node()
def nearby_glare(
    glare: Tensor,
    pupil: Pupil,
    direction: Tensor,
    line: Bands,
    responses: Tensor,
    *,
    focal_length: FocalLength,
    pixel_pitch: PixelPitch,
    sensor: SensorSampling = "point",
    patterns: Patterns = 12,
    pixels: Pixels = 0.5,
    wavelength: Shift = 2e-9,
    defocus: Waves = 0.1,
    rng: Generator,
) -> Tensor:
    """Draw patterns that the glare of a laser may have, if its direction, wavelength and focus are
    known roughly.

    Each pattern has its own direction, wavelength and defocus, drawn from normal distributions
    around those of the laser; ``pixels`` (along each axis, of the spot), ``wavelength`` and
    ``defocus`` are standard deviations. A Latin hypercube spreads the draws evenly over each law.
    `restore.wiener` takes the patterns as ``nearby``.

    Shapes: glare (channel, y, x), pupil (band,), direction (2,), line (band,), responses (channel,
            band) -> (pattern, channel, y, x).
    Units:  result as glare; pixels on the sensor; wavelength m; defocus waves at 550 nm, peak to
            valley.
    Error:  that of `optics.psf`, 3e-6 of the brightest pixel, and 1 / samples of the defocus. The
            covariance of the patterns has the relative error sqrt(2 / patterns), and at most
            ``patterns`` dimensions. Dispersion of the mask is neglected, 1e-4 of its phase for 2 nm
            of fused silica, and so is the change of the response.
    Raises: ValueError where pupil and line differ in the number of bands, or responses and glare in
            the channels.
    Source: sampled prior of a nuisance parameter as in Kaipio and Somersalo, Statistical and
            Computational Inverse Problems, 2005, ch. 5 (approximation error); McKay et al.,
            Technometrics 21, 239 (1979).
    """
    _agree(glare, pupil, line, responses)
    share = (responses.double() * (line.weights * line.centres)).to(single(glare))
    camera: dict[str, Any] = {
        "focal_length": focal_length,
        "pixel_pitch": pixel_pitch,
        "sensor": sensor,
    }
    camera["shape"] = (glare.shape[-2], glare.shape[-1])

    def pattern_of(around: Pupil, towards: Tensor) -> Tensor:
        channels: Tensor = torch.tensordot(
            share, focus(around, towards, **camera).intensity.to(share), 1
        )
        return channels

    drawn_light = pattern_of(pupil, direction).sum(dtype=torch.float64)
    # scaled so that the pattern without errors has as much light as the glare
    unit = (glare.sum(dtype=torch.float64) / drawn_light.where(drawn_light > 0, 1.0)).to(share)
    defocus_shape, patterns_drawn = _bowl(pupil), []
    for y, x, wavelength_step, defocus_step in _normal(patterns, rng).tolist():
        moved_direction = direction + pixels * pixel_pitch / focal_length * direction.new_tensor(
            [y, x]
        )
        path = pupil.path + defocus_step * defocus * DEFOCUS_WAVELENGTH * defocus_shape
        patterns_drawn.append(
            unit
            * pattern_of(
                pupil._replace(
                    path=path, wavelengths=pupil.wavelengths + wavelength_step * wavelength
                ),
                moved_direction,
            )
        )
    return torch.stack(patterns_drawn)


@nearby_glare.check
def _(result: Tensor, glare: Tensor, *inputs: Any, **params: Any) -> list[Check]:
    size = float(glare.square().mean().sqrt())
    relative_difference = float((result - glare).square().mean().sqrt()) / size if size else 0.0
    return [
        Check(
            f"{len(result)} patterns, rms difference {relative_difference:.2g} of the glare",
            math.isfinite(relative_difference),
        )
    ]


def _agree(glare: Tensor, pupil: Pupil, line: Bands, responses: Tensor) -> None:
    """Raise ValueError unless glare (channel, y, x), pupil, line and responses have the same bands
    and channels.
    """
    if len(pupil.wavelengths) != len(line.centres) or responses.shape != (
        len(glare),
        len(line.centres),
    ):
        raise ValueError(
            f"glare of {len(glare)} channels, responses {tuple(responses.shape)}, pupil of"
            f" {len(pupil.wavelengths)} bands and line of {len(line.centres)} bands do not fit:"
            " compute all from one `line` step"
        )


def _bowl(pupil: Pupil) -> Tensor:
    """Return the squared distance from the axis: the shape of defocus. It is 1 at the rim of a disc
    with the area of the clear aperture.
    """
    side = pupil.aperture.shape[-1]
    offset_from_axis = (
        torch.arange(side, dtype=torch.float64, device=pupil.path.device) - (side - 1) / 2
    )
    rim_squared = pupil.aperture.sum(dtype=torch.float64).clamp_min(1.0) / math.pi
    return (
        (offset_from_axis[:, None].square() + offset_from_axis.square())
        * (pupil.aperture > 0)
        / rim_squared
    ).to(pupil.path)


def _normal(count: int, rng: Generator) -> Tensor:
    """Return a Latin hypercube sample (count, 4) of the standard normal distribution: on each axis,
    one number lies in each of ``count`` equally probable intervals.
    """
    shape = (4, count)
    # ranks of random numbers are a random order of the intervals, for each axis
    order = torch.rand(shape, generator=rng, device=rng.device, dtype=torch.float64).argsort(-1)
    even_probabilities = (
        order + torch.rand(shape, generator=rng, device=rng.device, dtype=torch.float64)
    ) / count
    numbers: Tensor = torch.special.ndtri(even_probabilities.clamp(1e-9, 1 - 1e-9)).T
    return numbers
