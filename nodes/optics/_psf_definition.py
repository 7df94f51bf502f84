"""The PSF from its definition: a direct sum over all pupil samples for each pixel in float64,
without the code of the fast transforms.

Phases are in turns, reduced to between -1/2 and 1/2. Autograd differentiates the sums, so that the
reference of the gradient is independent too.
"""

import math
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from neusee.nodes.values import Psf, Pupil

SensorSampling = Literal["point", "integrated", "point_as_printed"]


class Geometry(NamedTuple):
    """The geometry of lens, sensor and source, in metres, radians and pixels."""

    focal_length: float
    pixel_pitch: float
    shape: tuple[int, int]
    angle: tuple[float, float] = (0.0, 0.0)
    pixel: str = "point"
    sensor: str = "point"


def by_definition(pupil: Pupil, camera: Geometry) -> Psf:
    """Return the PSF of a pupil in float64, by one matrix of phases for each axis, band by band."""
    screens = {"height": pupil.height.new_zeros(()), "path": pupil.path.new_zeros(())}
    clear_pupil = pupil._replace(
        amplitude=pupil.aperture.detach(), notches=pupil.notches[:0], **screens
    )
    on_axis = camera._replace(shape=(1, 1), angle=(0.0, 0.0))
    band_numbers = range(len(pupil.wavelengths))
    peaks = [_intensity(clear_pupil, on_axis, band)[0, 0] for band in band_numbers]
    point_peaks = [
        _intensity(clear_pupil, on_axis._replace(sensor="point"), band)[0, 0]
        for band in band_numbers
    ]
    # peak of a point-sampled PSF = pupil area / (wavelength x f / pixel)^2 = pi / 4 x cut-off^2
    cut_off = (torch.stack(point_peaks) * (4 / math.pi)).sqrt()
    side = 1.0 if camera.sensor == "integrated" else 0.0
    sides = torch.full_like(cut_off, side)
    return Psf(
        torch.stack([_intensity(pupil, camera, band) for band in band_numbers]),
        torch.stack(peaks),
        cut_off,
        sides,
    )


def _intensity(pupil: Pupil, camera: Geometry, band: int) -> Tensor:
    """Return the share of the clear pupil's light in each pixel (y, x), averaged over points
    within the pixel.
    """
    wavelength, index = float(pupil.wavelengths[band]), float(pupil.index[band])
    amplitude = pupil.amplitude.double()
    turns = _without_whole_turns(
        pupil.height.double() * (index / wavelength)
    ) + _without_whole_turns(pupil.path.double() / wavelength)
    field = amplitude * torch.exp(2j * math.pi * _without_whole_turns(turns))
    # turns of phase per pupil sample and pixel
    turns_per_sample = float(pupil.pitch) * camera.pixel_pitch / (wavelength * camera.focal_length)
    total = amplitude.new_zeros(camera.shape)
    points = (
        _pixel_points(turns_per_sample * max(field.shape))
        if camera.sensor == "integrated"
        else [(0.0, 1.0)]
    )
    for y, weight_y in points:
        for x, weight_x in points:
            rows, columns = (
                _phasors_along(camera, axis, shift, field.shape[axis], turns_per_sample)
                for axis, shift in ((0, y), (1, x))
            )
            total = total + weight_y * weight_x * (rows @ field @ columns.T).abs().square()
    light: Tensor = total * (turns_per_sample**2 / pupil.aperture.detach().double().square().sum())
    for centre, width, depth in pupil.notches.tolist():
        light = light * (1.0 - depth * 2.0 ** (-((2.0 * (wavelength - centre) / width) ** 2)))
    return light


def _phasors_along(camera: Geometry, axis: int, shift: float, samples: int, reach: float) -> Tensor:
    """Return the phasors (pixel, sample) along one axis, with the sinc envelope of square pupil
    pixels.
    """
    spot = camera.focal_length * camera.angle[axis] / camera.pixel_pitch
    pixels = (
        torch.arange(camera.shape[axis], dtype=torch.float64)
        - camera.shape[axis] // 2
        + (shift - spot)
    )
    sample = torch.arange(samples, dtype=torch.float64) - (samples - 1) / 2
    phasors = torch.exp(-2j * math.pi * _without_whole_turns(reach * pixels[:, None] * sample))
    return phasors * torch.sinc(reach * pixels)[:, None] if camera.pixel == "zoh" else phasors


def _without_whole_turns(turns: Tensor) -> Tensor:
    """Return the phase without whole turns; the gradient passes through unchanged."""
    return turns - turns.detach().round()


def _pixel_points(fringes: float) -> list[tuple[float, float]]:
    """Return Gauss-Legendre points across a pixel and weights, exact to 1e-9 for ``fringes``
    turns per pixel.
    """
    import numpy as np

    nodes, weights = np.polynomial.legendre.leggauss(10 + math.ceil(4 * fringes))
    return list(zip((nodes / 2).tolist(), (weights / 2).tolist(), strict=True))
