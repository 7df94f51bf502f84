"""A strong laser whose clipped pixels hide its spot is not fitted at a wrong place with a wrong
wavelength.
"""

import numpy as np
import pytest

from tests.nodes.restore.lasers import own_camera as own
from tests.nodes.restore.lasers.as_inputs import found_in

PIXEL, SIDE = own.PITCH / own.FOCAL, 64


@pytest.mark.parametrize(
    ("mask", "seed"),
    [
        # a fit at 427 nm in place of 439 nm, with responses 5 deviations from those of the camera
        ("cubic", 5),
        # 477 in place of 438 nm, 3 pixels away
        pytest.param("half_ring", 26, marks=pytest.mark.slow),
    ],
)
def test_a_strong_blue_laser_is_found_where_it_is(mask, seed):
    rng = np.random.default_rng([seed, 5])
    laser = own.Laser(tuple(rng.uniform(-0.2, 0.2, 2) * SIDE), rng.uniform(420e-9, 450e-9), 1e4)
    found = found_in(own.frame(mask, "noise", SIDE, [laser], rng), mask, lamps=0, most=1)
    assert (found.direction[0] / PIXEL).tolist() == pytest.approx(laser.spot, abs=0.1)
    assert float(found.wavelength[0]) == pytest.approx(laser.wavelength, abs=1e-9)


@pytest.mark.slow
def test_a_frame_with_few_pixels_that_are_not_clipped_tells_less_of_place_and_wavelength():
    """At 1e6 nine tenths of the pixels are clipped; errors behind dirt were four times those at
    1e3 there.
    """
    half = {}
    for strength in (1e3, 1e6):
        laser = own.Laser((4.3, -7.8), 533e-9, strength)
        frame = own.frame("half_ring", "noise", SIDE, [laser], np.random.default_rng(3))
        found = found_in(frame, "half_ring", lamps=0, most=1)
        ends = (found.wavelength_interval[0] * 1e9, found.direction_interval[0, 0] / PIXEL)
        half[strength] = [float(high - low) / 2 for low, high in ends]
    assert half[1e6][0] > 1.5 * half[1e3][0]
    assert half[1e6][1] > 1.5 * half[1e3][1]
