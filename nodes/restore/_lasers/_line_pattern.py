"""The pattern of one spectral line on the sensor, as a function of its direction and wavelength."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import torch
from numpy.polynomial.hermite_e import hermegauss
from torch import Tensor

from neusee.nodes.optics._notch import passed_by_notches
from neusee.nodes.values import Bands, Pupil

Sensor = Literal["point", "integrated"]

_COUNTS, _MOST = ((2.5e-9, 3), (6e-9, 5)), 7  #: widths of a line in m, each with the number of its parts; then the most
_NARROW = 0.1e-9  #: m, width of a line, below which slopes are those of a line so wide
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
    offsets, shares = _parts(fwhm)
    patterns = [_pattern(pupil, direction, wavelength + at * deviation(fwhm), lens) for at in offsets]
    return sum((share * each for share, each in zip(shares, patterns, strict=True)), torch.zeros_like(patterns[0]))


def deviation(fwhm: Tensor) -> Tensor:
    """Return the standard deviation of a Gaussian line in m, from its full width at half maximum."""
    return fwhm / (2.0 * math.sqrt(2.0 * math.log(2.0)))


def _parts(fwhm: Tensor) -> tuple[list[float], list[float]]:
    """Return the wavelengths that stand for a Gaussian line, in standard deviations, and their shares of its light.

    The sums over them are exact for every polynomial of the wavelength up to degree 5, 9 or 13 (Gauss and Hermite).
    """
    at, weights = hermegauss(next((count for most, count in _COUNTS if float(fwhm.detach()) < most), _MOST))
    return at.tolist(), (weights / weights.sum()).tolist()


def _pattern(pupil: Pupil, direction: Tensor, wavelength: Tensor, lens: Lens) -> Tensor:
    field = _field(pupil, wavelength)
    spot = direction.to(wavelength) * (lens.focal_length / lens.pixel_pitch)
    reach = _reach(pupil, wavelength, lens)
    light = torch.zeros(lens.shape, dtype=field.real.dtype, device=field.device)
    for y, wy in _points(lens.sensor):
        for x, wx in _points(lens.sensor):
            rows, columns = (
                _axis(n, reach, spot[i] - s, field, i) for i, (n, s) in enumerate(zip(lens.shape, (y, x), strict=True))
            )
            far = rows @ field @ columns.T
            light = light + wy * wx * (far.real.square() + far.imag.square())
    return light * _share(pupil, wavelength, reach).to(light)


def _reach(pupil: Pupil, wavelength: Tensor, lens: Lens) -> Tensor:
    """Return the phase that one sample of the pupil and one pixel add, in turns."""
    return pupil.pitch.to(wavelength) * lens.pixel_pitch / (wavelength * lens.focal_length)


def _share(pupil: Pupil, wavelength: Tensor, reach: Tensor) -> Tensor:
    """Return the factor from the squared sum over the pupil to the share of its light in one pixel."""
    area = pupil.aperture.double().square().sum()
    passed = passed_by_notches(pupil._replace(wavelengths=wavelength[None]))[0]
    return reach.square() * passed / area


def _turns(samples: int, reach: Tensor, field: Tensor) -> Tensor:
    """Return the factor (sample,) of a phasor's change when the spot moves by a pixel."""
    at = torch.arange(samples, dtype=torch.float64, device=field.device) - (samples - 1) / 2
    return 2j * math.pi * (reach * at).to(field)


class Moves(NamedTuple):
    """A pattern and how it changes with the place of its spot, and with its wavelength: (y, x)."""

    pattern: Tensor
    down: Tensor  #: by pixel, as right
    right: Tensor
    wave: Tensor  #: by m
    blur: Tensor  #: by m^2 of the variance of the line


def line_moves(pupil: Pupil, spot: Tensor, wavelength: Tensor, lens: Lens, fwhm: Tensor) -> Moves:
    """Return the pattern of `line_pattern` and its slopes, for a spot in pixels; no derivative.

    The slopes with wavelength and variance are means over the line too, by parts of the integral over a Gaussian line.
    """
    wide = fwhm.clamp_min(_NARROW)
    sigma, sums = deviation(wide), [torch.zeros(1)] * 5
    for at, share in zip(*_parts(wide), strict=True):
        still, down, right = _moves(pupil, spot, wavelength + at * sigma, lens)
        by = (share * still, share * down, share * right, share * at / sigma * still)
        blur = share * (at * at - 1.0) / (2.0 * sigma.square()) * still
        sums = [total.to(each) + each for total, each in zip(sums, (*by, blur), strict=True)]
    return Moves(*sums)


def _moves(pupil: Pupil, spot: Tensor, wavelength: Tensor, lens: Lens) -> tuple[Tensor, Tensor, Tensor]:
    """Return the pattern of one wavelength, and its slopes along y and x by pixel."""
    field, reach = _field(pupil, wavelength), _reach(pupil, wavelength, lens)
    turn_y, turn_x = (_turns(n, reach, field) for n in field.shape)
    light = [torch.zeros(lens.shape, dtype=field.real.dtype, device=field.device) for _ in range(3)]
    for y, wy in _points(lens.sensor):
        rows = _axis(lens.shape[0], reach, spot[0] - y, field, 0)
        for x, wx in _points(lens.sensor):
            columns = _axis(lens.shape[1], reach, spot[1] - x, field, 1)
            both = field @ torch.cat([columns, turn_x * columns]).T
            far, right = (rows @ both).chunk(2, dim=1)
            down = (turn_y * rows) @ both[:, : len(columns)]
            light[0] += wy * wx * (far.real.square() + far.imag.square())
            light[1] += (2 * wy * wx) * (far.real * down.real + far.imag * down.imag)
            light[2] += (2 * wy * wx) * (far.real * right.real + far.imag * right.imag)
    share = _share(pupil, wavelength, reach).to(light[0])
    return share * light[0], share * light[1], share * light[2]


def grid_patterns(pupil: Pupil, down: Tensor, right: Tensor, wavelength: Tensor, lens: Lens) -> Tensor:
    """Return the patterns (row, column, y, x) of one wavelength with spots at each of ``down`` x ``right`` pixels."""
    field, reach = _field(pupil, wavelength), _reach(pupil, wavelength, lens)
    y, x = lens.shape
    light = torch.zeros(len(down) * y, len(right) * x, dtype=field.real.dtype, device=field.device)
    for at_y, wy in _points(lens.sensor):
        rows = torch.cat([_axis(y, reach, at - at_y, field, 0) for at in down])
        for at_x, wx in _points(lens.sensor):
            columns = torch.cat([_axis(x, reach, at - at_x, field, 1) for at in right])
            far = rows @ (field @ columns.T)
            light += wy * wx * (far.real.square() + far.imag.square())
    share = _share(pupil, wavelength, reach).to(light)
    return share * light.view(len(down), y, len(right), x).transpose(1, 2)


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
