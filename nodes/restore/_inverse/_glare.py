"""The glare of lasers in a picture: strength, variance of the pattern, and other patterns that are as likely."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

_REACH = (1, 4, 16, 64)  #: pixels; radii of the squares around a pixel, an octave's light of counting alike
_ROWS = 64  #: rows of a picture at a time, so that their float64 copies fit in the cache


class Glare(NamedTuple):
    """Patterns of glare whose strengths are unknown, and for some of them other patterns that are as likely."""

    patterns: list[Tensor]  #: (channel, y, x), of maximum 1
    nearby: list[Tensor | None]  #: (pattern, channel, y, x), in the same unit
    around: list[Tensor] | None = None  #: (channel, y, x), of each pattern; by `with_light_around`, for a doubt
    peaks: Sequence[float] = ()  #: by which patterns were divided
    smooth: list[list[Tensor]] | None = None  #: (channel, y, x), of each pattern spread over each radius that is tried


class Light(NamedTuple):
    """An estimate of the glare in a picture, with what is not known about it."""

    sum: Tensor  #: (channel, y, x) e-
    variance: Tensor  #: (channel, y, x) e-^2, of each pixel by itself
    modes: list[Tensor]  #: (channel, y, x) e-; the sum of their outer products is the rest of the covariance


def visible(patterns: Sequence[Tensor], nearby: Sequence[Tensor | None], known: Tensor) -> Glare:
    """Return the glare patterns that are nonzero at some known pixel, each scaled to a maximum of 1."""
    peaks = [float((pattern.detach().abs() * known).max()) for pattern in patterns]
    seen = [
        (p / peak, n if n is None else n / peak) for p, n, peak in zip(patterns, nearby, peaks, strict=True) if peak
    ]
    return Glare([p for p, _ in seen], [n for _, n in seen], peaks=[peak for peak in peaks if peak])


def with_light_around(glare: Glare) -> Glare:
    """Return the glare with the light around each pixel of its patterns."""
    return glare._replace(around=[light_around(pattern) for pattern in glare.patterns])


def light_around(pattern: Tensor) -> Tensor:
    """Return the light around each pixel of a pattern (channel, y, x), in its unit.

    The mean over squares of 3, 9, 33 and 129 pixels a side, each over its radius and summed: a point of light spreads
    as 1 / distance^3, like the rings of a lens and the light that edges, dirt and defocus move. Beyond the picture is
    no light.
    """
    exact = pattern.double()
    total = sum((square_mean(exact, radius) / radius for radius in _REACH), torch.zeros_like(exact))
    return total.to(pattern)


def square_mean(picture: Tensor, radius: int) -> Tensor:
    """Return the mean over a square around each pixel, by running sums."""
    for dim in (-2, -1):
        size = picture.shape[dim]
        sums = torch.cat([torch.zeros_like(picture.narrow(dim, 0, 1)), picture.cumsum(dim)], dim)
        at = torch.arange(size, device=picture.device)
        upper, lower = (at + radius + 1).clamp(max=size), (at - radius).clamp(min=0)
        picture = (sums.index_select(dim, upper) - sums.index_select(dim, lower)) / (2 * radius + 1)
    return picture


def doubted(
    electrons: Tensor, known: Tensor, glare: Glare, doubt: float, noise: Callable[[Tensor], Tensor]
) -> tuple[Tensor, Light, Tensor]:
    """Return the weights of pixels, an estimate of the glare, and the mean variance of its pattern by these weights.

    A ``doubt`` above 0 needs the light around the patterns. If they are uncertain, the estimate is made twice: a pixel
    then weighs noise / (noise + variance of the glare). ``noise`` returns the variance of the noise for the mean of the
    picture without glare.
    """
    light = _estimated(electrons, known, glare, doubt)
    if not (doubt or light.modes) or not glare.patterns:
        return known, light, torch.zeros_like(known[:, :1, :1])
    trusted = known
    for _ in range(2):
        own = noise(average(electrons - light.sum, trusted))
        trusted = known * own / (own + _total(light))
        light = _estimated(electrons, trusted, glare, doubt)
    return trusted, light, average(_total(light), trusted)


def _estimated(electrons: Tensor, weights: Tensor, glare: Glare, doubt: float) -> Light:
    """Return the glare whose strengths fit a picture best, and its uncertainty at these strengths."""
    dark = torch.zeros_like(electrons)
    fit = strengths(electrons, weights, glare.patterns)
    parts = [strength * pattern for strength, pattern in zip(fit, glare.patterns, strict=True)]
    doubtful = zip(fit, glare.around or (), strict=True) if doubt else ()
    own = sum(((doubt * strength * around).square() for strength, around in doubtful), dark)
    modes = [
        strength * (other - pattern) / len(others) ** 0.5
        for strength, pattern, others in zip(fit, glare.patterns, glare.nearby, strict=True)
        if others is not None
        for other in others
    ]
    return Light(sum(parts, dark), own, modes)


def _total(light: Light) -> Tensor:
    """Return the variance of each pixel from all that is uncertain about the glare."""
    return sum((mode.square() for mode in light.modes), light.variance)


def average(picture: Tensor, weights: Tensor) -> Tensor:
    """Return the weighted mean of each channel of a picture: (channel, 1, 1)."""
    total: Tensor = (picture * weights).sum((-2, -1), keepdim=True)
    return total / weights.sum((-2, -1), keepdim=True)


def strengths(electrons: Tensor, weights: Tensor, glare: Sequence[Tensor]) -> Tensor:
    """Return the strength of each glare pattern by a weighted least-squares fit of all patterns and a constant."""
    if not glare:
        return electrons.new_zeros(0)
    means = [average(pattern, weights) for pattern in glare]
    products = torch.zeros(len(glare), len(glare) + 1, dtype=torch.float64, device=electrons.device)
    for channel in range(len(electrons)):
        for some in range(0, electrons.shape[-2], _ROWS):
            at = (channel, slice(some, some + _ROWS))
            flat = [(p[at] - m[channel]).flatten() for p, m in zip(glare, means, strict=True)]
            weight = weights[at].flatten()
            every = torch.stack([*flat, electrons[at].flatten()]).double()
            products += (every[:-1] * weight) @ every.T
    fit: Tensor = torch.linalg.pinv(products[:, :-1], hermitian=True) @ products[:, -1]
    return fit.to(electrons)
