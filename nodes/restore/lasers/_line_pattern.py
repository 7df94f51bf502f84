"""The pattern of one spectral line on the sensor, as a function of its direction and wavelength."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from numpy.polynomial.hermite_e import hermegauss
from torch import Tensor

from neusee.nodes.optics._lens import passed_by_notches
from neusee.nodes.optics._pixel_average import FineAxis, averaged, fine_axis
from neusee.nodes.optics._psf_definition import SensorSampling
from neusee.nodes.optics.transform._sample_axis import centred
from neusee.nodes.values import Bands, Pupil

Sensor = SensorSampling

#: (width in m, number of sample wavelengths) of lines below this width; then the number for others
_LINE_SAMPLES, _MOST_LINE_SAMPLES = ((2.5e-9, 3), (6e-9, 5)), 7
_NARROW_WIDTH = 0.1e-9  #: m, smallest width of a line in the computation of derivatives
_FILTER_ERROR = 1e-8  #: error of the average over a pixel, relative to the brightest pixel


class Lens(NamedTuple):
    """Focal length and pixel pitch in m, window (y, x) in pixels, and how a pixel samples the
    pattern.
    """

    focal_length: float
    pixel_pitch: float
    shape: tuple[int, int]
    sensor: Sensor = "point"


def line_pattern(
    pupil: Pupil, direction: Tensor, wavelength: Tensor, lens: Lens, fwhm: Tensor
) -> Tensor:
    """Return the light in each pixel (y, x), averaged over a Gaussian line, as a fraction of the
    light of the clear pupil.

    The result has derivatives with respect to every tensor. It is 0 beyond half the alias-free
    field from the spot, because the pattern of a sampled pupil repeats there.
    """
    offsets, shares = _parts(fwhm)
    patterns = [
        _pattern(pupil, direction, wavelength + offset * deviation(fwhm), lens)
        for offset in offsets
    ]
    return sum(
        (share * pattern for share, pattern in zip(shares, patterns, strict=True)),
        torch.zeros_like(patterns[0]),
    )


def deviation(fwhm: Tensor) -> Tensor:
    """Return the standard deviation of a Gaussian line in m, from its full width at half
    maximum.
    """
    return fwhm / (2.0 * math.sqrt(2.0 * math.log(2.0)))


def _parts(fwhm: Tensor) -> tuple[list[float], list[float]]:
    """Return the sample wavelengths of a Gaussian line, as offsets in standard deviations, and
    their weights, which sum to 1.

    The quadrature (Gauss-Hermite) is exact for polynomials of the wavelength up to degree 5, 9 or
    13.
    """
    nodes, weights = hermegauss(
        next(
            (count for limit, count in _LINE_SAMPLES if float(fwhm.detach()) < limit),
            _MOST_LINE_SAMPLES,
        )
    )
    return nodes.tolist(), (weights / weights.sum()).tolist()


def _pattern(pupil: Pupil, direction: Tensor, wavelength: Tensor, lens: Lens) -> Tensor:
    """Return the light in each pixel (y, x) for one wavelength in m, as a fraction of the light of
    the clear pupil.

    The far field is the Fourier transform of the field in the pupil, as a matrix product for each
    axis.
    """
    field = _field(pupil, wavelength)
    spot = direction.to(wavelength) * (lens.focal_length / lens.pixel_pitch)
    turns_per_pixel = _reach(pupil, wavelength, lens)
    window = _Window.of(lens, field, turns_per_pixel)
    row_phasors, column_phasors = (
        _axis(window.places[i], turns_per_pixel, spot[i], field, i) for i in (0, 1)
    )
    amplitude = row_phasors @ field @ column_phasors.T
    light = window.seen(
        amplitude.real.square() + amplitude.imag.square(), (spot[0], spot[1]), turns_per_pixel
    )
    return light * _share(pupil, wavelength, turns_per_pixel).to(light)


class _Window(NamedTuple):
    """The points along both axes at which the irradiance of a window is computed, and the average
    over its pixels.
    """

    places: tuple[Tensor, Tensor]  #: points along y and x, in pixels from the middle pixel
    pixels: tuple[Tensor, Tensor]  #: centres of the pixels along y and x, in the same unit
    grids: tuple[FineAxis, FineAxis] | None  #: finer grids for the average; None for point sampling

    @classmethod
    def of(cls, lens: Lens, field: Tensor, reach: Tensor) -> _Window:
        # `reach` is the result of `_reach`: turns of phase per sample of the pupil and pixel
        y, x = (
            torch.arange(n, dtype=torch.float64, device=field.device) - n // 2 for n in lens.shape
        )
        if lens.sensor != "integrated":
            return cls((y, x), (y, x), None)
        row_grid, column_grid = (
            fine_axis(n, k * float(reach.detach()), _FILTER_ERROR)
            for n, k in zip(lens.shape, field.shape, strict=True)
        )
        row_places, column_places = (
            centred(grid.samples, field.device) / grid.per_pixel + pixels.mean()
            for grid, pixels in ((row_grid, y), (column_grid, x))
        )
        return cls((row_places, column_places), (y, x), (row_grid, column_grid))

    def seen(self, light: Tensor, spot: tuple[Tensor, Tensor], reach: Tensor) -> Tensor:
        """Return the light (y, x) of each pixel; 0 where the pattern around ``spot`` would
        repeat.
        """
        if self.grids is not None:
            light = averaged(light, *self.grids)
        rows_within, columns_within = (
            _within(pixels, place, reach).to(light)
            for pixels, place in zip(self.pixels, spot, strict=True)
        )
        return light * rows_within[:, None] * columns_within


def _reach(pupil: Pupil, wavelength: Tensor, lens: Lens) -> Tensor:
    """Return the change of phase, in turns, per sample of the pupil and per pixel."""
    return pupil.pitch.to(wavelength) * lens.pixel_pitch / (wavelength * lens.focal_length)


def _share(pupil: Pupil, wavelength: Tensor, reach: Tensor) -> Tensor:
    """Return the factor that converts the squared sum over the pupil to the fraction of its light
    in one pixel.
    """
    area = pupil.aperture.double().square().sum()
    notch_share = passed_by_notches(pupil._replace(wavelengths=wavelength[None]))[0]
    return reach.square() * notch_share / area


def _turns(samples: int, reach: Tensor, field: Tensor) -> Tensor:
    """Return the factor (sample,) of a phasor in its derivative with respect to the place of the
    spot, per pixel.
    """
    position = torch.arange(samples, dtype=torch.float64, device=field.device) - (samples - 1) / 2
    return 2j * math.pi * (reach * position).to(field)


class Moves(NamedTuple):
    """A pattern (y, x), and its derivatives with respect to place, wavelength and variance of the
    line.
    """

    pattern: Tensor
    down: Tensor  #: derivative with respect to y of the spot, per pixel
    right: Tensor  #: derivative with respect to x of the spot, per pixel
    wave: Tensor  #: derivative with respect to the wavelength, per m
    blur: Tensor  #: derivative with respect to the variance of the line, per m^2


def line_moves(pupil: Pupil, spot: Tensor, wavelength: Tensor, lens: Lens, fwhm: Tensor) -> Moves:
    """Return the pattern of `line_pattern` and its derivatives, for a spot in pixels; no gradient
    flows through the result.

    The derivatives with respect to wavelength and variance are means over the Gaussian line as
    well (integration by parts).
    """
    line_width = fwhm.clamp_min(_NARROW_WIDTH)
    sigma, sums = deviation(line_width), [torch.zeros(1)] * 5
    for offset, share in zip(*_parts(line_width), strict=True):
        pattern, down, right = _moves(pupil, spot, wavelength + offset * sigma, lens)
        contributions = (
            share * pattern,
            share * down,
            share * right,
            share * offset / sigma * pattern,
        )
        # the means of the pattern times the Hermite polynomials t and t^2 - 1 are, but for a
        # factor, its derivatives with respect to wavelength and variance
        blur = share * (offset * offset - 1.0) / (2.0 * sigma.square()) * pattern
        sums = [
            total.to(contribution) + contribution
            for total, contribution in zip(sums, (*contributions, blur), strict=True)
        ]
    return Moves(*sums)


def _moves(
    pupil: Pupil, spot: Tensor, wavelength: Tensor, lens: Lens
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the pattern of one wavelength, and its derivatives with respect to y and x of the
    spot, per pixel.
    """
    field, turns_per_pixel = _field(pupil, wavelength), _reach(pupil, wavelength, lens)
    row_factor, column_factor = (_turns(n, turns_per_pixel, field) for n in field.shape)
    window, spot_place = _Window.of(lens, field, turns_per_pixel), (spot[0], spot[1])
    row_phasors, column_phasors = (
        _axis(window.places[i], turns_per_pixel, spot[i], field, i) for i in (0, 1)
    )
    amplitude_and_slope = field @ torch.cat([column_phasors, column_factor * column_phasors]).T
    amplitude, right_slope = (row_phasors @ amplitude_and_slope).chunk(2, dim=1)
    down_slope = (row_factor * row_phasors) @ amplitude_and_slope[:, : len(column_phasors)]
    light = window.seen(
        amplitude.real.square() + amplitude.imag.square(), spot_place, turns_per_pixel
    )
    # derivative of |a|^2 = 2 Re(conj(a) a'); the 2 is applied below
    by_pixel = [
        window.seen(
            amplitude.real * slope.real + amplitude.imag * slope.imag, spot_place, turns_per_pixel
        )
        for slope in (down_slope, right_slope)
    ]
    share = _share(pupil, wavelength, turns_per_pixel).to(light)
    return share * light, 2 * share * by_pixel[0], 2 * share * by_pixel[1]


