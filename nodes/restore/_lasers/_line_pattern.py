"""The pattern of one spectral line on the sensor, as a function of its direction and wavelength."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from neusee.nodes.optics._notch import passed_by_notches
from neusee.nodes.values import Bands, Pupil

Sensor = Literal["point", "integrated"]

_WIDE = 2.5e-9  #: m; parts of a line are about this wide
_GAUSS = (
    (-0.7745966692414834, 5 / 18),
    (0.0, 8 / 18),
    (0.7745966692414834, 5 / 18),
)  #: nodes over half a pixel, weights


class Lens(NamedTuple):
    """What forms the pattern: focal length and pixel pitch in m, window in pixels, and how a pixel sees it."""

    focal_length: float
    pixel_pitch: float
    shape: tuple[int, int]
    sensor: Sensor = "point"


def line_pattern(pupil: Pupil, direction: Tensor, wavelength: Tensor, lens: Lens, fwhm: Tensor) -> Tensor:
    """Return the share of the clear pupil's light in each pixel (y, x), mean over a Gaussian line.

    The result has derivatives with respect to every tensor. Beyond half the alias-free field from the spot it is 0,
    because a sampled pupil repeats its pattern there.
    """
    count = max(1, round(float(fwhm.detach()) / _WIDE))
    at = (torch.arange(count, dtype=torch.float64, device=fwhm.device) + 0.5) / count
    offsets = torch.special.ndtri(at) * (fwhm / (2.0 * math.sqrt(2.0 * math.log(2.0))))
    patterns = [_pattern(pupil, direction, wavelength + offset, lens) for offset in offsets]
    return torch.stack(patterns).mean(0)


def _pattern(pupil: Pupil, direction: Tensor, wavelength: Tensor, lens: Lens) -> Tensor:
    field = _field(pupil, wavelength)
    spot = direction.to(wavelength) * (lens.focal_length / lens.pixel_pitch)
    reach = (
        pupil.pitch.to(wavelength) * lens.pixel_pitch / (wavelength * lens.focal_length)
    )  # turns by sample and pixel
    light = torch.zeros(lens.shape, dtype=field.real.dtype, device=field.device)
    for y, wy in _points(lens.sensor):
        for x, wx in _points(lens.sensor):
            rows, columns = (
                _axis(n, reach, spot[i] - s, field, i) for i, (n, s) in enumerate(zip(lens.shape, (y, x), strict=True))
            )
            far = rows @ field @ columns.T
            light = light + wy * wx * (far.real.square() + far.imag.square())
    area = pupil.aperture.double().square().sum()
    passed = passed_by_notches(pupil._replace(wavelengths=wavelength[None]))[0]
    return light * (reach.square() * passed / area).to(light)


def _points(sensor: Sensor) -> tuple[tuple[float, float], ...]:
    """Return places within a pixel, in pixels, and their weights."""
    return ((0.0, 1.0),) if sensor == "point" else tuple((0.5 * at, weight) for at, weight in _GAUSS)


def _field(pupil: Pupil, wavelength: Tensor) -> Tensor:
    """Return the field in the pupil, with phases reduced in float64."""
    index = index_at(wavelength, pupil)
    turns = (index * pupil.height.double() + pupil.path.double()) / wavelength
    kind = torch.promote_types(pupil.height.dtype, pupil.path.dtype)
    return torch.polar(pupil.amplitude.to(kind), _radians(turns).to(kind))


def _axis(pixels: int, reach: Tensor, spot: Tensor, field: Tensor, dim: int) -> Tensor:
    """Return the phasors (pixel, sample) along one axis; 0 where the pattern would repeat."""
    samples = field.shape[dim]
    away = torch.arange(pixels, dtype=torch.float64, device=field.device) - pixels // 2 - spot
    at = torch.arange(samples, dtype=torch.float64, device=field.device) - (samples - 1) / 2
    inside = ((away * reach).abs() <= 0.5 * (1 + 1e-9)).to(field.real)
    return torch.polar(inside[:, None].expand(-1, samples), -_radians(reach * away[:, None] * at).to(field.real))


def _radians(turns: Tensor) -> Tensor:
    """Return an angle in turns as radians within half a turn; whole turns have no slope."""
    return (2.0 * math.pi) * (turns - turns.detach().round())


def index_at(wavelength: Tensor, pupil: Pupil) -> Tensor:
    """Return the index of the mask at a wavelength, by the cubic through the four nearest bands or fewer."""
    known, values = pupil.wavelengths.to(wavelength), pupil.index.to(wavelength)
    count = min(4, len(known))
    first = int(
        torch.searchsorted(known.detach(), wavelength.detach()).clamp(count // 2, len(known) - count + count // 2)
    )
    at, value = (x[first - count // 2 : first - count // 2 + count] for x in (known, values))
    total = torch.zeros_like(wavelength)
    for i in range(count):
        others = [j for j in range(count) if j != i]
        factors = [(wavelength - at[j]) / (at[i] - at[j]) for j in others]
        total = total + value[i] * (torch.stack(factors).prod() if factors else 1.0)
    return total


def interpolated(at: Tensor, known: Tensor, values: Tensor) -> Tensor:
    """Return values (row,) at one place, linear between known places in rising order and beyond their ends."""
    if len(known) == 1:
        return values[:, 0] + 0.0 * at
    right = int(torch.searchsorted(known.detach(), at.detach()).clamp(1, len(known) - 1))
    share = (at - known[right - 1]) / (known[right] - known[right - 1])
    return values[:, right - 1] * (1.0 - share) + values[:, right] * share


def response_at(wavelength: Tensor, responses: Tensor, bands: Bands) -> Tensor:
    """Return the response of each channel at a wavelength: (channel,), linear between the centres of the bands."""
    return interpolated(wavelength, bands.centres.to(wavelength), responses.to(wavelength)).clamp_min(0.0)
