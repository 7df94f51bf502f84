"""Sums over the bands of an image: the same as band by band, within their bound, at every
extreme.
"""

import math
import statistics

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.nodes.optics import _convolution_plan, _few_bands, image, image_channels
from neusee.nodes.spectra import (
    bands,
    compress,
    illuminant,
    illuminate,
    lift_lmmse,
    responses,
    rows,
)
from neusee.nodes.values import Channels, FewBands, LowRankCube, Psf

SCENE = bands(start=400e-9, stop=700e-9, count=31)
ROWS = rows(SCENE, responses(SCENE))


def seeded(seed):
    return torch.Generator().manual_seed(seed)


def rand(*shape, seed=0, dtype=torch.float64):
    return torch.rand(*shape, generator=seeded(seed), dtype=torch.float64).to(dtype)


def as_psf(kernel):
    return Psf(kernel, torch.ones(len(kernel), dtype=torch.float64))


def mixed(planes, basis):
    """A mixture that leaves nothing away."""
    each = basis.abs() * planes.abs().amax((1, 2)).double()
    rest = torch.cat(
        [each.flip(1).cumsum(1).flip(1).T, torch.zeros(1, len(basis), dtype=torch.float64)]
    )
    return LowRankCube(planes, basis, rest)


def spread(count, size, seed=0, power=1.5, dtype=torch.float64):
    """PSFs with long tails, wider from band to band."""
    y, x = (torch.arange(n, dtype=torch.float64) - n // 2 for n in size)
    wide = (0.3 + torch.arange(count, dtype=torch.float64) / count * (1 + seed % 3))[:, None, None]
    kernel = (1 + (y[:, None] ** 2 + x**2) / wide**2) ** -power
    return as_psf((kernel / kernel.sum((1, 2), keepdim=True)).to(dtype))


def off(found, exact):
    """The root mean square error of each row's planes over its largest, the worst."""
    error = (found.double() - exact).square().mean((1, 2)).sqrt()
    return float(torch.where(error > 0, error / exact.abs().amax((1, 2)), 0.0).amax())


def brightest(found, exact):
    """How far the brightest pixel of each row is off, over itself, the worst."""
    top, true = found.double().amax((1, 2)), exact.amax((1, 2))
    return float(torch.where(top != true, (top - true).abs() / true, 0.0).amax())


def band_by_band(cube, psf, weights, border="zero"):
    """In float64, by transforms; the direct sum takes minutes."""
    exact = image(cube.double(), Psf(psf.intensity.double(), psf.clear_peak), border=border)
    return torch.tensordot(weights.double(), exact, 1)


def of_mixture(scene, psf, weights, border="zero"):
    return band_by_band(
        torch.tensordot(scene.basis, scene.planes.double(), 1), psf, weights, border
    )


sizes = st.integers(1, 9)


@settings(max_examples=25, deadline=None)
@given(
    sizes,
    sizes,
    st.integers(1, 20),
    st.integers(1, 20),
    st.integers(1, 4),
    st.sampled_from(["zero", "reflect"]),
)
def test_agrees_with_the_bands_for_any_size(y, x, m, n, k, border):
    scene, psf, weights = (
        mixed(rand(k, y, x) - 0.3, rand(5, k) - 0.2),
        as_psf(rand(5, m, n)),
        rand(3, 5),
    )
    found, exact = (
        f(scene, psf, weights, border=border)
        for f in (image_channels, image_channels.hooks.reference)
    )
    assert found.planes.shape == (3, y, x)
    torch.testing.assert_close(found.planes, exact.planes, rtol=1e-11, atol=1e-11)
    assert off(found.planes, exact.planes) <= float(found.bound) < 1e-11


@pytest.mark.parametrize("border", ["zero", "reflect"])
@pytest.mark.parametrize("rank", [1, 3, 6])
def test_the_collapse_of_a_linear_scene_is_exact(rank, border):
    planes, basis = rand(rank, 97, 101, dtype=torch.float32), rand(31, rank)
    psf = as_psf(rand(31, 64, 80, dtype=torch.float32) / 5120)
    found = image_channels(mixed(planes, basis), psf, ROWS, border=border)
    plain = image(torch.tensordot(basis.float(), planes, 1), psf, border=border)
    assert off(found.planes, torch.tensordot(ROWS, plain.double(), 1)) < 1e-5
    exact = of_mixture(mixed(planes, basis), psf, ROWS, border)
    assert off(found.planes, exact) <= float(found.bound) < 2e-5


def test_from_colours_to_channels_as_band_by_band():
    cube = illuminate(
        lift_lmmse(0.5 + 0.02 * rand(3, 80, 90, dtype=torch.float32), SCENE), illuminant(SCENE)
    )
    psf = spread(31, (70, 70), dtype=torch.float32)
    found = image_channels(compress(cube), psf, ROWS)
    assert found.kept[0] == 3
    assert off(found.planes, band_by_band(cube, psf, ROWS)) <= float(found.bound) < 1e-5


def drawn(seed):
    """A scene, its PSF, rows, border and bound, at random: points of light, darkness, noise of
    full rank, tails.
    """
    g = seeded(seed)
    count, y, x, m, n = (int(v) for v in torch.randint(1, 48, (5,), generator=g))
    kind, dtype = seed % 4, torch.float32 if seed % 3 else torch.float64
    cube = torch.zeros(count, y, x, dtype=torch.float64)
    for k in range(1 + seed % 6):
        cube += (
            10.0 ** (-0.7 * k)
            * torch.rand(count, 1, 1, generator=g)
            * torch.rand(1, y, x, generator=g)
        )
    if kind == 1:
        cube *= 1e-3
        cube[:, y // 2, x // 3] = 100.0 * torch.rand(count, generator=g, dtype=torch.float64)
    elif kind == 2:
        cube = torch.rand(count, y, x, generator=g, dtype=torch.float64)
    power = 1.1 + float(torch.rand(1, generator=g))
    psf = (
        as_psf(rand(count, m, n, seed=seed) / (m * n))
        if kind == 3
        else spread(count, (m, n), seed, power)
    )
    weights = torch.rand(1 + seed % 4, count, generator=g, dtype=torch.float64) ** 4 * 1e-6
    within = (0.0, 1e-1, 1e-2, 1e-3, 1e-4, 1e-5)[seed % 6]
    border = "reflect" if seed % 5 == 0 else "zero"
    return cube.to(dtype), Psf(psf.intensity.to(dtype), psf.clear_peak), weights, border, within


def looseness(seed):
    """Check the bound of a draw; give how much larger it is than the error."""
    cube, psf, weights, border, within = drawn(seed)
    found = image_channels(
        compress(cube, within=within / 10), psf, weights, border=border, within=within
    )
    error = off(found.planes, band_by_band(cube, psf, weights, border))
    assert error <= float(found.bound), seed
    assert within < 2e-5 or float(found.bound) <= within, seed
    return float(found.bound) / max(error, 1e-300)


def top_holds(seed):
    """Check the bound of the brightest pixel of a draw, which leaves nothing away but what the
    mixture does.

    Gives how much larger it is than the error.
    """
    cube, psf, weights, border, within = drawn(seed)
    scene = compress(cube, within=within / 10)
    found = image_channels(scene, psf, weights, border=border, within=within, largest=True)
    exact = band_by_band(cube, psf, weights, border)
    assert off(found.planes, exact) <= float(found.bound), seed
    assert brightest(found.planes, exact) <= float(found.largest), seed
    assert image_channels.hooks.approximation_error(found) == (
        float(found.bound),
        float(found.largest),
    )
    return float(found.largest) / max(brightest(found.planes, exact), 1e-300)


def test_where_few_pixels_are_clipped_few_planes_do_and_the_brightest_pixel_is_known():
    cube = rand(31, 3).matmul(rand(3, 64 * 64)).reshape(31, 64, 64)
    cube[:, 5:7, 9] += 0.05 * rand(31, 2, seed=4)
    cube[:, 40, 40] *= 3.0
    psf, scene = spread(31, (30, 30)), compress(cube, within=1e-3)
    found = image_channels(scene, psf, ROWS, within=3e-3, largest=True)
    assert found.kept[0] == 3
    exact = band_by_band(cube, psf, ROWS)
    assert off(found.planes, exact) <= float(found.bound) <= 3e-3
    assert brightest(found.planes, exact) <= float(found.largest) <= 1e-3
    assert image_channels(scene, psf, ROWS, within=3e-3).largest == math.inf


@pytest.mark.parametrize("drawn_bound", [looseness, top_holds])
def test_bounds_hold_and_are_not_loose(drawn_bound):
    assert statistics.median(drawn_bound(seed) for seed in range(30)) < 30


@pytest.mark.slow
@pytest.mark.parametrize("drawn_bound", [looseness, top_holds])
def test_bounds_hold_over_many_draws_and_are_not_loose(drawn_bound):
    found = [drawn_bound(seed) for seed in range(300)]
    assert statistics.median(found) < 30
    for n in range(6):
        assert statistics.median(found[n::6]) < 100, n


def test_a_tail_that_no_one_sees_is_not_convolved():
    scene, psf = mixed(rand(3, 90, 90), rand(31, 3)), spread(31, (90, 90), power=3)
    found = image_channels(scene, psf, ROWS, within=1e-3)
    assert max(found.kept[3:].tolist()) < 90
    assert off(found.planes, of_mixture(scene, psf, ROWS)) <= float(found.bound) <= 1e-3


def test_bands_that_no_row_sees_are_left_out():
    weights = ROWS[:3].clone()
    weights[:, 5:12] = 0.0
    weights[:, 20] *= 1e-9
    scene, psf = mixed(rand(2, 30, 31), rand(31, 2)), as_psf(rand(31, 9, 9))
    for within, out in ((0.0, 7), (1e-4, 8)):
        found = image_channels(scene, psf, weights, within=within)
        assert 31 - int(found.kept[2]) >= out
        assert off(found.planes, of_mixture(scene, psf, weights)) <= float(found.bound)
        assert "left out" in image_channels.hooks.check(found, within=within)[0].text


def test_fewer_kernels_where_the_rows_are_alike():
    weights = torch.stack([1 + 1e-5 * rand(31, seed=s) for s in range(4)])
    scene, psf = mixed(rand(3, 64, 64), rand(31, 3)), as_psf(rand(31, 60, 60))
    found = image_channels(scene, psf, weights, within=1e-2)
    assert int(found.kept[1]) == 3
    assert off(found.planes, of_mixture(scene, psf, weights)) <= float(found.bound) <= 1e-2


@pytest.mark.parametrize("largest", [False, True])
def test_psfs_of_few_bands_are_transformed_once_each_where_sums_of_them_are_more(largest):
    scene, few, weights = mixed(rand(3, 64, 64), rand(31, 3)), as_psf(rand(4, 60, 60)), rand(3, 31)
    share = _few_bands.share_of_bands(torch.tensor([0, 9, 22, 30]), 31)
    none = torch.tensor(0.0, dtype=torch.float64)
    chosen = FewBands(share, torch.tensor([0, 9, 22, 30]), none, none)
    found = image_channels(scene, few, weights, chosen, largest=largest)
    assert int(found.kept[1]) == 4  # in place of three rows times three planes
    every = as_psf(torch.einsum("bj,jyx->byx", share, few.intensity.double()))
    assert off(found.planes, of_mixture(scene, every, weights)) <= float(found.bound) < 2e-6


def test_a_scene_of_full_rank_costs_no_more_kernels_than_bands():
    cube, psf = rand(9, 40, 41), as_psf(rand(9, 30, 30))
    found = image_channels(compress(cube, within=0.0), psf, rand(5, 9))
    assert int(found.kept[1]) == 9
    assert off(found.planes, band_by_band(cube, psf, rand(5, 9))) <= float(found.bound) < 1e-6


def test_what_the_mixture_lacks_is_part_of_the_bound():
    cube, psf = rand(6, 20, 20), as_psf(rand(6, 5, 5))
    rough = compress(cube, within=0.6)
    found = image_channels(rough, psf, rand(2, 6), within=1e-3)
    error = off(found.planes, band_by_band(cube, psf, rand(2, 6)))
    assert 1e-3 < error <= float(found.bound)
    assert not image_channels.hooks.check(found, within=1e-3)[0].ok
    assert image_channels.hooks.approximation_error(found) == (float(found.bound), math.inf)


def test_darkness_and_rows_of_nothing_are_exact():
    psf = as_psf(rand(5, 9, 9))
    dark = image_channels(compress(torch.zeros(5, 8, 8)), psf, rand(2, 5), within=1e-3)
    assert not bool(dark.planes.any())
    assert float(dark.bound) == 0.0
    blind = image_channels(compress(rand(5, 8, 8)), psf, torch.zeros(2, 5), within=1e-3)
    assert not bool(blind.planes.any())
    assert float(blind.bound) == 0.0


def test_light_that_is_not_a_number_has_no_bound():
    kernel = rand(3, 5, 5)
    kernel[1, 2, 2] = float("nan")
    assert float(
        image_channels(compress(rand(3, 8, 8)), as_psf(kernel), rand(1, 3)).bound
    ) == float("inf")


@pytest.mark.parametrize("border", ["zero", "reflect"])
@pytest.mark.parametrize("rank", [1, 3])
def test_gradients_of_planes_and_psf(border, rank):
    """Kernels of a plane and row, or of a band, as is cheaper."""
    planes, kernel = rand(rank, 3, 2).requires_grad_(), rand(3, 2, 3).requires_grad_()
    basis, weights = rand(3, rank), rand(2, 3)

    def all_of_it(planes, kernel):
        found = image_channels(
            mixed(planes.detach(), basis)._replace(planes=planes),
            as_psf(kernel),
            weights,
            border=border,
        )
        return found.planes

    assert torch.autograd.gradcheck(all_of_it, (planes, kernel))


def test_sums_of_convolutions_have_every_derivative():
    a, b = rand(2, 2, 1).requires_grad_(), rand(2, 1, 2).requires_grad_()
    where = _convolution_plan.Placement((0, 0), (0, 0), (0, 1), (2, 1), (3, 4))
    for how, mix in (
        (where, _convolution_plan.Mix(rand(1, 3), rand(3, 2), rand(3, 2))),
        (where._replace(conjugate=True), _convolution_plan.Mix(None, rand(2, 2), None)),
    ):
        assert torch.autograd.gradcheck(
            lambda a, b, m=mix, w=how: _convolution_plan.summed(a, b, m, w), (a, b)
        )
        assert torch.autograd.gradgradcheck(
            lambda a, b, m=mix, w=how: _convolution_plan.summed(a, b, m, w), (a, b)
        )


def test_inputs_of_other_bands_are_refused():
    scene, psf = mixed(rand(2, 5, 5), rand(4, 2)), as_psf(rand(4, 3, 3))
    for wrong in (
        (scene, psf, rand(2, 3)),
        (scene, as_psf(rand(5, 3, 3)), rand(2, 4)),
        (scene, psf, rand(4)),
    ):
        with pytest.raises(ValueError, match="same `bands` step"):
            image_channels(*wrong)


def test_channels_know_what_stands_in_for_an_image():
    assert image.channel_sum_form is image_channels
    assert Channels(rand(1, 2, 2), rand(1, 3), rand(1)[0]).kept.shape == (5,)
