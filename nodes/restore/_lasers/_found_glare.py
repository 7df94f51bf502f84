"""The glare of a laser that was found in a frame, and other patterns that it may have."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Generator, Tensor

from neusee.nodes import Check, node
from neusee.nodes._half_precision import single
from neusee.nodes.restore._inverse._nearby_glare import Patterns
from neusee.nodes.restore._lasers._intervals import NORMAL
from neusee.nodes.restore._lasers._line_pattern import Lens, Sensor, line_pattern
from neusee.nodes.units import FocalLength, PixelPitch
from neusee.nodes.values import FoundLasers, Pupil

Rank = Annotated[int, Field(ge=1, le=8)]


@node()
def found_glare(
    found: FoundLasers,
    pupil: Pupil,
    electrons: Tensor,
    *,
    rank: Rank = 1,
    focal_length: FocalLength,
    pixel_pitch: PixelPitch,
    sensor: Sensor = "point",
) -> Tensor:
    """Compute the glare of a laser that was found in a frame; 0 where fewer than ``rank`` lasers were found.

    The glare is the pattern of a spectral line at the direction and wavelength found, times the electrons of each
    channel that follow it. `restore.wiener` takes it as ``glare``. Every tensor of ``found`` and ``pupil`` receives a
    derivative. Of ``electrons``, the frame, only the shape is used.

    Shapes: found (laser,), pupil (v, u), electrons (channel, y, x) -> (channel, y, x).
    Units:  e-; rank counts from 1, the laser of the largest gain.
    Error:  the sums over the pupil are exact in the precision of the height: 1e-6 of the brightest pixel for float32.
            The index of the mask is a cubic between the bands of the pupil. Beyond half the alias-free field from the
            spot the glare is 0.
    Raises: ValueError where the found lasers and the frame differ in the number of channels.
    Source: Goodman, Introduction to Fourier Optics, 3rd edition, eq. 5-14 (field in the focal plane of a lens).
    """
    _agree(found, electrons)
    if rank > int(found.number):
        return torch.zeros_like(single(electrons))
    lens = Lens(focal_length, pixel_pitch, (electrons.shape[-2], electrons.shape[-1]), sensor)
    row = rank - 1
    pattern = line_pattern(pupil, found.direction[row], found.wavelength[row], lens, found.fwhm[row])
    glare: Tensor = found.straight[row].to(pattern)[:, None, None] * pattern
    return glare.to(single(electrons))


@node()
def found_nearby(
    found: FoundLasers,
    pupil: Pupil,
    electrons: Tensor,
    *,
    rank: Rank = 1,
    focal_length: FocalLength,
    pixel_pitch: PixelPitch,
    sensor: Sensor = "point",
    patterns: Patterns = 12,
    rng: Generator,
) -> Tensor:
    """Draw patterns that the glare of a found laser may have, from the joint normal law of what was found.

    Each pattern has its own direction, wavelength and electrons of each channel, drawn with the covariance of the found
    laser. `restore.wiener` takes the patterns as ``nearby``. A laser that was not found has patterns of 0.

    Shapes: found (laser,), pupil (v, u), electrons (channel, y, x) -> (pattern, channel, y, x).
    Units:  e-; rank counts from 1.
    Error:  each pattern as `restore.found_glare`. The covariance of the patterns has the relative error
            sqrt(2 / patterns), and at most ``patterns`` dimensions.
    Raises: ValueError where the found lasers and the frame differ in the number of channels.
    Source: sampled prior of a nuisance parameter as in Kaipio and Somersalo, Statistical and Computational Inverse
            Problems, 2005, ch. 5 (approximation error).
    """
    _agree(found, electrons)
    if rank > int(found.number):
        return torch.zeros(patterns, *electrons.shape).to(single(electrons))
    row, lens = rank - 1, Lens(focal_length, pixel_pitch, (electrons.shape[-2], electrons.shape[-1]), sensor)
    drawn = []
    for values in _drawn(found, row, patterns, rng):
        pattern = line_pattern(pupil, values[:2], values[2], lens, found.fwhm[row])
        drawn.append(values[3:].clamp_min(0.0).to(pattern)[:, None, None] * pattern)
    return torch.stack(drawn).to(single(electrons))


@found_nearby.check
@found_glare.check
def _(result: Tensor, found: FoundLasers, *inputs: Any, rank: int = 1, **params: Any) -> list[Check]:
    if rank > int(found.number):
        return [Check(f"no laser of rank {rank} was found, so there is no glare")]
    return [Check(f"brightest pixel {float(result.max()):.3g} e-", bool(result.isfinite().all()))]


def _drawn(found: FoundLasers, row: int, count: int, rng: Generator) -> Tensor:
    """Return draws (draw, value) of direction, wavelength and the strength of each channel of one found laser."""
    middle = torch.cat([found.direction[row], found.wavelength[row][None], found.straight[row]])
    each = (found.direction_interval[row], found.wavelength_interval[row][None])
    spread = torch.cat([*((ends[:, 1] - ends[:, 0]) / (2 * NORMAL) for ends in each), found.straight_spread[row]])
    even = (found.correlation[row] + found.correlation[row].mT) / 2  # the factor reads one triangle alone
    lower = torch.linalg.cholesky(even + 1e-9 * torch.eye(len(even)).to(even))
    numbers = torch.randn(count, len(middle), generator=rng, device=rng.device, dtype=torch.float64).to(middle)
    draws: Tensor = middle + spread * (numbers @ lower.mT)
    return draws


def _agree(found: FoundLasers, electrons: Tensor) -> None:
    if electrons.ndim != 3 or len(electrons) != found.strength.shape[-1]:
        raise ValueError(
            f"electrons {tuple(electrons.shape)} and found lasers of {found.strength.shape[-1]} channels do not fit: "
            "give the frame in which the lasers were found, (channel, y, x)"
        )
