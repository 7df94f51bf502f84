"""Exposures over the distance: air, hot spots, focus, stops and masks, against closed forms
written here.
"""

import math

import numpy as np
import pytest

from neusee.workflows.recipe.blocks.safety_block import Laser, Safety, SafetySettings
from neusee.workflows.safety.exposures import (
    Option,
    SettingDraws,
    asked_distances,
    compute_exposures,
    options_of,
)

WAVELENGTH, DIAMETER, FOCAL, THETA = 532e-9, 12e-3, 50e-3, 1e-3
WAIST = 2 * WAVELENGTH / (math.pi * THETA)
PLAIN = Option("plain lens")


def case(lens=(), beam=(), laser=(), protection=()):
    """A laser of 532 nm and 1 mrad 100 m in front of a lens of 12 mm that is focused on the
    laser.
    """
    light = {
        "wavelength": "532 nm",
        "power": "5 mW",
        "divergence": "1 mrad",
        "distance": "100 m",
        **dict(laser),
    }
    optics = {"focal_length": "50 mm", "diameter": "12 mm", "focus": "laser", **dict(lens)}
    sensor = {"pixel_pitch": "3.45 um", "shape": [101, 101]}
    settings = {
        "lens": optics,
        "sensor": sensor,
        "beam": dict(beam),
        "protection": dict(protection),
    }
    return Safety(
        Laser.model_validate(light), SafetySettings.model_validate(settings), "laser", {}, ()
    )


def draws(**columns):
    values = {name.replace("__", "."): np.array(column) for name, column in columns.items()}
    return SettingDraws(len(next(iter(values.values()), ())), values, {}, 7)


def exposures(safety, *options, at=(0.5, 20.0, 100.0, 3e3), drawn=None):
    return compute_exposures(safety, drawn or draws(), options or (PLAIN,), np.array(at))


def width(distance):
    return math.hypot(WAIST, THETA * distance / 2)


def focused(distance, diameter=DIAMETER):
    """Peak over power of the lens in focus: the field of a Gaussian beam adds in phase over the
    aperture.
    """
    square = width(distance) ** 2
    field = math.pi * square * -math.expm1(-(diameter**2) / (4 * square))
    return 2 / (math.pi * square) * (field / (WAVELENGTH * FOCAL)) ** 2


def through(distance, diameter=DIAMETER):
    return -math.expm1(-(diameter**2) / (2 * width(distance) ** 2))


AT = (0.5, 20.0, 100.0, 3e3)


def test_every_exposure_has_the_factors_that_lie_before_it_and_no_other():
    """Air of 0.8 on 100 m, a lens of 0.9, a filter of 0.01 and hot spots of 2.5: the filter is
    behind the lens.
    """
    safety = case({"transmittance": 0.9}, {"hot_spots": 2.5}, {"air_transmittance": 0.8})
    grey = Option("grey filter", passing=0.01)
    found = exposures(safety, PLAIN, grey)
    before = [2.5 * 0.8 ** (r / 100) for r in AT]
    np.testing.assert_allclose(
        found.lens[0], [b * 2 / (math.pi * width(r) ** 2) for b, r in zip(before, AT, strict=True)]
    )
    for option, passing in ((PLAIN, 0.9), (grey, 0.009)):
        peaks = [b * passing * focused(r) for b, r in zip(before, AT, strict=True)]
        light = [b * passing * through(r) for b, r in zip(before, AT, strict=True)]
        np.testing.assert_allclose(found.sensor[option.name][0], peaks, rtol=1e-9)
        np.testing.assert_allclose(found.through[option.name][0], light, rtol=1e-9)
    fills = [(DIAMETER / (2 * width(r))) ** 2 for r in AT]
    np.testing.assert_allclose(found.fill["plain lens"][0], fills, rtol=1e-9)


def test_drawn_air_and_drawn_hot_spots_have_a_row_each():
    drawn = draws(laser__air_transmittance=[0.5, 0.9], beam__hot_spots=[1.0, 3.0])
    safety = case(beam={"hot_spots": 2.0}, laser={"air_transmittance": 0.8})
    found = exposures(safety, drawn=drawn)
    factors = np.array(
        [[2 * 0.8 ** (r / 100), 0.5 ** (r / 100), 3 * 0.9 ** (r / 100)] for r in AT]
    ).T
    for values in (found.lens, found.sensor["plain lens"], found.through["plain lens"]):
        np.testing.assert_allclose(values / values[1], factors / factors[1], rtol=1e-9)
    alone = exposures(case(laser={"air_transmittance": 0.8}))
    np.testing.assert_allclose(found.lens[0], 2 * alone.lens[0], rtol=1e-9)


