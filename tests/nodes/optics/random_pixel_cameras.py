"""Random cameras whose PSF is averaged over pixels: drawn from a seed, and compared with
separate code.
"""

from typing import NamedTuple

import numpy as np
import torch

from neusee.nodes.optics import psf
from neusee.nodes.values import Pupil
from tests.nodes.optics import own_pixel_average as own

FOCAL = 0.05  #: m
LARGEST = 420  #: samples a side of the pupil, so that 300 cameras take minutes


class Camera(NamedTuple):
    """A camera drawn from a seed."""

    seed: int
    number: float
    pixel: float
    wavelength: float
    samples: tuple[int, int]
    shape: tuple[int, int]
    spot: tuple[float, float]  #: pixels
    square: bool  #: pupil samples
    rough: float  #: m of height

    @property
    def alpha(self):
        """Turns for each sample and pixel."""
        return self.pixel / (self.number * self.samples[0] * self.wavelength)


def drawn(seed):
    """A camera from f/1.2 to f/32, 1 to 20 um and 355 to 1600 nm, or None where its samples
    cannot carry a window.
    """
    rng = np.random.default_rng(seed)
    ranges = ((1.2, 32), (1e-6, 20e-6), (355e-9, 1.6e-6))
    number, pixel, wavelength = (
        float(np.exp(rng.uniform(np.log(low), np.log(high)))) for low, high in ranges
    )
    side = int(rng.integers(40, LARGEST + 1))
    samples = (side, side - int(rng.integers(0, 3)) if rng.random() < 0.3 else side)
    period = number * samples[0] * wavelength / pixel  # pixels after which the PSF repeats
    spot = tuple(float(x) for x in rng.uniform(-1, 1, 2) * rng.choice([0.0, 0.5, 2.0]))
    most = int(period - 2 * max(abs(x) for x in spot)) - 1
    shape = tuple(int(n) for n in np.ceil(rng.uniform(0.05, 1.2, 2) * period))
    if max(shape) > most or max(shape) > 600:
        return None
    # more fringes a pixel need too many points
    square = bool(rng.random() < 0.2) and samples[0] < 3 * period
    return Camera(
        seed,
        number,
        pixel,
        wavelength,
        samples,
        shape,
        spot,
        square,
        float(rng.choice([0.0, 5e-8, 5e-7])),
    )


def pupil_of(camera):
    """The pupil of a camera, as wide as its grid along v."""
    rng = np.random.default_rng(camera.seed + 10**6)
    clear = torch.from_numpy(own.disc(*camera.samples)).float()
    height = torch.from_numpy(camera.rough * rng.random(camera.samples)).float()
    one = torch.tensor([camera.wavelength], dtype=torch.float64)
    pitch = torch.tensor(FOCAL / camera.number / camera.samples[0], dtype=torch.float64)
    return Pupil(clear, clear, height, 0 * clear, own.SILICA + 0 * one, one, pitch)


def found(camera, precision="single"):
    """The PSF of the node."""
    return psf(
        pupil_of(camera),
        focal_length=FOCAL,
        pixel_pitch=camera.pixel,
        shape=camera.shape,
        angle=tuple(x * camera.pixel / FOCAL for x in camera.spot),
        pixel="zoh" if camera.square else "point",
        sensor="integrated",
        precision=precision,
    )


def energy(camera):
    """The light in the window, as a share of that of the pupil."""
    return float(found(camera).intensity.sum(dtype=torch.float64))


def compared(camera):
    """The largest difference from separate double-precision code, relative to the peak of the
    clear lens.
    """
    pupil = pupil_of(camera)
    phase = own.SILICA * pupil.height.double().numpy() / camera.wavelength
    clear = pupil.aperture.double().numpy()
    light = float((clear**2).sum())
    field = clear * np.exp(2j * np.pi * phase)
    own_psf = own.by_points if camera.square else own.averaged
    peak = own_psf(clear + 0j, light, camera.alpha, (1, 1))[0, 0]
    expected = own_psf(field, light, camera.alpha, camera.shape, camera.spot)
    return float(np.abs(found(camera).intensity[0].double().numpy() - expected).max() / peak)
