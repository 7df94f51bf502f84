"""Wiener deconvolution with a known PSF, a baseline that needs no training."""

import math
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes._half_precision import refuse_not_finite, single
from neusee.nodes.restore._inverse._fft_grid import torus
from neusee.nodes.restore._inverse._glare import Glare, Light, average, doubted, visible, with_light_around
from neusee.nodes.restore._inverse._glare_doubt import likeliest_doubt
from neusee.nodes.restore._inverse._grey_psf import effective_psf, grey_white
from neusee.nodes.restore._inverse._hidden_pixels import most_likely
from neusee.nodes.restore._inverse._masked_blur import Blurred, Size
from neusee.nodes.restore._inverse._picture_scale import (
    about_mean,
    expected_variance,
    fall,
    picture_noise,
    power_of_two,
    shared_level,
)
from neusee.nodes.restore._inverse._psf_on_grid import bordered, edge, wrapped
from neusee.nodes.restore._inverse._scattered_glare import scattered
from neusee.nodes.restore._inverse._scene_level import SceneDoubt, scene_doubt, told_of_scene
from neusee.nodes.sensor._digitization import crop
from neusee.nodes.units import Electrons
from neusee.nodes.values import Bands, Psf

GREY = 0.95  #: correlation between the channels of pictures
PRECISE = 256  #: pixels a side, up to which all is computed in float64: the dense float64 algebra takes most time there


#: standard deviation of a glare pattern in each pixel over its light around there; None: the likeliest for the picture
Doubt = Annotated[float, Field(ge=0, le=10)] | None
LeastDoubt = Annotated[float, Field(ge=0, le=10)]  #: of a doubt that is found
Border = Annotated[float, Field(ge=1, le=4)]  #: of unknown pixels around a picture, over the reach of its PSF


class Settings(NamedTuple):
    """What the filter is told besides the picture and the camera; as the parameters of `wiener`."""

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
    """Deconvolve a picture with a known PSF: compute the most likely scene, given the pixels that are not clipped.

    Least squares with a Gaussian prior, which for a picture without edges is the Wiener filter. Each channel has the
    PSF that it sees of a grey scene: the mean over bands, weighted by illuminant x response x wavelength. The power
    spectrum of the prior falls as 1 / frequency^3, like that of edges, with the variance of this picture; channels have
    a correlation of 0.95. Clipped pixels and pixels beyond the edge are unknown. The picture with its border repeats
    itself, so that opposite ends agree. `border` above 1 widens the border beyond the reach of the PSF, so that they
    may differ behind a wide PSF; the prior then hardly rises below half a cycle in the picture, and its variance counts
    about the mean of the picture. The patterns of `glare` and `ghosts`, wide as the scene, are removed, each with its
    own unknown strength. By default their shapes count as known exactly.
    `doubt` is the standard deviation of a pattern in each pixel over the light of the pattern around this pixel, which
    falls as 1 / distance^3 from each point of it: the variance of the noise grows by (doubt x this light)^2. Without a
    number (null) it is the likeliest of 0, 0.01, 0.03, 0.1, 0.3, 1 and 3 for this picture that is not below
    `least_doubt`. `nearby` has other possible patterns of each glare, as `restore.nearby_glare` computes them: their
    differences from the glare, averaged over the patterns, are its covariance. The glare in a variance is a
    least-squares estimate, in which uncertain pixels count less. With `scatter`, patterns are in e- and nearly of the
    strength told, and `doubt` does not count: dirt and defocus scatter part of their light over 4, 16 and 64 pixels,
    as much as speckle and clipped pixels of this picture tell, and channels that glare covers take mean and contrast of
    others, as of a grey scene. The iteration starts from the answer on
    `coarser_grids`; without these it starts from a picture without contrast: faster, and right for a plain lens alone.

    Shapes: electrons and clipped (channel, y, x), psf.intensity (band, any, any), responses (channel, band),
            each glare and ghost (channel, at least y, at least x), cropped to the centre, each nearby
            (pattern, channel, y, x) -> (channel, y, x).
    Units:  e-; glare any, nearby as its glare; the result as behind a perfect lens without losses. `balance` multiplies
            the noise variance, without that of the glare; doubt none.
    Error:  a grey scene is assumed, and noise in the dark no smaller than that of the mean picture. Without `glare` a
            laser that does not clip is taken for scene. The result may be negative: beside lamps hundreds of times as
            bright as the scene it rings. The iteration ends by its residual, or after 20 steps on the finest grid: rms
            from the converged answer over the contrast, for 96 pixels a side, 4e-4 to 5e-3 (medians behind four masks)
            and at most 0.025; for 384, 0.010 behind five half-rings and 0.023 behind a half-ring, where it costs 0.05
            dB; 4e-3 without coarser grids behind a plain lens. Gradients: of the exact answer, first order only; a
            doubt that is found counts as constant. Up to 256 pixels a side all is float64, and rounding adds 1e-6 to
            both (`rtol` holds there); in wider pictures float32 adds 3e-4 to the result and up to 2e-3 to the
            gradients; in pictures of 1e7 e-, 2e-2 and 8e-2. With less noise rounding adds more to the gradients,
            1e-16 of the largest ratio of the variances of scene and noise at one frequency: 1 in pictures of 1e15 e-,
            whose result up to 20 pixels a side is right to 1e-7.
            With `scatter`, the light that is scattered over 4 and 64 pixels is found to a factor of 2 to 3.
    Raises: ValueError where shapes or bands differ, and for pictures and PSFs that are not finite.
    Source: Wiener filter as in Gonzalez and Woods, Digital Image Processing, 4th ed., ch. 5; as least squares with a
            prior, Kaipio and Somersalo, Statistical and Computational Inverse Problems, 2005, ch. 3.
    """
    electrons, light = single(electrons), (glare, nearby, ghosts)
    settings = Settings(balance, read_noise, doubt, least_doubt, scatter, border)
    scaled = pose(electrons, psf, illuminant, responses, bands, clipped, *light, settings)
    return (scaled.pixels(most_likely(scaled.problem, coarser=coarser_grids)) + scaled.mean).to(electrons)


