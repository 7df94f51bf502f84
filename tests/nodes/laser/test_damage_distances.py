"""Intervals of distance for margins with known roots, and limits at the lens."""

import math

import pytest

from neusee.nodes.laser import (
    axis_irradiance,
    beam,
    curvature_radius,
    defocus_of_source,
    defocused_peak,
    distance_intervals,
    exposure_limit,
    peak_on_sensor,
    sensor_gain,
)


def between(*ends):
    """A margin above 0 between each pair of ends, without a slope that would help."""

    def margin(distance):
        inside = any(a < distance < b for a, b in zip(ends[::2], ends[1::2], strict=True))
        return 1.0 if inside else -1.0

    return margin


def polynomial(*ends):
    """A smooth margin with these roots, in the logarithm of the distance, below 0 far away."""

    def margin(distance):
        return -math.prod(math.log(distance / end) for end in ends)

    return margin


@pytest.mark.parametrize("ends", [(), (2.0, 30.0), (2.0, 3.0, 50.0, 700.0)])
@pytest.mark.parametrize("margin", [between, polynomial])
def test_every_interval_is_found(ends, margin):
    found = distance_intervals(margin(*ends) if ends else lambda distance: -1.0, 0.5, 1e4)
    assert [end for pair in found for end in pair] == pytest.approx(list(ends), rel=1e-9)


def test_a_zone_that_reaches_the_first_or_the_last_distance_ends_there():
    assert distance_intervals(lambda r: math.log(20 / r), 1.0, 1e3) == [(1.0, pytest.approx(20.0))]
    assert distance_intervals(lambda r: math.log(r / 20), 1.0, 1e3) == [(pytest.approx(20.0), 1e3)]
    assert distance_intervals(lambda r: 1.0, 1.0, 1e3) == [(1.0, 1e3)]


@pytest.mark.parametrize("sign", [1, -1])
def test_a_zone_and_a_gap_narrower_than_a_step_are_found(sign):
    """400 samples over four decades are 2.3 % apart; the zone is 0.04 % wide."""
    width = 2e-4

    def margin(distance):
        return sign * (width**2 - math.log(distance / 37.0) ** 2)

    ends = [37 * math.exp(-width), 37 * math.exp(width)]
    found = distance_intervals(margin, 1.0, 1e4)
    assert [end for pair in found for end in pair] == pytest.approx(
        ends if sign > 0 else [1.0, *ends, 1e4], rel=1e-9
    )


@pytest.mark.parametrize(
    "ends", [(0.0, 10.0), (10.0, 10.0), (5.0, 1.0), (1.0, math.inf), (-1.0, 2.0)]
)
def test_distances_without_an_interval_are_refused(ends):
    with pytest.raises(ValueError, match="give 0 < near < far"):
        distance_intervals(lambda distance: 1.0, *ends)


def test_a_margin_that_is_not_a_number_is_refused_with_its_distance():
    with pytest.raises(ValueError, match="margin at 1 m is not a number"):
        distance_intervals(lambda distance: math.nan, 1.0, 2.0)
    assert distance_intervals(
        lambda distance: -math.inf if distance < 1.5 else math.inf, 1.0, 2.0
    ) == [(pytest.approx(1.5), 2.0)]


def test_a_source_at_2_m_is_eight_waves_out_of_focus():
    """The paper's lens, f/13.6 and 110 mm, focused far away."""
    assert defocus_of_source(2.0, 8.08e-3, 532e-9) == pytest.approx(7.7, abs=0.05)
    assert defocus_of_source(2.0, 8.08e-3, 532e-9, focused_at=2.0) == 0.0


def test_a_near_laser_that_is_out_of_focus_has_several_zones_of_damage():
    """A beam of 8 mm before a lens that is focused far away: the peak falls and rises with the
    distance.
    """
    laser = beam(532e-9, power=20.0, waist=4e-3, divergence=2e-3)
    diameter, focal_length, threshold = 8.08e-3, 0.11, 2.5e9

    def margin(distance):
        waves = defocus_of_source(curvature_radius(laser, distance), diameter, 532e-9)
        peak = peak_on_sensor(laser, distance, diameter, focal_length, 1.0) * defocused_peak(waves)
        return math.log(peak / threshold)

    found = distance_intervals(margin, 0.5, 1e4)
    assert len(found) == 3
    for a, b in found:
        assert margin(math.sqrt(a * b)) > 0
        assert a == 0.5 or margin(a * (1 - 1e-6)) < 0 < margin(a * (1 + 1e-6))
        assert margin(b * (1 + 1e-6)) < 0 < margin(b * (1 - 1e-6))


def test_the_exposure_limit_at_the_lens_gives_the_threshold_on_the_sensor():
    """The irradiance of a beam at the distance where it is at the limit, and its peak on the
    sensor.
    """
    laser = beam(532e-9, power=50.0, waist=1e-3, divergence=1e-3)
    gain = sensor_gain(532e-9, 0.11, 8.08e-3, 0.9)
    limit = exposure_limit(3e8, gain)
    (interval,) = distance_intervals(
        lambda r: math.log(axis_irradiance(laser, r) / limit), 100.0, 1e5
    )
    assert peak_on_sensor(laser, interval[1], 8.08e-3, 0.11, 0.9) == pytest.approx(3e8, rel=3e-4)
    assert sensor_gain(532e-9, 0.11, 8.08e-3, 0.9, peak_ratio=1e-2) == pytest.approx(gain / 100)
