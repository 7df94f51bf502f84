"""Wiener deconvolution with a known PSF: the filter, its linear problem, and maps of its
certainty.
"""

import math
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.precision import refuse_not_finite, single
from neusee.nodes.restore.inverse._glare import (
    Glare,
    Light,
    average,
    doubted,
    likeliest_doubt,
    scattered,
    visible,
    with_light_around,
)
from neusee.nodes.restore.inverse._hidden_pixels import most_likely
from neusee.nodes.restore.inverse._masked_blur import (
    Blurred,
    Size,
    bordered,
    edge,
    effective_psf,
    grey_white,
    torus,
    variance,
    wrapped,
)
from neusee.nodes.restore.inverse._wiener_prior import (
    SceneDoubt,
    about_mean,
    expected_variance,
    fall,
    picture_noise,
    power_of_two,
    scene_doubt,
    shared_level,
    told_of_scene,
)
from neusee.nodes.sensor._digitization import crop
from neusee.nodes.units import Electrons
from neusee.nodes.values import Bands, FilterFacts, Psf, WienerProblem

# --- wiener ---------------------------------------------------------------------------------------

# Wiener deconvolution with a known PSF: a baseline that needs no training.


GREY = 0.95  #: correlation between the channels of pictures
#: largest side in pixels of a picture that is computed in float64 throughout: up to this size the
#: dense algebra, which is float64 anyway, takes most of the time
PRECISE = 256


#: standard deviation of a glare pattern in each pixel, relative to the light of the pattern around
#: it; None: the most likely value for the picture
Doubt = Annotated[float, Field(ge=0, le=10)] | None
LeastDoubt = Annotated[float, Field(ge=0, le=10)]  #: lower limit for a doubt that is estimated
#: width of the unknown border around a picture, relative to the radius of its PSF
Border = Annotated[float, Field(ge=1, le=4)]


class Settings(NamedTuple):
    """Settings of the filter besides picture and camera; the names are those of the parameters of
    `wiener`.
    """

    balance: float
    read_noise: float
    doubt: float | None = 0.0
    least_doubt: float = 0.0
    scatter: bool = False
    border: float = 1.0


