"""Exposure limits of the eye against the values of the table, and hazard distances against the
beam itself.
"""

import itertools
import math

import pytest

from neusee.nodes import ParameterError
from neusee.nodes.laser import (
    axis_density,
    axis_irradiance,
    beam,
    eye_aperture,
    eye_limit,
    eye_mpe,
    eye_mpe_train,
    hazard_distance,
    nominal_ocular_hazard_distance,
    power_through,
    share_through,
)

#: wavelength nm, duration s, radiant exposure J/m2: each worked out by hand from Table A.1 of IEC
#: 60825-1:2014
TABLE = [
    (532, 1e-8, 2e-3),
    (532, 0.25, 6.364),  # 18 x 0.25^0.75, the familiar 25.5 W/m2
    (532, 10, 100.0),
    (532, 100, 1000.0),
    (450, 0.25, 6.364),
    (450, 50, 100.0),
    (450, 1000, 1000.0),
    (475, 20, 200.0),  # 100 C3 = 316 J/m2 would let more pass than 10 W/m2
    (475, 60, 316.23),
    (475, 1000, 3162.3),
    (905, 1e-8, 5.1404e-3),  # C_A = 10^0.41
    (905, 10, 257.04),
    (1064, 1e-8, 2e-2),
    (1064, 1e-3, 0.50611),  # 90 x 1e-3^0.75
    (1064, 10, 500.0),
    (1180, 1e-8, 6.9343e-2),  # C_C = 10^0.54
    (1310, 10, 1e5),  # the skin's 2000 C_A W/m2, not 10 C_A C_C = 12 960
    (1390, 1e-8, 1000.0),  # the skin's 200 C_A J/m2
    (1450, 1e-8, 1000.0),
    (1450, 0.25, 3959.8),  # 5600 x 0.25^0.25
    (1550, 1e-8, 1e4),
    (1550, 1, 1e4),
    (1550, 100, 1e5),
    (10600, 1e-8, 100.0),
    (10600, 0.25, 3959.8),
    (10600, 100, 1e5),
]


@pytest.mark.parametrize(("nm", "duration", "expected"), TABLE)
def test_the_limit_is_that_of_the_table(nm, duration, expected):
    assert eye_mpe(nm * 1e-9, duration) == pytest.approx(expected, rel=2e-4)


@pytest.mark.parametrize(
    "nm", [400, 449, 500, 600, 700, 900, 1049.9, 1050, 1199.9, 1300, 1399, 1400, 1550, 2000, 1e4]
)
def test_the_limit_has_no_jump_in_time_and_never_falls_with_a_longer_exposure(nm):
    limits = [(t, eye_mpe(nm * 1e-9, t)) for t in (1e-11 * 10 ** (k / 50) for k in range(770))]
    for (one, before), (other, after) in itertools.pairwise(limits):
        # the table's numbers are rounded to two digits
        assert before * 0.94 <= after <= before * other / one * 1.07


def test_infrared_from_700_nm_is_limited_without_a_jump_in_wavelength():
    for nm in (700, 1050, 1150, 1200):
        for duration in (1e-8, 1e-4, 0.25, 100):
            step = eye_mpe((nm + 1e-6) * 1e-9, duration) / eye_mpe((nm - 1e-6) * 1e-9, duration)
            assert step == pytest.approx(2 if (nm, duration) == (1050, 1e-8) else 1, rel=0.15), (
                nm,
                duration,
            )


@pytest.mark.parametrize(
    ("wavelength", "duration", "parameter"),
    [
        (355e-9, 0.25, "wavelength"),
        (200e-6, 1, "wavelength"),
        (532e-9, 1e-12, "duration"),
        (532e-9, 1e5, "duration"),
    ],
)
def test_what_the_formulas_do_not_cover_is_refused(wavelength, duration, parameter):
    for limit in (eye_mpe, eye_aperture):
        with pytest.raises(ParameterError, match="take the limit from the standard") as raised:
            limit(wavelength, duration)
        assert raised.value.parameter == parameter


def test_the_aperture_is_a_wide_pupil_in_the_retinal_region_and_small_beyond():
    assert eye_aperture(532e-9, 0.25) == eye_aperture(1399e-9, 100) == 7e-3
    assert (eye_aperture(1550e-9, 0.1), eye_aperture(1550e-9, 100)) == (1e-3, 3.5e-3)
    assert eye_aperture(1550e-9, 1) == pytest.approx(1.5e-3)


