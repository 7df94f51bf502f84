"""The pupil: stop, defocus, Zernike aberrations and what the check sees."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from neusee.nodes import doe, optics
from neusee.nodes.optics import (
    PupilGrid,
    inside_stop,
    noll,
    phase_screen,
    phase_steps,
    polar_coordinates,
    pupil_axes,
    pupil_grid,
    zernike_sum,
    zernike_surface,
)
from neusee.nodes.values import Bands, Dirt

LENS = {"pitch": 10e-6, "diameter": 2e-3}


def bands(*nanometres):
    centres = torch.tensor(nanometres, dtype=torch.float64) * 1e-9
    return Bands(centres, torch.full_like(centres, 10e-9), torch.ones_like(centres))


def stop(samples, **params):
    """Return a stop; one that is wider than the grid is narrowed, as these tests of the pupil
    ask for.
    """
    return optics.stop(samples=samples, **{"aperture": "inscribed"} | LENS | params)


def pupil(
    height=None, dirt=None, wavelengths=(450, 550, 650), pitch=10e-6, diameter=2e-3, **params
):
    height = torch.zeros(200, 200) if height is None else height
    line, grid = bands(*wavelengths), stop(len(height), pitch=pitch, diameter=diameter)
    return optics.pupil(height, doe.material(line), line, grid, dirt, **params)


def field(p):
    turns = (p.index[:, None, None] * p.height.double() + p.path.double()) / p.wavelengths[
        :, None, None
    ]
    return torch.polar(p.amplitude.double().expand_as(turns), 2 * math.pi * turns)


def on_axis(p):
    """Intensity on the axis over that of the clear pupil: the square of the mean field."""
    return (field(p).sum((-2, -1)) / p.aperture.double().sum()).abs().square()


@pytest.mark.parametrize("samples", [1, 2, 15, 64, 2160])
def test_stop_is_round_centred_and_inscribed(samples):
    open_ = inside_stop(pupil_grid(samples, 3.74e-6, 11e-3, "inscribed"))
    assert bool(open_.any())
    assert torch.equal(open_, open_.flip(0))
    assert torch.equal(open_, open_.T)
    if samples > 50:
        assert bool(open_[samples // 2].all())
        assert float(open_.double().mean()) == pytest.approx(math.pi / 4, rel=2 / samples)


@settings(max_examples=60, deadline=None)
@given(
    samples=st.integers(1, 40),
    pitch=st.floats(1e-7, 1e-3),
    diameter=st.floats(1e-7, 1.0),
    aperture=st.sampled_from(["held", "inscribed", "clipped", "stretched"]),
)
def test_every_user_of_the_stop_sees_the_same_one(samples, pitch, diameter, aperture):
    try:
        grid = pupil_grid(samples, pitch, diameter, aperture)
    except ValueError:
        assert diameter < math.sqrt(2) * pitch or (
            aperture == "held" and diameter > samples * pitch
        )
        return
    assert aperture == "clipped" or grid.diameter <= grid.samples * grid.pitch * (1 + 1e-12)
    line = bands(550)
    at = optics.stop(samples=samples, pitch=pitch, diameter=diameter, aperture=aperture)
    p = optics.pupil(torch.zeros(samples, samples), doe.material(line), line, at)
    assert float(p.pitch) == grid.pitch
    assert torch.equal(p.aperture > 0, inside_stop(grid))
    assert bool(inside_stop(grid).any())


def test_clear_pupil_is_clear():
    p = pupil()
    assert torch.equal(p.amplitude, p.aperture)
    assert not p.path.any()
    assert on_axis(p).tolist() == pytest.approx([1, 1, 1])


@pytest.mark.parametrize("waves", [0.0, 0.25, 0.5, 1.0, 1.5, -0.7])
def test_defocus_dims_the_axis_by_sinc_squared(waves):
    """Peak to valley W at 550 nm is W * 550 / lambda at lambda; intensity sinc(W)**2."""
    found = on_axis(pupil(defocus=waves))
    wanted = [
        float(torch.sinc(torch.tensor(waves * 550 / w, dtype=torch.float64))) ** 2
        for w in (450, 550, 650)
    ]
    assert found.tolist() == pytest.approx(wanted, abs=2e-3)


@pytest.mark.parametrize("index", [5, 6, 7, 8, 11, 12, 22])
def test_small_aberrations_follow_marechal(index):
    sigma = 2 * math.pi * 20 / 550
    found = float(on_axis(pupil(aberrations={index: 20e-9}))[1])
    assert found == pytest.approx(math.exp(-(sigma**2)), abs=2e-3)


def test_tilt_is_a_slope_of_four_rms_across():
    p = pupil(aberrations={3: 100e-9})
    v = pupil_axes(pupil_grid(200, **LENS))[0].expand(200, 200)
    open_ = p.aperture > 0
    assert_close(p.path.double()[open_], (200e-9 * v)[open_], rtol=1e-6, atol=1e-14)
    assert not p.path[~open_].any()


def test_noll_counts_as_noll_does():
    table = [
        (0, 0),
        (1, 1),
        (1, -1),
        (2, 0),
        (2, -2),
        (2, 2),
        (3, -1),
        (3, 1),
        (3, -3),
        (3, 3),
        (4, 0),
        (4, 2),
        (4, -2),
    ]
    assert [noll(j) for j in range(1, 14)] == table
    assert noll(22) == (6, 0)
    with pytest.raises(ValueError, match="begin at 1"):
        noll(0)


def test_zernikes_are_orthonormal():
    """On a polar quadrature that is exact for these orders."""
    nodes, weights = (torch.from_numpy(x) for x in np.polynomial.legendre.leggauss(16))
    radius = ((nodes + 1) / 2).sqrt()[:, None]
    azimuth = torch.arange(40, dtype=torch.float64)[None, :] * (2 * math.pi / 40)
    every = torch.stack(
        [
            zernike_sum({j: 1.0}, radius * azimuth.sin(), radius * azimuth.cos())
            for j in range(1, 46)
        ]
    )
    gram = torch.einsum("iab,jab,a->ij", every, every, weights / 2) / 40
    assert_close(gram, torch.eye(45, dtype=torch.float64), rtol=0, atol=1e-12)


def test_zernikes_are_those_of_the_textbook():
    radius, azimuth = polar_coordinates(PupilGrid(31, 1.0, 31.0))
    v, u = pupil_axes(PupilGrid(31, 1.0, 31.0))
    wanted = {
        4: math.sqrt(3) * (2 * radius**2 - 1),
        5: math.sqrt(6) * radius**2 * torch.sin(2 * azimuth),
        8: math.sqrt(8) * (3 * radius**3 - 2 * radius) * torch.cos(azimuth),
        11: math.sqrt(5) * (6 * radius**4 - 6 * radius**2 + 1),
        14: math.sqrt(10) * radius**4 * torch.cos(4 * azimuth),
    }
    for index, formula in wanted.items():
        assert_close(zernike_sum({index: 1.0}, v, u), formula, rtol=0, atol=1e-12)


def test_coefficients_add_up_in_root_sum_of_squares():
    parts = {4: 30e-9, 6: -40e-9, 11: 120e-9}
    grid = pupil_grid(400, 10e-6, 4e-3)
    total = zernike_surface(parts, grid)[inside_stop(grid)]
    assert float(total.std()) == pytest.approx(130e-9, rel=0.01)


def test_dirt_multiplies_the_amplitude_and_adds_to_the_path():
    draw = torch.rand(2, 200, 200, generator=torch.Generator().manual_seed(2))
    p = pupil(dirt=Dirt(draw[0], draw[1] * 1e-7), defocus=0.5)
    clean = pupil(defocus=0.5)
    assert_close(p.amplitude, clean.aperture * draw[0])
    assert_close(p.path, clean.path + draw[1] * 1e-7)


def test_relief_learns_through_the_pupil():
    height = torch.rand(8, 8, dtype=torch.float64, requires_grad=True)
    line = bands(500, 600)

    def axis(h):
        p = optics.pupil(
            h * 1e-6, doe.material(line), line, stop(8, pitch=1e-4, diameter=8e-4), defocus=0.3
        )
        return on_axis(p)

    assert torch.autograd.gradcheck(axis, (height,))
    assert pupil(height=height.detach()[:8, :8], diameter=8e-5).path.dtype == torch.float64


def test_shapes_that_do_not_belong_together_are_refused():
    line = bands(500, 600)
    index = doe.material(line)
    with pytest.raises(ValueError, match="square"):
        optics.pupil(torch.zeros(4, 5), index, line, stop(4))
    with pytest.raises(ValueError, match=r"\(8, 8\), not the square pupil grid \(4, 4\) of `stop`"):
        optics.pupil(torch.zeros(8, 8), index, line, stop(4))
    with pytest.raises(ValueError, match="from one `bands` or `line` step"):
        optics.pupil(torch.zeros(4, 4), index[:1], line, stop(4))
    with pytest.raises(ValueError, match="from one `stop` step"):
        optics.pupil(
            torch.zeros(4, 4), index, line, stop(4), Dirt(torch.ones(5, 5), torch.zeros(5, 5))
        )


def check(p, **params):
    return optics.pupil.hooks.check(p, p.height, p.index, None, stop(len(p.height), **params), None)


def test_check_measures_throughput_and_clipping():
    grey = Dirt(torch.full((200, 200), 0.5), torch.zeros(200, 200))
    throughput, _ = check(pupil(dirt=grey))
    assert "0.2500" in throughput.text
    assert "asked" not in throughput.text
    wide = pupil(diameter=11e-3)
    throughput, _ = check(wide, diameter=11e-3)
    assert "of the clear pupil 2.00 mm" in throughput.text
    for aperture in ("inscribed", "clipped"):
        asked = {"samples": 200, "pitch": 10e-6, "diameter": 11e-3, "aperture": aperture}
        (clear,) = optics.stop.hooks.check(optics.stop(**asked), **asked)
        assert f"2 mm, {aperture} instead of the requested 11 mm" in clear.text
    (clear,) = optics.stop.hooks.check(stop(200), **LENS, samples=200, aperture="inscribed")
    assert "asked" not in clear.text
    assert "requested" not in clear.text
    black = Dirt(torch.zeros(200, 200), torch.zeros(200, 200))
    assert not check(pupil(dirt=black))[0].ok


@pytest.mark.parametrize(("waves", "ok"), [(20.0, True), (90.0, False)])
def test_check_warns_of_phase_that_the_samples_cannot_follow(waves, ok):
    p = pupil(height=doe.axicon(stop(200), waves=waves), wavelengths=(550,))
    _, step = check(p)
    assert step.ok is ok
    median, _ = phase_steps(p)
    radius, azimuth = polar_coordinates(pupil_grid(200, **LENS))
    slopes = torch.cat([azimuth.cos().abs()[radius <= 1], azimuth.sin().abs()[radius <= 1]])
    assert median == pytest.approx(waves / 100 * float(slopes.median()), rel=0.03)


def test_wrapped_elements_are_not_called_aliased():
    slopes = (12.0, 18.0, 24.0, 30.0, 36.0)
    height = doe.half_rings(stop(1000, pitch=2e-6), waves=slopes)
    p = pupil(height=doe.fabricate(height, wrap_at=550e-9), pitch=2e-6)
    assert check(p, pitch=2e-6)[1].ok


def test_a_large_pupil_is_made_and_checked_by_parts_as_a_whole():
    """More rows than one stripe has, and more than are looked at one by one."""
    grid = pupil_grid(1100, 10e-6, 11e-3)
    height = phase_screen(grid, 0.02, torch.Generator().manual_seed(0)).float() * 2e-6
    p = pupil(height=height, wavelengths=(550,), diameter=11e-3, defocus=2.0, aberrations={5: 1e-7})
    v, u = pupil_axes(grid)
    path = zernike_surface({5: 1e-7}, grid) + 2.0 * 550e-9 * (
        v.square() + u.square()
    ) * inside_stop(grid)
    assert_close(p.path, path.float(), rtol=1e-6, atol=1e-15)
    assert torch.equal(p.aperture > 0, inside_stop(grid))
    turns = (p.index[0] * p.height.double() + p.path.double()) / p.wavelengths[0]
    pairs = [(turns.diff(dim=d).abs(), inside_stop(grid).unfold(d, 2, 1).all(-1)) for d in (0, 1)]
    steps = torch.cat([step[both] for step, both in pairs])
    median, share = phase_steps(p)
    assert median == pytest.approx(float(steps.median()), rel=5e-3)
    assert share == pytest.approx(float((steps > 0.5).double().mean()), abs=2e-3)


def test_one_sample_is_a_pupil():
    p = pupil(height=torch.zeros(1, 1), wavelengths=(550,))
    assert float(p.amplitude) == 1
    assert phase_steps(p) == (0.0, 0.0)


def test_screen_is_standard_noise_with_the_asked_correlation():
    grid = pupil_grid(61, 1.0, 61.0)
    draws = torch.stack(
        [phase_screen(grid, 0.15, torch.Generator().manual_seed(k)) for k in range(400)]
    )
    assert float(draws.mean()) == pytest.approx(0, abs=0.03)
    assert float(draws.square().mean()) == pytest.approx(1, abs=0.03)
    assert draws.square().mean(0).flatten().std() < 0.1
    for step in (3, 9, 15):
        along = float((draws[:, step:] * draws[:, :-step]).mean())
        assert along == pytest.approx(math.exp(-((step / 61 / 0.15) ** 2)), abs=0.03)


def test_everything_is_made_where_the_relief_is():
    """A device without memory shows where tensors are made; mixing two devices would raise."""
    line = Bands(*(x.to("meta") for x in bands(500, 600)))
    aberrations = {5: 1e-8, 8: 1e-8}
    height = torch.zeros(8, 8, device="meta")
    p = optics.pupil(
        height, doe.material(line), line, stop(8), defocus=1.0, aberrations=aberrations
    )
    assert {x.device.type for x in p} == {"meta"}


def test_a_height_of_one_wave_turns_the_phase_once_and_at_twice_the_wavelength_nearly_half():
    height = torch.full((200, 200), doe.wave_height("fused silica", 450e-9))
    turns = optics.mask_turns(pupil(height, wavelengths=(450, 900)), 0, step=4)
    assert turns.shape == (50, 50)
    assert_close(turns, torch.ones(50, 50, dtype=torch.float64), rtol=1e-6, atol=0)
    assert float(
        optics.mask_turns(pupil(height, wavelengths=(450, 900)), 1).mean()
    ) == pytest.approx(0.485, abs=0.01)


def test_phase_steps_on_a_thick_plate_are_exact():
    """10 mm are 8600 turns, of which float32 holds the steps to 5e-4 turn alone."""
    grid = stop(64, pitch=30e-6)
    height = doe.half_rings(grid, waves=(3.0,)) + 10e-3
    median, share = phase_steps(
        p := optics.pupil(height, doe.material(bands(532)), bands(532), grid)
    )
    turns = p.index * height.double() / p.wavelengths
    lit = p.aperture > 0
    steps = torch.cat(
        [(turns.diff(dim=d)[lit.narrow(d, 1, 63) & lit.narrow(d, 0, 63)]).abs() for d in (0, 1)]
    )
    assert median == pytest.approx(float(steps.median()), rel=1e-6)
    assert share == float((steps > 0.5).double().mean())
