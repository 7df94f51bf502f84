"""Ghosts: on the line through the axis, point-symmetric to it, and no more energy than asked."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from neusee.nodes import flare
from neusee.nodes.flare._ghosts import _random_ghosts, _reflectance
from neusee.nodes.values import Bands

LENS = {"focal_length": 0.11, "pixel_pitch": 2.9e-6}
LINE = torch.tensor([525e-9, 532e-9, 539e-9], dtype=torch.float64)


def seeded(seed=1):
    return torch.Generator().manual_seed(seed)


def bands(centres=LINE):
    return Bands(
        centres, torch.full_like(centres, 7e-9), torch.full_like(centres, 1 / len(centres))
    )


def spot(size=301, bands=3):
    light = torch.zeros(bands, size, size)
    light[:, size // 2 + 20, size // 2 - 30] = torch.tensor([1.0, 4.0, 2.0])[:bands] * 1e6
    return light


def towards(y, x):
    return torch.tensor([y, x], dtype=torch.float64)


def ghosts(light=None, angle=(5e-4, -8e-4), **params):
    light = spot() if light is None else light
    line = bands(LINE[: len(light)])
    return flare.ghosts(
        light, line, towards(*angle), **LENS, **{"radius": 60e-6, "rng": seeded()} | params
    )


def test_energy_in_is_energy_out():
    light = spot()
    found = ghosts(light, energy=1e-3)
    assert float(found.double().sum()) == pytest.approx(
        1e-3 * float(light.double().sum()), rel=1e-5
    )
    assert float(found.min()) == 0


def test_a_single_band_carries_all_of_it():
    light = spot(bands=1)
    assert float(ghosts(light, energy=1e-4).sum()) == pytest.approx(
        1e-4 * float(light.sum()), rel=1e-5
    )


def test_what_leaves_the_window_is_lost():
    light = spot(101)
    found = ghosts(light, angle=(3e-3, 3e-3), energy=1e-3, count=40)
    assert 0 < float(found.sum()) < 0.9e-3 * float(light.sum())
    assert not ghosts(light, angle=(5.0, 5.0), count=4).any()


def test_ghosts_are_point_symmetric_to_the_source():
    here, there = ghosts(angle=(5e-4, -8e-4)), ghosts(angle=(-5e-4, 8e-4))
    assert_close(there, here.flip(-1, -2), rtol=1e-5, atol=1e-6)


def test_each_ghost_lies_on_the_line_through_axis_and_source():
    for seed in range(6):
        found = ghosts(count=1, rng=seeded(seed), angle=(6e-4, 3e-4), energy=1.0)
        line = torch.arange(301, dtype=torch.float64) - 150
        total = found.sum(0, dtype=torch.float64)
        y, x = (
            float((total.sum(1) * line).sum() / total.sum()),
            float((total.sum(0) * line).sum() / total.sum()),
        )
        assert y == pytest.approx(2 * x, abs=0.1)
        assert abs(y) <= 2 * 6e-4 * 0.11 / 2.9e-6 + 0.1


def test_on_the_axis_all_ghosts_are_centred():
    found = ghosts(angle=(0.0, 0.0))
    assert_close(found, found.flip(-1), rtol=1e-5, atol=1e-9)
    assert_close(found, found.transpose(-1, -2), rtol=1e-5, atol=1e-9)


def test_colour_differs_between_ghosts_and_energy_follows_the_spot():
    centres = torch.linspace(420e-9, 680e-9, 14, dtype=torch.float64)
    light = torch.zeros(14, 64, 64)
    light[:, 32, 32] = 1e6
    params = {"direction": towards(0.0, 0.0), "count": 1} | LENS
    first, second = (
        flare.ghosts(light, bands(centres), **params, rng=seeded(k)).sum((-1, -2)) for k in (1, 2)
    )
    assert float(first.max() / first.min()) > 1.2
    assert not torch.allclose(first, second, rtol=0.05)


def coated(wavelengths, tuned, layer=1.38, glass=1.70):
    """Reflectance of magnesium fluoride on dense flint glass, by Airy's sum, over that of the
    bare glass.
    """
    above, below = (1 - layer) / (1 + layer), (layer - glass) / (layer + glass)
    twice = torch.exp(-1j * math.pi * tuned / wavelengths)
    return ((above + below * twice) / (1 + above * below * twice)).abs().square() / (
        (1 - glass) / (1 + glass)
    ) ** 2


@pytest.mark.parametrize("tuned", [400e-9, 550e-9, 700e-9])
def test_a_coating_reflects_as_a_quarter_wave_of_magnesium_fluoride(tuned):
    waves = torch.linspace(350e-9, 1100e-9, 151, dtype=torch.float64)
    assert_close(_reflectance(waves, tuned), coated(waves, tuned), rtol=0, atol=0.02)


def test_coatings_are_tuned_to_all_of_the_visible_range():
    """That of a camera lens, 400 to 700 nm, and evenly."""
    tuned = (
        torch.tensor(
            [ghost.tuned for ghost in _random_ghosts(1000, 2.0, 3e-4, seeded())],
            dtype=torch.float64,
        )
        * 1e9
    )
    assert 400 <= float(tuned.min()) < 402
    assert 698 < float(tuned.max()) <= 700
    assert_close(
        tuned.mean(0),
        torch.full((2,), 550.0, dtype=torch.float64),
        rtol=0,
        atol=4 * 300 / math.sqrt(12e3),
    )


@settings(max_examples=25, deadline=None)
@given(
    count=st.integers(0, 20),
    shape=st.tuples(st.integers(1, 3), st.integers(1, 40), st.integers(1, 40)),
    angle=st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1)),
    level=st.sampled_from([0.0, 1e-42, 1.0, 1e30]),
    radius=st.floats(1e-9, 1e-3),
)
def test_ghosts_never_take_light_away_nor_make_any(count, shape, angle, level, radius):
    light = torch.full(shape, level)
    found = ghosts(light, angle=angle, count=count, radius=radius, energy=1e-3)
    assert found.shape == light.shape
    assert bool(torch.isfinite(found).all())
    assert float(found.min()) >= 0
    smallest = 1.5e-45 * count * light.numel()
    assert float(found.double().sum()) <= 1e-3 * float(light.double().sum()) * 1.001 + smallest


def test_ghosts_are_linear_in_the_spot_and_learn():
    light = torch.rand(2, 9, 9, dtype=torch.float64, requires_grad=True)

    def run(x):
        return flare.ghosts(
            x, bands(LINE[:2]), towards(1e-4, 0.0), **LENS, radius=8e-6, energy=0.1, rng=seeded()
        )

    assert torch.autograd.gradcheck(run, (light,), fast_mode=True)


def test_bands_of_another_laser_are_refused():
    with pytest.raises(ValueError, match="from one `line`"):
        flare.ghosts(spot(bands=2), bands(), towards(0.0, 0.0), **LENS, rng=seeded())


def test_check_reports_the_share():
    light = spot()
    (line,) = flare.ghosts.hooks.check(
        ghosts(light, energy=1e-3), light, bands(), towards(0.0, 0.0), energy=1e-3
    )
    assert line.ok
    assert "have 0.001 of" in line.text
    assert not flare.ghosts.hooks.check(light, light, bands(), towards(0.0, 0.0), energy=1e-3)[0].ok


def test_ghosts_fall_where_the_spot_is():
    line = Bands(*(x.to("meta") for x in bands()))
    found = flare.ghosts(spot().to("meta"), line, towards(1e-4, 0.0), **LENS, rng=seeded())
    assert found.device.type == "meta"


@pytest.mark.parametrize("angle", [(0.0, 0.0), (1.31825e-5, 1.31825e-5), (5e-4, -8e-4)])
def test_a_ghost_that_is_smaller_than_a_pixel_is_seen_all_the_same(angle):
    light = spot()
    found = ghosts(light, angle=angle, radius=1e-7, energy=1e-3, count=3, spread=1.0)
    assert float(found.double().sum()) == pytest.approx(
        1e-3 * float(light.double().sum()), rel=1e-5
    )


def test_no_ghost_is_asked_for_where_nothing_is_reflected():
    class Unread:
        pass

    lens = {**LENS, "spread": 2.0, "radius": 3e-4}
    for nothing in ({"count": 0, "energy": 1e-4}, {"count": 8, "energy": 0.0}):
        assert flare.ghosts.hooks.zero_bound(Unread(), Unread(), Unread(), **lens, **nothing) == 0.0