@node(rtol=1e-5, additive_inputs=[("glare", "nearby"), ("ghosts",)])
def wiener(
    electrons: Tensor,
    psf: Psf,
    illuminant: Tensor,
    responses: Tensor,
    bands: Bands,
    clipped: Tensor,
    glare: list[Tensor] | None = None,
    nearby: list[Tensor] | None = None,
    ghosts: list[Tensor] | None = None,
    *,
    balance: Annotated[float, Field(ge=1e-6, le=1e6)] = 1.0,
    doubt: Doubt = 0.0,
    least_doubt: LeastDoubt = 0.0,
    scatter: bool = False,
    border: Border = 1.0,
    coarser_grids: bool = True,
    read_noise: Electrons,
) -> Tensor:
    """Deconvolve a picture with a known PSF: compute the most likely scene, given the pixels that
    are not clipped.

    Least squares with a Gaussian prior, which for a picture without edges is the Wiener filter.
    Each channel has the PSF that it sees of a grey scene: the mean over bands, weighted by
    illuminant x response x wavelength. The power spectrum of the prior falls as 1 / frequency^3,
    like that of edges, with the variance of this picture; channels have a correlation of 0.95.
    Clipped pixels and pixels beyond the edge are unknown. The picture with its border repeats
    itself, so that opposite ends agree. `border` above 1 widens the border beyond the reach of the
    PSF, so that they may differ behind a wide PSF; the prior then hardly rises below half a cycle
    in the picture, and its variance counts about the mean of the picture. The patterns of `glare`
    and `ghosts`, wide as the scene, are removed, each with its own unknown strength. By default
    their shapes count as known exactly. `doubt` is the standard deviation of a pattern in each
    pixel over the light of the pattern around this pixel, which falls as 1 / distance^3 from each
    point of it: the variance of the noise grows by (doubt x this light)^2. Without a number (null)
    it is the likeliest of 0, 0.01, 0.03, 0.1, 0.3, 1 and 3 for this picture that is not below
    `least_doubt`. `nearby` has other possible patterns of each glare, as `restore.nearby_glare`
    computes them: their differences from the glare, averaged over the patterns, are its covariance.
    The glare in a variance is a least-squares estimate, in which uncertain pixels count less. With
    `scatter`, patterns are in e- and nearly of the strength told, and `doubt` does not count: dirt
    and defocus scatter part of their light over 4, 16 and 64 pixels, as much as speckle and clipped
    pixels of this picture tell, and channels that glare covers take mean and contrast of others, as
    of a grey scene. The iteration starts from the answer on `coarser_grids`; without these it
    starts from a picture without contrast: faster, and right for a plain lens alone.

    Shapes: electrons and clipped (channel, y, x), psf.intensity (band, any, any), responses
            (channel, band), each glare and ghost (channel, at least y, at least x), cropped to the
            centre, each nearby (pattern, channel, y, x) -> (channel, y, x).
    Units:  e-; glare any, nearby as its glare; the result as behind a perfect lens without losses.
            `balance` multiplies the noise variance, without that of the glare; doubt none.
    Error:  a grey scene is assumed, and noise in the dark no smaller than that of the mean picture.
            Without `glare` a laser that does not clip is taken for scene. The result may be
            negative: beside lamps hundreds of times as bright as the scene it rings. The iteration
            ends by its residual, or after 20 steps on the finest grid: rms from the converged
            answer over the contrast, for 96 pixels a side, 4e-4 to 5e-3 (medians behind four masks)
            and at most 0.025; for 384, 0.010 behind five half-rings and 0.023 behind a half-ring,
            where it costs 0.05 dB; 4e-3 without coarser grids behind a plain lens. Gradients: of
            the exact answer, first order only; a doubt that is found counts as constant. Up to 256
            pixels a side all is float64, and rounding adds 1e-6 to both (`rtol` holds there); in
            wider pictures float32 adds 3e-4 to the result and up to 2e-3 to the gradients; in
            pictures of 1e7 e-, 2e-2 and 8e-2. With less noise rounding adds more to the gradients,
            1e-16 of the largest ratio of the variances of scene and noise at one frequency: 1 in
            pictures of 1e15 e-, whose result up to 20 pixels a side is right to 1e-7. With
            `scatter`, the light that is scattered over 4 and 64 pixels is found to a factor of 2 to
            3.
    Raises: ValueError where shapes or bands differ, and for pictures and PSFs that are not finite.
    Source: Wiener filter as in Gonzalez and Woods, Digital Image Processing, 4th ed., ch. 5; as
            least squares with a prior, Kaipio and Somersalo, Statistical and Computational Inverse
            Problems, 2005, ch. 3.
    """
    electrons, light = single(electrons), LaserLight(glare, nearby, ghosts)
    view = View(psf, illuminant, responses, bands)
    settings = Settings(balance, read_noise, doubt, least_doubt, scatter, border)
    scaled = pose(electrons, clipped, view, light, settings)
    return (scaled.pixels(most_likely(scaled.problem, coarser=coarser_grids)) + scaled.mean).to(
        electrons
    )


class View(NamedTuple):
    """The PSF of a camera in each band, with the illuminant, channel responses and bands."""

    psf: Psf
    illuminant: Tensor
    responses: Tensor
    bands: Bands


class LaserLight(NamedTuple):
    """Patterns of the light of lasers in a picture, as inputs of `wiener`."""

    glare: list[Tensor] | None
    nearby: list[Tensor] | None
    ghosts: list[Tensor] | None = None


def known_and_light(
    psf: Psf, responses: Tensor, electrons: Tensor, clipped: Tensor, light: LaserLight
) -> tuple[Tensor, Tensor, Glare]:
    """Return a picture in the precision of the computation, a mask of the unclipped pixels (1 or
    0), and the visible glare.

    Raises ValueError for inputs that differ in shape or are not finite.
    """
    glare, nearby, ghosts = light
    refuse_other_pictures(
        electrons, psf, responses, clipped, [*(glare or ()), *(nearby or ()), *(ghosts or ())]
    )
    _refuse_other_glare(glare or [], nearby)
    size = (electrons.shape[-2], electrons.shape[-1])
    # small pictures are computed in float64, see `PRECISE`
    picture = electrons.double() if max(size) <= PRECISE else electrons
    patterns, nearby_patterns, ghost_patterns = (
        [crop(x.to(picture), shape=size) for x in g or ()] for g in (glare, nearby, ghosts)
    )
    unclipped = (~clipped).to(picture)
    return (
        picture,
        unclipped,
        visible(
            [*patterns, *ghost_patterns],
            # None: no nearby patterns, as for ghosts
            [
                *nearby_patterns,
                *[None] * (len(patterns) + len(ghost_patterns) - len(nearby_patterns)),
            ],
            unclipped,
        ),
    )