@pytest.mark.parametrize(("visibility", "at"), [("5 km", 1e3), ("23 km", 3e3)])
def test_air_of_a_visibility_leaves_two_per_cent_of_green_contrast_there(visibility, at):
    """Kruse's law at 550 nm: 3.91 / V; the exponent of the wavelength is 1.3 from 6 km and Kim's
    0.16 V + 0.34.
    """
    metres = float(visibility.split()[0]) * 1e3
    exponent = 1.3 if metres >= 6e3 else 0.16 * metres / 1e3 + 0.34
    expected = math.exp(-3.912 / metres * (532 / 550) ** -exponent * at)
    hazy, clear = (
        exposures(case(laser=more), at=(at,)) for more in ({"visibility": visibility}, {})
    )
    assert float(hazy.lens[0, 0] / clear.lens[0, 0]) == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize("focus", ["infinity", "20 m", "laser"])
def test_defocus_is_that_of_the_distance_and_of_the_lens_by_the_square_of_a_stop(focus):
    """Half a wave of the lens at 550 nm is a quarter of it behind half the diameter; a lens on
    the laser has none.
    """
    stop = Option("stop 6 mm", diameter=6e-3)
    found = exposures(case({"focus": focus, "defocus": "0.5 waves"}), PLAIN, stop)
    for option, diameter in ((PLAIN, DIAMETER), (stop, 6e-3)):
        waves = np.broadcast_to(found.waves[option.name], (1, len(AT)))[0]
        if focus == "laser":
            assert (waves == 0).all()
            continue
        rayleigh = math.pi * WAIST**2 / WAVELENGTH
        bends = [1 / (r + rayleigh**2 / r) - (0.05 if focus == "20 m" else 0.0) for r in AT]
        lens = 0.5 * 550e-9 * (diameter / DIAMETER) ** 2
        expected = [(diameter**2 / 8 * bend + lens) / WAVELENGTH for bend in bends]
        np.testing.assert_allclose(waves, expected, rtol=1e-6)


def test_a_stop_narrows_and_never_widens_the_lens():
    narrow, wide = Option("narrow", diameter=3e-3), Option("wide", diameter=40e-3)
    found = exposures(case(), PLAIN, narrow, wide)
    np.testing.assert_allclose(found.sensor["narrow"][0], [focused(r, 3e-3) for r in AT], rtol=1e-6)
    np.testing.assert_allclose(
        found.through["narrow"][0], [through(r, 3e-3) for r in AT], rtol=1e-6
    )
    np.testing.assert_array_equal(found.sensor["wide"], found.sensor["plain lens"])


def behind(option, at, safety=None, drawn=None):
    """The peak behind a mask over that of the clear lens in focus."""
    found = exposures(safety or case(), PLAIN, option, at=at, drawn=drawn)
    return found.sensor["mask"] / found.sensor["plain lens"]


ALONG = ((2.0, 0.4), (20.0, 0.02), (500.0, 0.001))


def test_the_peak_behind_a_mask_is_that_of_its_distance_and_1_nearer_than_the_first():
    """Nearer than the first computed peak no mask is sure to help; farther than the last one it
    stays the same.
    """
    mask = Option("mask", peak=0.007, masked=True, peaks=ALONG)
    ratio = behind(mask, (0.1, 1.9, 2.0, 20.0, 60.0, 500.0, 9e4))[0]
    assert ratio[[0, 1]].tolist() == pytest.approx([1.0, 1.0], rel=1e-9)
    assert ratio[[2, 3, 5, 6]].tolist() == pytest.approx([0.4, 0.02, 0.001, 0.001], rel=1e-6)
    assert 0.001 < ratio[4] < 0.02
    alone = behind(Option("mask", peak=0.007, masked=True), (0.1, 20.0, 9e4))
    np.testing.assert_allclose(alone, 0.007, rtol=1e-9)


