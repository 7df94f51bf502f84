"""Threshold of the first damage over the duration: figures by hand, and what no duration and no
spot may contradict.
"""

import math

import numpy as np
import pytest
import torch

from neusee.nodes.laser import PUBLISHED_DAMAGE, CurveEnds, first_damage

ENDS = {
    device: CurveEnds(
        *(
            next(
                law
                for law in PUBLISHED_DAMAGE
                if (law.device, law.damage, law.quantity) == (device, "point", quantity)
            )
            for quantity in ("fluence", "irradiance")
        )
    )
    for device in ("CMOS", "CCD")
}
CMOS = ENDS["CMOS"]
DURATIONS = np.geomspace(1e-9, 100, 2000)
SPOTS = [None, 1e-6, 5e-6, 25.7e-6, 26e-6, 60e-6, 300e-6, 5e-3]


@pytest.mark.parametrize(
    ("duration", "joules"), [(1e-9, 0.1), (1e-8, 0.1), (1e-7, 0.15), (1e-6, 0.22), (1e-5, 0.32)]
)
def test_the_fluence_is_interpolated_in_logarithms(duration, joules):
    assert float(first_damage(CMOS, duration).middle) / 1e4 == pytest.approx(joules, rel=0.025)


@pytest.mark.parametrize("duration", [1e-5, 3e-4, 1e-3, 0.25, 10.0, 100.0])
def test_beyond_ten_microseconds_the_continuous_law_counts(duration):
    found = first_damage(CMOS, duration)
    assert float(found.middle) / duration / 1e4 == pytest.approx(10**4.5)
    assert float(found.low) / duration / 1e4 == pytest.approx(1e4)
    assert float(found.high) / duration / 1e4 == pytest.approx(
        max(1e5, 2e5 * 1e-5 / duration), rel=0.01
    )


@pytest.mark.parametrize("spot", SPOTS)
@pytest.mark.parametrize("exponent", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("device", ENDS)
def test_a_longer_pulse_never_needs_less_fluence_and_never_more_irradiance(spot, exponent, device):
    """Power in the pulse over the continuous law once gave 0.044 J/cm2 at 1 us, less than the
    0.1 J/cm2 of 10 ns.
    """
    found = first_damage(ENDS[device], torch.from_numpy(DURATIONS), spot, exponent)
    for end in (found.low, found.middle, found.high):
        fluence = end.numpy()
        assert (np.diff(fluence) >= -1e-12 * fluence[1:]).all()
        irradiance = fluence / DURATIONS
        assert (np.diff(irradiance) <= 1e-12 * irradiance[1:]).all()
    assert (found.low <= found.middle).all()
    assert (found.middle <= found.high).all()


def test_the_spread_is_at_least_six_times_between_the_ends():
    between = np.geomspace(1e-9, 1e-5, 200)
    found = first_damage(CMOS, torch.from_numpy(between))
    assert float((found.high / found.middle).min()) >= 6
    assert float((found.high / found.low).min()) >= 6
    below = between < 4e-6  # later the lower end of the continuous law, 10 kW/cm2, is higher
    assert float((found.middle / found.low)[below].min()) >= 6


def test_the_bracket_holds_every_first_damage_that_was_read_for_nanoseconds():
    """0.1 J/cm2, 78.9 mJ/cm2, and 30.06 mJ/cm2 of a back-illuminated CMOS module (Chinese
    Optics, CO.2025-0090).
    """
    found = first_damage(CMOS, 1e-8)
    for joules in (0.1, 0.0789, 0.03006):
        assert float(found.low) < joules * 1e4 < float(found.high)


@pytest.mark.parametrize("duration", [1e-14, 1e-12, 0.9e-9])
def test_below_a_nanosecond_no_lower_end_is_stated(duration):
    found = first_damage(CMOS, duration)
    assert float(found.low) == 0
    assert float(found.high) == pytest.approx(1e3 * math.sqrt(40))


@pytest.mark.parametrize("duration", [1e-8, 1e-6, 1e-3, 1.0])
def test_a_wider_spot_never_needs_more(duration):
    spots = torch.from_numpy(np.geomspace(1e-6, 1e-2, 400))
    found = first_damage(CMOS, torch.full_like(spots, duration), spots)
    for end in (found.low, found.middle, found.high):
        assert (np.diff(end.numpy()) <= 1e-12 * end[1:].numpy()).all()
