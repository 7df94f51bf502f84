"""Dirt: bounded, seeded, the same at every sampling, with the statistics asked for."""

import math
from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from neusee.nodes import flare, optics
from neusee.nodes.flare._dirt import (
    Grain,
    Scratch,
    _dents,
    _distance_to_line,
    _generators,
    _grains,
    _scratches,
    stamp,
)
from neusee.nodes.optics import grid_of, inside_stop, phase_screen, pupil_grid, zernike_surface

STOP = optics.stop(samples=128, pitch=10e-6, diameter=1.28e-3)
FILTHY = {"dust": 30.0, "scratches": 10.0, "grease": 0.2, "smudges": 0.5, "dents": 0.4}


def seeded(seed=1):
    return torch.Generator().manual_seed(seed)


def test_clean_glass_by_default():
    clean = flare.dirt(STOP, rng=seeded())
    assert bool((clean.amplitude == 1).all())
    assert not clean.path.any()


def test_a_seed_is_a_window():
    first, again, other = (flare.dirt(STOP, **FILTHY, rng=seeded(k)) for k in (1, 1, 2))
    assert torch.equal(first.amplitude, again.amplitude)
    assert torch.equal(first.path, again.path)
    assert not torch.equal(first.amplitude, other.amplitude)
    assert first.amplitude.dtype == first.path.dtype == torch.float32


def test_more_dust_leaves_the_rest_as_it_was():
    with_dust, without = (
        flare.dirt(STOP, **FILTHY | {"dust": n}, rng=seeded()) for n in (30.0, 0.0)
    )
    assert torch.equal(with_dust.path, without.path)
    assert bool((with_dust.amplitude <= without.amplitude).all())
    assert bool((with_dust.amplitude == without.amplitude).double().mean() > 0.5)


@settings(max_examples=25, deadline=None)
@given(
    samples=st.integers(1, 48),
    dust=st.floats(0, 100),
    scratches=st.floats(0, 30),
    sizes=st.tuples(*[st.floats(1e-3, 1)] * 3),
    soft=st.tuples(st.floats(0, 5), st.floats(0, 1), st.floats(0, 5)),
    seed=st.integers(0, 1000),
)
def test_no_window_gives_light(samples, dust, scratches, sizes, soft, seed):
    found = flare.dirt(
        optics.stop(samples=samples, pitch=1e-5, diameter=samples * 1e-5),
        dust=dust,
        scratches=scratches,
        dust_radius=sizes[0],
        scratch_length=sizes[1],
        scratch_width=sizes[2],
        grease=soft[0],
        smudges=soft[1],
        dents=soft[2],
        rng=seeded(seed),
    )
    assert float(found.amplitude.min()) >= 0
    assert float(found.amplitude.max()) <= 1
    assert bool(torch.isfinite(found.path).all())


def test_dirt_does_not_depend_on_the_sampling():
    def window(samples):
        stop = optics.stop(samples=samples, pitch=1.28e-3 / samples, diameter=1.28e-3)
        return flare.dirt(stop, **FILTHY, rng=seeded(3))

    coarse, fine = window(90), window(270)
    assert_close(fine.path[1::3, 1::3], coarse.path, rtol=1e-4, atol=1e-12)
    boxed = torch.nn.functional.avg_pool2d(fine.amplitude[None, None], 3)[0, 0]
    assert float((boxed - coarse.amplitude).abs().mean()) < 0.01
    assert float(boxed.mean()) == pytest.approx(float(coarse.amplitude.mean()), rel=2e-3)


@pytest.mark.parametrize("across", [0.2, 0.6, 1.0, 1.2, 2.0])
def test_grains_about_a_sample_across_cover_their_area_on_average(across):
    grid, places = (
        pupil_grid(16, 1.0, 16.0),
        torch.rand(300, 2, generator=seeded(), dtype=torch.float64),
    )
    marks = [Grain(v / 16, u / 16, across / 32, 1.0) for v, u in places.tolist()]
    shade = sum(float((1 - stamp(torch.ones(16, 16), [mark], grid)).sum()) for mark in marks)
    assert shade / 300 == pytest.approx(math.pi * across**2 / 4, rel=0.05)


