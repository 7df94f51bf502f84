"""A camera and its lasers in NumPy alone, which shares no line with what it judges: direct sums,
own noise, own scenes.

The field in the pupil is summed over all samples for each row and column of pixels. A scene is
three smooth spectra, mixed by the colours of a picture; a lamp has a spectrum over all bands.
Photons are Poisson, the converter rounds down.
"""

from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.signal import fftconvolve

FOCAL, PITCH, DIAMETER, SAMPLES = 0.11, 2.9e-6, 11e-3, 256
BANDS = np.linspace(400e-9, 700e-9, 31)
WELL, READ, GAIN, OFFSET, BITS = 25500.0, 6.0, 0.5, 60.0, 16  # e-, e-, DN/e-, e-
#: centre, sd, height of a channel
PEAKS = np.array([[600e-9, 42e-9, 1.0], [540e-9, 45e-9, 1.0], [455e-9, 32e-9, 0.9]])
SAMPLE = Path(__file__).parents[4] / "recipes" / "samples" / "china.jpg"


def silica(wavelength):
    """Refractive index of fused silica minus 1 (Malitson 1965)."""
    um2 = (np.asarray(wavelength) * 1e6) ** 2
    terms = ((0.6961663, 0.0684043), (0.4079426, 0.1162414), (0.8974794, 9.896161))
    return np.sqrt(1 + sum(a * um2 / (um2 - b**2) for a, b in terms)) - 1


def response(wavelength):
    """Relative response of red, green and blue: (channel, ...)."""
    each = [h * np.exp(-0.5 * ((np.asarray(wavelength) - c) / s) ** 2) for c, s, h in PEAKS]
    return np.stack(
        [
            0.98 * e + 0.02 * np.exp(-0.5 * ((np.asarray(wavelength) - 560e-9) / 80e-9) ** 2)
            for e in each
        ]
    )


def daylight(wavelength):
    """A smooth illuminant, relative power."""
    t = (np.asarray(wavelength) - 550e-9) / 150e-9
    return 1.0 - 0.15 * t - 0.2 * t**2


def band_response():
    """The response, averaged over each band of 10 nm."""
    fine = np.linspace(-5e-9, 5e-9, 21)
    return response(BANDS[:, None] + fine).mean(-1)


@lru_cache
def pupil(mask):
    """Aperture and height in metres, on a grid of the aperture's width."""
    at = (np.arange(SAMPLES) - (SAMPLES - 1) / 2) * (DIAMETER / SAMPLES)
    v, u = np.meshgrid(at, at, indexing="ij")
    r = np.hypot(v, u) / (DIAMETER / 2)
    inside = (r <= 1).astype(float)
    wave = 550e-9 / silica(550e-9)
    height = {
        "plain": 0 * r,
        "half_ring": 10 * wave * r * np.sign(u),
        "axicon": 8 * wave * r,
        "cubic": 6 * wave * (v**3 + u**3) / (DIAMETER / 2) ** 3,
    }[mask]
    return inside, height * inside