def known_and_light(
    psf: Psf,
    responses: Tensor,
    electrons: Tensor,
    clipped: Tensor,
    glare: list[Tensor] | None,
    nearby: list[Tensor] | None,
    ghosts: list[Tensor] | None,
) -> tuple[Tensor, Tensor, Glare]:
    """Return a picture in the type of the computation, 1 for each pixel that is not clipped, and the visible glare.

    Raises ValueError for inputs that differ in shape or are not finite.
    """
    refuse_other_pictures(electrons, psf, responses, clipped, [*(glare or ()), *(nearby or ()), *(ghosts or ())])
    _refuse_other_glare(glare or [], nearby)
    size = (electrons.shape[-2], electrons.shape[-1])
    fine = electrons.double() if max(size) <= PRECISE else electrons
    patterns, others, ghostly = ([crop(x.to(fine), shape=size) for x in g or ()] for g in (glare, nearby, ghosts))
    known = (~clipped).to(fine)
    return (
        fine,
        known,
        visible([*patterns, *ghostly], [*others, *[None] * (len(patterns) + len(ghostly) - len(others))], known),
    )


@wiener.check
def _(result: Tensor, electrons: Tensor, *inputs: Any, **params: float) -> list[Check]:
    share = float(inputs[4].any(-3).double().mean())
    finite = math.isfinite(float(result.sum()))
    return [
        Check(
            f"{share:.2%} of pixels clipped, restored mean {float(result.mean() / electrons.mean()):.2f} of raw mean",
            finite,
        )
    ]


def _refuse_other_glare(glare: list[Tensor], nearby: list[Tensor] | None) -> None:
    if nearby and [x.shape[-3:] for x in nearby] != [x.shape for x in glare]:
        found, wanted = [tuple(x.shape) for x in nearby], [tuple(x.shape) for x in glare]
        raise ValueError(
            f"nearby {found} does not fit glare {wanted}: give one nearby, (pattern, channel, y, x), for each glare"
        )


def refuse_other_pictures(
    electrons: Tensor, psf: Psf, responses: Tensor, clipped: Tensor, glare: list[Tensor] | None
) -> None:
    """Raise ValueError for inputs that differ in channels or pixels, and for inputs that are not finite."""
    if electrons.shape != clipped.shape or len(responses) != electrons.shape[-3]:
        raise ValueError(
            f"electrons {tuple(electrons.shape)}, clipped {tuple(clipped.shape)} and responses "
            f"{tuple(responses.shape)} must have the same channels and pixels"
        )
    for name, values in {"electrons": [electrons], "psf": [psf.intensity], "glare": glare or ()}.items():
        for x in values:
            refuse_not_finite("the picture cannot be restored", **{name: x.sum(-1).sum(dtype=torch.float64)})


class Scaled(NamedTuple):
    """A deconvolution whose scene has mean 0 and variance 1, and what gives the result its scale and mean back."""

    problem: Blurred
    scale: Tensor  #: (channel, 1, 1)
    mean: Tensor  #: (channel, 1, 1), of the scene
    share: Tensor  #: (channel, 1, 1), powers of two by which the PSF was divided
    kernels: Tensor  #: (channel, any, any), the PSF of each channel, divided by ``share``
    doubt: SceneDoubt | None = None  #: of a scene behind glare

    def pixels(self, spectrum: Tensor) -> Tensor:
        """Return the contrast of a scene in e-, given its spectrum."""
        return self.problem.first(spectrum) * self.scale / self.share


