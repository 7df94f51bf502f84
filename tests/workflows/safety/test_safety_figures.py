"""The picture of the spot on the sensor over a limit of damage: never one colour, and white at
the limit.
"""

import numpy as np
import pytest

from neusee.workflows.safety.damage_pattern import DamagePattern
from neusee.workflows.safety.safety_page import spots


@pytest.mark.parametrize("peak", [5e-8, 0.0096, 0.3, 1.0, 2.6, 40.0, 2.3e5])
def test_a_spot_is_seen_however_far_below_the_limit_it_is(peak):
    at = np.linspace(-2, 2, 25)
    light = peak * np.exp(-2 * (at[:, None] ** 2 + at**2))
    figure = spots.__wrapped__([DamagePattern("mask", "damage: point", light, 1e-5, peak, 0.0)])
    (shown,) = figure.axes[0].images
    found, (low, high) = np.asarray(shown.get_array()), shown.get_clim()
    assert low == -high  # the limit is in the middle of the colours
    assert low <= found.min() < found.max() <= high + 1e-9
    assert found.max() == pytest.approx(np.log10(peak))
    assert found.max() - found.min() >= 1.499
