"""What is not known of a scene behind glare besides its details: its mean, its contrast, and blotches of the glare.

The mean of a picture without its estimated glare is wrong by the light that the glare is wrong by, of the same sign in
all pixels. Where glare covers most pixels, this is more than the light of the scene. Then a prior decides: a camera is
mostly exposed such that the mean is a seventh of the fullest pixel, to a factor of three, and the standard deviation
of a scene is 0.8 of its mean, to a factor of 1.6. Channels see nearly a grey scene.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Generator, Tensor

from neusee.nodes.restore._inverse._glare import Light, average

_EXPOSED, _EXPOSURE = 0.15, math.log(3.0)  #: mean of a scene over the fullest pixel, and deviation of its logarithm
_CONTRAST, _CONTRASTS = 0.8, 0.5  #: deviation of a scene over its mean, and deviation of the logarithm of this ratio
_COLOUR = 0.3  #: deviation of the mean of a channel, over what it sees of a grey scene
_TINT = 0.2  #: deviation of the contrast of a channel, over what it sees of a grey scene
_ALONE = 0.1  #: part of the variance of an error that is not the same in all channels
_ROUGH = 0.1  #: relative error of a variance that is estimated from one picture
_GRID = 241  #: logarithms that are tried
_WIDE = 4.0  #: deviations of the prior, over which they are tried
_BLOTCHES = 0.3  #: deviation of scattered light over blotches, over that of a pixel of it
_BLOTCH = 16  #: pixels from one blotch to the next


class Told(NamedTuple):
    """What a picture tells of a quantity of its channels."""

    value: Tensor  #: (channel, 1, 1)
    errors: Tensor  #: (error, channel, 1, 1), deviations; each error has the same sign in all channels


class Level(NamedTuple):
    """Mean or variance of each channel of a scene, (channel, 1, 1) each."""

    value: Tensor
    deviation: Tensor


class SceneDoubt(NamedTuple):
    """What a filter does not know of a scene behind glare, in units of its own scale."""

    mean: float  #: expected square of the error of the mean
    contrast: float  #: expected variance of the scene
    blotches: Tensor  #: (channel, y, x), deviation of light that is the same over some pixels


@torch.no_grad()
def scene_doubt(
    used: tuple[Tensor, Tensor], told: tuple[Told, Told], white: Tensor | None, full: float, light: Light
) -> SceneDoubt | None:
    """Return what is not known of a scene of which the filter uses a mean and a scale; None where glare is known.

    ``used`` by the filter as mean and scale, (channel, 1, 1), ``told`` by the picture of mean and variance. Without
    ``white``, what the channels see of a grey scene, mean and scale count as known.
    """
    if not light.modes:
        return None
    mean, scale = used
    blotches = _BLOTCHES * light.variance.sqrt() / scale
    if white is None:
        return SceneDoubt(0.0, 1.0, blotches)
    level, squares = level_and_variance(*told, white, full)
    wrong = (level.deviation.square() + (level.value - mean).square()) / scale.square()
    return SceneDoubt(float(wrong.mean()), float((squares.value / scale.square()).mean()), blotches)


def told_of_scene(
    mean: Tensor, variance: Tensor, wrong: Tensor, light: Light, weights: Tensor, unseen: Tensor
) -> tuple[Told, Told]:
    """Return what a picture without glare tells of the mean and the variance of its scene.

    ``wrong`` (channel, 1, 1) is the variance that may be glare, ``weights`` those of the pixels in the mean, and
    ``unseen`` the light that a channel may have of which no pixel is known.
    """
    errors = torch.stack([*(average(mode, weights) for mode in light.modes), unseen])
    return Told(mean, errors), Told(variance, (wrong + unseen.square())[None])


def level_and_variance(mean: Told, variance: Told, white: Tensor, full: float) -> tuple[Level, Level]:
    """Return the mean and the variance of a scene in each channel, with what is not known of both.

    ``white`` (channel, 1, 1) is what channels see of a grey scene, ``full`` the light of the fullest pixel.
    """
    grey = white.flatten().double()
    level, log, spread = _likely(mean, grey, math.log(_EXPOSED * full), _EXPOSURE, _COLOUR)
    ratio = 2.0 * (log + math.log(_CONTRAST))
    width = 2.0 * math.hypot(spread, _CONTRASTS)
    squares, _, _ = _likely(variance, grey.square(), ratio, width, 2.0 * _TINT, _ROUGH)
    return level, squares


def drawn_blotches(blotches: Tensor, rng: Generator) -> Tensor:
    """Return a draw of light (channel, y, x) that is nearly the same over some pixels, and of one colour."""
    y, x = (_hats(n).to(blotches) for n in blotches.shape[-2:])
    drawn = torch.randn(len(y), len(x), generator=rng, device=rng.device, dtype=blotches.dtype).to(blotches)
    field: Tensor = blotches * (y.T @ drawn @ x)
    return field


def _hats(size: int) -> Tensor:
    """Return the weights (blotch, pixel) of blotches in the pixels of an axis, whose squares add up to 1."""
    at = torch.arange(size) / _BLOTCH
    hats = (1.0 - (at - torch.arange(size // _BLOTCH + 2)[:, None]).abs()).clamp_min(0.0)
    return hats / hats.square().sum(0).sqrt()


def _likely(
    told: Told, grey: Tensor, middle: float, width: float, own: float, rough: float = 0.0
) -> tuple[Level, float, float]:
    """Return a quantity of each channel, and mean and deviation of the logarithm of what the channels share.

    The shared logarithm is normal, of mean ``middle`` and deviation ``width``; a channel differs from ``grey`` times
    the shared quantity by a relative deviation ``own``.
    """
    value, errors = told.value.flatten().double(), told.errors.flatten(1).double()
    known = errors.T @ errors
    known = known + (_ALONE * known.diagonal() + 1.0).diag()
    logs = torch.linspace(-_WIDE, _WIDE, _GRID, dtype=torch.float64, device=value.device) * width + middle
    expected = logs.exp()[:, None] * grey
    free = (own * expected).square()
    whole = known + (free + (rough * expected).square()).diag_embed()
    rest = value - expected
    lower = torch.linalg.cholesky(whole)
    solved = torch.cholesky_solve(rest[..., None], lower)[..., 0]
    half = -0.5 * ((logs - middle) / width).square() - lower.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    share = torch.softmax(half - 0.5 * (rest * solved).sum(-1), 0)[:, None]
    each = (expected + free * solved).clamp_min(0.0)
    left = free - free.square() * torch.cholesky_inverse(lower).diagonal(dim1=-2, dim2=-1)
    mean = (share * each).sum(0)
    variance = (share * (left.clamp_min(0.0) + (each - mean).square())).sum(0)
    log = float((share[:, 0] * logs).sum())
    spread = float((share[:, 0] * (logs - log).square()).sum().sqrt())
    level = (x[:, None, None].to(told.value) for x in (mean, variance.sqrt()))
    return Level(*level), log, spread