@pytest.mark.parametrize("radius", [0.02, 0.05, 0.2])
def test_a_grain_covers_its_area(radius):
    grid = pupil_grid(256, 1.0, 256.0)
    shade = 1 - stamp(torch.ones(256, 256), [Grain(0.013, -0.021, radius, 0.8)], grid)
    assert float(shade.sum()) == pytest.approx(0.8 * math.pi * (radius * 256) ** 2, rel=0.01)
    line = torch.arange(256) - 127.5
    assert float((shade.sum(1) * line).sum() / shade.sum()) == pytest.approx(0.013 * 256, abs=0.05)
    assert float((shade.sum(0) * line).sum() / shade.sum()) == pytest.approx(-0.021 * 256, abs=0.05)


@pytest.mark.parametrize("width", [0.3, 1.0, 4.0])
def test_a_scratch_covers_its_area_even_below_a_sample(width):
    grid = pupil_grid(256, 1.0, 256.0)
    scratch = Scratch([(-0.3, 0.1), (0.3, 0.1)], width / 256, 1.0)
    shade = 1 - stamp(torch.ones(256, 256), [scratch], grid)
    assert float(shade[100:156].sum()) == pytest.approx(56 * width, rel=0.02)


def test_marks_off_the_grid_leave_no_trace():
    grid = pupil_grid(16, 1.0, 16.0)
    far = [Grain(3.0, 0.0, 0.1, 1.0), Scratch([(-2.0, -2.0), (-2.0, 2.0)], 0.1, 1.0)]
    assert bool((stamp(torch.ones(16, 16), far, grid) == 1).all())


def test_numbers_and_sizes_are_those_of_wu():
    """30 grains and scratches with a spread of 5; radius uniform under a largest one; 0 is
    opaque, 1/2 the clearest.
    """
    windows = [_grains(30, 1 / 60, seeded(k)) for k in range(300)]
    numbers = torch.tensor([float(len(w)) for w in windows])
    assert float(numbers.mean()) == pytest.approx(30, abs=1)
    assert float(numbers.std()) == pytest.approx(5, rel=0.15)
    radii = torch.tensor([g.radius for w in windows for g in w])
    assert float(radii.mean()) == pytest.approx(0.5 / 60, rel=0.1)
    opacity = torch.tensor([g.opacity for w in windows for g in w])
    assert (float(opacity.min()), float(opacity.max())) == pytest.approx((0.5, 1.0), abs=0.01)
    scratches = [s for k in range(60) for s in _scratches(30, 0.1, 1 / 300, seeded(k))]
    steps = torch.tensor([len(s.points) - 1.0 for s in scratches])
    assert (float(steps.min()), float(steps.max())) == (1, 16)
    assert float(steps.mean()) == pytest.approx(8.5, abs=0.4)
    assert all(0.5 <= s.opacity <= 1 for s in scratches)
    strides = [
        math.dist(a, b) for s in scratches for a, b in zip(s.points, s.points[1:], strict=False)
    ]
    assert max(strides) <= 0.1


def test_soft_kinds_have_the_asked_strength():
    drawn = [flare.dirt(STOP, grease=0.2, rng=seeded(k)).path for k in range(40)]
    assert float(torch.stack(drawn).square().mean().sqrt()) == pytest.approx(0.2 * 550e-9, rel=0.05)
    open_ = inside_stop(grid_of(STOP))
    bent = flare.dirt(STOP, dents=0.4, rng=seeded()).path[open_]
    assert float(bent.std()) == pytest.approx(0.4 * 550e-9, rel=0.03)
    smeared = flare.dirt(STOP, smudges=0.6, rng=seeded()).amplitude
    assert 0.4 <= float(smeared.min()) < 0.6
    assert float(smeared.max()) > 0.9


def spread(amplitude):
    """Point-spread function on the natural grid, unit sum, axis in the middle."""
    open_ = inside_stop(pupil_grid(len(amplitude), 1.0, float(len(amplitude))))
    field = torch.fft.fftshift(torch.fft.fft2(amplitude.double() * open_))
    return field.abs().square() / field.abs().square().sum()