@wiener.check
def _(result: Tensor, electrons: Tensor, *inputs: Any, **params: float) -> list[Check]:
    # `inputs`: psf, illuminant, responses, bands, then `clipped` at index 4
    share = float(inputs[4].any(-3).double().mean())
    finite = math.isfinite(float(result.sum()))
    return [
        Check(
            f"{share:.2%} of pixels clipped, restored mean"
            f" {float(result.mean() / electrons.mean()):.2f} of raw mean",
            finite,
        )
    ]


def _refuse_other_glare(glare: list[Tensor], nearby: list[Tensor] | None) -> None:
    """Raise ValueError if there are nearby patterns, unless each glare (channel, y, x) has one
    tensor of them (pattern, channel, y, x).
    """
    if nearby and [x.shape[-3:] for x in nearby] != [x.shape for x in glare]:
        nearby_shapes, glare_shapes = (
            [tuple(x.shape) for x in nearby],
            [tuple(x.shape) for x in glare],
        )
        raise ValueError(
            f"nearby {nearby_shapes} does not fit glare {glare_shapes}: give one nearby, (pattern,"
            " channel, y, x), for each glare"
        )


def refuse_other_pictures(
    electrons: Tensor, psf: Psf, responses: Tensor, clipped: Tensor, glare: list[Tensor] | None
) -> None:
    """Raise ValueError for inputs that differ in channels or pixels, and for inputs that are not
    finite.
    """
    if electrons.shape != clipped.shape or len(responses) != electrons.shape[-3]:
        raise ValueError(
            f"electrons {tuple(electrons.shape)}, clipped {tuple(clipped.shape)} and responses "
            f"{tuple(responses.shape)} must have the same channels and pixels"
        )
    for name, values in {
        "electrons": [electrons],
        "psf": [psf.intensity],
        "glare": glare or (),
    }.items():
        # a sum is not finite if one of its pixels is not: cheaper than a test of each pixel
        for x in values:
            refuse_not_finite(
                "the picture cannot be restored", **{name: x.sum(-1).sum(dtype=torch.float64)}
            )


class Scaled(NamedTuple):
    """A deconvolution problem whose scene has mean 0 and variance 1, with the factors and means
    that convert its result to electrons.
    """

    problem: Blurred
    scale: Tensor  #: (channel, 1, 1)
    mean: Tensor  #: (channel, 1, 1), mean of the scene, e-
    share: Tensor  #: (channel, 1, 1), power of two by which the PSF of each channel is divided
    kernels: Tensor  #: (channel, any, any), the PSF of each channel, divided by ``share``
    doubt: SceneDoubt | None = None  #: uncertainty of mean and contrast of a scene behind glare

    def pixels(self, spectrum: Tensor) -> Tensor:
        """Return the deviation of a scene from its mean in e-, from its half spectrum."""
        return self.problem.first(spectrum) * self.scale / self.share


def pose(
    electrons: Tensor, clipped: Tensor, view: View, light: LaserLight, settings: Settings
) -> Scaled:
    """Return the linear problem of a deconvolution for the inputs of `wiener`; it is not solved."""
    picture, unclipped, glare = known_and_light(view.psf, view.responses, electrons, clipped, light)
    kernels = effective_psf(
        view.psf, view.illuminant, view.responses, view.bands, picture.dtype
    ).to(picture)
    white = grey_white(view.illuminant, view.responses, view.bands).to(picture)
    return posed(picture, unclipped, kernels, glare, settings, white)