def test_a_published_hazard_distance_is_met():
    """A laser of 1 W and 1 mrad (at 1/e) is commonly stated to have 225 m, by 25 W/m2 (laser
    show handbooks).
    """
    show = beam(532e-9, power=1.0, divergence=1e-3, waist=0.5e-3, convention="1/e")
    assert nominal_ocular_hazard_distance(show) == pytest.approx(225, rel=0.01)


@pytest.mark.parametrize("aperture", [0.0, 7e-3, 0.05])
@pytest.mark.parametrize("waist", [0.5e-3, 2e-3, 30e-3])
def test_the_exposure_at_the_hazard_distance_is_the_limit(aperture, waist):
    """The closed inverse put back into the irradiance of the beam, which it does not share."""
    laser = beam(532e-9, power=5.0, waist=waist, divergence=1.2e-3)
    distance = hazard_distance(laser, 25.0, aperture, transmittance=0.8)
    assert distance > 100
    found = axis_irradiance(laser, distance, 0.8)
    if aperture:
        found = power_through(laser, distance, aperture, 0.8) / (math.pi * aperture**2 / 4)
    assert found == pytest.approx(25.0, rel=1e-9)


def test_a_laser_that_is_safe_everywhere_has_the_distance_0():
    """A beam of class 2, 1 mW, stays below 25.5 W/m2 over a pupil of 7 mm; its axis does not."""
    pointer = beam(532e-9, power=0.9e-3, waist=0.5e-3, divergence=1e-3)
    assert nominal_ocular_hazard_distance(pointer) == 0.0
    assert hazard_distance(pointer, eye_limit(pointer, 0.25)) > 5
    wide = beam(532e-9, power=1e-3, waist=0.1, divergence=1e-3)
    assert hazard_distance(wide, 25.0) == 0.0


def test_a_pulsed_laser_is_judged_by_the_energy_of_a_pulse():
    single = beam(1064e-9, pulse_energy=0.1, pulse_duration=1e-8, divergence=1e-3)
    distance = nominal_ocular_hazard_distance(single)
    assert share_through(single, distance, 7e-3) * 0.1 / (math.pi * 3.5e-3**2) == pytest.approx(
        0.02, rel=1e-9
    )
    assert 0.1 * axis_density(single, distance) == pytest.approx(0.02, rel=1e-3)


def test_a_train_is_limited_by_the_strictest_of_three_rules():
    one, rate, seconds, old = eye_mpe(905e-9, 1e-8), 100.0, 10.0, "N^(-1/4)"
    count = rate * seconds
    assert eye_mpe_train(905e-9, 1e-8, rate, seconds, old) == pytest.approx(
        one * count**-0.25, rel=1e-12
    )
    fast = 50e3  # 5e5 pulses: the mean irradiance decides
    assert eye_mpe_train(905e-9, 1e-8, fast, seconds, old) == pytest.approx(
        one * (fast * seconds) ** -0.25, rel=1e-12
    )
    very = 1e6  # five pulses within 5 us count as one
    groups = very * seconds / 5
    assert eye_mpe_train(905e-9, 1e-8, very, seconds, old) == pytest.approx(
        min(eye_mpe(905e-9, seconds) / (very * seconds), one / 5 * groups**-0.25), rel=1e-9
    )
    assert eye_mpe_train(1550e-9, 5e-9, 1e5, 10) == pytest.approx(1e4 / 1e6, rel=1e-12)
    lidar = beam(
        905e-9, pulse_energy=1e-6, pulse_duration=5e-9, repetition_rate=1e5, divergence=2e-3
    )
    assert eye_limit(lidar, 10) == eye_mpe_train(905e-9, 5e-9, 1e5, 10)
    assert eye_limit(lidar, 1e-6) == eye_mpe(905e-9, 5e-9)
    with pytest.raises(ParameterError, match="too long"):
        eye_mpe_train(905e-9, 1e-3, 1e4, 10)


@pytest.mark.parametrize("rate", [10.0, 1e3, 1e5, 1e6, 8e7])
def test_no_train_lets_more_pass_than_its_mean_or_one_of_its_pulses(rate):
    limit = eye_mpe_train(532e-9, 1e-9, rate, 0.25)
    assert limit <= eye_mpe(532e-9, 1e-9)
    assert limit * rate * 0.25 <= eye_mpe(532e-9, 0.25) * (1 + 1e-12)
