"""A strong laser whose clipped pixels hide its spot is not fitted at a wrong place with a wrong wavelength."""

import numpy as np
import pytest

from tests.nodes.restore.lasers import own_camera as own
from tests.nodes.restore.lasers.as_inputs import found_in

PIXEL, SIDE = own.PITCH / own.FOCAL, 64


@pytest.mark.parametrize(
    ("mask", "seed"),
    [
        ("cubic", 5),  # a fit at 427 nm in place of 439 nm, with responses 5 deviations from those of the camera
        ("cubic", 23),  # 435 in place of 424 nm, with responses 2 deviations away
        pytest.param("half_ring", 26, marks=pytest.mark.slow),  # 477 in place of 438 nm, 3 pixels away
    ],
)
def test_a_strong_blue_laser_is_found_where_it_is(mask, seed):
    rng = np.random.default_rng([seed, 5])
    laser = own.Laser(tuple(rng.uniform(-0.2, 0.2, 2) * SIDE), rng.uniform(420e-9, 450e-9), 1e4)
    found = found_in(own.frame(mask, "noise", SIDE, [laser], rng), mask, lamps=0, most=1)
    assert (found.direction[0] / PIXEL).tolist() == pytest.approx(laser.spot, abs=0.1)
    assert float(found.wavelength[0]) == pytest.approx(laser.wavelength, abs=1e-9)
