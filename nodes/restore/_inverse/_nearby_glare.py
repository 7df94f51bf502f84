"""Other patterns that the glare of a laser may have if its direction, wavelength and focus are known roughly."""

import math
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Generator, Tensor

from neusee.nodes import Check, node
from neusee.nodes._half_precision import single
from neusee.nodes.optics import psf as focus
from neusee.nodes.optics._psf_definition import SensorSampling
from neusee.nodes.optics._pupil import DEFOCUS_WAVELENGTH
from neusee.nodes.units import FocalLength, Length, PixelPitch, Waves
from neusee.nodes.values import Bands, Pupil

Shift = Annotated[Length, Field(ge=0, le=100e-9)]  #: of the wavelength
Patterns = Annotated[int, Field(ge=1, le=256)]
Pixels = Annotated[float, Field(ge=0, le=100)]


@node()
def nearby_glare(
    glare: Tensor,
    pupil: Pupil,
    direction: Tensor,
    line: Bands,
    responses: Tensor,
    *,
    focal_length: FocalLength,
    pixel_pitch: PixelPitch,
    sensor: SensorSampling = "point",
    patterns: Patterns = 12,
    pixels: Pixels = 0.5,
    wavelength: Shift = 2e-9,
    defocus: Waves = 0.1,
    rng: Generator,
) -> Tensor:
    """Draw patterns that the glare of a laser may have, if its direction, wavelength and focus are known roughly.

    Each pattern has its own direction, wavelength and defocus, drawn from normal distributions around those of the
    laser; ``pixels`` (along each axis, of the spot), ``wavelength`` and ``defocus`` are standard deviations. A Latin
    hypercube spreads the draws evenly over each law. `restore.wiener` takes the patterns as ``nearby``.

    Shapes: glare (channel, y, x), pupil (band,), direction (2,), line (band,), responses (channel, band)
            -> (pattern, channel, y, x).
    Units:  result as glare; pixels on the sensor; wavelength m; defocus waves at 550 nm, peak to valley.
    Error:  that of `optics.psf`, 3e-6 of the brightest pixel, and 1 / samples of the defocus. The covariance of the
            patterns has the relative error sqrt(2 / patterns), and at most ``patterns`` dimensions. Dispersion of the
            mask is neglected, 1e-4 of its phase for 2 nm of fused silica, and so is the change of the response.
    Raises: ValueError where pupil and line differ in the number of bands, or responses and glare in the channels.
    Source: sampled prior of a nuisance parameter as in Kaipio and Somersalo, Statistical and Computational Inverse
            Problems, 2005, ch. 5 (approximation error); McKay et al., Technometrics 21, 239 (1979).
    """
    _agree(glare, pupil, line, responses)
    share = (responses.double() * (line.weights * line.centres)).to(single(glare))
    camera: dict[str, Any] = {"focal_length": focal_length, "pixel_pitch": pixel_pitch, "sensor": sensor}
    camera["shape"] = (glare.shape[-2], glare.shape[-1])

    def seen(around: Pupil, towards: Tensor) -> Tensor:
        channels: Tensor = torch.tensordot(share, focus(around, towards, **camera).intensity.to(share), 1)
        return channels

    own = seen(pupil, direction).sum(dtype=torch.float64)
    unit = (glare.sum(dtype=torch.float64) / own.where(own > 0, 1.0)).to(share)
    bowl, found = _bowl(pupil), []
    for y, x, longer, further in _normal(patterns, rng).tolist():
        moved = direction + pixels * pixel_pitch / focal_length * direction.new_tensor([y, x])
        path = pupil.path + further * defocus * DEFOCUS_WAVELENGTH * bowl
        found.append(unit * seen(pupil._replace(path=path, wavelengths=pupil.wavelengths + longer * wavelength), moved))
    return torch.stack(found)


@nearby_glare.check
def _(result: Tensor, glare: Tensor, *inputs: Any, **params: Any) -> list[Check]:
    size = float(glare.square().mean().sqrt())
    apart = float((result - glare).square().mean().sqrt()) / size if size else 0.0
    return [Check(f"{len(result)} patterns, rms difference {apart:.2g} of the glare", math.isfinite(apart))]


def _agree(glare: Tensor, pupil: Pupil, line: Bands, responses: Tensor) -> None:
    if len(pupil.wavelengths) != len(line.centres) or responses.shape != (len(glare), len(line.centres)):
        raise ValueError(
            f"glare of {len(glare)} channels, responses {tuple(responses.shape)}, pupil of {len(pupil.wavelengths)} "
            f"bands and line of {len(line.centres)} bands do not fit: compute all from one `line` step"
        )


def _bowl(pupil: Pupil) -> Tensor:
    """Return the square of the distance from the axis, 1 at the rim of the disc with the area of the clear aperture."""
    side = pupil.aperture.shape[-1]
    at = torch.arange(side, dtype=torch.float64, device=pupil.path.device) - (side - 1) / 2
    rim = pupil.aperture.sum(dtype=torch.float64).clamp_min(1.0) / math.pi
    return ((at[:, None].square() + at.square()) * (pupil.aperture > 0) / rim).to(pupil.path)


def _normal(count: int, rng: Generator) -> Tensor:
    """Return (count, 4) normal numbers, one in each of ``count`` equally likely parts of each of the four axes."""
    shape = (4, count)
    order = torch.rand(shape, generator=rng, device=rng.device, dtype=torch.float64).argsort(-1)
    even = (order + torch.rand(shape, generator=rng, device=rng.device, dtype=torch.float64)) / count
    numbers: Tensor = torch.special.ndtri(even.clamp(1e-9, 1 - 1e-9)).T
    return numbers