def grid_patterns(
    pupil: Pupil, down: Tensor, right: Tensor, wavelength: Tensor, lens: Lens
) -> Tensor:
    """Return the patterns (row, column, y, x) of one wavelength for spots on a grid with the rows
    ``down`` and the columns ``right``, in pixels.
    """
    field, turns_per_pixel = _field(pupil, wavelength), _reach(pupil, wavelength, lens)
    window = _Window.of(lens, field, turns_per_pixel)
    # the phasors of all spots are stacked, so that one product gives all patterns
    row_phasors = torch.cat(
        [_axis(window.places[0], turns_per_pixel, place, field, 0) for place in down]
    )
    column_phasors = torch.cat(
        [_axis(window.places[1], turns_per_pixel, place, field, 1) for place in right]
    )
    amplitude = row_phasors @ (field @ column_phasors.T)
    light = amplitude.real.square() + amplitude.imag.square()
    row_count, column_count = (len(places) for places in window.places)
    patterns = [
        torch.stack(
            [
                window.seen(columns_of_spot, (y, x), turns_per_pixel)
                for x, columns_of_spot in zip(
                    right, torch.split(light_of_row, column_count, 1), strict=True
                )
            ]
        )
        for y, light_of_row in zip(down, torch.split(light, row_count), strict=True)
    ]
    return _share(pupil, wavelength, turns_per_pixel).to(light) * torch.stack(patterns)


