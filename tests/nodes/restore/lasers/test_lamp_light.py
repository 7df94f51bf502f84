"""The light of a lamp anywhere in the frame is that of direct sums, and no part of it is taken
for a laser.
"""

import numpy as np
import pytest
import torch

from neusee.nodes import optics
from neusee.nodes.restore.inverse import View
from neusee.nodes.restore.lasers import Lamp, Lens, lamp_light
from tests.nodes.restore.lasers import own_camera as own
from tests.nodes.restore.lasers.as_inputs import BANDS, LENS, found_in, pupil_of, tensor

SIDE, WINDOW = 40, 25  #: pixels a side of the frame, and of the PSF that the node is given
CORNER, CENTRE = (11.4, -13.3), (0.5, 0.25)  #: pixels


def lamp_at(spot, mask, veil=0.0, sensor="point"):
    """The light of a lamp with the spectrum of the illuminant, one electron a channel: (channel,
    y, x).
    """
    psf = optics.psf(pupil_of(mask), shape=(WINDOW, WINDOW), sensor=sensor, **LENS)
    psf = psf._replace(intensity=psf.intensity + veil * tensor(gaussian((0.0, 0.0), WINDOW)))
    lens = Lens(own.FOCAL, own.PITCH, (SIDE, SIDE), sensor)
    told = tensor(own.daylight(own.BANDS)), tensor(own.band_response()), BANDS
    light = lamp_light(View(psf, *told), pupil_of(mask), lens, torch.float64)
    values = torch.tensor([*spot, 1, 1, 1, 0, 0, 0, 0, 0, 0], dtype=torch.float64)
    return Lamp(light, (SIDE, SIDE), values)


def summed(spot, mask):
    """The same by direct sums over the pupil."""
    weights = own.band_response() * own.daylight(own.BANDS) * own.BANDS
    weights /= weights.sum(1, keepdims=True)
    return np.tensordot(
        weights, np.stack([own.pattern(mask, w, spot, (SIDE, SIDE)) for w in own.BANDS]), 1
    )


def gaussian(spot, side):
    """A veil with a standard deviation of 2 pixels."""
    y, x = (np.arange(side) - side // 2 - s for s in spot)
    return np.exp(-(y[:, None] ** 2 + x**2) / 8.0).astype(np.float32)


@pytest.mark.slow
@pytest.mark.parametrize("mask", ["plain", "half_ring", "cubic"])
@pytest.mark.parametrize("spot", [CORNER, CENTRE])
def test_a_lamp_between_pixels_lights_the_frame_beyond_the_window_of_the_psf(mask, spot):
    """Behind the half-ring, most of the light is farther from the spot than that window reaches."""
    found, expected = lamp_at(spot, mask).electrons().numpy(), summed(spot, mask)
    # which may lie beyond the frame
    brightest = own.scene_psf(mask, 2 * SIDE + 1).max((1, 2)).mean()
    assert np.abs(found - expected).max() < 1e-5 * brightest


@pytest.mark.slow
def test_a_pixel_that_is_integrated_sees_the_mean_over_its_area():
    """Four points of Gauss and Legendre along each axis of a pixel."""
    found = lamp_at(CENTRE, "plain", sensor="integrated").electrons().numpy()
    points, weights = np.polynomial.legendre.leggauss(4)
    expected = sum(
        wy * wx / 4 * summed((CENTRE[0] - y / 2, CENTRE[1] - x / 2), "plain")
        for y, wy in zip(points, weights, strict=True)
        for x, wx in zip(points, weights, strict=True)
    )
    assert np.abs(found - expected)[:, 5:-5, 5:-5].max() < 1e-4 * expected.max()


def test_stray_light_of_the_psf_is_added_to_the_pattern_of_the_pupil():
    found, expected = (
        lamp_at(CENTRE, "half_ring", veil=1e-3).electrons(),
        summed(CENTRE, "half_ring"),
    )
    expected = expected + 1e-3 * gaussian(CENTRE, SIDE)
    assert np.abs(found.numpy() - expected).max() < 2e-6
    assert expected.max() > 1e-3


def test_the_slopes_of_a_lamp_are_differences_of_direct_sums():
    columns = lamp_at(CORNER, "half_ring").columns(lambda pictures: pictures)[:2].numpy()
    for axis, found in enumerate(columns):
        step = np.eye(2)[axis] * 1e-3
        expected = (summed(CORNER + step, "half_ring") - summed(CORNER - step, "half_ring")) / 2e-3
        assert np.abs(found - expected).max() < 1e-3 * np.abs(expected).max()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [33, 34])
def test_a_lamp_that_clips_behind_a_mask_is_no_laser(seed):
    """With the light of a lamp cut at the window of the PSF, both had a laser with a place and a
    wavelength.
    """
    frame = own.frame("half_ring", "noise", 48, [], np.random.default_rng(seed), lamps=1)
    assert frame.clipped.any(0).mean() > 0.03
    assert int(found_in(frame, "half_ring", most=1, lamps=1).number) == 0
