"""The light of the faintest lost pixel over the distance, against direct sums over the pupil and
every pixel.
"""

import math

import numpy as np
import pytest
import torch
from scipy.special import j0

from neusee.nodes.laser import BrightPixels
from neusee.workflows.recipe.blocks.safety_block import Laser, Safety, SafetySettings
from neusee.workflows.safety.dazzled_area import Area, area_of
from neusee.workflows.safety.exposures import Option, SettingDraws, compute_exposures
from neusee.workflows.safety.laser_spots import Ranked

WAVELENGTH, FOCAL, DIAMETER, PITCH, HALF = 532e-9, 50e-3, 12e-3, 3.45e-6, 20
WAIST = 2 * WAVELENGTH / (math.pi * 1e-3)
COUNT = (2 * HALF + 1) ** 2
PLAIN, STOP = Option("plain lens"), Option("stop 6 mm", diameter=6e-3)


def case(focus="infinity", scatter=None, defocus="0 waves", **dazzle):
    lens = {
        "focal_length": "50 mm",
        "diameter": "12 mm",
        "focus": focus,
        "scatter": scatter,
        "defocus": defocus,
    }
    sensor = {"pixel_pitch": "3.45 um", "shape": [2 * HALF + 1] * 2, "quantum_efficiency": 0.65, "full_well": "1e4 e-",
              "exposure": "10 ms"}  # fmt: skip
    light = {"wavelength": "532 nm", "power": "5 mW", "divergence": "1 mrad", "distance": "100 m"}
    settings = {"lens": lens, "sensor": sensor, "dazzle": {"share": 0.1, **dazzle}}
    return Safety(
        Laser.model_validate(light), SafetySettings.model_validate(settings), "laser", {}, ()
    )


def pixels_by_hand(
    metres, diameter=DIAMETER, focus=math.inf, scatter=0.0, lens=0.0, nm=532.0, focal=FOCAL
):
    """The light of every pixel: a direct sum over the pupil at 7 x 7 points of each, and Harvey
    and Shack's law.
    """
    wavelength = nm * 1e-9
    waist = 2 * wavelength / (math.pi * 1e-3)
    fill = (diameter / (2 * math.hypot(waist, 0.5e-3 * metres))) ** 2
    bend = 1 / (metres + (2e3 * waist) ** 2 / metres) - 1 / focus
    waves = (diameter**2 / 8 * bend + lens * 550e-9 * (diameter / DIAMETER) ** 2) / wavelength
    at, weights = np.polynomial.legendre.leggauss(300)
    square = (at + 1) / 2
    pupil = weights / 2 * np.exp((-fill + 2j * np.pi * waves) * square)
    axis = (np.arange(-HALF, HALF + 1)[:, None] + (np.arange(7) - 3) / 7).ravel()
    table = np.linspace(0, 1.5 * HALF + 2, 3000)
    spread = wavelength * focal / diameter / PITCH
    field = np.concatenate(
        [
            j0(np.outer(x, np.sqrt(square)) * np.pi / spread) @ pupil
            for x in np.array_split(table, 9)
        ]
    )
    light = np.interp(np.hypot(axis[:, None], axis), table, np.abs(field) ** 2)
    core = light.reshape(2 * HALF + 1, 7, 2 * HALF + 1, 7).mean((1, 3))
    core *= math.pi / (4 * spread**2) * 2 * fill / -math.expm1(-2 * fill)
    centres = np.arange(-HALF, HALF + 1)
    sine = np.hypot(centres[:, None], centres) * PITCH / focal
    law = 2 * math.pi * ((0.01**2 + 1) ** 0.25 - 0.01**0.5) / (0.01**-1.5 * 0.5)
    return (1 - scatter) * core + scatter / law * (1 + (sine / 0.01) ** 2) ** -0.75 * (
        PITCH / focal
    ) ** 2


def faintest(light, number=0.1 * COUNT):
    return np.sort(light.ravel())[::-1][round(number) - 1]


def area(safety, option=PLAIN, ranked=None, at=(0.8, 6.0, 90.0, 4e3), **drawn):
    columns = {name.replace("__", "."): np.array(column) for name, column in drawn.items()}
    draws = SettingDraws(len(next(iter(columns.values()), ())), columns, {}, 7)
    return (
        Area(option, safety, ranked),
        compute_exposures(safety, draws, (option,), np.array(at)),
        draws,
    )


@pytest.mark.slow
@pytest.mark.parametrize(("option", "diameter"), [(PLAIN, DIAMETER), (STOP, 6e-3)])
@pytest.mark.parametrize(("focus", "metres", "scatter", "lens"), [("infinity", math.inf, None, 0.0),
                                                                  ("7 m", 7.0, 0.02, 0.8)])  # fmt: skip