def _field(pupil: Pupil, wavelength: Tensor) -> Tensor:
    """Return the complex field in the pupil; its phases are reduced to one turn in float64."""
    index = index_at(wavelength, pupil)
    turns = (index * pupil.height.double() + pupil.path.double()) / wavelength
    kind = torch.promote_types(pupil.height.dtype, pupil.path.dtype)
    return torch.polar(pupil.amplitude.to(kind), _radians(turns).to(kind))


def _axis(places: Tensor, reach: Tensor, spot: Tensor, field: Tensor, dim: int) -> Tensor:
    """Return the Fourier matrix (place, sample) along one axis, for a spot at ``spot`` pixels."""
    turns = reach * (places - spot)[:, None] * centred(field.shape[dim], field.device)
    angle = -_radians(turns).to(field.real)
    return torch.polar(torch.ones_like(angle), angle)


def _within(pixels: Tensor, spot: Tensor, reach: Tensor) -> Tensor:
    """Return True for pixels within half the alias-free field from the spot."""
    distance_in_fields: Tensor = ((pixels - spot) * reach).abs()
    return distance_in_fields <= 0.5 * (1 + 1e-9)


def _radians(turns: Tensor) -> Tensor:
    """Return an angle in turns as radians between -pi and pi; the derivative is that of the full
    angle.
    """
    return (2.0 * math.pi) * (turns - turns.detach().round())


def index_at(wavelength: Tensor, pupil: Pupil) -> Tensor:
    """Return the refractive index of the mask at a wavelength, by cubic interpolation between the
    four nearest bands (lower degree for fewer bands).
    """
    wavelengths, values = pupil.wavelengths.to(wavelength), pupil.index.to(wavelength)
    count = min(4, len(wavelengths))
    first = int(
        torch.searchsorted(wavelengths.detach(), wavelength.detach()).clamp(
            count // 2, len(wavelengths) - count + count // 2
        )
    )
    near_wavelengths, near_values = (
        x[first - count // 2 : first - count // 2 + count] for x in (wavelengths, values)
    )
    index = torch.zeros_like(wavelength)
    for i in range(count):
        others = [j for j in range(count) if j != i]
        # Lagrange interpolation
        factors = [
            (wavelength - near_wavelengths[j]) / (near_wavelengths[i] - near_wavelengths[j])
            for j in others
        ]
        index = index + near_values[i] * (torch.stack(factors).prod() if factors else 1.0)
    return index


def interpolated(place: Tensor, places: Tensor, values: Tensor) -> Tensor:
    """Return values (row,) at one place, by linear interpolation between places in rising order,
    and linear extrapolation beyond them.
    """
    if len(places) == 1:
        return values[:, 0] + 0.0 * place
    upper = int(torch.searchsorted(places.detach(), place.detach()).clamp(1, len(places) - 1))
    share = (place - places[upper - 1]) / (places[upper] - places[upper - 1])
    return values[:, upper - 1] * (1.0 - share) + values[:, upper] * share


def response_at(wavelength: Tensor, responses: Tensor, bands: Bands) -> Tensor:
    """Return the response of each channel at a wavelength: (channel,), linear between the
    centres of the bands.
    """
    return interpolated(
        wavelength, bands.centres.to(wavelength), responses.to(wavelength)
    ).clamp_min(0.0)
