"""The standard deviation of each pixel of a deconvolved picture."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Annotated, Any, Literal, NamedTuple

import torch
from pydantic import Field
from torch import Generator, Tensor
from torch.nn.functional import avg_pool2d

from neusee.nodes import Check, node
from neusee.nodes.precision import single
from neusee.nodes.restore.inverse._hidden_pixels import Inverses, most_likely
from neusee.nodes.restore.inverse._masked_blur import (
    Blurred,
    blurred,
    effective_psf,
    grey_white,
    mixed,
    wrapped,
)
from neusee.nodes.restore.inverse._wiener import (
    Border,
    Doubt,
    LaserLight,
    LeastDoubt,
    Scaled,
    Settings,
    known_and_light,
    posed,
)
from neusee.nodes.restore.inverse._wiener_prior import drawn_blotches, fitted_law
from neusee.nodes.units import Electrons
from neusee.nodes.values import Bands, Psf

# --- frame deviation ------------------------------------------------------------------------------

# The error of the filter for scenes like the scene of a frame: scenes with the power spectrum of
# the frame, and with details where the frame has details.


_DETAIL_SIDE = 5  #: side in pixels of a square; a detail is the difference from the mean over it
_NEAR_SIDE = 11  #: side in pixels of the square over which the energy of details is averaged
_SMOOTH_SIDE = 7  #: side in pixels of the square over which the variance of few draws is averaged
#: smallest share of known pixels around a pixel for which the energy of details is used
_KNOWN = 0.02
#: mean square of errors averaged over 11 x 11 pixels: of photographs, relative to drawn scenes with
#: their power spectrum
_COARSE = 2.0
_SHOWN = 0.2  #: restored share of the energy of details, above which a lack of details has meaning
_DARK = 1e-30  #: added to energies, which may be 0 in a ratio


def frame_deviation(
    scaled: Scaled, matrix: Tensor, draws: int, rng: Generator, kernels: Tensor | None = None
) -> Tensor:
    """Return the root mean square error (colour, y, x) of the filter for scenes and noise like
    those of its frame.

    Scenes and noise are drawn separately from the model fitted to the frame. Each has half of
    ``draws``; one draw of the noise is the frame itself. The variance of details (errors minus
    their mean over 11 x 11 pixels) is scaled by a ratio: the energy of the details around a pixel
    of the restored picture, relative to the energy in the restored draws. So an edge has larger
    errors than a sky. Where this ratio exceeds 1, it scales the rest of the variance too. The low
    frequencies of photographs vary more than a power law predicts, by the factor `_COARSE`, and are
    not below those of the prior. The uncertainty of a scene behind glare is drawn too. ``kernels``
    (any, channel, y, x) are PSFs that blur the drawn scenes in turn, in place of the PSF of the
    filter.
    """
    problem, inverses = scaled.problem, Inverses()
    scenes = max(1, draws // 2)
    # minus 1: one draw of the noise is the frame itself
    noises = max(1, draws - scenes - 1)
    with torch.no_grad():
        law = fitted_law(problem, scaled.doubt)
        frame_details = _details(problem.first(most_likely(problem, inverses=inverses)))
    drawn = _of_scenes(scaled, law.power, scenes, rng, kernels, inverses)
    scenes_found = _Scenes.of(drawn, scenes, scaled, matrix)
    noise_square, drawn_details = torch.zeros_like(scenes_found.coarse), scenes_found.restored
    for error in _of_noise(scaled, law.noise**0.5, noises, rng, inverses):
        noise_square = noise_square + _square(scaled.scale / scaled.share * error, matrix) / noises
        drawn_details = drawn_details + _details(error) / noises
    detail_ratio = _ratio(frame_details, drawn_details, problem.weight)
    # a lack of details has little meaning where the filter could not restore them
    detail_ratio = detail_ratio.where(detail_ratio > 1.0, detail_ratio**scenes_found.told)
    coarse_square = _COARSE * law.low * scenes_found.coarse + noise_square
    total: Tensor = detail_ratio * _around(
        scenes_found.fine, _SMOOTH_SIDE
    ) + detail_ratio.clamp_min(1.0) * _around(coarse_square, _SMOOTH_SIDE)
    return total.sqrt()


class _Scenes(NamedTuple):
    """Mean squares over drawn scenes: errors (colour, y, x) and details (y, x)."""

    coarse: Tensor  #: mean square of the errors averaged over `_NEAR_SIDE` pixels
    fine: Tensor  #: mean square of the rest of the errors
    restored: Tensor  #: mean square of the restored details
    #: from 0 to 1: how reliably a lack of restored details shows that the scene has few details
    told: Tensor

    @classmethod
    def of(
        cls, drawn: Iterator[tuple[Tensor, Tensor]], count: int, scaled: Scaled, matrix: Tensor
    ) -> _Scenes:
        """Return the mean squares over ``count`` pairs of (error of the filter, restored scene)."""
        # tensors are never changed in place, so that both may start from the same zeros
        coarse_square = fine_square = scaled.problem.picture.new_zeros(
            len(matrix), *scaled.problem.picture.shape[-2:]
        )
        restored = true_details = torch.zeros_like(coarse_square[0])
        for error, contrast in drawn:
            smooth = _around(error, _NEAR_SIDE)
            coarse_square = coarse_square + _square(smooth, matrix) / count
            fine_square = fine_square + _square(error - smooth, matrix) / count
            restored = restored + _details(contrast) / count
            true_details = (
                true_details + _details(contrast + error * scaled.share / scaled.scale) / count
            )
        resolved = (
            _around(restored, _NEAR_SIDE) / (_SHOWN * _around(true_details, _NEAR_SIDE) + _DARK)
        ).clamp(max=1.0)
        return cls(coarse_square, fine_square, restored, resolved)


def drawn_scene(problem: Blurred, power: Tensor, rng: Generator) -> Tensor:
    """Return the half spectrum of a random scene with the given power spectrum and the colour
    correlation of the prior.
    """
    white = _normal((len(problem.picture), *problem.torus), problem.picture, rng)
    own_factor, shared_factor = _root_of_colour(len(white), problem.grey)
    return mixed(torch.fft.rfft2(white), own_factor, shared_factor) * power.clamp_min(0.0).sqrt()


def drawn_noise(problem: Blurred, rng: Generator) -> Tensor:
    """Return random noise of a picture (channel, y, x): noise of the pixels, and glare patterns
    with normal strengths.
    """
    noise = _normal(problem.picture.shape, problem.picture, rng)
    unclipped = problem.weight > 0
    noise = torch.where(unclipped, noise / problem.weight.where(unclipped, 1.0).sqrt(), 0.0)
    for pattern in problem.glare[len(problem.glare) - problem.bounded :]:
        noise = noise + _normal((), noise, rng) * pattern
    return noise


def _normal(shape: tuple[int, ...], like: Tensor, rng: Generator) -> Tensor:
    drawn: Tensor = torch.randn(shape, generator=rng, device=rng.device, dtype=like.dtype).to(like)
    return drawn


def _transfer(scaled: Scaled, kernels: Tensor | None, number: int) -> Tensor:
    """Return the transfer function that blurs drawn scene ``number``: that of one of ``kernels`` in
    turn, or that of the filter.
    """
    if kernels is None:
        return scaled.problem.transfer
    kernel = kernels[number % len(kernels)].to(scaled.share) / scaled.share
    transfer: Tensor = torch.fft.rfft2(wrapped(kernel, scaled.problem.torus))
    return transfer


def _of_scenes(
    scaled: Scaled,
    power: Tensor,
    draws: int,
    rng: Generator,
    kernels: Tensor | None,
    inverses: Inverses,
) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield for each drawn scene without noise the error of the filter in e-, and the restored
    contrast.
    """
    problem = scaled.problem
    size = (problem.picture.shape[-2], problem.picture.shape[-1])
    for draw in range(draws):
        with torch.no_grad():
            scene = drawn_scene(problem, power, rng)
            picture = blurred(_transfer(scaled, kernels, draw), scene, problem.torus, size)
            answer = most_likely(replace(problem, picture=picture), inverses=inverses)
            error_and_contrast = scaled.pixels(scene - answer), problem.first(answer)
        yield error_and_contrast


