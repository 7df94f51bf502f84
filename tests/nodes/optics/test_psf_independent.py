"""The PSF against a reference that shares no line with it, from the height map to the intensity:
`independent_psf`.

The heights and the index are inputs of both. Everything after that, the stop included, is computed
twice.
"""

import sys
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
import torch

from neusee.nodes import doe, optics, spectra
from neusee.nodes.optics.transform import _intensity

sys.path.insert(0, str(Path(__file__).parent))
from independent_psf import round_stop, window

FOCAL_LENGTH, PIXEL_PITCH, WAVELENGTH = 0.11, 3.45e-6, 532e-9
ANGLE = (0.37 * 3 * PIXEL_PITCH / FOCAL_LENGTH, -5 * PIXEL_PITCH / FOCAL_LENGTH)
LINE = spectra.bands(start=WAVELENGTH, stop=WAVELENGTH + 1e-12, count=1)
INDEX = doe.material(LINE)


def rough(stop):
    """Draw a height of up to ten waves for each sample by itself."""
    samples = int(stop.samples)
    share = torch.rand(samples, samples, generator=torch.Generator().manual_seed(3))
    return share * (10 * WAVELENGTH / float(INDEX[0]))


MASKS = {
    "flat": doe.flat,
    "half-ring": lambda stop: doe.half_rings(stop, waves=(20.0,)),
    "five half-rings": lambda stop: doe.half_rings(stop, waves=(12.0, 18.0, 24.0, 30.0, 36.0)),
    "axicon of 100 waves": lambda stop: doe.axicon(stop, waves=100.0),
    "vortex": lambda stop: doe.vortex(stop, charge=3),
    "cubic": lambda stop: doe.cubic(stop, waves=5.0),
    "rough": rough,
    "100 um": lambda stop: doe.half_rings(stop, waves=(20.0,)) + 100e-6,
    "10 mm plate": lambda stop: doe.half_rings(stop, waves=(20.0,)) + 10e-3,
}
LENS = {540: 14.96e-6, 1080: 7.48e-6, 2160: 3.74e-6}  #: samples and pitch of the pupil


@lru_cache(maxsize=2)  # sizes alternate, and both precisions follow each other
def reference(mask, samples, side):
    """Return the stop, the height map, and the intensity of the reference, (y, x) float64."""
    stop = optics.stop(samples=samples, pitch=LENS[samples], diameter=8e-3)
    height = MASKS[mask](stop)
    expected = window(
        height.numpy(),
        np.zeros((samples, samples)),
        round_stop(samples, LENS[samples], 8e-3),
        float(INDEX[0]),
        float(LINE.centres[0]),
        LENS[samples],
        FOCAL_LENGTH,
        PIXEL_PITCH,
        (side, side),
        ANGLE,
    )
    return stop, height, expected


def both(mask, samples, precision, side=64):
    """Return the intensity of the node, that of the reference, (y, x) float64, and the peak of
    the clear lens.
    """
    stop, height, expected = reference(mask, samples, side)
    pupil = optics.pupil(height, INDEX, LINE, stop)
    sensor = {
        "focal_length": FOCAL_LENGTH,
        "pixel_pitch": PIXEL_PITCH,
        "shape": (side, side),
        "angle": ANGLE,
    }
    found = optics.psf(pupil, **sensor, precision=precision)
    return found.intensity[0].double().numpy(), expected, float(found.clear_peak[0])


slow, long = pytest.mark.slow, pytest.mark.long
#: masks at the full size of 2160 samples: light in phase, no two samples alike, and a thick plate
FULL = ("half-ring", "rough", "10 mm plate")


def sized(*full):
    """Return every mask at 540 samples, and the given ones at 2160."""
    return [(mask, 540) for mask in MASKS] + [pytest.param(m, 2160, marks=slow) for m in full]


@pytest.mark.parametrize(("precision", "limit"), [("single", 2e-6), ("double", 1e-11)])
@pytest.mark.parametrize(("mask", "samples"), sized(*FULL))
def test_the_error_is_as_stated_from_the_height_map_to_the_intensity(
    mask, precision, limit, samples
):
    found, expected, _ = both(mask, samples, precision)
    assert np.abs(found - expected).max() <= limit * expected.max()


@pytest.mark.parametrize("mask", ["rough", "10 mm plate"])
def test_without_a_compiler_the_error_is_as_stated_too(mask, monkeypatch):
    monkeypatch.setattr(_intensity, "available", lambda device: False)
    found, expected, _ = both(mask, 540, "single")
    assert np.abs(found - expected).max() <= 2e-6 * expected.max()


@pytest.mark.parametrize(
    ("mask", "samples"),
    [
        *[
            (mask, 540)
            for mask in (
                "half-ring",
                "five half-rings",
                "axicon of 100 waves",
                "cubic",
                "10 mm plate",
            )
        ],
        pytest.param("five half-rings", 2160, marks=slow),
    ],
)
def test_the_relative_error_of_a_dark_pixel_grows_as_stated(mask, samples):
    """The round-off of the field is a share of the clear lens's field, however dark the mask
    makes the pixel.
    """
    found, expected, clear = both(mask, samples, "single", side=192)
    share = expected / clear
    error = (np.abs(found - expected) / expected * np.sqrt(share))[share < 1e-6]
    assert error.size > 200
    assert np.median(error) <= 5e-9
    assert error.max() <= 2e-7


def tail_errors(mask, samples, side):
    """Return the relative error of each pixel within a factor of two of 1e-8 of the brightest
    pixel.
    """
    found, expected, _ = both(mask, samples, "single", side)
    tail = np.abs(np.log2(expected / expected.max() / 1e-8)) < 1
    assert tail.sum() > 10
    return np.abs(found - expected)[tail] / expected[tail]


@pytest.mark.parametrize(
    ("mask", "samples", "side"),
    [
        *[(mask, samples, 192) for mask in ("flat", "vortex") for samples in (540, 1080)],
        ("cubic", 1080, 64),
        ("cubic", 1080, 192),
        pytest.param("flat", 2160, 192, marks=slow),
        pytest.param("cubic", 2160, 64, marks=slow),
        pytest.param("five half-rings", 2160, 400, marks=slow),
    ],
)
def test_a_tail_at_1e_8_of_the_brightest_pixel_is_right(mask, samples, side):
    errors = tail_errors(mask, samples, side)
    assert np.median(errors) <= 1e-4
    assert errors.max() <= 1e-3


@pytest.mark.parametrize(
    ("mask", "samples", "side"),
    [
        ("five half-rings", 540, 1024),
        pytest.param("half-ring", 540, 192, marks=slow),
        pytest.param("cubic", 540, 1024, marks=slow),
        # beside it, 2160 samples in a window of 400 and 540 in one of 1024
        pytest.param("five half-rings", 2160, 2048, marks=long),
    ],
)
def test_a_tail_at_1e_8_in_a_wide_window_is_as_stated(mask, samples, side):
    errors = tail_errors(mask, samples, side)
    assert np.median(errors) <= 2e-4
    assert errors.max() <= 4e-3
