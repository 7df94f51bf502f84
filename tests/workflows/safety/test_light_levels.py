"""Levels of light of ranked pixels with the veil of a lens, against sums over every pixel and
SciPy's programs.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.optimize import brentq

from neusee.nodes.laser import BrightPixels
from neusee.workflows.recipe.blocks.safety_block import Laser, Safety, SafetySettings
from neusee.workflows.safety.exposures import SettingDraws
from neusee.workflows.safety.laser_spots import Grid, Levels, Veil, levels_of, veil_of

SHAPE = (61, 81)
Y, X = (np.arange(n) - n // 2 for n in SHAPE)
AWAY = np.hypot(Y[:, None], X)


def law(radius):
    """The light of a veil of 2 % in a pixel, at any distance."""
    return 0.02 * (1 + (radius / 9) ** 2) ** -0.75 / 2e3


def veil(share=0.02):
    return Veil(np.array([share]), False, lambda radius: law(radius) * share / 0.02)


def groups(light, rim=(math.inf, 0.0, 1.0), smooth=None):
    """Every pixel of a frame as a group of its own, or of several that are alike."""
    columns = [
        AWAY.ravel(),
        np.ones(AWAY.size),
        light.ravel(),
        (light if smooth is None else smooth).ravel(),
    ]
    return BrightPixels(*map(torch.from_numpy, columns), torch.tensor(rim, dtype=torch.float64))


def spot(kind):
    """Pixels of a spot in the middle, or of a mask that sends its light to a ring and leaves the
    middle dark.
    """
    core = np.exp(-((AWAY / 4) ** 2)) if kind == "middle" else np.exp(-(((AWAY - 20) / 2) ** 2))
    return core / core.sum()


RANKS = np.array([1.0, 30.0, 494.0, 2000.0, 4941.0])


@pytest.mark.parametrize("kind", ["middle", "ring"])
@pytest.mark.parametrize("share", [0.005, 0.02, 0.3])
def test_the_veil_lies_beside_the_spot_behind_a_mask_as_well(kind, share):
    """Where the spot is dark there is nothing but the veil, less what it takes from the core."""
    found, beyond = levels_of(groups(spot(kind)), SHAPE, RANKS, veil(), np.array([share]), False)
    light = (1 - share) * spot(kind) + share * law(AWAY) / 0.02
    expected = np.sort(light.ravel())[::-1][RANKS.astype(int) - 1]
    np.testing.assert_allclose(np.exp(found[0]), expected, rtol=1e-9)
    assert beyond.tolist() == [[0.0] * len(RANKS)]


def test_without_a_veil_there_is_one_row_of_the_core_and_the_veiled_feature_has_the_smooth_one():
    core, smooth = spot("middle"), np.full(SHAPE, 1 / AWAY.size)
    bare, _ = levels_of(
        groups(core, smooth=smooth), SHAPE, RANKS, None, np.array([0.1, 0.2]), False
    )
    assert bare.shape == (1, len(RANKS))
    np.testing.assert_allclose(
        np.exp(bare[0]), np.sort(core.ravel())[::-1][RANKS.astype(int) - 1] + 1e-300, rtol=1e-9
    )
    even, _ = levels_of(groups(core, smooth=smooth), SHAPE, RANKS, None, np.zeros(1), True)
    np.testing.assert_allclose(np.exp(even[0]), 1 / AWAY.size, rtol=1e-9)


def in_window(half=10, light=1e-5):
    """A window of 21 pixels of a frame of 61 x 81: a spot within it, a rim, and a tenth of the
    light nowhere.
    """
    inside = np.maximum(np.abs(Y)[:, None], np.abs(X)) <= half
    core = np.where(inside, 1 / (1 + (AWAY / 2) ** 3), 0.0)
    core *= 0.8 / core.sum()
    columns = [AWAY[inside], np.ones(int(inside.sum())), core[inside], core[inside]]
    rim = torch.tensor([10.0, light, 0.9], dtype=torch.float64)
    return BrightPixels(*map(torch.from_numpy, columns), rim), inside, core


@pytest.mark.parametrize("rim", [1e-5, 3e-4])
@pytest.mark.parametrize("share", [0.0, 0.02])
def test_hidden_light_is_dealt_out_so_that_as_many_pixels_as_can_be_reach_a_level(share, rim):
    """The tenth that neither window nor radial law has lies outside: levels by a root of SciPy
    over all pixels.
    """
    found, inside, core = in_window(light=rim)
    outside = AWAY[~inside]
    light = (1 - share) * rim * (10 / outside) ** 3 + share / 0.02 * law(outside)
    own = np.sort((1 - share) * core[inside] + share / 0.02 * law(AWAY[inside]))[::-1]
    hidden = (1 - share) * 0.1

    def lit(level):
        lacks = np.sort(np.maximum(level - light, 0.0)).cumsum()
        return np.searchsorted(lacks, hidden, side="right") + np.searchsorted(
            -own, -level, side="right"
        )

    ranks = np.array([200.0, 500.0, 1500.0, 4000.0])
    lights = veil() if share else None
    levels, beyond = levels_of(found, SHAPE, ranks, lights, np.array([share]), False)
    expected = [
        math.exp(
            brentq(
                lambda x, rank=rank: lit(math.exp(x)) - rank + 0.5, math.log(1e-9), math.log(0.1)
            )
        )
        for rank in ranks
    ]
    np.testing.assert_allclose(np.exp(levels[0]), expected, rtol=0.05)
    assert (beyond[0] > 0).all()
    assert (beyond[0] <= 1).all()


def test_the_radial_law_decides_where_it_and_not_the_veil_gives_the_light_beyond_the_window():
    found, inside, core = in_window()
    known = found._replace(rim=torch.tensor([10.0, 1e-5, 1.0], dtype=torch.float64))
    alone, bare = levels_of(known, SHAPE, np.array([4000.0]), None, np.zeros(1), False)
    light = np.concatenate([core[inside], 1e-5 * (10 / AWAY[~inside]) ** 3])
    assert math.exp(alone[0, 0]) == pytest.approx(np.sort(light)[::-1][3999], rel=0.01)
    assert bare[0, 0] == pytest.approx(1 - inside.sum() / 4000, rel=0.02)
    _, veiled = levels_of(known, SHAPE, np.array([4000.0]), veil(), np.array([0.9]), False)
    assert veiled[0, 0] == 0


def test_a_grid_holds_its_values_and_interpolates_them_in_straight_lines():
    one = Grid.around(np.array([1.0, 1.01]), 4)
    assert one.points.tolist() == [1.0]
    grid = Grid.around(np.array([[0.0], [2.0]]), 4)
    assert grid.points.tolist() == pytest.approx(np.linspace(0, 2, 9))
    assert len(Grid.around(np.array([0.0, 0.1]), 4).points) == 3
    at = np.array([[-1.0, 0.0, 0.6, 2.0, 5.0]])
    weights = np.stack(grid.weights(at))
    np.testing.assert_allclose(weights.sum(0), 1, rtol=1e-12)
    np.testing.assert_allclose(
        (weights * grid.points[:, None, None]).sum(0), np.clip(at, 0, 2), atol=1e-12
    )
    assert one.weights(at)[0].tolist() == [[1.0]]


@pytest.mark.parametrize(("low", "high"), [(-0.75, 0.38), (0.2, 0.9), (-3.0, -0.1), (0.0, 1.0)])
def test_a_grid_through_zero_holds_its_values_and_gives_zero_without_interpolation(low, high):
    """The nominal values and all draws far from the laser have the offset 0: a chord there was 6
    % too low.
    """
    points = Grid.through_zero(np.array([low, high]), 1.5).points
    assert 0.0 in points.tolist()
    assert points[0] <= low + 1e-12
    assert points[-1] >= high - 1e-12
    assert np.diff(points) == pytest.approx(points[1] - points[0])
    assert points[1] - points[0] <= 1 / 1.5


def test_a_grid_through_zero_of_values_that_are_alike_is_one_point():
    assert Grid.through_zero(np.array([[1e-9]]), 1.5).points.tolist() == [0.0]


def test_levels_are_those_of_their_rungs_and_nearer_than_the_first_the_bound():
    rungs, grid = np.log([2.0, 20.0, 200.0]), Grid(np.array([0.0, 1.0]))
    values = np.random.default_rng(1).standard_normal((3, 2, 2))
    table = Levels(rungs, (grid,), values, np.zeros_like(values), most=np.array([7.0, 8.0]))
    place = np.log([[1.0, 1.99, 2.0, 20.0, 200.0, 5e3]])
    found = table.at(place, [np.array([[0.25]])], slice(None))
    expected = 0.75 * values[:, 0] + 0.25 * values[:, 1]
    np.testing.assert_allclose(found[0], [[7, 8], [7, 8], *expected, expected[2]], rtol=1e-9)
    assert table.at(place, [np.array([[0.25]])], slice(1, 2)).shape == (1, 6, 1)
    free = Levels(rungs, (grid,), values, np.zeros_like(values))
    np.testing.assert_allclose(
        free.at(place, [np.array([[0.25]])], slice(None))[0, 0], expected[0], rtol=1e-9
    )


def case(scatter, stated=False):
    lens = {"focal_length": "50 mm", "diameter": "12 mm", "scatter": scatter}
    sensor = {"pixel_pitch": "3.45 um", "shape": [101, 101]}
    laser = {"wavelength": "532 nm", "power": "5 mW", "divergence": "1 mrad", "distance": "100 m"}
    values = {"lens.scatter.share": SimpleNamespace()} if stated else {}
    settings = SafetySettings.model_validate({"lens": lens, "sensor": sensor})
    return Safety(Laser.model_validate(laser), settings, "laser", values, ())


def test_a_share_that_is_not_stated_is_drawn_within_a_factor_of_one_and_a_half():
    found = veil_of(case({}), SettingDraws(4000, {}, {}, 3))
    assert found.assumed
    assert found.share[0] == 0.005
    logs = np.log(found.share[1:] / 0.005)
    assert logs.mean() == pytest.approx(0, abs=0.02)
    assert logs.std() == pytest.approx(math.log(1.5), rel=0.04)
    assert veil_of(case(None), SettingDraws(4, {}, {}, 3)) is None


def test_a_share_that_is_stated_is_not_drawn_unless_it_is_a_law():
    stated = veil_of(case({"share": 0.02}, stated=True), SettingDraws(4, {}, {}, 3))
    assert (stated.share.tolist(), stated.assumed) == ([0.02], False)
    drawn = veil_of(
        case({"share": 0.02}, stated=True),
        SettingDraws(2, {"lens.scatter.share": np.array([0.01, 0.04])}, {}, 3),
    )
    assert (drawn.share.tolist(), drawn.assumed) == ([0.02, 0.01, 0.04], False)


def test_the_veil_of_stated_surfaces_is_theirs():
    """pi b0 l^2 ln(1 + 1 / l^2) for the slope -2, in the middle of a pixel far away b0 (1 + (x /
    f l)^2)^-1.
    """
    found = veil_of(
        case({"surfaces": {"front": {"b0": 2.0, "l": 0.01, "s": -2.0}}}), SettingDraws(4, {}, {}, 3)
    )
    assert not found.assumed
    assert found.share.tolist() == pytest.approx([math.pi * 2e-4 * math.log1p(1e4)], rel=1e-6)
    angle = 3.45e-6 / 50e-3
    expected = 2 / (1 + (100 * angle / 0.01) ** 2) * angle**2
    assert found.light(np.array([100.0]))[0] == pytest.approx(expected, rel=1e-4)


def test_a_group_is_as_bright_from_its_first_pixel_to_its_last():
    """100 pixels of 1e-3 before 400 of 1e-5: the 101st and the 500th have the same light, the
    80th has the other.
    """
    radius, pixels, light = (
        torch.tensor(column).double() for column in ([1.0, 9.0], [100.0, 400.0], [1e-3, 1e-5])
    )
    pair = BrightPixels(radius, pixels, light, light, torch.tensor([math.inf, 0.0, 1.0]))
    ranks = np.array([80.0, 100.0, 101.0, 250.0, 500.0])
    found, _ = levels_of(pair, (20, 25), ranks, None, np.zeros(1), False)
    np.testing.assert_allclose(np.exp(found[0]), [1e-3, 1e-3, 1e-5, 1e-5, 1e-5], rtol=1e-6)
