"""Sentences and cells of an estimate, as a reader of the terminal and the page sees them."""

import pytest

from neusee.workflows.safety.exposures import Spread, Zones
from neusee.workflows.safety.safety_text import zones_text


@pytest.mark.parametrize(
    ("reach", "text"),
    [
        (None, "nowhere"),
        (
            Spread(1.02, 1.0, 1.06),
            "nowhere at the nominal values; in some draws up to 1.02 m (1 m to 1.06 m)",
        ),
        (Spread(2e3, 2e3, 2e3), "nowhere at the nominal values; in some draws up to 2 km"),
    ],
)
def test_a_limit_that_only_draws_exceed_says_how_far_out(reach, text):
    assert zones_text(Zones((), none=0.9, alike=0.9, reach=reach, inside=0.0)) == text
