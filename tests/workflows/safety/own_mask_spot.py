"""The spot of a laser behind a mask over the distance, without a line of the project: a fine pupil
and its transforms.

A Gaussian beam of the radius w (1/e2) and the wavefront radius R meets a lens that is focused at
infinity, behind a mask of the height h and the index n. For each watt of the laser the sensor has

    E(x) = tau / (lambda f)^2 |sum U exp(-2 pi i x u / (lambda f))|^2 du^4
    U(u) = sqrt(2 / (pi w^2)) exp(-u^2 / w^2 + i pi u^2 / (lambda R) + 2 pi i (n - 1) h(u) / lambda)

Samples at the rim count with their share inside the circle. The mean over a pixel is the sum of the
autocorrelation of U, times the sinc of the pixel, over its frequencies.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

Floats = NDArray[np.float64]
PLANCK_LIGHT = 6.62607015e-34 * 299792458.0


@dataclass(frozen=True)
class Mask:
    """A mask: its height in metres over (v, u) in radii of the lens, and its steepest slope."""

    height: Callable[[Floats, Floats], Floats]
    slope: float  # wavelengths of 550 nm and fused silica from the axis to the rim


@dataclass(frozen=True)
class Setting:
    """A laser, a lens, a mask and a sensor, in SI units."""

    wavelength: float
    divergence: float  # full angle at 1/e2
    waist: float
    focal_length: float
    diameter: float
    transmittance: float
    pixel: float
    shape: tuple[int, int]
    mask: Mask


def fused_silica(wavelength: float) -> float:
    """Return n - 1 of fused silica (Malitson 1965)."""
    square = (wavelength * 1e6) ** 2
    terms = ((0.6961663, 0.0684043), (0.4079426, 0.1162414), (0.8974794, 9.896161))
    return (
        math.sqrt(1 + sum(strength * square / (square - line**2) for strength, line in terms)) - 1
    )


def axicon(waves: float) -> Mask:
    """Return an axicon of a number of waves of 550 nm at the rim."""
    wave = 550e-9 / fused_silica(550e-9)
    return Mask(lambda v, u: waves * wave * np.hypot(v, u), waves)


def vortex(charge: float) -> Mask:
    """Return a vortex of a charge at 550 nm. Its slope is that of a ring at a tenth of the
    radius.
    """
    wave = 550e-9 / fused_silica(550e-9)
    return Mask(
        lambda v, u: charge * wave * np.arctan2(v, u) / (2 * math.pi), charge / (2 * math.pi * 0.1)
    )


def five_half_rings(waves: tuple[float, ...] = (12, 18, 24, 30, 36)) -> Mask:
    """Return half-rings of equal area, each a rising cone on one side and a falling one on the
    other, in turns.
    """
    wave = 550e-9 / fused_silica(550e-9)

    def height(v: Floats, u: Floats) -> Floats:
        radius = np.hypot(v, u)
        ring = np.minimum((radius**2 * len(waves)).astype(int), len(waves) - 1)
        side = np.where(u >= 0, 1.0, -1.0) * np.where(ring % 2 == 0, 1.0, -1.0)
        return np.asarray(waves, float)[ring] * wave * radius * side

    return Mask(height, max(waves))


def smooth_random(seed: int, waves: float, terms: int = 12) -> Mask:
    """Return cosines of up to 2 periods a radius on a plate; their steepest slope stays below
    `waves` a radius.
    """
    draw = np.random.default_rng(seed)
    waviness = draw.uniform(-2, 2, (terms, 2))
    phase = draw.uniform(0, 2 * math.pi, terms)
    size = draw.uniform(0.5, 1, terms)
    steepest = float(np.sum(size * np.hypot(*waviness.T))) * 2 * math.pi
    scale = waves * 550e-9 / fused_silica(550e-9) / steepest

    def height(v: Floats, u: Floats) -> Floats:
        turns = (
            2
            * math.pi
            * (np.multiply.outer(waviness[:, 0], v) + np.multiply.outer(waviness[:, 1], u))
        )
        waves_of_terms = np.cos(turns + phase[:, None, None])
        return scale * (size.sum() + np.tensordot(size, waves_of_terms, 1))

    return Mask(height, waves)


def beam_at(setting: Setting, metres: float) -> tuple[float, float]:
    """Return the radius and the curvature of the wavefront at a distance."""
    rayleigh = 2 * setting.waist / setting.divergence
    return math.hypot(setting.waist, setting.divergence * metres / 2), metres / (
        metres**2 + rayleigh**2
    )


def blur(setting: Setting, metres: float) -> float:
    """Return the radius of the geometric spot in units of the wavelength times the f-number."""
    _, curvature = beam_at(setting, metres)
    waves = setting.diameter**2 * curvature / (8 * setting.wavelength)
    return 4 * waves + 2 * setting.mask.slope * 550e-9 / setting.wavelength


def samples_for(setting: Setting, metres: float, reach: float = 0.0) -> int:
    """Return samples across the lens that carry the spot and `reach` (wavelength times f-number)
    with room.
    """
    return max(384, int(fft.next_fast_len(int(2.6 * max(blur(setting, metres), reach) + 128))))


def pupil(setting: Setting, metres: float, samples: int) -> NDArray[np.complex128]:
    """Return the complex field behind the mask for each watt, sqrt(W) / m."""
    width, curvature = beam_at(setting, metres)
    line = (np.arange(samples) - (samples - 1) / 2) * 2 / samples
    v, u = np.meshgrid(line, line, indexing="ij", sparse=True)
    inside = np.clip((1 - np.hypot(v, u)) * samples / 2 + 0.5, 0, 1)
    square = (v**2 + u**2) * (setting.diameter / 2) ** 2
    path = square * curvature / 2 + fused_silica(setting.wavelength) * setting.mask.height(v, u)
    amplitude = math.sqrt(2 / math.pi) / width * np.exp(-square / width**2) * inside
    return amplitude * np.exp(2j * math.pi * path / setting.wavelength)


def point_gain(setting: Setting, samples: int) -> float:
    """Return the irradiance of a sum of 1 over the samples of the pupil."""
    pitch = setting.diameter / samples
    return setting.transmittance * pitch**4 / (setting.wavelength * setting.focal_length) ** 2


def zoomed(field: NDArray[np.complex128], rows: Floats, columns: Floats) -> Floats:
    """Return |sum field exp(-2 pi i ...)|^2 at frequencies in cycles a sample."""
    index = np.arange(len(field))
    left = np.exp(-2j * math.pi * np.outer(rows, index))
    right = np.exp(-2j * math.pi * np.outer(index, columns))
    return np.abs(left @ field @ right) ** 2


def peak(setting: Setting, metres: float, samples: int | None = None) -> float:
    """Return the highest irradiance at a point of the sensor's plane for each watt of the laser
    (1/m2).
    """
    samples = samples or samples_for(setting, metres)
    field = pupil(setting, metres, samples)
    light = np.abs(fft.fft2(field, (2 * samples, 2 * samples))) ** 2
    highest = 0.0
    for place in np.argpartition(light.ravel(), -6)[-6:]:
        row, column = np.divmod(place, 2 * samples) / np.float64(2 * samples)
        step = 0.5 / samples
        for _ in range(3):
            near = np.linspace(-1, 1, 9) * step
            values = zoomed(field, row + near, column + near)
            i, j = np.unravel_index(values.argmax(), values.shape)
            row, column, step = row + near[i], column + near[j], step / 4
            highest = max(highest, float(values[i, j]))
    return highest * point_gain(setting, samples)


def clear_peak(setting: Setting, metres: float) -> float:
    """Return the peak of the focused lens without a mask for each watt, from the closed form."""
    width, _ = beam_at(setting, metres)
    fill = (setting.diameter / (2 * width)) ** 2
    mean = -math.expm1(-fill) / fill * math.pi * setting.diameter**2 / 4
    return (
        setting.transmittance
        * 2
        / (math.pi * width**2)
        * (mean / (setting.wavelength * setting.focal_length)) ** 2
    )


def pixels(setting: Setting, metres: float, samples: int | None = None) -> Floats:
    """Return the irradiance of each pixel for each watt, without scatter; the axis is in the
    middle of a pixel.
    """
    unit = setting.wavelength * setting.focal_length / setting.diameter
    samples = samples or samples_for(
        setting, metres, 0.5 * math.hypot(*setting.shape) * setting.pixel / unit
    )
    size = 2 * samples
    spectrum = fft.fft2(pupil(setting, metres, samples), (size, size))
    lags = np.rint(fft.fftfreq(size, 1 / size))
    scale = setting.pixel / (unit * samples)  # cycles of a lag of one sample over a pixel
    smear = np.sinc(scale * lags)
    pairs = fft.ifft2(np.abs(spectrum) ** 2, overwrite_x=True) * smear[:, None] * smear
    left, right = (
        np.exp(-2j * math.pi * scale * np.outer(np.arange(count) - count // 2, lags))
        for count in setting.shape
    )
    return (left @ pairs @ right.T).real * point_gain(setting, samples)


def scattered(setting: Setting, metres: float, share: float = 0.005, width: float = 0.01) -> Floats:
    """Return the veil of Harvey and Shack of the slope -1.5 in each pixel for each watt."""
    radius, _ = beam_at(setting, metres)
    through = setting.transmittance * -math.expm1(-(setting.diameter**2) / (2 * radius**2))
    y, x = (np.arange(count) - count // 2 for count in setting.shape)
    sine = np.hypot(y[:, None], x) * setting.pixel / setting.focal_length
    total = 2 * math.pi * ((width**2 + 1) ** 0.25 - width**0.5) / (width**-1.5 * 0.5)
    return through * share / total * (1 + (sine / width) ** 2) ** -0.75 / setting.focal_length**2


def faintest_of(light: Floats, share: float) -> float:
    """Return the light of the faintest pixel among a share of the brightest."""
    rank = math.ceil(share * light.size - 1e-9)
    return float(np.sort(light, axis=None)[-rank])


def levels(
    setting: Setting, metres: float, share: float, samples: int | None = None
) -> tuple[float, float]:
    """Return the light of that pixel for each watt, without scatter and with half a per cent."""
    core = pixels(setting, metres, samples)
    return faintest_of(core, share), faintest_of(0.995 * core + scattered(setting, metres), share)


def saturation(
    wavelength: float, pixel: float, efficiency: float, well: float, exposure: float
) -> float:
    """Return the irradiance that fills a pixel (W/m2)."""
    return well * PLANCK_LIGHT / wavelength / (efficiency * pixel**2 * exposure)
