"""The peak of a sampled spot between its samples, against the Airy pattern and a Gaussian lobe."""

import numpy as np
import pytest
import torch
from scipy.special import j1

from neusee.nodes.laser import summit_gain, unseen_light


def airy(y, x, samples):
    """The Airy pattern at the samples of wavelength times f-number around a peak at (y, x)."""
    at = np.arange(-24, 25) / samples
    v = np.pi * np.hypot(at[:, None] - y, at - x)
    v[v < 1e-9] = 1e-9
    return torch.from_numpy((2 * j1(v) / v) ** 2)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.125, 0.125), (0.125, 0.0), (0.06, -0.1)])
def test_an_airy_peak_between_four_samples_a_width_is_found(shift):
    spot = airy(*shift, samples=4)
    assert float(spot.max() * summit_gain(spot)) == pytest.approx(1.0, abs=4e-3)


def test_the_grid_alone_misses_an_eighth_of_a_width_by_seven_percent():
    spot = airy(0.125, 0.125, samples=4)
    assert float(spot.max()) < 0.93
    assert float(summit_gain(spot)) > 1.07


def test_a_lobe_that_lies_worse_on_the_grid_than_the_brightest_sample_counts():
    at = torch.arange(40.0, dtype=torch.float64)

    def lobe(y, x, top):
        return top * torch.exp(-((at[:, None] - y).square() + (at - x).square()) / (2 * 0.9**2))

    spot = lobe(10.0, 10.0, 0.9) + lobe(29.5, 30.5, 1.0)
    assert float(spot.max()) == pytest.approx(0.9, rel=1e-6)
    assert float(spot.max() * summit_gain(spot)) == pytest.approx(1.0, rel=1e-6)


def test_dark_and_narrow_images_gain_nothing():
    assert float(summit_gain(torch.zeros(5, 5))) == 1.0
    assert float(summit_gain(torch.rand(2, 9))) == 1.0


def airy_light(half, samples):
    """The share of an Airy pattern's light at each sample of a window of 2 half wavelengths
    times f-number.
    """
    at = np.arange(-half * samples, half * samples + 1) / samples
    v = np.pi * np.hypot(at[:, None], at)
    v[v < 1e-9] = 1e-9
    return torch.from_numpy((2 * j1(v) / v) ** 2) * (np.pi / 4 / samples**2)


def test_light_outside_a_window_is_in_no_spot_where_the_wings_explain_it():
    """The window of 15 wavelengths times f-number to each side lacks 1.2 % of an Airy pattern;
    light may be a share.
    """
    spot = airy_light(15, 3)
    assert 0.005 < 1 - float(spot.sum()) < 0.02
    assert float(unseen_light(spot, 1.0)) == 0
    assert float(unseen_light(0.3 * spot, 0.3)) == 0


def test_light_that_the_wings_do_not_explain_may_be_in_one_spot():
    """Of an Airy pattern with 2 % of its light elsewhere; and of one of which a part of the spot
    itself is cut.
    """
    spot = airy_light(30, 3)
    assert 0.010 < float(unseen_light(0.98 * spot, 1.0)) < 0.021
    lacking = 1 - float(airy_light(3, 3).sum())
    assert 0.03 < lacking < 0.1
    assert float(unseen_light(airy_light(3, 3), 1.0)) == pytest.approx(lacking)
    assert float(unseen_light(0.1 * spot, 0.5)) == pytest.approx(0.8, abs=0.01)
