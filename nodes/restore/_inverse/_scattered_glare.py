"""The glare of a laser behind a lens that is not quite its recipe's: part of its light is scattered around it.

Dirt, edges and defocus take light out of a pattern and spread it over some pixels (defocus, edges) or many (grains of
dirt, each like a hole of its size). Laser light is coherent: where scattered light of mean d meets light c of the
pattern, the intensity has the mean c + d and the variance d^2 + 2 c d, speckle. Smooth light may be scene, speckle is
not, and it has the colour of the laser: speckle tells how much is scattered.
Source: Goodman, Speckle Phenomena in Optics, 2007, ch. 3 (speckle with a known phasor).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from neusee.nodes.restore._inverse._glare import Glare, Light, average, square_mean

RADII = (4, 16, 64)  #: pixels, over which light is scattered
_TIMES = 3  #: running means one after another, which are nearly a Gaussian
_SHARES = (0.1, 0.01, 0.02)  #: of the light of a pattern, scattered over each radius, in the median of lenses
_FACTORS = (3.0, 3.0, 2.0)  #: of one standard deviation of these shares
_STRENGTH = 0.5  #: standard deviation of the logarithm of a strength that was found
_SHARP = 0.5  #: part of the variance of speckle two pixels wide that differs from the mean of the 3 x 3 pixels around
_ALIKE = 4.0  #: pixels that share a grain of speckle, so that a likelihood of pixels counts too much
_GRAINY = 2.0  #: variance of a pixel over that of its speckle, because grains of speckle are wider than pixels
_SMOOTH, _SIZE = 1.0, 0.3  #: standard deviations of scattered light and of a pattern, over their light
_COLOUR = 0.1  #: variance of speckle that differs between channels, over that of all
_BRIGHT = 0.01  #: probability that something else than the patterns fills a pixel
_SAMPLE = 1 << 15  #: pixels of a frame that tell of speckle
_FEW = 300  #: pixels known in all channels, fewer of which do not tell
_EVALUATIONS = 160  #: of the likelihood


def scattered(
    electrons: Tensor, known: Tensor, glare: Glare, noise: Callable[[Tensor], Tensor]
) -> tuple[Tensor, Light, Tensor]:
    """Return what `doubted` returns, for glare in electrons of which a part that the picture tells is scattered."""
    if glare.smooth is None:
        glare = with_smooth(glare)
    strength, *shares = _likeliest(electrons, known, glare, noise)
    light = _light(glare, strength, shares)
    total = sum((mode.square() for mode in light.modes), light.variance)
    known = torch.where(known.amax((-2, -1), keepdim=True) > 0, known, 1.0)  # a channel without known pixels has a mean
    trusted = known
    for _ in range(2):
        own = noise(average(electrons - light.sum, trusted))
        trusted = known * own / (own + total)
    return trusted, light, average(total, trusted)


def speckle(electrons: Tensor, known: Tensor, glare: Glare, noise: Callable[[Tensor], Tensor]) -> Tensor:
    """Return the variance of each pixel by the likeliest speckle of glare: (channel, y, x) e-^2."""
    if not glare.patterns:
        return torch.zeros_like(electrons)
    glare = with_smooth(glare)
    strength, *shares = _likeliest(electrons, known, glare, noise)
    return _light(glare, strength, shares).variance


def with_smooth(glare: Glare) -> Glare:
    """Return the glare with each of its patterns spread over each of the `RADII`."""
    return glare._replace(smooth=[[_spread(pattern, radius) for radius in RADII] for pattern in glare.patterns])


def _spread(pattern: Tensor, radius: int) -> Tensor:
    """Return a pattern spread over about ``radius`` pixels; beyond the picture is no light."""
    wide = pattern.double()
    for _ in range(_TIMES):
        wide = square_mean(wide, max(1, round(radius / _TIMES**0.5)))
    return wide.to(pattern)


def _light(glare: Glare, strength: float, shares: Sequence[float]) -> Light:
    """Return the light of all patterns, with its uncertainty, if ``shares`` of each are scattered."""
    total = variance = torch.zeros_like(glare.patterns[0])
    modes: list[Tensor] = []
    found = zip(glare.patterns, glare.peaks, glare.nearby, glare.smooth or (), strict=True)
    for pattern, peak, others, smooth in found:
        straight = strength * peak * pattern
        each = [share * peak * wide for share, wide in zip(shares, smooth, strict=True)]
        wide = sum(each, torch.zeros_like(pattern))
        total, variance = total + straight + wide, variance + _GRAINY * (wide.square() + 2.0 * straight * wide)
        modes += [_SMOOTH * x for x in each] + [_SIZE * straight]
        if others is not None:
            modes += [strength * peak * (other - pattern) / len(others) ** 0.5 for other in others]
    return Light(total, variance, modes)


# --- what a picture tells of the shares -------------------------------------------------------------------------------


class _Pixels(NamedTuple):
    """Pixels that are known with all around them, one a column: of all channels (channel, pixel) or of any (1, pixel).

    Sharp pictures lack the mean of the 3 x 3 pixels around.
    """

    picture: Tensor  #: sharp
    parts: Tensor  #: sharp patterns: straight, and over each radius (part, channel, pixel)
    light: Tensor  #: as ``parts``, not sharp
    noise: Tensor  #: variance of the noise in the dark
    whole: Tensor  #: the picture, not sharp
    hidden: _Hidden


class _Hidden(NamedTuple):
    """Pixels that are not known, because their light is at least full."""

    light: Tensor  #: (part, pixel)
    full: Tensor  #: (pixel,)
    channel: Tensor  #: (pixel,), the row of `_Pixels`


def _likeliest(electrons: Tensor, known: Tensor, glare: Glare, noise: Callable[[Tensor], Tensor]) -> tuple[float, ...]:
    """Return the strength of the patterns over that told, and the share scattered over each radius: the likeliest."""
    from scipy.optimize import minimize

    start = [0.0, *(math.log(share) for share in _SHARES)]
    with torch.no_grad():
        likelihood = _likelihood(electrons, known, glare, noise)
    if likelihood is None:
        return tuple(math.exp(x) for x in start)
    simplex = [start, *([x + 1.2 * (i == j) for j, x in enumerate(start)] for i in range(len(start)))]
    options = {"maxfev": _EVALUATIONS, "xatol": 0.05, "fatol": 0.1, "initial_simplex": simplex}
    found = minimize(lambda x: -likelihood(x) / _ALIKE - _prior(x), start, method="Nelder-Mead", options=options)
    return tuple(math.exp(x) for x in found.x)


def _prior(logs: Sequence[float]) -> float:
    """Return the log prior density of the logarithms of the strength and of what is scattered."""
    ratios = [
        (log - logs[0] - math.log(share)) / math.log(factor)
        for log, share, factor in zip(logs[1:], _SHARES, _FACTORS, strict=True)
    ]
    return -0.5 * ((logs[0] / _STRENGTH) ** 2 + sum(x * x for x in ratios))


def _likelihood(
    electrons: Tensor, known: Tensor, glare: Glare, noise: Callable[[Tensor], Tensor]
) -> Callable[[Sequence[float]], float] | None:
    """Return the log likelihood of logarithms of the strength and of what is scattered; None where nothing tells."""
    pixels = _pixels(electrons, known, glare, noise)
    if pixels is None:
        return None
    scenes: list[float] = []

    def likelihood(logs: Sequence[float]) -> float:
        amounts = torch.tensor([math.exp(x) for x in logs]).to(pixels.picture)[:, None, None]
        straight, wide = amounts[0] * pixels.light[0], (amounts[1:] * pixels.light[1:]).sum(0)
        speckle = wide.square() + 2.0 * straight * wide
        mean = _average(pixels.whole - straight - wide, pixels.noise / (pixels.noise + speckle))
        given = (
            pixels.picture - (amounts * pixels.parts).sum(0),
            8 / 9 * torch.maximum(pixels.noise, mean),
            _SHARP * speckle,
            mean / mean.norm(),
        )
        top = float(given[0].square().mean())
        tried = [scenes[-1] * f for f in (0.5, 0.7, 1.0, 1.4, 2.0)] if scenes else [top * 0.5**n for n in range(20)]
        best = max((_log_density(*given, scene), scene) for scene in tried)
        scenes[:] = best[1:]
        return best[0] + _log_full(pixels.hidden, amounts[:, :, 0], mean[:, 0])

    return likelihood


def _pixels(electrons: Tensor, known: Tensor, glare: Glare, noise: Callable[[Tensor], Tensor]) -> _Pixels | None:
    """Return the pixels of a frame that tell of speckle; None for too few."""
    kinds = [glare.patterns, *([each[number] for each in glare.smooth or ()] for number in range(len(RADII)))]
    peaks, nothing = glare.peaks, torch.zeros_like(electrons)
    lights = [sum((peak * x for x, peak in zip(kind, peaks, strict=True)), nothing).detach() for kind in kinds]
    use = _mean_around(known) > 1 - 1e-6  # all of the 3 x 3 pixels are known
    dark = noise(torch.zeros_like(average(electrons, torch.ones_like(electrons))))
    together = use.all(0)
    joint = int(together.sum()) >= _FEW
    if not joint and int(use.sum()) < _FEW:
        return None
    some = slice(None, None, max(1, int((together if joint else use).sum()) // _SAMPLE))

    def picked(picture: Tensor) -> Tensor:
        return picture[:, together][:, some] if joint else picture[use][None, some]

    parts, light = (torch.stack([picked(x) for x in each]) for each in ([_sharp(x) for x in lights], lights))
    hidden = (known == 0).nonzero(as_tuple=True)
    hidden = tuple(at[:: max(1, len(at) // _SAMPLE)] for at in hidden)
    rows = hidden[0] if joint else torch.zeros_like(hidden[0])
    full = _Hidden(torch.stack([x[hidden] for x in lights]), electrons[hidden], rows)
    return _Pixels(picked(_sharp(electrons)), parts, light, picked(dark), picked(electrons), full)


def _log_density(rest: Tensor, noise: Tensor, speckle: Tensor, grey: Tensor, scene: float) -> float:
    """Return the log density of sharp pictures (channel, pixel).

    Speckle is that of one colour, the root of its variance. A scene has the variance ``scene`` in each channel, and
    details of any strength that have the colour ``grey`` in all channels, which therefore count for nothing.
    """
    if len(rest) == 1:
        variance = noise + scene + speckle
        return -0.5 * float((variance.log() + rest.square() / variance).sum())
    inverse, colour = 1.0 / (noise + _COLOUR * speckle + scene), speckle.sqrt()
    grey = grey.expand_as(rest)

    def products(a: Tensor, b: Tensor) -> Tensor:
        return (a * b * inverse).sum(0)

    own, lost = products(colour, colour), products(colour, grey)
    across, share = products(colour, rest), 1.0 / (1.0 + products(colour, colour))
    greys = products(grey, grey) - share * lost.square()
    dull = products(grey, rest) - share * lost * across
    squares = products(rest, rest) - share * across.square() - dull.square() / greys
    return -0.5 * float((own.log1p() - inverse.log().sum(0) + greys.log() + squares).sum())


def _log_full(hidden: _Hidden, amounts: Tensor, mean: Tensor) -> float:
    """Return the log probability that pixels which are not known are full."""
    straight, wide = amounts[0] * hidden.light[0], (amounts[1:] * hidden.light[1:]).sum(0)
    scene = mean[hidden.channel]
    over = straight + wide + scene - hidden.full
    short = torch.special.ndtr(-over / (wide.square() + 2.0 * straight * wide + scene.square()).sqrt())
    return float(torch.log1p(-(1.0 - _BRIGHT) * short).sum())


def _average(values: Tensor, weights: Tensor) -> Tensor:
    """Return the weighted mean of each channel of pixels, (channel, 1), at least 1 e-."""
    return ((values * weights).sum(-1, keepdim=True) / weights.sum(-1, keepdim=True)).clamp_min(1.0)


def _sharp(picture: Tensor) -> Tensor:
    return picture - _mean_around(picture)


def _mean_around(picture: Tensor) -> Tensor:
    return avg_pool2d(picture[None], 3, stride=1, padding=1, count_include_pad=False)[0]
