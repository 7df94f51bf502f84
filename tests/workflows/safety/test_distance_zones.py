"""Zones of distance: none, one or several, their ends, and what draws say of them, against
closed forms.
"""

import numpy as np
import pytest
from scipy.special import ndtr

from neusee.workflows.safety.exposures import Spread, crossings, sampled, zones_of

AT = sampled(1.0, 1e4, (100.0,))


def test_the_distance_of_the_recipe_is_among_the_distances():
    assert 100.0 in AT
    assert (AT[0], AT[-1]) == (1.0, 1e4)
    assert (np.diff(AT) > 0).all()


@pytest.mark.parametrize("end", [3.3, 100.0, 5012.0])
def test_the_end_of_a_falling_exposure_is_its_root(end):
    near, far = crossings(AT, (end / AT[None]) ** 2)
    assert near[0, 0] == pytest.approx(1.0)
    assert far[0, 0] == pytest.approx(end, rel=1e-9)


def test_a_zone_that_begins_away_from_the_laser_has_two_roots():
    hump = 2 / (AT / 50 + 50 / AT)  # at least 1 / 2 where R / 50 lies within 2 +- sqrt 3
    near, far = crossings(AT, hump[None] * 2)
    assert near[0, 0] == pytest.approx(50 * (2 - np.sqrt(3)), rel=1e-4)
    assert far[0, 0] == pytest.approx(50 * (2 + np.sqrt(3)), rel=1e-4)


def test_several_zones_and_none_stand_in_one_table_of_draws():
    waves = np.sin(np.log(AT) * 2)
    near, far = crossings(
        AT, np.exp(np.stack([waves, np.full_like(waves, -1), np.full_like(waves, 1)]))
    )
    roots = np.exp(np.arange(6) * np.pi / 2)
    assert near[0] == pytest.approx(roots[::2], rel=1e-3)
    assert far[0] == pytest.approx(roots[1::2], rel=1e-3)
    assert np.isnan(near[1]).all()
    assert np.isnan(far[1]).all()
    assert (near[2, 0], far[2, 0]) == (pytest.approx(1.0), pytest.approx(1e4))
    assert np.isnan(near[2, 1:]).all()


def test_an_exposure_of_zero_ends_a_zone():
    dark = np.where(AT < 10, 2.0, 0.0)
    assert crossings(AT, dark[None])[1][0, 0] == pytest.approx(10, rel=0.02)


def test_the_ends_and_the_probability_of_none_follow_the_law():
    # factor on the squared distance
    draws = np.exp(np.random.default_rng(1).standard_normal(4000) * 0.5)
    ratio = 10.0**2 / AT**2
    found = zones_of(AT, ratio, ratio * draws[:, None] ** 2, 20.0)
    (zone,) = found.zones
    assert zone.far.value == pytest.approx(10)
    assert zone.begins_before
    assert not zone.ends_beyond
    assert zone.far.low == pytest.approx(10 * np.exp(-1.6449 * 0.5), rel=0.04)
    assert zone.far.high == pytest.approx(10 * np.exp(1.6449 * 0.5), rel=0.04)
    assert found.inside == pytest.approx(ndtr(-np.log(2) / 0.5), abs=0.02)
    assert found.none == pytest.approx(ndtr(np.log(1 / 10) / 0.5), abs=1e-3)


def test_a_limit_that_is_met_in_some_draws_only_has_no_zone_but_a_reach():
    ratio = 0.5 / AT**2
    draws = np.concatenate([np.ones(900), np.full(100, 50.0)])
    found = zones_of(AT, ratio, ratio * draws[:, None], 3.0)
    assert found.zones == ()
    assert found.none == 0.9
    assert found.inside == 0.1
    assert found.reach == Spread(pytest.approx(5.0), pytest.approx(5.0), pytest.approx(5.0))


def test_the_ends_between_two_zones_are_those_of_draws_with_as_many_zones():
    one, two = (
        np.where(AT < 10, 2.0, 0.1),
        np.where((AT < 10) | ((AT > 100) & (AT < 1000)), 2.0, 0.1),
    )
    found = zones_of(AT, two, np.stack([one, one, one, two]), 500.0)
    assert len(found.zones) == 2
    assert found.alike == 0.25
    assert found.zones[1].near.low == pytest.approx(found.zones[1].near.value)
    assert found.zones[1].far.low == pytest.approx(10, rel=0.02)
    assert found.inside == 0.25
    assert found.reach.high > 800


def test_zones_that_no_draw_shares_have_ends_without_an_interval():
    one, two = (
        np.where(AT < 10, 2.0, 0.1),
        np.where((AT < 10) | ((AT > 100) & (AT < 1000)), 2.0, 0.1),
    )
    found = zones_of(AT, two, np.stack([one, one]), 500.0)
    assert found.zones[1].near == Spread.of(found.zones[1].near.value, np.zeros(0))


def test_the_farthest_distance_has_the_interval_of_every_draw_with_a_zone():
    """A third of the draws reaches farther in one zone; the two nominal zones hid this as 300 m
    without an interval.
    """
    two = np.where((AT < 100) | ((AT > 200) & (AT < 300)), 1.1, 0.9) / np.where(
        AT < 900, 1.0, 100.0
    )
    found = zones_of(AT, two, np.stack([two] * 60 + [two * 2] * 30 + [two * 0.1] * 10), 50.0)
    assert len(found.zones) == 2
    assert found.zones[1].far.value == pytest.approx(300, rel=0.02)
    assert found.zones[1].far.high == pytest.approx(900, rel=0.02)
    assert found.zones[1].far == found.reach
    assert found.none == 0.1


def test_an_exposure_that_just_reaches_the_limit_exceeds_it_there():
    at = np.array([1.0, 2.0, 4.0, 8.0])
    near, far = crossings(at, np.array([[0.5, 1.0, 0.25, 0.1]]))
    assert (near.tolist(), far.tolist()) == ([[2.0]], [[2.0]])


@pytest.mark.parametrize("recipe", [0.2, 30.0, 5e5])
def test_zones_lie_between_the_asked_distances_wherever_the_laser_of_the_recipe_is(recipe):
    """The exposure is above the limit up to 300 m; at the distance of the recipe it is judged
    apart.
    """
    at = sampled(2.0, 5e3, (recipe,))
    ratio = (300.0 / at) ** 2
    found = zones_of(at, ratio, np.stack([ratio, ratio * 1.1, ratio / 1.1]), recipe, (2.0, 5e3))
    (zone,) = found.zones
    assert zone.near.value == pytest.approx(2.0, rel=1e-9)
    assert zone.far.value == pytest.approx(300, rel=1e-6)
    assert (zone.begins_before, zone.ends_beyond) == (True, False)
    assert found.inside == (1.0 if recipe < 300 else 0.0)
    assert found.reach.high == pytest.approx(300 * np.sqrt(1.1), rel=0.02)
    (short,) = zones_of(at, ratio, ratio[None], recipe, (2.0, float(at[at < 200][-1]))).zones
    assert short.ends_beyond