@pytest.mark.parametrize("across", [True, False])
def test_a_scratch_throws_a_streak_at_right_angles(across):
    """A scratch along v is narrow in u: its light spreads along x, and the other way round."""
    ends = [(-0.4, 0.0), (0.4, 0.0)] if across else [(0.0, -0.4), (0.0, 0.4)]
    glass = stamp(torch.ones(255, 255), [Scratch(ends, 1 / 128, 1.0)], pupil_grid(255, 1.0, 255.0))
    streak = spread(glass) - spread(torch.ones(255, 255))
    middle = slice(126, 129)
    far = torch.cat([torch.arange(0, 90), torch.arange(165, 255)])
    along_x, along_y = float(streak[middle][:, far].sum()), float(streak[far][:, middle].sum())
    strong, weak = (along_x, along_y) if across else (along_y, along_x)
    assert strong > 50 * abs(weak)


def test_dirt_scatters_the_halo_that_a_clean_pupil_has_not():
    dusty = flare.dirt(STOP, dust=200.0, rng=seeded()).amplitude
    halo = torch.ones(128, 128, dtype=torch.bool)
    halo[34:94, 34:94] = False
    assert float(spread(dusty)[halo].sum()) > 1.5 * float(spread(torch.ones(128, 128))[halo].sum())


def test_preflight_and_check():
    assert flare.dirt.hooks.preflight is None  # the notes about the grid are those of `optics.stop`
    found = flare.dirt(STOP, dents=0.4, smudges=0.3, rng=seeded())
    light, bounds = flare.dirt.hooks.check(found, STOP)
    assert light.ok
    assert bounds.ok
    assert "by 0.401 waves" in light.text
    assert not flare.dirt.hooks.check(found._replace(amplitude=found.amplitude + 1), STOP)[1].ok


def test_recipe_cannot_ask_for_negative_dirt():
    with pytest.raises(ValueError, match="greater than or equal to 0"):
        flare.dirt.params(grease="-0.1 waves")


def test_a_scratch_is_darkest_where_its_nearest_step_says():
    """Each step darkens its own neighbourhood only; together they are the distance to the whole
    line.
    """
    grid, points = (
        pupil_grid(200, 1.0, 200.0),
        [(-0.3, -0.4), (0.1, -0.35), (0.1, 0.2), (-0.2, 0.3), (-0.2, 0.6)],
    )
    shade = 1 - stamp(torch.ones(200, 200), [Scratch(points, 3 / 200, 0.7)], grid)
    y, x = torch.meshgrid(torch.arange(200.0), torch.arange(200.0), indexing="ij")
    places = [(v * 200 + 99.5, u * 200 + 99.5) for v, u in points]
    nearest = torch.stack([_distance_to_line(y, x, a, b) for a, b in pairwise(places)]).amin(0)
    assert_close(shade, 0.7 * (2.0 - nearest).clamp(0, 1), rtol=0, atol=1e-6)


def test_dirt_is_made_by_stripes_that_fit_together():
    """A pupil of many stripes: each kind against its formula over the whole plane."""
    stop, rngs = optics.stop(samples=401, pitch=1e-5, diameter=4.01e-3), _generators(5, seeded())
    grid = grid_of(stop)
    film, patches = phase_screen(grid, 0.05, rngs[2]), phase_screen(grid, 0.15, rngs[3])
    found = flare.dirt(stop, grease=0.3, smudges=0.4, dents=0.5, rng=seeded())
    bent = 0.3 * 550e-9 * film + zernike_surface(_dents(0.5 * 550e-9, rngs[4]), grid)
    assert_close(found.path, bent.float(), rtol=1e-6, atol=1e-13)
    assert_close(found.amplitude, (1 - 0.4 * torch.sigmoid(3 * patches)).float())
    light, _ = flare.dirt.hooks.check(found, stop)
    inner, open_ = bent.float().double(), inside_stop(grid)
    assert f"by {float(inner[open_].std(correction=0)) / 550e-9:.3g} waves" in light.text