def test_a_drawn_beam_has_the_peak_of_the_nominal_beam_where_that_one_is_as_wide():
    """A beam of 2 mrad is at 10 m as wide as the one of 1 mrad at 20 m, but for the waist."""
    mask = Option("mask", peak=0.007, masked=True, peaks=ALONG)
    ratio = behind(mask, (0.9, 10.0, 250.0), drawn=draws(laser__divergence=[2e-3]))
    assert ratio[0, 0] == pytest.approx(1, rel=1e-9)
    assert ratio[1].tolist() == pytest.approx([1.0, 0.02, 0.001], rel=2e-3)


def test_a_filter_and_a_stop_take_the_scenes_light_by_their_own_shares():
    """A grey filter as much as the laser's, a notch another share, and a stop the square of its
    diameter's.
    """
    assert Option("grey filter", passing=0.01).scene_share(DIAMETER) == 0.01
    assert Option("notch filter", passing=1e-4, scene=0.95).scene_share(DIAMETER) == 0.95
    assert Option("stop", diameter=3e-3).scene_share(DIAMETER) == pytest.approx(1 / 16)
    assert Option("stop", diameter=20e-3).scene_share(DIAMETER) == 1


def test_the_mask_with_a_grey_filter_keeps_the_peaks_over_the_distance():
    named = options_of(case(protection={"filter": 0.01, "stop": "3 mm"}), 0.007, ALONG)
    assert [option.name for option in named] == [
        "plain lens",
        "mask",
        "grey filter 0.01",
        "stop 3 mm",
        "mask and grey filter",
    ]
    both = named[-1]
    assert (both.masked, both.peak, both.peaks, both.passing) == (True, 0.007, ALONG, 0.01)
    assert [option.masked for option in named[:4]] == [False, True, False, False]


def test_distances_are_those_that_are_asked_for_and_that_of_the_recipe():
    at = asked_distances(case())
    assert (at[0], at[-1]) == (1.0, 1e5)
    assert 100.0 in at
    far = asked_distances(case(laser={"distance": "300 km"}))
    assert far[-1] == 3e5
    assert exposures(case(), at=AT).at(99.0) == AT.index(100.0)


def test_out_of_focus_the_heated_spot_is_wider_and_in_focus_it_is_not():
    """By less than an even disc of the same light and peak has, the bound that counts behind a
    mask.
    """
    focus, off = (
        exposures(case({"focus": name}), at=(10.0, 100.0, 1e5)) for name in ("laser", "infinity")
    )
    loss = (focus.sensor["plain lens"] / off.sensor["plain lens"])[0]
    wider = (off.spot["plain lens"] / focus.spot["plain lens"])[0]
    assert loss[0] > 5
    disc = 3 * math.pi / 8 * np.sqrt(loss)
    assert (wider < disc).all()
    assert wider[0] > 0.7 * disc[0]
    # a lens focused at infinity has a far laser in focus
    assert wider[-1] == pytest.approx(1, abs=1e-3)
    mask = Option("mask", peak=0.04, masked=True)
    found = exposures(case(), PLAIN, mask, at=(100.0,))
    # `Option.heated` has the rest
    assert found.spot["mask"][0] == pytest.approx(found.spot["plain lens"][0], rel=0.04)


def test_hot_spots_and_turbulence_multiply_each_other():
    """The factor of 95 % of the time at Rytov's variance of a plane wave, on 1.5 times the even
    beam.
    """
    even, spotted, moved, both = (
        exposures(case(beam=more))
        for more in (
            {},
            {"hot_spots": 1.5},
            {"cn2": 1e-15, "worst": 0.95},
            {"hot_spots": 1.5, "cn2": 1e-15, "worst": 0.95},
        )
    )
    spreads = [
        math.sqrt(1.23e-15 * (2 * math.pi / WAVELENGTH) ** (7 / 6) * r ** (11 / 6)) for r in AT
    ]
    factors = [math.exp(1.6448536269514722 * x - x * x / 2) for x in spreads]
    np.testing.assert_allclose((moved.lens / even.lens)[0], factors, rtol=1e-9)
    np.testing.assert_allclose((both.lens / even.lens)[0], 1.5 * np.array(factors), rtol=1e-9)
    np.testing.assert_allclose(
        both.sensor["plain lens"], spotted.sensor["plain lens"] * factors, rtol=1e-9
    )
