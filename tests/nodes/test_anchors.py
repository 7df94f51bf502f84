"""Suppression figures that were computed elsewhere, and the two bounds that no phase mask beats.

A pupil of 2160 x 2160 samples, 8.078 mm across, f = 0.11 m, 2.9 um pixels sampled at their centres,
one of them on the axis, window 1024 x 1024. LSR is the peak over the peak of the clear pupil.
"""

import functools
import math

import pytest
import torch

from neusee.nodes import doe, optics
from neusee.nodes.values import Bands

STOP = optics.stop(samples=2160, pitch=3.74e-6, diameter=8.0784e-3)
SMALL = optics.stop(samples=32, pitch=1e-5, diameter=3.2e-4)
CAMERA = {"focal_length": 0.11, "pixel_pitch": 2.9e-6}
AREA = math.pi * (2160 * 3.74e-6) ** 2 / 4  #: m2, of the pupil
slow = pytest.mark.slow


def psf(height, wavelength, window=1024):
    centre = torch.tensor([wavelength], dtype=torch.float64)
    bands = Bands(centre, torch.full_like(centre, 1e-9), torch.ones_like(centre))
    pupil = optics.pupil(height, doe.material(bands), bands, STOP)
    return optics.psf(pupil, **CAMERA, shape=(window, window))


def lsr(height, wavelength=550e-9):
    spread = psf(height, wavelength)
    return float(spread.intensity.amax() / spread.clear_peak)


MASKS = [
    pytest.param(doe.vortex, {"charge": 1}, 0.2587, marks=slow),
    pytest.param(doe.vortex, {"charge": 2}, 0.1462),
    pytest.param(doe.vortex, {"charge": 4}, 0.0715, marks=slow),
    pytest.param(doe.vortex, {"charge": 8}, 0.0301, marks=slow),
    pytest.param(doe.axicon, {"waves": 5.0}, 8.78e-3, marks=slow),
    pytest.param(doe.axicon, {"waves": 10.0}, 4.41e-3),
    pytest.param(doe.axicon, {"waves": 20.0}, 2.23e-3, marks=slow),
    pytest.param(doe.axicon, {"waves": 40.0}, 1.12e-3, marks=slow),
    pytest.param(doe.half_rings, {"waves": (10.0,)}, 2.05e-2, marks=slow),
    pytest.param(doe.half_rings, {"waves": (20.0,)}, 1.02e-2),
    pytest.param(doe.half_rings, {"waves": (40.0,)}, 5.17e-3, marks=slow),
    pytest.param(doe.half_rings, {"waves": (12.0, 18.0, 24.0, 30.0, 36.0)}, 1.48e-3),
    pytest.param(doe.half_rings, {"waves": (16.0, 28.0, 40.0, 52.0, 64.0)}, 1.22e-3, marks=slow),
]


@pytest.mark.parametrize(("mask", "params", "wanted"), MASKS)
def test_mask_suppresses_as_computed_elsewhere(mask, params, wanted):
    assert lsr(mask(STOP, **params)) == pytest.approx(wanted, rel=0.03)


@functools.cache
def five_half_rings():
    return doe.half_rings(STOP, waves=(12.0, 18.0, 24.0, 30.0, 36.0))


@pytest.mark.parametrize(
    ("wavelength", "deep", "wrapped"),
    [
        pytest.param(400e-9, 1.10e-3, 4.12e-2, marks=slow),
        pytest.param(500e-9, 1.46e-3, 4.97e-3, marks=slow),
        pytest.param(600e-9, 1.93e-3, 1.39e-2, marks=slow),
        (700e-9, 2.28e-3, 8.07e-2),
    ],
)
def test_wrapping_at_one_wave_costs_the_other_colours(wavelength, deep, wrapped):
    """Fused silica, height designed at 550 nm: unwrapped, and wrapped to one wave at 550 nm."""
    assert lsr(five_half_rings(), wavelength) == pytest.approx(deep, rel=0.03)
    thin = doe.fabricate(five_half_rings(), wrap_at=550e-9)
    assert lsr(thin, wavelength) == pytest.approx(wrapped, rel=0.03)


@pytest.mark.parametrize(
    ("wavelength", "floor"), [(400e-9, 1.07e-6), (550e-9, 2.02e-6), (700e-9, 3.28e-6)]
)
def test_energy_floor_of_the_full_sensor(wavelength, floor):
    """Spread evenly over S, light leaves 1 / (pixels * clear peak) = 4 lambda2 f2 / (pi D2 S) of
    the peak.
    """
    clear = psf(torch.zeros(2160, 2160), wavelength, window=8)
    assert 1 / (2048**2 * float(clear.clear_peak)) == pytest.approx(floor, rel=0.005)
    assert float(clear.intensity[0, 4, 4]) == pytest.approx(float(clear.clear_peak), rel=1e-4)


def test_no_mask_of_ours_is_below_the_floor_of_its_window():
    """Of the light E that the window holds: LSR >= 4 lambda2 f2 E / (pi D2 S)."""
    spread = psf(five_half_rings(), 550e-9)
    held, side = float(spread.intensity.double().sum()), 1024 * 2.9e-6
    suppression = float(spread.intensity.amax() / spread.clear_peak)
    floor = held * (550e-9 * 0.11 / side) ** 2 / AREA
    assert 0.98 < held <= 1.0001
    assert floor < suppression < 1000 * floor


def random_relief(seed):
    """A relief of any roughness and depth, from nearly flat to a diffuser."""
    rng = torch.Generator().manual_seed(seed)
    draw = torch.rand(2, generator=rng)
    depth, scale = 10 ** float(-8 + 3 * draw[0]), 10 ** float(-1.7 + 1.7 * draw[1])
    return doe.pixelwise(SMALL, depth=depth, scale=scale, rng=rng)


def test_two_hundred_masks_obey_the_floor_and_the_parseval_bound():
    """On a full period of n x n points, n >= 2 N - 1, with sum(PSF) = 1 and OTF = DFT(PSF):

    max PSF = LSR * p0 >= 1 / n**2 (floor), and mean over the n**2 frequencies of |OTF|**2
    = sum(PSF**2) <= max(PSF) * sum(PSF) = LSR * p0 (Parseval), p0 = peak of the clear pupil.
    """
    size, loosest = 64, 0.0
    for seed in range(200):
        centre = torch.tensor([550e-9], dtype=torch.float64)
        bands = Bands(centre, centre, centre)
        pupil = optics.pupil(random_relief(seed).double(), doe.material(bands), bands, SMALL)
        phase = 2 * math.pi / 550e-9 * float(pupil.index) * pupil.height
        light = torch.fft.fft2(torch.polar(pupil.amplitude, phase), s=(size, size)).abs().square()
        spread = light / light.sum()
        clear_peak = float(pupil.aperture.sum()) / size**2
        suppression = float(spread.max()) / clear_peak
        rms_mtf = float(torch.fft.fft2(spread).abs().square().mean().sqrt())
        bound = math.sqrt(suppression * clear_peak)
        assert 1 / (size**2 * clear_peak) <= suppression <= 1 + 1e-12
        assert rms_mtf <= bound
        loosest = max(loosest, rms_mtf / bound)
    assert loosest > 0.6  # the bound is near: suppression is paid for in contrast