def posed(
    electrons: Tensor,
    unclipped: Tensor,
    kernels: Tensor,
    glare: Glare,
    settings: Settings,
    white: Tensor | None = None,
) -> Scaled:
    """Return the linear problem of the deconvolution of a picture.

    ``white`` (channel, 1, 1) is the signal of a grey scene in each channel. With it and
    `Settings.scatter`, a channel that glare covers takes its mean and contrast from the others.
    """
    frame = (electrons.shape[-2], electrons.shape[-1])
    read_noise, scatter = settings.read_noise, settings.scatter
    # `has_unclipped` is 1 for a channel with an unclipped pixel. A fully clipped channel counts as
    # unclipped, so that its averages below are not 0 / 0
    unclipped_or_blind, has_unclipped = unclipped, unclipped.amax((-2, -1), keepdim=True)
    unclipped = torch.where(has_unclipped > 0, unclipped, 1.0)
    share = power_of_two(kernels.sum((-2, -1), keepdim=True).detach())
    # division by a power of two is exact; the lower limits below then depend on the shape of the
    # PSF alone, not on its total transmittance
    kernels = kernels / share

    free, trusted, light, glare_error = _found_light(
        electrons, (unclipped, unclipped_or_blind), glare, settings
    )
    picture = electrons - light.sum
    mean = average(picture, trusted)
    picture_variance = average((picture - mean).square(), trusted)
    size, transfer, power, variance_factor = _on_torus(kernels, frame, settings.border)
    # variance of the scene = (variance of the picture - photon noise - read noise - glare) /
    # (variance after the blur of a scene of variance 1); photon noise has the variance `mean`
    mean_and_variance = (
        mean,
        (picture_variance - mean - read_noise**2 - glare_error) / variance_factor,
    )
    # at least 1 % of the variance of the picture, in case noise exceeds it
    scale = (
        torch.maximum(mean_and_variance[1], 0.01 * picture_variance / variance_factor)
        .clamp_min(1e-6)
        .sqrt()
    )
    if scatter and white is not None and light.modes:
        trust = (
            trusted.sum((-2, -1), keepdim=True)
            / unclipped.sum((-2, -1), keepdim=True)
            * has_unclipped
        )
        mean, scale = (shared_level(x, trust.detach(), white) for x in (mean.clamp_min(1.0), scale))
    noise = settings.balance * picture_noise(electrons, mean, read_noise) + light.variance
    # inverse variance of the noise, in units of the scaled picture
    weight = unclipped * (scale / noise.sqrt()).square()
    scaled = tuple(pattern / scale for pattern in (*free, *light.modes))
    problem = Blurred(
        (picture - mean) / scale,
        weight,
        transfer,
        power,
        size,
        GREY,
        scaled,
        # the modes come last; their strengths have variance 1
        bounded=len(light.modes),
    )
    # mean of the scene = mean of the picture / sum of the PSF, which is `kernels` x `share`
    scene_mean = mean / kernels.sum((-2, -1)).clamp_min(1e-3)[:, None, None] / share
    if not scatter:
        return Scaled(problem, scale, scene_mean, share, kernels)
    fullest_pixel = float(electrons.detach().max())
    evidence = told_of_scene(
        *mean_and_variance,
        glare_error / variance_factor,
        light,
        trusted,
        (has_unclipped == 0) * fullest_pixel,
    )
    return Scaled(
        problem,
        scale,
        scene_mean,
        share,
        kernels,
        scene_doubt((mean, scale), evidence, white, fullest_pixel, light),
    )


def _on_torus(kernels: Tensor, frame: Size, border: float) -> tuple[Size, Tensor, Tensor, Tensor]:
    """Return the size of the torus of a picture, the transfer function of the PSF, the power
    spectrum of the prior, and the variance (channel, 1, 1) of the blurred picture of a scene of
    variance 1.
    """
    size = torus(frame, bordered(edge(kernels, frame), border))
    transfer, wider_than_reach = torch.fft.rfft2(wrapped(kernels, size)), border > 1
    power = fall(size, (2 * frame[0], 2 * frame[1]) if wider_than_reach else None).to(kernels)
    varying_power = about_mean(power, frame, size) if wider_than_reach else power
    return size, transfer, power, expected_variance(transfer, varying_power, size).clamp_min(1e-6)


