"""What the Wiener filter finds in a picture and knows of it, as maps for a network that goes on from its answer."""

from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes._half_precision import single
from neusee.nodes.restore._inverse._hidden_pixels import most_likely
from neusee.nodes.restore._inverse._masked_blur import Blurred, variance
from neusee.nodes.restore._inverse._wiener import Doubt, LeastDoubt, Scaled, Settings, pose
from neusee.nodes.units import Electrons
from neusee.nodes.values import Bands, FilterFacts, Psf

_OCTAVES = 5  #: of frequency, below half a cycle per pixel
_BRIGHT = 1e3  #: of a glare pattern of maximum 1, so that its far rings are seen
_GAMMA = 1 / 2.2  #: of a display, so that dark parts are seen
EACH = 9  #: maps of each channel
MAPS = 3 * EACH + _OCTAVES  #: of a picture of three channels


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
    """Deconvolve a picture by `restore.wiener`, and map what the filter knows of each pixel and of each frequency.

    Nine maps of each channel, all without a unit: the answer; the brightness, the answer above black to the power
    1 / 2.2; the frame y without the glare; the residual y - B x over its noise; the certainty of the pixel of the
    frame, its inverse noise variance W; 1 where it is not clipped; the pattern of the glare; the variance of what is
    not known of this pattern; and the deviation, the predicted error of the answer. Wide ranges are compressed by asinh
    or log. Then, for each of five octaves of frequency from the finest down, one map with the share of the prior's
    variance that the frame tells: the mean over the octave of S / (S + 1), where S = |OTF|^2 W P with the mean W of the
    picture and the prior's spectrum P. The square of the deviation has the mean 1 - S / (S + 1) weighted by P, and is
    larger where the frame tells less.

    Shapes: as `restore.wiener`; maps (9 channels + 5, y, x).
    Units:  as `restore.wiener`; the maps none.
    Error:  as `restore.wiener`; the deviation leaves out light from beyond the frame and errors of PSF and glare, so
            that behind masks the true error was 10 to 30 times as large: it orders pixels, no more.
    Raises: ValueError as `restore.wiener`.
    Source: as `restore.wiener`; the maps are ours.
    """
    electrons, light = single(electrons), (glare, nearby, ghosts)
    settings = Settings(balance, read_noise, doubt, least_doubt)
    return facts(pose(electrons, psf, illuminant, responses, bands, clipped, *light, settings))


@filter_facts.check
def _(result: FilterFacts, *inputs: Any, **params: Any) -> list[Check]:
    largest = float(result.maps.abs().max())
    return [Check(f"maps of the filter up to {largest:.3g}", largest < float("inf"))]


def facts(scaled: Scaled) -> FilterFacts:
    """Return the answer of a posed deconvolution and its maps."""
    seen, scale = scaled.problem, scaled.scale / scaled.share
    spectrum = most_likely(seen)
    answer = seen.first(spectrum)
    found = maps(seen, answer, answer + scaled.mean / scale, seen.blur(spectrum))
    return FilterFacts(answer, *found, scale, scaled.mean)


def maps(seen: Blurred, answer: Tensor, brightness: Tensor, blurred: Tensor) -> tuple[Tensor, Tensor]:
    """Return the predicted deviation and all maps of an answer, its value above black, and its blur by the camera."""
    known = (seen.weight > 0).to(answer)
    root = torch.where(seen.weight > 0, seen.weight, 1.0).sqrt() * known  # the slope of sqrt is infinite at 0
    free = len(seen.glare) - seen.bounded
    glare = sum(seen.glare[:free], torch.zeros_like(answer))
    doubt = sum((mode.square() for mode in seen.glare[free:]), torch.zeros_like(answer))
    deviation, octaves = _predicted(seen, seen.weight / (1.0 + seen.weight * doubt))
    each = [
        answer,
        brightness.sign() * brightness.abs().clamp_min(1e-12).pow(_GAMMA),
        seen.picture.asinh(),
        (root * (seen.picture - blurred)).asinh(),
        seen.weight.log1p() / 10.0,
        known,
        (_BRIGHT / glare.detach().amax().clamp_min(1e-30) * glare).asinh() / 5.0,
        (100.0 * doubt).log1p() / 10.0,
        deviation.log() / 5.0,
    ]
    return deviation, torch.cat([*each, octaves])


def _predicted(seen: Blurred, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Return the deviation of the answer from the scene that the filter expects, and a map for each octave.

    The mean square over the frame follows from the share of each frequency that the frame tells. It is divided over
    the pixels by the inverse of 1 + I, where I is the diagonal of B' W B: a pixel behind a clipped one is less certain.
    """
    gain = seen.transfer.abs().square() * weight.mean((-2, -1), keepdim=True) * seen.power
    untold = _whole_mean(seen.power / (1.0 + gain), seen.torus) / _whole_mean(seen.power, seen.torus)
    information = _information(seen, weight)
    uneven = (1.0 + information.mean((-2, -1), keepdim=True)) / (1.0 + information)
    return (untold * uneven).clamp(1e-6, 1.0).sqrt(), _octaves(gain / (1.0 + gain), seen)


def _whole_mean(half: Tensor, size: tuple[int, int]) -> Tensor:
    """Return the means over whole spectra (..., 1, 1), given their halves."""
    return (variance(half, size))[..., None, None]


def _information(seen: Blurred, weight: Tensor) -> Tensor:
    """Return the diagonal of B' W B for the blur B: the information of the frame on each pixel of the scene."""
    squared = torch.fft.rfft2(torch.fft.irfft2(seen.transfer, s=seen.torus).square())
    whole: Tensor = torch.fft.irfft2(squared.conj() * torch.fft.rfft2(weight, s=seen.torus), s=seen.torus)
    return whole[..., : seen.picture.shape[-2], : seen.picture.shape[-1]].clamp_min(0.0)


def _octaves(shares: Tensor, seen: Blurred) -> Tensor:
    """Return for each octave of frequency a map of the mean of the shares (channel, fy, fx)."""
    told = shares.mean(0)
    rows = torch.fft.fftfreq(seen.torus[0], dtype=told.dtype, device=told.device)
    columns = torch.fft.rfftfreq(seen.torus[1], dtype=told.dtype, device=told.device)
    octave = (-torch.hypot(rows[:, None], columns).clamp(1e-9, 0.5).log2() - 1.0).floor().clamp_max(_OCTAVES - 1)
    means = torch.stack([told[octave == k].mean() if (octave == k).any() else told.mean() for k in range(_OCTAVES)])
    return means[:, None, None].expand(_OCTAVES, *seen.picture.shape[-2:])
