"""The error of the filter on scenes like that of a frame: with its power spectrum, and details where it has any."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Generator, Tensor
from torch.nn.functional import avg_pool2d

from neusee.nodes.restore._inverse._frame_spectrum import fitted_law
from neusee.nodes.restore._inverse._hidden_pixels import Inverses, most_likely
from neusee.nodes.restore._inverse._masked_blur import Blurred, blurred, mixed
from neusee.nodes.restore._inverse._psf_on_grid import wrapped
from neusee.nodes.restore._inverse._scene_level import drawn_blotches
from neusee.nodes.restore._inverse._wiener import Scaled

_DETAIL = 5  #: pixels a side; what differs from its mean over such a square is a detail
_NEAR = 11  #: pixels a side of the square around a pixel whose details tell of this pixel
_SMOOTH = 7  #: pixels a side of the square over which the variance of few draws is averaged
_KNOWN = 0.02  #: share of known pixels around a pixel, below which nothing around it tells of details
_COARSE = 2.0  #: mean square of errors of photographs averaged over 11 x 11 pixels, over that of scenes of their law
_SHOWN = 0.2  #: part of the energy of details that is restored, from which on a lack of them tells
_DARK = 1e-30  #: added to energies


def frame_deviation(
    scaled: Scaled, matrix: Tensor, draws: int, rng: Generator, kernels: Tensor | None = None
) -> Tensor:
    """Return the root mean square error (colour, y, x) of the filter for scenes and noise like those of its frame.

    Scenes and noise are drawn apart by the law of the frame, each half of ``draws``, one of which is the frame itself.
    The variance of details (errors of a scene less their mean over 11 x 11 pixels) grows and falls with the energy of
    the details of the restored picture around a pixel, relative to that of the restored draws: an edge has larger
    errors than a sky. Where the picture has more details than the draws, the rest of the variance grows as well.
    Low frequencies of photographs vary about a power law, by `_COARSE`, and are not below those of the prior. What is
    not known of a scene behind glare is drawn too.
    ``kernels`` (any, channel, y, x) are PSFs that blur the drawn scenes in turn, in place of the PSF of the filter.
    """
    problem, inverses = scaled.problem, Inverses()
    scenes = max(1, draws // 2)
    noises = max(1, draws - scenes - 1)
    with torch.no_grad():
        law = fitted_law(problem, scaled.doubt)
        own = _details(problem.first(most_likely(problem, inverses=inverses)))
    drawn = _of_scenes(scaled, law.power, scenes, rng, kernels, inverses)
    found = _Scenes.of(drawn, scenes, scaled, matrix)
    noisy, details = torch.zeros_like(found.coarse), found.restored
    for error in _of_noise(scaled, law.noise**0.5, noises, rng, inverses):
        noisy = noisy + _square(scaled.scale / scaled.share * error, matrix) / noises
        details = details + _details(error) / noises
    ratio = _ratio(own, details, problem.weight)
    ratio = ratio.where(ratio > 1.0, ratio**found.told)  # a lack of details means little where none could be seen
    slow = _COARSE * law.low * found.coarse + noisy
    total: Tensor = ratio * _around(found.fine, _SMOOTH) + ratio.clamp_min(1.0) * _around(slow, _SMOOTH)
    return total.sqrt()


class _Scenes(NamedTuple):
    """Mean squares over drawn scenes, (colour, y, x) of errors and (y, x) of details."""

    coarse: Tensor  #: of errors averaged over the pixels near
    fine: Tensor  #: of the rest of the errors
    restored: Tensor  #: of restored details
    told: Tensor  #: from 0 to 1, how far a lack of restored details near a pixel tells of a lack of details

    @classmethod
    def of(cls, drawn: Iterator[tuple[Tensor, Tensor]], count: int, scaled: Scaled, matrix: Tensor) -> _Scenes:
        """Return the mean squares of drawn errors and restored scenes."""
        coarse = fine = scaled.problem.picture.new_zeros(len(matrix), *scaled.problem.picture.shape[-2:])
        restored = true = torch.zeros_like(coarse[0])
        for error, seen in drawn:
            smooth = _around(error, _NEAR)
            coarse = coarse + _square(smooth, matrix) / count
            fine = fine + _square(error - smooth, matrix) / count
            restored = restored + _details(seen) / count
            true = true + _details(seen + error * scaled.share / scaled.scale) / count
        told = (_around(restored, _NEAR) / (_SHOWN * _around(true, _NEAR) + _DARK)).clamp(max=1.0)
        return cls(coarse, fine, restored, told)


def drawn_scene(problem: Blurred, power: Tensor, rng: Generator) -> Tensor:
    """Return the spectrum of a drawn scene with a power spectrum, and with the colours of the prior."""
    white = _normal((len(problem.picture), *problem.torus), problem.picture, rng)
    own, shared = _root_of_colour(len(white), problem.grey)
    return mixed(torch.fft.rfft2(white), own, shared) * power.clamp_min(0.0).sqrt()


def drawn_noise(problem: Blurred, rng: Generator) -> Tensor:
    """Return drawn noise of a picture (channel, y, x): of its pixels, and of the patterns of bounded strength."""
    noise = _normal(problem.picture.shape, problem.picture, rng)
    seen = problem.weight > 0
    noise = torch.where(seen, noise / problem.weight.where(seen, 1.0).sqrt(), 0.0)
    for pattern in problem.glare[len(problem.glare) - problem.bounded :]:
        noise = noise + _normal((), noise, rng) * pattern
    return noise


def _normal(shape: tuple[int, ...], like: Tensor, rng: Generator) -> Tensor:
    drawn: Tensor = torch.randn(shape, generator=rng, device=rng.device, dtype=like.dtype).to(like)
    return drawn


def _transfer(scaled: Scaled, kernels: Tensor | None, number: int) -> Tensor:
    """Return the transfer that blurs a drawn scene: of the PSF of this number in turn, or that of the filter."""
    if kernels is None:
        return scaled.problem.transfer
    other = kernels[number % len(kernels)].to(scaled.share) / scaled.share
    transfer: Tensor = torch.fft.rfft2(wrapped(other, scaled.problem.torus))
    return transfer


def _of_scenes(
    scaled: Scaled, power: Tensor, draws: int, rng: Generator, kernels: Tensor | None, inverses: Inverses
) -> Iterator[tuple[Tensor, Tensor]]:
    """Draw the error of the filter without noise, in e-, and the contrast of the picture that it restores."""
    problem = scaled.problem
    size = (problem.picture.shape[-2], problem.picture.shape[-1])
    for number in range(draws):
        with torch.no_grad():
            scene = drawn_scene(problem, power, rng)
            seen = blurred(_transfer(scaled, kernels, number), scene, problem.torus, size)
            found = most_likely(replace(problem, picture=seen), inverses=inverses)
            each = scaled.pixels(scene - found), problem.first(found)
        yield each


def _of_noise(scaled: Scaled, factor: float, draws: int, rng: Generator, inverses: Inverses) -> Iterator[Tensor]:
    """Draw the contrast that the filter restores from noise alone."""
    for _ in range(draws):
        with torch.no_grad():
            noise = factor * drawn_noise(scaled.problem, rng)
            if scaled.doubt is not None:
                noise = noise + drawn_blotches(scaled.doubt.blotches, rng)
            error = scaled.problem.first(most_likely(replace(scaled.problem, picture=noise), inverses=inverses))
        yield error


def _square(error: Tensor, matrix: Tensor) -> Tensor:
    square: Tensor = torch.tensordot(matrix.to(error), error, 1).square()
    return square


def _details(contrast: Tensor) -> Tensor:
    """Return the energy (y, x) of details of a picture, in the mean of its channels."""
    energy: Tensor = (contrast - _around(contrast, _DETAIL)).square().mean(0)
    return energy


def _ratio(found: Tensor, drawn: Tensor, weight: Tensor) -> Tensor:
    """Return the energy of details (y, x) around each pixel over that of drawn pictures; 1 where nothing tells."""
    known = (weight > 0).all(0).to(found)
    ratio = (_around(found * known, _NEAR) + _DARK) / (_around(drawn * known, _NEAR) + _DARK)
    return ratio.where(_around(known, _NEAR) > _KNOWN, 1.0)


def _around(pictures: Tensor, side: int) -> Tensor:
    """Return the mean over a square of odd side around each pixel, of the pixels in the picture."""
    wide = pictures.reshape(1, -1, *pictures.shape[-2:])
    for window in ((side, 1), (1, side)):
        rim = (window[0] // 2, window[1] // 2)
        wide = avg_pool2d(wide, window, stride=1, padding=rim, count_include_pad=False)
    return wide.reshape(pictures.shape)


def _root_of_colour(channels: int, grey: float) -> tuple[float, float]:
    """Return (own, shared) such that  own I + shared  is the root of the correlation  (1 - grey) I + grey."""
    own = (1.0 - grey) ** 0.5
    return own, ((1.0 - grey + channels * grey) ** 0.5 - own) / channels
