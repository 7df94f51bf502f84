"""How far a glare pattern is to be doubted: the light around it that it may get wrong, and the likeliest such doubt."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from neusee.nodes.restore._inverse._glare import Glare, average, doubted

DOUBTS = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0)  #: that are tried
_STEPS = 30  #: variances of the scene that are tried for each doubt, each half of an octave below the other
_SAMPLE = 1 << 16  #: pixels of a channel from which the variance of the scene is chosen; all decide on the doubt


def likeliest_doubt(
    electrons: Tensor, known: Tensor, glare: Glare, noise: Callable[[Tensor], Tensor], least: float = 0.0
) -> float:
    """Return the doubt of highest likelihood, at least ``least``, for a picture of which ``known`` pixels count.

    Likelihood: what is left of the picture without glare, less the mean of the 3 x 3 pixels around, is Gaussian in each
    pixel by itself, with the variance of the noise, of the doubted glare and of a scene that is the same in all pixels
    of a channel. Errors of a pattern are sharper than scenes, so that little of the scene hides them.
    """
    if not glare.patterns:
        return 0.0
    whole = _mean_around(known) > 1 - 1e-6  # all of the 3 x 3 pixels are known

    def likelihood(doubt: float) -> float:
        trusted, light, _ = doubted(electrons, known, glare, doubt, noise)
        rest = electrons - light.sum
        variance = 8 / 9 * (noise(average(rest, trusted)) + light.variance)
        for mode in light.modes:
            variance = variance + _sharp(mode).square()
        channels = zip(_sharp(rest), variance, whole, strict=True)
        return sum(_profile(errors[use].square(), own[use]) for errors, own, use in channels if use.any())

    with torch.no_grad():
        return max((least, *(doubt for doubt in DOUBTS if doubt > least)), key=likelihood)


def _profile(squares: Tensor, variance: Tensor) -> float:
    """Return the log likelihood of squared Gaussian errors, with the likeliest constant added to their variance."""
    some = slice(None, None, max(1, len(squares) // _SAMPLE))
    top = float(squares.mean())
    each = [top * 2 ** (-n / 2) for n in range(_STEPS)]
    best = max(each, key=lambda scene: _gaussian(squares[some], variance[some] + scene))
    return _gaussian(squares, variance + best)


def _gaussian(squares: Tensor, variance: Tensor) -> float:
    return -0.5 * float((variance.log() + squares / variance).double().sum())


def _sharp(picture: Tensor) -> Tensor:
    return picture - _mean_around(picture)


def _mean_around(picture: Tensor) -> Tensor:
    return avg_pool2d(picture[None], 3, stride=1, padding=1, count_include_pad=False)[0]