def _of_noise(
    scaled: Scaled, factor: float, draws: int, rng: Generator, inverses: Inverses
) -> Iterator[Tensor]:
    """Yield for each draw of noise the contrast that the filter restores from the noise alone."""
    for _ in range(draws):
        with torch.no_grad():
            noise = factor * drawn_noise(scaled.problem, rng)
            if scaled.doubt is not None:
                noise = noise + drawn_blotches(scaled.doubt.blotches, rng)
            error = scaled.problem.first(
                most_likely(replace(scaled.problem, picture=noise), inverses=inverses)
            )
        yield error


def _square(error: Tensor, matrix: Tensor) -> Tensor:
    """Return the square (colour, y, x) of an error (channel, y, x) that ``matrix`` (colour,
    channel) converts to colour.
    """
    square: Tensor = torch.tensordot(matrix.to(error), error, 1).square()
    return square


def _details(contrast: Tensor) -> Tensor:
    """Return the energy (y, x) of the details of a picture, averaged over its channels."""
    energy: Tensor = (contrast - _around(contrast, _DETAIL_SIDE)).square().mean(0)
    return energy


def _ratio(energy: Tensor, drawn: Tensor, weight: Tensor) -> Tensor:
    """Return the energy of the details (y, x) around each pixel, relative to the drawn pictures; 1
    where too few pixels are known.
    """
    unclipped = (weight > 0).all(0).to(energy)
    ratio = (_around(energy * unclipped, _NEAR_SIDE) + _DARK) / (
        _around(drawn * unclipped, _NEAR_SIDE) + _DARK
    )
    return ratio.where(_around(unclipped, _NEAR_SIDE) > _KNOWN, 1.0)


