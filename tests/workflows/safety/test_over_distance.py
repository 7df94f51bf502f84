"""Intervals of distance do not depend on the distance of the recipe, and near ends are those of
separate code.
"""

import math

import numpy as np
import pytest
from scipy.special import j0

from neusee.workflows import Store, load
from neusee.workflows.safety.run_safety import document
from neusee.workflows.safety.safety_estimate import estimate

CAMERA = ["laser=pointer", "+safety=camera", "sensor.full_well=2.55e6 e-", "safety.draws=100"]
LENS = [
    "safety.draws=100",
    "lasers.pointer.power=5 mW",
    "lasers.pointer.divergence=1 mrad",
    "optics.samples=640",
    "wide.window=[1203, 1203]",
    "safety.protection.stop=null",
    "safety.sensor.shape=[401, 401]",
]
pytestmark = pytest.mark.usefixtures("without_remedies")
PLANCK_LIGHT = 6.62607015e-34 * 299792458.0


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return Store(tmp_path_factory.mktemp("store"))


def zones(recipe, changes, store):
    said = document(estimate(load(recipe, changes), store))
    return {
        (each["protection"], each["limit"]): [
            (zone["near"]["value"], zone["far"]["value"]) for zone in each["zones"]
        ]
        for each in said["limits"]
    }


def same_ends(recipe, changes, distances, store):
    first = zones(recipe, changes, store)
    for metres in distances:
        found = zones(recipe, [*changes, f"lasers.pointer.distance={metres:g} m"], store)
        assert found.keys() == first.keys()
        for row, ends in first.items():
            assert len(found[row]) == len(ends), (row, metres)
            for one, other in zip(found[row], ends, strict=True):
                assert one == pytest.approx(other, rel=0.01), (row, metres)


@pytest.mark.slow
def test_the_intervals_of_a_camera_do_not_move_with_the_distance_of_the_recipe(store):
    """At 3 m they once were "nowhere", and 45 m in place of 522 m behind the mask."""
    same_ends("first_light", [*CAMERA, "optics.bands=5"], (3.0,), store)


@pytest.mark.slow
def test_the_intervals_of_a_lens_do_not_move_with_the_distance_of_the_recipe(store):
    same_ends("safety_pointer", LENS, (0.3, 1e4), store)


@pytest.mark.long
@pytest.mark.parametrize(("recipe", "changes"), [("first_light", CAMERA), ("safety_pointer", LENS)])
def test_the_intervals_do_not_move_at_twenty_distances(recipe, changes, store):
    """The tests above have one or both ends of the range, of the same two recipes."""
    same_ends(recipe, changes, np.geomspace(0.3, 1e4, 20), store)


def level_by_hand(metres, scatter, share=0.1):
    """The light of the faintest of a share of 401 x 401 pixels: a direct sum over the pupil, and
    Harvey and Shack.
    """
    wavelength, diameter, focal, pitch, half = 532e-9, 12e-3, 50e-3, 3.45e-6, 200
    waist = 2 * wavelength / (math.pi * 1e-3)
    width = math.hypot(waist, 1e-3 * metres / 2)
    fill = diameter**2 / (4 * width**2)
    curvature = 1 / (metres + (2 * waist / 1e-3) ** 2 / metres)
    waves = diameter**2 * curvature / (8 * wavelength)
    points = (np.arange(5) - 2) / 5
    axis = (np.arange(half + 1)[:, None] + points).ravel()
    radius = np.hypot(axis[:, None], axis)
    at, weights = np.polynomial.legendre.leggauss(700)
    ring = (at + 1) / 2
    pupil = ring * weights * np.exp((-fill + 2j * np.pi * waves) * ring**2)
    table = np.linspace(0, radius.max() + 1, 9000)
    scale = np.pi * pitch * diameter / (wavelength * focal)
    field = np.concatenate(
        [j0(np.outer(part * scale, ring)) @ pupil for part in np.array_split(table, 60)]
    )
    spot = np.interp(radius, table, np.abs(field) ** 2)
    core = spot.reshape(half + 1, 5, half + 1, 5).mean((1, 3))
    core *= (
        np.pi
        / 4
        * (pitch * diameter / (wavelength * focal)) ** 2
        / (-np.expm1(-2 * fill) / (2 * fill))
    )
    centres = np.hypot(np.arange(half + 1)[:, None], np.arange(half + 1)) * pitch / focal
    bsdf = (1 + (centres / 0.01) ** 2) ** -0.75
    total = 2 * np.pi * ((0.01**2 + 1) ** 0.25 - 0.01**0.5) / (0.01**-1.5 * 0.5)
    light = (1 - scatter) * core + scatter / total * bsdf * (pitch / focal) ** 2
    number = np.outer([1, *[2] * half], [1, *[2] * half]).ravel()
    order = np.argsort(-light.ravel())
    faintest = light.ravel()[order][np.searchsorted(number[order].cumsum(), share * 401 * 401)]
    return faintest, 5e-3 * 0.9 * -np.expm1(-2 * fill), pitch**2