def pattern(mask, wavelength, spot, shape):
    """Share of the clear pupil's light in each pixel; ``spot`` is in pixels from the middle
    pixel.
    """
    inside, height = pupil(mask)
    field = inside * np.exp(2j * np.pi * silica(wavelength) * height / wavelength)
    reach = DIAMETER / SAMPLES * PITCH / (wavelength * FOCAL)
    at = np.arange(SAMPLES) - (SAMPLES - 1) / 2
    rows, columns = (
        np.exp(-2j * np.pi * reach * np.outer(np.arange(n) - n // 2 - s, at))
        for n, s in zip(shape, spot, strict=True)
    )
    return np.abs(rows @ field @ columns.T) ** 2 * reach**2 / (inside**2).sum()


def line(mask, wavelength, fwhm, spot, shape):
    """The pattern of a Gaussian line, by the midpoints of equally likely parts."""
    if fwhm == 0:
        return pattern(mask, wavelength, spot, shape)
    from scipy.stats import norm

    offsets = norm.ppf((np.arange(7) + 0.5) / 7) * fwhm / 2.3548
    return np.mean([pattern(mask, wavelength + o, spot, shape) for o in offsets], 0)


@lru_cache
def scene_psf(mask, side):
    """The PSF of every band in a window of ``side`` pixels."""
    return np.stack([pattern(mask, w, (0, 0), (side, side)) for w in BANDS]).astype(np.float32)


def clear_peak(wavelength):
    """The brightest pixel behind the clear lens."""
    inside, _ = pupil("plain")
    return (inside.sum() * DIAMETER / SAMPLES * PITCH / (wavelength * FOCAL)) ** 2 / (
        inside**2
    ).sum()


@dataclass
class Laser:
    spot: tuple[float, float]  #: pixels from the middle
    wavelength: float
    #: times the full well, at the peak behind the clear lens, in a channel of response 1
    strength: float
    fwhm: float = 1e-9

    def electrons(self, mask, shape):
        scale = self.strength * WELL / clear_peak(self.wavelength) * response(self.wavelength)
        return scale[:, None, None] * line(mask, self.wavelength, self.fwhm, self.spot, shape)

    @property
    def channels(self):
        """Electrons of each channel in all pixels behind the clear lens."""
        return self.strength * WELL / clear_peak(self.wavelength) * response(self.wavelength)


@dataclass
class Frame:
    electrons: np.ndarray
    clipped: np.ndarray
    lasers: list = field(default_factory=list)


def picture(kind, side, rng):
    """A picture of ``side`` pixels in linear colours (y, x, 3), mean about 0.3."""
    if kind == "sample":
        from PIL import Image

        whole = np.asarray(Image.open(SAMPLE).convert("RGB"), float) / 255
        y, x = (int(rng.integers(0, n - side + 1)) for n in whole.shape[:2])
        return whole[y : y + side, x : x + side] ** 2.2
    if kind == "leaves":
        y, x = np.mgrid[:side, :side]
        found = np.full((side, side, 3), 0.3)
        for _ in range(220):
            r = 3 * (1 - rng.random() * 0.995) ** -0.7
            cy, cx = rng.random(2) * side
            grey, tint = rng.random(), rng.normal(0, 0.12, 3)
            found[(y - cy) ** 2 + (x - cx) ** 2 < r**2] = np.clip(grey + tint * grey, 0.01, 1)
        return found
    noise = rng.normal(size=(side, side, 3)) * 0.25 + rng.normal(size=(side, side, 1))
    f = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.fftfreq(side)) + 1 / side
    smooth = np.fft.ifft2(np.fft.fft2(noise, axes=(0, 1)) * (f**-1.5)[:, :, None], axes=(0, 1)).real
    return np.exp(0.5 * smooth / smooth.std()) * 0.3


def irradiance(mask, kind, side, rng, lamps=0, lamp_strength=30.0):
    """Electrons (channel, y, x) of a scene with lamps, with the brightest pixel of the scene at
    0.7 full wells.
    """
    rim = side // 2
    whole = picture(kind, side + 2 * rim, rng)
    basis = np.stack([np.exp(-0.5 * ((BANDS - c) / 45e-9) ** 2) for c in (610e-9, 545e-9, 460e-9)])
    basis /= basis.sum(0) + 0.05
    photons = daylight(BANDS) * BANDS
    psf = scene_psf(mask, 2 * rim + 1)
    weight = band_response() * photons  # (channel, band)
    found = np.zeros((len(weight), side, side))
    for k in range(3):
        kernels = np.tensordot(weight * basis[k], psf, 1)
        found += fftconvolve(whole[None, :, :, k], kernels, "valid", axes=(1, 2))[:, :side, :side]
    found *= 0.7 * WELL / found.max()
    for _ in range(lamps):
        warm = np.exp(rng.uniform(-1.0, 1.0) * (BANDS - 550e-9) / 150e-9)
        spot = tuple(rng.uniform(-0.4, 0.4, 2) * side)
        weight = band_response() * BANDS * warm
        peak = np.tensordot(weight, scene_psf("plain", 3), 1).max()
        # between pixels, and as far as the frame reaches
        kernels = np.tensordot(
            weight, np.stack([pattern(mask, w, spot, (side, side)) for w in BANDS]), 1
        )
        found += lamp_strength * WELL * 10 ** rng.uniform(-1, 1) / peak * kernels
    return found


def digitized(light, rng):
    """The frame of a mean number of electrons: electrons above the offset, and the clipped
    pixels.
    """
    charge = rng.poisson(np.minimum(light, 1e9)) + rng.normal(0, READ, light.shape) + OFFSET
    number = np.floor(np.clip(charge, 0, WELL) * GAIN)
    most = min(np.floor(WELL * GAIN), 2**BITS - 1)
    return np.maximum(number, 0) / GAIN - OFFSET, number >= most - 1


def frame(mask, kind, side, lasers, rng, lamps=0):
    """One frame of a scene with lasers and lamps."""
    light = irradiance(mask, kind, side, rng, lamps)
    for laser in lasers:
        light = light + laser.electrons(mask, (side, side))
    electrons, clipped = digitized(light, rng)
    return Frame(electrons, clipped, list(lasers))
