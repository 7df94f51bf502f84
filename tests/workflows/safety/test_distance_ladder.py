"""Rungs of the ladder of distances, and where a laser is distant, against closed forms."""

import math

import numpy as np
import pytest

from neusee.nodes.laser import beam
from neusee.workflows.recipe.blocks.safety_block import Lens
from neusee.workflows.safety.exposures import (
    FAR_WAVES,
    UNFOCUSED_WAVES,
    as_wide,
    far_distance,
    fill_at,
    focus_of,
    interpolated,
    ladder,
)

POINTER = beam(532e-9, power=5e-3, divergence=1e-3)
WIDE = beam(905e-9, power=1.0, waist=30e-3, divergence=5e-4)


def lens(focus="infinity", defocus="0 waves"):
    return Lens.model_validate(
        {"focal_length": "50 mm", "diameter": "12 mm", "focus": focus, "defocus": defocus}
    )


def width(laser, distance):
    return math.hypot(laser.waist, laser.divergence * distance / 2)


def bend(laser, distance):
    """Waves at the rim of 12 mm by the curvature of the wavefront."""
    rayleigh = 2 * laser.waist / laser.divergence
    return 12e-3**2 / 8 / (distance + rayleigh**2 / distance) / laser.wavelength


@pytest.mark.parametrize(("laser", "decides"), [(POINTER, "curvature"), (WIDE, "curvature"),
                                                (beam(532e-9, power=1.0, divergence=5e-5), "fill")])  # fmt: skip
def test_a_distant_laser_fills_the_lens_to_two_per_cent_with_three_hundredths_of_a_wave(
    laser, decides
):
    far = far_distance(laser, 12e-3)
    fill, waves = (12e-3 / (2 * width(laser, far))) ** 2, 12e-3**2 / (8 * laser.wavelength * far)
    assert max(fill / 0.02, waves / 0.03) == pytest.approx(1, rel=1e-6)
    assert (waves / 0.03 > fill / 0.02) == (decides == "curvature")


def test_a_distance_and_the_fill_of_the_lens_are_inverse_to_each_other():
    at = np.array([0.02, 3.0, 4e3])
    fill = np.array([(12e-3 / (2 * width(POINTER, r))) ** 2 for r in at])
    np.testing.assert_allclose([fill_at(POINTER, 12e-3, r) for r in at], fill, rtol=1e-12)
    np.testing.assert_allclose(as_wide(POINTER, 12e-3 / (2 * np.sqrt(fill))), at, rtol=1e-6)


def test_a_beam_has_its_width_at_the_distance_that_is_returned():
    at = np.array([0.01, 3.0, 4e4])
    np.testing.assert_allclose(
        as_wide(POINTER, np.array([width(POINTER, r) for r in at])), at, rtol=1e-6
    )
    assert as_wide(POINTER, np.array([0.1 * POINTER.waist])) == pytest.approx(1e-3)


def test_values_between_rungs_never_overshoot_and_one_rung_holds_everywhere():
    """A step between two plateaus: a cubic without this care would swing above and below both."""
    rungs, values = np.arange(6.0), np.array([0.0, 0, 0, 1, 1, 1])[:, None] * [1.0, -2.0]
    between = interpolated(rungs, values, np.linspace(0, 5, 401).reshape(1, -1))
    assert between.shape == (1, 401, 2)
    assert between[..., 0].min() >= 0
    assert between[..., 0].max() <= 1
    np.testing.assert_allclose(between[0, 200], [0.5, -1], atol=1e-12)
    np.testing.assert_array_equal(
        interpolated(rungs[:1], values[3:4], np.zeros((2, 3))), np.full((2, 3, 2), [1.0, -2])
    )


def test_the_focus_of_a_lens_is_its_distance_or_none():
    assert [focus_of(lens(focus)) for focus in ("infinity", "laser", "7 m")] == [
        math.inf,
        math.inf,
        7.0,
    ]


@pytest.mark.parametrize("focus", ["infinity", "10 m", "laser"])
@pytest.mark.parametrize("nearest", [0.3, 15.0])
def test_no_step_of_the_ladder_is_wider_than_it_may_be_and_both_ends_are_on_it(focus, nearest):
    rungs = ladder(POINTER, lens(focus), 12e-3, (nearest, 1e4), 0.3, 0.5)
    assert rungs[0] == pytest.approx(nearest)
    waves = UNFOCUSED_WAVES if focus == "10 m" else FAR_WAVES
    assert rungs[-1] == pytest.approx(min(far_distance(POINTER, 12e-3, waves), 1e4))
    assert (np.diff(rungs) > 0).all()
    assert (rungs[1:] / rungs[:-1]).max() <= 1.3 * (1 + 1e-9)
    if focus == "laser":
        assert len(rungs) == 1 + math.ceil(math.log(rungs[-1] / nearest) / math.log(1.3))
        return
    off = 12e-3**2 / 8 / 10 / 532e-9 if focus == "10 m" else 0.0
    waves = np.array([bend(POINTER, r) - off for r in rungs])
    assert (np.abs(np.diff(waves)) <= np.maximum(0.5, 0.3 * np.abs(waves[1:])) + 1e-9).all()
    assert len(rungs) < 150


@pytest.mark.parametrize(
    ("focus", "waves"), [("3 m", "0 waves"), ("infinity", "0.35 waves"), ("3540 m", "1 waves")]
)
def test_the_ladder_of_a_lens_out_of_focus_ends_where_its_defocus_is_that_of_a_distant_laser(
    focus, waves
):
    """There a change of 0.03 waves changes the light on the axis by 7 %, which held for all
    distances beyond.
    """
    last = ladder(POINTER, lens(focus, waves), 12e-3, (0.3, 1e6), 0.3, 0.5)[-1]
    assert bend(POINTER, last) < 0.0021


def test_the_ladder_ends_where_it_is_asked_before_the_laser_is_distant():
    rungs = ladder(POINTER, lens(), 12e-3, (2.0, 40.0), 0.3, 0.5)
    assert (rungs[0], rungs[-1]) == (2.0, 40.0)


def test_a_lens_on_the_laser_has_no_defocus_that_would_need_more_rungs():
    near, far = 0.3, far_distance(POINTER, 12e-3)
    plain, bent = (
        ladder(POINTER, lens("laser", waves), 12e-3, (near, far), 0.3, 0.5)
        for waves in ("0 waves", "-9 waves")
    )
    np.testing.assert_array_equal(plain, bent)
    assert len(ladder(POINTER, lens("infinity", "-9 waves"), 12e-3, (near, far), 0.3, 0.5)) > len(
        plain
    )