def pose(
    electrons: Tensor,
    psf: Psf,
    illuminant: Tensor,
    responses: Tensor,
    bands: Bands,
    clipped: Tensor,
    glare: list[Tensor] | None,
    nearby: list[Tensor] | None,
    ghosts: list[Tensor] | None,
    settings: Settings,
) -> Scaled:
    """Return the inputs of `wiener` as a linear problem, unsolved; ``settings`` as `Settings` says."""
    fine, known, light = known_and_light(psf, responses, electrons, clipped, glare, nearby, ghosts)
    kernels = effective_psf(psf, illuminant, responses, bands, fine.dtype).to(fine)
    return posed(fine, known, kernels, light, settings, grey_white(illuminant, responses, bands).to(fine))


def posed(
    electrons: Tensor,
    known: Tensor,
    kernels: Tensor,
    glare: Glare,
    settings: Settings,
    white: Tensor | None = None,
) -> Scaled:
    """Return the deconvolution of a picture as a linear problem; ``settings`` as `Settings` says.

    With `Settings.scatter` and ``white``, what the channels (channel, 1, 1) see of a grey scene, channels that glare
    covers take mean and contrast of others.
    """
    frame = (electrons.shape[-2], electrons.shape[-1])
    read, scatter = settings.read_noise, settings.scatter
    seen, some = known, known.amax((-2, -1), keepdim=True)
    known = torch.where(some > 0, known, 1.0)
    share = power_of_two(kernels.sum((-2, -1), keepdim=True).detach())
    kernels = kernels / share  # the same bits, and the floors below concern the shape of the PSF, not a grey filter

    free, trusted, light, wrong = _found_light(electrons, (known, seen), glare, settings)
    picture = electrons - light.sum
    mean = average(picture, trusted)
    found = average((picture - mean).square(), trusted)
    size, transfer, power, passed = _on_torus(kernels, frame, settings.border)
    told = mean, (found - mean - read**2 - wrong) / passed
    scale = torch.maximum(told[1], 0.01 * found / passed).clamp_min(1e-6).sqrt()
    if scatter and white is not None and light.modes:
        trust = trusted.sum((-2, -1), keepdim=True) / known.sum((-2, -1), keepdim=True) * some
        mean, scale = (shared_level(x, trust.detach(), white) for x in (mean.clamp_min(1.0), scale))
    noise = settings.balance * picture_noise(electrons, mean, read) + light.variance
    weight = known * (scale / noise.sqrt()).square()
    scaled = tuple(pattern / scale for pattern in (*free, *light.modes))
    problem = Blurred((picture - mean) / scale, weight, transfer, power, size, GREY, scaled, bounded=len(light.modes))
    bright = mean / kernels.sum((-2, -1)).clamp_min(1e-3)[:, None, None] / share
    if not scatter:
        return Scaled(problem, scale, bright, share, kernels)
    full = float(electrons.detach().max())
    both = told_of_scene(*told, wrong / passed, light, trusted, (some == 0) * full)
    return Scaled(problem, scale, bright, share, kernels, scene_doubt((mean, scale), both, white, full, light))


def _on_torus(kernels: Tensor, frame: Size, border: float) -> tuple[Size, Tensor, Tensor, Tensor]:
    """Return the torus of a picture, the transfer of the PSF, the prior, and the variance that a picture then has."""
    size = torus(frame, bordered(edge(kernels, frame), border))
    transfer, wide = torch.fft.rfft2(wrapped(kernels, size)), border > 1
    power = fall(size, (2 * frame[0], 2 * frame[1]) if wide else None).to(kernels)
    varying = about_mean(power, frame, size) if wide else power
    return size, transfer, power, expected_variance(transfer, varying, size).clamp_min(1e-6)


def _found_light(
    electrons: Tensor, known: tuple[Tensor, Tensor], glare: Glare, settings: Settings
) -> tuple[list[Tensor], Tensor, Light, Tensor]:
    """Return the patterns of unknown strength, and what `doubted` returns; ``known`` with and without blind channels.

    With `Settings.scatter` the strengths are found too, so that no pattern of unknown strength is left.
    """

    def own_noise(mean: Tensor) -> Tensor:
        return picture_noise(electrons, mean, settings.read_noise)

    if settings.scatter and glare.patterns:
        return [], *scattered(electrons, known[1], glare, own_noise)
    return glare.patterns, *_doubted(electrons, known[0], glare, (settings.doubt, settings.least_doubt), own_noise)


def _doubted(
    electrons: Tensor,
    known: Tensor,
    glare: Glare,
    doubts: tuple[float | None, float],
    noise: Callable[[Tensor], Tensor],
) -> tuple[Tensor, Light, Tensor]:
    """Return what `doubted` returns, for a doubt, or None and the least doubt that is found."""
    doubt, least = doubts
    if doubt != 0 and glare.around is None:
        glare = with_light_around(glare)
    doubt = likeliest_doubt(electrons, known, glare, noise, least) if doubt is None else doubt
    return doubted(electrons, known, glare, doubt, noise)