def test_the_faintest_lost_pixel_is_that_of_a_direct_sum(
    option, diameter, focus, metres, scatter, lens
):
    scatters = None if scatter is None else {"share": scatter, "surfaces": None}
    safety = case(focus, scatters, f"{lens} waves")
    found = area(safety, option)
    level = found[0].level(found[1], found[2], False)[0]
    for value, distance in zip(level, (0.8, 6.0, 90.0, 4e3), strict=True):
        light = pixels_by_hand(distance, diameter, metres, scatter or 0.0, lens)
        low, high = (faintest(light, number * 0.1 * COUNT) for number in (1.06, 0.94))
        assert 0.97 * low <= value <= 1.03 * high, distance


def test_a_lens_on_the_laser_has_the_focused_spot_at_every_distance():
    found = area(case("laser"), at=(6.0, 4e3))
    level = found[0].level(*found[1:], False)[0]
    for value, distance in zip(level, (6.0, 4e3), strict=True):
        light = pixels_by_hand(distance, focus=distance + (2e3 * WAIST) ** 2 / distance)
        assert (
            0.97 * faintest(light, 0.106 * COUNT) <= value <= 1.03 * faintest(light, 0.094 * COUNT)
        )


def test_drawn_colours_and_focal_lengths_have_spots_of_their_own_size():
    drawn = {"laser__wavelength": [480e-9, 640e-9], "lens__focal_length": [0.04, 0.06]}
    found = area(case(), at=(90.0, 4e3), **drawn)
    level = found[0].level(*found[1:], False)
    for row, (nm, focal) in zip(level, ((532, 0.05), (480, 0.04), (640, 0.06)), strict=True):
        for value, distance in zip(row, (90.0, 4e3), strict=True):
            light = pixels_by_hand(distance, nm=nm, focal=focal)
            assert (
                0.93 * faintest(light, 0.11 * COUNT)
                <= value
                <= 1.07 * faintest(light, 0.09 * COUNT)
            )


def test_the_number_of_pixels_with_a_light_is_the_inverse_of_the_level():
    found = area(case())
    level = found[0].level(*found[1:], False)[0]
    for index, value in enumerate(level):
        number = found[0].saturated(found[1], found[2], index, np.array([[value, 1.0, 1e-30]]))[0]
        assert number.tolist() == pytest.approx([found[0].asked, 0.0, COUNT], rel=1e-6)


def test_the_asked_number_is_the_share_of_all_pixels_and_one_at_least():
    assert area(case())[0].asked == pytest.approx(0.1 * 41 * 41)
    assert area(case(share=1e-5))[0].asked == 1
    assert 0.1 * 41 * 41 in area(case())[0].ranks


def spot(level):
    """Pixels of a mask that leaves an even light."""
    radius, pixels, light = (
        torch.tensor(column).double() for column in ([1.0, 9, 25], [COUNT / 3] * 3, [level] * 3)
    )
    return BrightPixels(radius, pixels, light, light, torch.tensor([math.inf, 0.0, 1.0]))


def test_behind_a_mask_the_light_is_that_of_its_distance_and_nearer_than_the_first_all_of_it():
    """All light in the pixels that may be lost, 1 / N in each, is the most that there can be."""
    ranked = Ranked("mask", (6.0, 90.0), (spot(1e-4), spot(1e-5)), 0.01)
    mask = Option("mask", peak=0.01, masked=True)
    found = area(case(), mask, ranked, at=(0.8, 5.9, 6.0, 90.0, 4e3))
    level = found[0].level(*found[1:], False)[0]
    assert level.tolist() == pytest.approx([10 / COUNT, 10 / COUNT, 1e-4, 1e-5, 1e-5], rel=1e-6)
    wide = area(case(), mask, ranked, at=(3.1, 45.0), laser__divergence=[2e-3])
    drawn = wide[0].level(*wide[1:], False)[1]  # as wide as the nominal beam is twice as far away
    assert drawn.tolist() == pytest.approx([1e-4, 1e-5], rel=0.05)


def test_an_option_has_its_own_spots_or_says_why_it_has_none():
    """A stop cuts the spots of the plain lens, so that its own integral counts; a mask without
    spots has no area.
    """
    plain, mask = (Ranked(arm, (6.0,), (spot(1e-4),), 0.01) for arm in ("plain", "mask"))
    masked = Option("mask", masked=True)
    assert area_of(case(), PLAIN, (plain, mask)).ranked is plain
    assert area_of(case(), STOP, (plain, mask)).ranked is None
    assert area_of(case(), masked, (plain, mask)).ranked is mask
    assert "does not compute the dazzled area" in area_of(case(), masked, (plain,))
    single = Ranked("mask", (6.0,), (spot(1e-4),), math.inf)
    assert "no wavefront" in area_of(case(), masked, (single,))
    assert "no wavefront" in area_of(
        case(), PLAIN, (Ranked("plain", (6.0,), (spot(1e-4),), math.inf),)
    )