def _found_light(
    electrons: Tensor, unclipped: tuple[Tensor, Tensor], glare: Glare, settings: Settings
) -> tuple[list[Tensor], Tensor, Light, Tensor]:
    """Return the patterns of unknown strength, then the result of `doubted`: weights of the pixels,
    estimate of the glare, mean variance of the glare.

    ``unclipped`` are two masks: in the first, a fully clipped channel counts as unclipped. With
    `Settings.scatter` the strengths are estimated, so that no pattern of unknown strength remains.
    """

    def own_noise(mean: Tensor) -> Tensor:
        return picture_noise(electrons, mean, settings.read_noise)

    if settings.scatter and glare.patterns:
        return [], *scattered(electrons, unclipped[1], glare, own_noise)
    return glare.patterns, *_doubted(
        electrons, unclipped[0], glare, (settings.doubt, settings.least_doubt), own_noise
    )


def _doubted(
    electrons: Tensor,
    unclipped: Tensor,
    glare: Glare,
    doubts: tuple[float | None, float],
    noise: Callable[[Tensor], Tensor],
) -> tuple[Tensor, Light, Tensor]:
    """Return the result of `doubted` (weights, light, mean variance).

    ``doubts`` are the doubt, None for the most likely one, and the lower limit of the most likely
    one.
    """
    doubt, smallest = doubts
    if doubt != 0 and glare.around is None:
        glare = with_light_around(glare)
    doubt = (
        likeliest_doubt(electrons, unclipped, glare, noise, smallest) if doubt is None else doubt
    )
    return doubted(electrons, unclipped, glare, doubt, noise)


# --- wiener problem -------------------------------------------------------------------------------

# The linear problem of the Wiener filter as the result of a node, for the training of networks that
# start from its answer.


@node(rtol=1e-5, additive_inputs=[("glare", "nearby"), ("ghosts",)])
def wiener_problem(
    electrons: Tensor,
    psf: Psf,
    illuminant: Tensor,
    responses: Tensor,
    bands: Bands,
    clipped: Tensor,
    glare: list[Tensor] | None = None,
    nearby: list[Tensor] | None = None,
    ghosts: list[Tensor] | None = None,
    *,
    balance: Annotated[float, Field(ge=1e-6, le=1e6)] = 1.0,
    doubt: Doubt = 0.0,
    least_doubt: LeastDoubt = 0.0,
    read_noise: Electrons,
) -> WienerProblem:
    """Pose the deconvolution of `restore.wiener` as a linear problem, and solve it: the answer is
    that of the filter.

    A training of `restore.unrolled` poses the problem of each picture once, and uses it at each of
    its iterations.

    Shapes: as `restore.wiener`; those of the result as `WienerProblem` says.
    Units:  e-; the fields of the result as `WienerProblem` says.
    Error:  as `restore.wiener`.
    Raises: ValueError as `restore.wiener`.
    Source: as `restore.wiener`.
    """
    electrons, light = single(electrons), LaserLight(glare, nearby, ghosts)
    view = View(psf, illuminant, responses, bands)
    settings = Settings(balance, read_noise, doubt, least_doubt)
    return packed(pose(electrons, clipped, view, light, settings))


@wiener_problem.check
def _(result: WienerProblem, *inputs: Any, **params: Any) -> list[Check]:
    largest = float(result.answer.abs().max())
    return [
        Check(f"contrast of the answer up to {largest:.3g} of its scale", largest < float("inf"))
    ]


def packed(scaled: Scaled) -> WienerProblem:
    """Return a deconvolution problem and its solution as a `WienerProblem`."""
    problem = scaled.problem
    free_count = len(problem.glare) - problem.bounded
    no_patterns = problem.picture.new_zeros(0, *problem.picture.shape)
    free_and_bounded = [
        torch.stack(patterns) if patterns else no_patterns
        for patterns in (problem.glare[:free_count], problem.glare[free_count:])
    ]
    spectrum = most_likely(problem)
    scale = scaled.scale / scaled.share
    answer = (problem.first(spectrum), problem.blur(spectrum))
    # in the order of the fields of `WienerProblem`
    return WienerProblem._make(
        (
            problem.picture,
            problem.weight,
            scaled.kernels,
            *free_and_bounded,
            *answer,
            scale,
            scaled.mean,
        )
    )


