"""Where spots are computed along the axis, and with which defocus: closed forms, without a run."""

import functools
import math

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator

from neusee.workflows import load
from neusee.workflows.safety import laser_spots as spots_along
from neusee.workflows.safety.exposures import miss_between
from neusee.workflows.safety.laser_spots import at_distance

STEP = "laser_pixels[mask,pointer]"
DIAMETER, WAVELENGTH = 12e-3, 532e-9
RAYLEIGH = (2 * WAVELENGTH / (math.pi * 1e-3)) / 0.5e-3


@functools.cache
def pointer(focus="infinity", samples=512):
    return load(
        "safety_pointer",
        [f"+safety.lens.focus={focus}", f"optics.samples={samples}", "optics.defocus=0.3 waves"],
    )


def defocus_of(recipe):
    (pupil,) = (
        step for step in spots_along._upstream(recipe, STEP) if step.node.path == "optics.pupil"
    )
    return pupil.params["defocus"]


@pytest.mark.parametrize("metres", [5.0, 700.0])
@pytest.mark.parametrize("focus", ["infinity", "20 m", "laser"])
def test_a_spot_at_another_distance_has_its_wavefront_and_the_defocus_of_the_focus(focus, metres):
    """A lens on the laser takes away the bend of the wavefront, one on 20 m that of a point
    there, at 550 nm.
    """
    recipe = pointer(focus)
    varied = at_distance(recipe, recipe.safety, STEP, metres)
    moved = [
        step.params["distance"]
        for step in varied.steps.values()
        if step.node.path == "laser.wavefront"
    ]
    assert metres in moved
    bend = {"infinity": 0.0, "20 m": 1 / 20, "laser": 1 / (metres + RAYLEIGH**2 / metres)}[focus]
    assert defocus_of(varied) == pytest.approx(0.3 - bend * DIAMETER**2 / 8 / 550e-9, rel=1e-9)
    assert defocus_of(recipe) == 0.3


@pytest.mark.parametrize("samples", [512, 3072])
def test_the_nearest_spot_is_one_whose_bend_the_samples_of_the_pupil_carry(samples):
    """Between two samples of the rim, or of the edge of the beam, the phase turns by a quarter
    at most.
    """
    recipe = pointer(samples=samples)
    first = spots_along._first(recipe.safety, recipe, STEP)

    def turns(metres):
        width = math.hypot(2 * WAVELENGTH / (math.pi * 1e-3), 0.5e-3 * metres)
        rim = min(DIAMETER / 2, 3 * width)
        return rim * DIAMETER / samples / (metres + RAYLEIGH**2 / metres) / WAVELENGTH

    assert turns(first[0]) <= 0.25
    assert first[0] == recipe.safety.settings.distances[0] or turns(first[0] / 1.03) > 0.25
    fill = 0.02  # of a distant laser, whose curvature of 0.03 waves is farther away still
    far = max(DIAMETER**2 / (8 * WAVELENGTH * 0.03), 2 * math.sqrt(DIAMETER**2 / 4 / fill) / 1e-3)
    assert first[-1] == pytest.approx(far, rel=1e-3)
    assert max(np.divide(first[1:], first[:-1])) <= 6 * (1 + 1e-9)


@pytest.mark.parametrize("fill", [0.0, 0.3, 4.0])
def test_the_peak_in_focus_is_the_square_of_the_mean_field(fill):
    at, weights = np.polynomial.legendre.leggauss(40)
    mean = (np.exp(-fill * (at + 1) / 2) * weights).sum() / 2
    assert spots_along._focused(fill) == pytest.approx(mean**2, rel=1e-9)


def test_spots_are_added_where_interpolation_misses_them_and_the_miss_is_said():
    asked = []

    def bent(distance):
        asked.append(distance)
        return np.array([-2 * math.log1p((distance / 30) ** 2)])

    found = spots_along._refined([1.0, 30.0, 900.0], bent, 13)
    assert list(found.distances) == sorted(asked)
    assert all(value == bent(at) for at, value in zip(found.distances, found.values, strict=True))
    assert {math.sqrt(30.0), math.sqrt(30.0 * 900.0)} <= set(asked)
    assert 5 < len(found.distances) <= 13
    assert len(found.misses) == len(found.distances) - 1
    straight = spots_along._refined(
        [1.0, 30.0, 900.0], lambda distance: np.array([3 * math.log(distance)]), 13
    )
    assert len(straight.distances) == 5
    assert max(straight.misses) < 1e-9
    assert 0 < max(found.misses) < 0.06


def test_the_gap_that_misses_most_has_the_next_spot_and_no_miss_is_too_small():
    """A maximum at 700 m and a smooth rest: the spots gather there, and most of what they miss
    is counted.
    """

    def bent(distance):
        return np.array(
            [-math.log(distance) + 2 * math.exp(-((math.log(distance / 700) / 0.6) ** 2))]
        )

    found = spots_along._refined([1.0, 10.0, 100.0, 1000.0, 10000.0], bent, 25)
    assert len([at for at in found.distances if 200 < at < 2500]) >= 8
    along, at = np.log(np.geomspace(1.0, 10000.0, 4001)), np.log(found.distances)
    guess = PchipInterpolator(at, np.concatenate(found.values))(along)
    lifted = guess + miss_between(at, found.misses, along)
    truth = np.array([bent(math.exp(x))[0] for x in along])
    assert (truth - guess).max() > 0.01
    assert (truth - lifted).max() < 0.01


def test_a_miss_counts_in_the_middle_of_its_gap_and_nowhere_at_a_rung():
    rungs, misses = np.log([1.0, 4.0, 100.0]), (0.02, 0.3)
    np.testing.assert_allclose(miss_between(rungs, misses, rungs), 0, atol=1e-15)
    np.testing.assert_allclose(miss_between(rungs, misses, np.log([2.0, 20.0])), misses)
    np.testing.assert_array_equal(miss_between(rungs, (), np.log([2.0, 20.0])), 0)
