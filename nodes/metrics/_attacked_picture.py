"""A picture under attack: the glare of a laser by its level, and what a filter recovers of the pixels that are left."""

from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.metrics._filtered_picture import noise_variance
from neusee.nodes.metrics._picture_spectrum import PictureSpectrum, information_bits, remaining_error

_LEAST, _MOST, _EACH = -16, 1, 20  #: decades of the glare, and bins a decade
_NOISES = 48  #: noises for which the error is computed; others are interpolated, to 1e-4


class GlareLevels(NamedTuple):
    """The light of a laser over the pixels of a field as a histogram, relative to the peak of the clear lens."""

    level: Tensor  #: (bin,) mean of the light in a bin
    share: Tensor  #: (bin,) share of the pixels


class PixelNoise(NamedTuple):
    """The noise of a pixel and its well."""

    read_noise: float  #: e-
    full_well: float  #: e-
    prnu: float  #: relative spread of the sensitivity of pixels
    residual_glare: float  #: share of the glare that is subtracted wrongly


class Attacked(NamedTuple):
    """What is left of a picture under attack, averaged over pixels and channels."""

    error: Tensor  #: () error after the filter over the variance of the scene; a full pixel counts as 1
    information: Tensor  #: () bits a pixel; a full pixel counts as 0
    seen: Tensor  #: () share of the pixels that are not full


def glare_levels(light: Tensor, clear_peak: float) -> GlareLevels:
    """Sort the pixels of a field by the light (y, x) that a laser sends to each pixel."""
    relative = light.double().flatten() / clear_peak
    at = ((relative.clamp_min(1e-300).log10() - _LEAST) * _EACH).long().clamp(0, (_MOST - _LEAST) * _EACH - 1)
    empty = torch.zeros((_MOST - _LEAST) * _EACH, dtype=torch.float64)
    count = empty.index_add(0, at, torch.ones_like(relative))
    mean = empty.index_add(0, at, relative) / count.clamp_min(1)
    held = count > 0
    return GlareLevels(mean[held], count[held] / len(relative))


def attacked_picture(
    spectrum: PictureSpectrum,
    glare: GlareLevels,
    noise: PixelNoise,
    *,
    electrons: float,
    transmittance: float,
    strengths: Tensor,
    colour: Tensor,
) -> Attacked:
    """Return error, information and share of seen pixels at each strength of a laser: (strength,) each.

    A strength of 1 fills one pixel behind the clear lens in the channel that responds most; ``colour`` (channel,) is
    the response of each channel relative to that one. A grey filter of ``transmittance`` dims scene and laser alike.
    The Wiener filter knows the noise of each pixel, and a pixel is lost where scene and glare fill it.
    """
    amplitude = electrons * transmittance
    light = amplitude * spectrum.light
    full = noise.full_well * strengths[:, None, None] * transmittance
    each = full * glare.level[:, None] * colour  # (strength, bin, channel)
    free = (each + light) < noise.full_well
    quiet = noise_variance(light, 0.0, noise.read_noise, noise.prnu, noise.residual_glare)
    most = noise_variance(light, noise.full_well, noise.read_noise, noise.prnu, noise.residual_glare)
    steps = torch.linspace(0, 1, _NOISES, dtype=torch.float64)[:, None]
    table = quiet.log() + steps * (most / quiet).log()  # (noise, channel)
    here = noise_variance(light, each, noise.read_noise, noise.prnu, noise.residual_glare).log()
    place = ((here - quiet.log()) / (most / quiet).log() * (_NOISES - 1)).clamp(0, _NOISES - 1 - 1e-9)
    error, bits = (_between(f(spectrum, amplitude, table.exp()), place) for f in (remaining_error, information_bits))
    weights = glare.share[:, None]
    found = (torch.where(free, error, 1.0), torch.where(free, bits, 0.0), free.double())
    return Attacked(*((weights * one).sum(1).mean(-1) for one in found))


def _between(table: Tensor, place: Tensor) -> Tensor:
    """Interpolate a table (noise, channel) at real rows ``place`` (strength, bin, channel)."""
    low = place.floor().long()
    channel = torch.arange(table.shape[1])
    below, above = table[low, channel], table[low + 1, channel]
    return below + (place - low) * (above - below)