def unpacked(value: WienerProblem) -> Blurred:
    """Return the linear problem that a `WienerProblem` contains."""
    frame = (value.picture.shape[-2], value.picture.shape[-1])
    size = torus(frame, edge(value.psf, frame))
    transfer, power = torch.fft.rfft2(wrapped(value.psf, size)), fall(size).to(value.psf)
    glare = (*value.glare, *value.doubts)
    return Blurred(
        value.picture, value.weight, transfer, power, size, GREY, glare, bounded=len(value.doubts)
    )


# --- filter facts ---------------------------------------------------------------------------------

# The result of the Wiener filter for a picture, with its residual and certainty, as maps for a
# network that improves the result.


_OCTAVES = 5  #: number of octaves of frequency, from half a cycle per pixel down
_GLARE_GAIN = 1e3  #: factor of a glare pattern of maximum 1, so that its outer rings are visible
_DISPLAY_GAMMA = 1 / 2.2  #: exponent of a display, so that dark parts are visible
MAPS_OF_CHANNEL = 9  #: number of maps of each channel
MAPS = 3 * MAPS_OF_CHANNEL + _OCTAVES  #: number of maps of a picture with three channels


@node(rtol=1e-5, additive_inputs=[("glare", "nearby"), ("ghosts",)])
def filter_facts(
    electrons: Tensor,
    psf: Psf,
    illuminant: Tensor,
    responses: Tensor,
    bands: Bands,
    clipped: Tensor,
    glare: list[Tensor] | None = None,
    nearby: list[Tensor] | None = None,
    ghosts: list[Tensor] | None = None,
    *,
    balance: Annotated[float, Field(ge=1e-6, le=1e6)] = 1.0,
    doubt: Doubt = 0.0,
    least_doubt: LeastDoubt = 0.0,
    read_noise: Electrons,
) -> FilterFacts:
    """Deconvolve a picture by `restore.wiener`, and map what the filter knows of each pixel and of
    each frequency.

    Nine maps of each channel, all without a unit: the answer; the brightness, the answer above
    black to the power 1 / 2.2; the frame y without the glare; the residual y - B x over its noise;
    the certainty of the pixel of the frame, its inverse noise variance W; 1 where it is not
    clipped; the pattern of the glare; the variance of what is not known of this pattern; and the
    deviation, the predicted error of the answer. Wide ranges are compressed by asinh or log. Then,
    for each of five octaves of frequency from the finest down, one map with the share of the
    prior's variance that the frame tells: the mean over the octave of S / (S + 1), where S =
    |OTF|^2 W P with the mean W of the picture and the prior's spectrum P. The square of the
    deviation has the mean 1 - S / (S + 1) weighted by P, and is larger where the frame tells less.

    Shapes: as `restore.wiener`; maps (9 channels + 5, y, x).
    Units:  as `restore.wiener`; the maps none.
    Error:  as `restore.wiener`; the deviation leaves out light from beyond the frame and errors of
            PSF and glare, so that behind masks the true error was 10 to 30 times as large: it
            orders pixels, no more.
    Raises: ValueError as `restore.wiener`.
    Source: as `restore.wiener`; the maps are ours.
    """
    electrons, light = single(electrons), LaserLight(glare, nearby, ghosts)
    view = View(psf, illuminant, responses, bands)
    settings = Settings(balance, read_noise, doubt, least_doubt)
    return facts(pose(electrons, clipped, view, light, settings))


@filter_facts.check
def _(result: FilterFacts, *inputs: Any, **params: Any) -> list[Check]:
    largest = float(result.maps.abs().max())
    return [Check(f"maps of the filter up to {largest:.3g}", largest < float("inf"))]


def facts(scaled: Scaled) -> FilterFacts:
    """Return the solution of a deconvolution problem, and its maps."""
    problem, scale = scaled.problem, scaled.scale / scaled.share
    spectrum = most_likely(problem)
    answer = problem.first(spectrum)
    deviation_and_maps = maps(problem, answer, answer + scaled.mean / scale, problem.blur(spectrum))
    return FilterFacts(answer, *deviation_and_maps, scale, scaled.mean)