@pytest.mark.slow
@pytest.mark.parametrize("scatter", [0.005, 0.0])
def test_the_ends_are_those_of_a_direct_sum_over_the_pupil_and_every_pixel(scatter, store):
    setting = "null" if scatter == 0 else f"{{share: {scatter}}}"
    changes = [
        *LENS,
        "safety.protection.mask=null",
        f"+safety.lens.scatter={setting}",
        "safety.distances=[0.3 m, 10 km]",
    ]
    found = zones("safety_pointer", changes, store)["plain lens", "saturated: 10 % of the picture"]
    full = 10500 / 0.65 * PLANCK_LIGHT / 532e-9 / (3.45e-6**2 * 10e-3)

    def margin(metres):
        light, power, area = level_by_hand(metres, scatter)
        return math.log(power * light / area / full)

    assert found
    for near, far in found:
        assert near <= 0.3 * (1 + 1e-6) or margin(near / 1.03) < 0 < margin(near * 1.03)
        assert margin(far / 1.03) > 0 > margin(far * 1.03)
    if scatter:
        assert found[0][0] == pytest.approx(0.3)  # the veil dazzles up to the lens
        assert margin(0.35) > 0
    else:
        assert found[0][0] > 1  # without a veil a narrow beam leaves most pixels dark


@pytest.mark.slow
def test_the_veil_is_named_with_its_value_and_can_be_turned_off(store):
    few = [*LENS, "safety.protection={}", "safety.distances=[10 m, 1 km]"]
    said = document(estimate(load("safety_pointer", few), store))
    assert said["scattered_share"]["value"] == pytest.approx(0.005)
    assert said["scattered_share_is_assumed"]
    assert said["scattered_share"]["low"] < 0.003 < 0.008 < said["scattered_share"]["high"]
    stated = document(
        estimate(load("safety_pointer", [*few, "+safety.lens.scatter.share=0.01"]), store)
    )
    assert stated["scattered_share"] == {"value": 0.01, "low": 0.01, "high": 0.01}
    assert not stated["scattered_share_is_assumed"]
    assert (
        document(estimate(load("safety_pointer", [*few, "+safety.lens.scatter=null"]), store))[
            "scattered_share"
        ]
        is None
    )


@pytest.mark.slow
def test_hot_spots_and_turbulence_raise_the_exposure_by_their_factors(store):
    few = [*LENS, "safety.protection.mask=null", "safety.dazzle=null"]
    even, spotted, moved = (
        estimate(load("safety_pointer", [*few, *more]), store)
        for more in ([], ["+safety.beam.hot_spots=2.5"], ["+safety.beam.cn2=1e-14"])
    )
    at = even.at
    plain = even.exposures.sensor["plain lens"][0]
    np.testing.assert_allclose(spotted.exposures.sensor["plain lens"][0], 2.5 * plain)
    variance = 1.23 * 1e-14 * (2 * math.pi / 532e-9) ** (7 / 6) * 100.0 ** (11 / 6)
    factor = math.exp(2.3263478740408408 * math.sqrt(variance) - variance / 2)
    assert moved.exposures.sensor["plain lens"][0, at] / plain[at] == pytest.approx(
        factor, rel=1e-9
    )
    assert factor > 1.2


@pytest.mark.slow
def test_a_lens_that_focuses_on_the_laser_has_the_peak_of_the_focused_lens(store):
    few = [
        *LENS,
        "safety.protection.mask=null",
        "safety.dazzle=null",
        "lasers.pointer.distance=10 m",
    ]
    infinity, near, focused = (
        estimate(load("safety_pointer", [*few, f"+safety.lens.focus={focus}"]), store)
        for focus in ("infinity", "10 m", "laser")
    )
    peaks = [each.exposures.sensor["plain lens"][0, each.at] for each in (infinity, near, focused)]
    width = math.hypot(2 * 532e-9 / (math.pi * 1e-3), 5e-3)
    fill = (6e-3 / width) ** 2
    clear = 0.9 * (math.pi * 0.012**2 / 4 / (532e-9 * 0.05)) ** 2 * 2 / (math.pi * width**2)
    assert peaks[2] == pytest.approx(clear * ((1 - math.exp(-fill)) / fill) ** 2, rel=1e-9)
    assert peaks[1] == pytest.approx(peaks[2], rel=0.02)
    waves = 0.012**2 / (8 * 532e-9 * 10)
    size = complex(fill, -2 * math.pi * waves)
    on_axis = clear * abs((1 - np.exp(-size)) / size) ** 2
    assert peaks[0] == pytest.approx(on_axis, rel=0.05)
    assert peaks[0] < 0.1 * peaks[2]