def _around(pictures: Tensor, side: int) -> Tensor:
    """Return the mean over a square of odd side around each pixel; pixels beyond the edge are left
    out.
    """
    averaged = pictures.reshape(1, -1, *pictures.shape[-2:])
    for window in ((side, 1), (1, side)):
        padding = (window[0] // 2, window[1] // 2)
        averaged = avg_pool2d(averaged, window, stride=1, padding=padding, count_include_pad=False)
    return averaged.reshape(pictures.shape)


def _root_of_colour(channels: int, grey: float) -> tuple[float, float]:
    """Return (own, shared) such that  own I + shared J  is the square root of the correlation
    matrix  (1 - grey) I + grey J, where J is the matrix of ones.
    """
    own_factor = (1.0 - grey) ** 0.5
    # eigenvalues: 1 - grey + channels x grey for the grey colour, 1 - grey for the others
    return own_factor, ((1.0 - grey + channels * grey) ** 0.5 - own_factor) / channels


# --- posterior spread -----------------------------------------------------------------------------

# The standard deviation of each pixel of a deconvolved picture, under the model of the filter.


Draws = Annotated[int, Field(ge=2, le=4096)]


@node()
def wiener_spread(
    electrons: Tensor,
    psf: Psf,
    illuminant: Tensor,
    responses: Tensor,
    bands: Bands,
    clipped: Tensor,
    matrix: Tensor,
    glare: list[Tensor] | None = None,
    nearby: list[Tensor] | None = None,
    ghosts: list[Tensor] | None = None,
    *,
    balance: Annotated[float, Field(ge=1e-6, le=1e6)] = 1.0,
    doubt: Doubt = 0.0,
    least_doubt: LeastDoubt = 0.0,
    scatter: bool = False,
    border: Border = 1.0,
    draws: Draws = 8,
    law: Literal["filter", "frame"] = "frame",
    read_noise: Electrons,
    rng: Generator,
) -> Tensor:
    """Compute the standard deviation of each pixel that `restore.wiener` deconvolves, and `matrix`
    converts to colour.

    Each draw is a scene, or noise, that the filter restores; the variance is that of the errors.
    With `law` filter the scenes have the power spectrum of the prior, so that the errors of scene
    and noise are draws from the posterior. With `law` frame they have the spectrum A / f^b of the
    highest debiased Whittle likelihood for this frame, and the noise has a factor of the same fit,
    because a scene that is rougher than the prior is restored worse than the prior says. The frame
    itself is then one of the draws: where the restored frame has more details (differences from the
    mean over 5 x 5 pixels) than the restored draws have, errors are larger, and where it is even,
    errors of details are smaller, unless no details could be restored. Low frequencies of
    photographs vary about a power law: errors averaged over 11 x 11 pixels have twice the variance.
    Clipped pixels, and the ``border`` beyond the edge, are as unknown as in `restore.wiener`.

    With ``scatter`` the mean and the contrast of the scene are as doubtful as the glare leaves
    them, given that a camera is mostly exposed to a seventh of the fullest pixel, to a factor of
    three, and that the deviation of a scene is 0.8 of its mean, to a factor of 1.6; and scattered
    light has blotches of 16 pixels, with 0.4 of the deviation of its speckle.

    Shapes: as `restore.wiener`, matrix (colour, channel) -> (colour, y, x).
    Units:  those of `restore.colour`; with the unit matrix e-.
    Error:  with `law` filter a relative standard deviation of 1 / sqrt(2 draws) in each pixel,
            independent of the picture; with `law` frame less, because variances are averaged over 7
            x 7 pixels. The interval of 90 % is the deviation times the 95 % quantile of Student's t
            of four degrees of freedom for each draw. The deviation holds under the model of the
            filter: not for light that the filter is not told of, such as a laser, nor for a wrong
            PSF, and not for the colour of paints. The iteration adds what `restore.wiener` says. On
            60 photographs behind three masks, lasers of 0 to 1e6 found by the search, intervals of
            90 % hold 92.6 % of the pixels; of a single frame 45 to 100 %, least behind a mask that
            spreads light over most of the frame. The result has a derivative with respect to
            ``matrix`` alone; draws and fitted power count as constants.
    Raises: ValueError as `restore.wiener`.
    Source: Papandreou and Yuille, Gaussian sampling by local perturbations, NIPS 23 (2010),
            algorithm 1; Sykulski, Olhede, Guillaumin, Lilly and Early, Biometrika 106, 251 (2019).
    """
    with torch.no_grad():
        light = LaserLight(glare, nearby, ghosts)
        picture, unclipped, visible_glare = known_and_light(
            psf, responses, single(electrons), clipped, light
        )
        kernels = effective_psf(psf, illuminant, responses, bands, picture.dtype).to(picture)
        white = grey_white(illuminant, responses, bands).to(picture)
        settings = Settings(balance, read_noise, doubt, least_doubt, scatter, border)
        scaled = posed(picture, unclipped, kernels, visible_glare, settings, white)
    deviation = drawn_deviation if law == "filter" else frame_deviation
    return deviation(scaled, matrix, draws, rng).to(single(electrons))


def drawn_deviation(scaled: Scaled, matrix: Tensor, draws: int, rng: Generator) -> Tensor:
    """Return the root mean square error (colour, y, x) of the filter over scenes and noise drawn
    from its prior.
    """
    problem, inverses = scaled.problem, Inverses()
    square_sum = problem.picture.new_zeros(len(matrix), *problem.picture.shape[-2:])
    for _ in range(draws):
        with torch.no_grad():
            scene = drawn_scene(problem, problem.power, rng)
            picture = problem.blur(scene) + drawn_noise(problem, rng)
            error = scaled.pixels(
                scene - most_likely(replace(problem, picture=picture), inverses=inverses)
            )
        square_sum = square_sum + torch.tensordot(matrix.to(error), error, 1).square()
    return (square_sum / draws).sqrt()


@wiener_spread.check
def _(result: Tensor, *inputs: Any, **params: Any) -> list[Check]:
    lowest, highest = float(result.min()), float(result.max())
    return [
        Check(
            f"deviation from {lowest:.2g} to {highest:.2g}", math.isfinite(highest) and lowest >= 0
        )
    ]