def maps(
    problem: Blurred, answer: Tensor, brightness: Tensor, blurred: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the predicted standard deviation of an answer, and all maps.

    ``brightness`` is the answer above black, and ``blurred`` the answer after the blur of the
    camera.
    """
    unclipped = (problem.weight > 0).to(answer)
    # `where` before `sqrt`, whose derivative is infinite at 0
    inverse_deviation = torch.where(problem.weight > 0, problem.weight, 1.0).sqrt() * unclipped
    free_count = len(problem.glare) - problem.bounded
    # the first patterns have unknown strengths, the last are modes of the uncertainty
    glare = sum(problem.glare[:free_count], torch.zeros_like(answer))
    doubt = sum((mode.square() for mode in problem.glare[free_count:]), torch.zeros_like(answer))
    # 1 / (noise variance + doubt): the weight of a pixel whose glare is uncertain
    deviation, octaves = _predicted(problem, problem.weight / (1.0 + problem.weight * doubt))
    # the divisors scale each map to about 1, as a network needs
    channel_maps = [
        answer,
        brightness.sign() * brightness.abs().clamp_min(1e-12).pow(_DISPLAY_GAMMA),
        problem.picture.asinh(),
        (inverse_deviation * (problem.picture - blurred)).asinh(),
        problem.weight.log1p() / 10.0,
        unclipped,
        (_GLARE_GAIN / glare.detach().amax().clamp_min(1e-30) * glare).asinh() / 5.0,
        (100.0 * doubt).log1p() / 10.0,
        deviation.log() / 5.0,
    ]
    return deviation, torch.cat([*channel_maps, octaves])


def _predicted(problem: Blurred, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Return the standard deviation (channel, y, x) of the scene from the answer that the filter
    predicts, and maps (octave, y, x) of the share of the variance that the frame determines.

    The mean square over the frame follows from the share of each frequency that the frame
    determines. It is distributed over the pixels in proportion to 1 / (1 + I), where I is the
    diagonal of B^T W B: a pixel behind a clipped one is less certain.
    """
    signal_to_noise = (
        problem.transfer.abs().square() * weight.mean((-2, -1), keepdim=True) * problem.power
    )
    untold_share = _whole_mean(
        problem.power / (1.0 + signal_to_noise), problem.torus
    ) / _whole_mean(problem.power, problem.torus)
    information = _information(problem, weight)
    uneven = (1.0 + information.mean((-2, -1), keepdim=True)) / (1.0 + information)
    return (untold_share * uneven).clamp(1e-6, 1.0).sqrt(), _octaves(
        signal_to_noise / (1.0 + signal_to_noise), problem
    )


def _whole_mean(half: Tensor, size: tuple[int, int]) -> Tensor:
    """Return the means (..., 1, 1) over whole spectra, from their half spectra."""
    return (variance(half, size))[..., None, None]


def _information(problem: Blurred, weight: Tensor) -> Tensor:
    """Return the diagonal of B^T W B for the blur B: the Fisher information of the frame on each
    pixel of the scene.
    """
    squared_psf_transfer = torch.fft.rfft2(
        torch.fft.irfft2(problem.transfer, s=problem.torus).square()
    )
    # diagonal element i = sum over j of psf(j - i)^2 W(j), a correlation
    information: Tensor = torch.fft.irfft2(
        squared_psf_transfer.conj() * torch.fft.rfft2(weight, s=problem.torus), s=problem.torus
    )
    return information[..., : problem.picture.shape[-2], : problem.picture.shape[-1]].clamp_min(0.0)


def _octaves(shares: Tensor, problem: Blurred) -> Tensor:
    """Return the mean of the shares (channel, fy, fx) in each octave of frequency, as constant maps
    (octave, y, x).
    """
    mean_share = shares.mean(0)
    rows = torch.fft.fftfreq(problem.torus[0], dtype=mean_share.dtype, device=mean_share.device)
    columns = torch.fft.rfftfreq(problem.torus[1], dtype=mean_share.dtype, device=mean_share.device)
    # octave k: frequencies from 0.5 / 2^(k + 1) to 0.5 / 2^k; the last octave: all lower ones too
    octave = (
        (-torch.hypot(rows[:, None], columns).clamp(1e-9, 0.5).log2() - 1.0)
        .floor()
        .clamp_max(_OCTAVES - 1)
    )
    means = torch.stack(
        [
            mean_share[octave == k].mean() if (octave == k).any() else mean_share.mean()
            for k in range(_OCTAVES)
        ]
    )
    return means[:, None, None].expand(_OCTAVES, *problem.picture.shape[-2:])
