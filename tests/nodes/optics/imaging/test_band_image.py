"""The image of the scene: linear, of the right size, centred, differentiable, light kept."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.nodes.optics import image
from neusee.nodes.optics.transform import fft_length
from neusee.nodes.values import Psf


def as_psf(kernel):
    return Psf(kernel, torch.ones(len(kernel), dtype=torch.float64))


def rand(*shape, dtype=torch.float64):
    return torch.rand(*shape, dtype=dtype, generator=torch.Generator().manual_seed(sum(shape)))


sizes = st.integers(1, 9)


@settings(max_examples=60, deadline=None)
@given(sizes, sizes, st.integers(1, 25), st.integers(1, 25), st.sampled_from(["zero", "reflect"]))
def test_agrees_with_the_direct_sum_for_any_size(y, x, m, n, border):
    scene, psf = rand(2, y, x), as_psf(rand(2, m, n))
    found = image(scene, psf, border=border)
    assert found.shape == scene.shape
    torch.testing.assert_close(
        found, image.hooks.reference(scene, psf, border=border), rtol=1e-12, atol=1e-12
    )


def test_single_precision_agrees_within_the_agreed_error():
    scene, kernel = rand(2, 60, 50, dtype=torch.float32), rand(2, 33, 48, dtype=torch.float32)
    exact = image.hooks.reference(scene, as_psf(kernel))
    assert image(scene, as_psf(kernel)).dtype == torch.float32
    assert float((image(scene, as_psf(kernel)) - exact).abs().max() / exact.max()) < image.rtol


@pytest.mark.parametrize("size", [5, 6])
def test_a_point_becomes_the_psf_and_the_axis_stays(size):
    scene = torch.zeros(1, 11, 12)
    scene[0, 5, 6] = 1.0
    kernel = rand(1, size, size, dtype=torch.float32)
    found = image(scene, as_psf(kernel))[0]
    c = size // 2
    torch.testing.assert_close(
        found[5 - c : 5 - c + size, 6 - c : 6 - c + size], kernel[0], rtol=1e-5, atol=1e-6
    )


def test_what_leaves_one_edge_does_not_come_back_at_the_other():
    scene, kernel = torch.zeros(1, 8, 8), torch.zeros(1, 9, 9)
    scene[0, 0, 0], kernel[0, 0, 0] = 1.0, 1.0
    assert float(image(scene, as_psf(kernel)).abs().max()) < 1e-6


def test_reflect_keeps_a_flat_scene_flat():
    kernel = rand(1, 7, 7)
    found = image(
        torch.ones(1, 9, 9, dtype=torch.float64), as_psf(kernel / kernel.sum()), border="reflect"
    )
    torch.testing.assert_close(found, torch.ones_like(found))


def test_a_batch_is_the_scenes_one_by_one():
    scenes, psf = rand(2, 3, 2, 6, 5), as_psf(rand(2, 5, 5))
    torch.testing.assert_close(image(scenes, psf)[1, 2], image(scenes[1, 2], psf))


@pytest.mark.parametrize("border", ["zero", "reflect"])
def test_gradients_of_scene_and_psf(border):
    scene, kernel = rand(2, 5, 4).requires_grad_(), rand(2, 4, 7).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda s, k: image(s, as_psf(k), border=border), (scene, kernel)
    )


def test_second_derivatives_are_real():
    scene, kernel = rand(1, 3, 3).requires_grad_(), rand(1, 2, 3).requires_grad_()
    assert torch.autograd.gradgradcheck(lambda s, k: image(s, as_psf(k)), (scene, kernel))


def test_bands_must_agree():
    with pytest.raises(ValueError, match="same bands"):
        image(torch.ones(2, 4, 4), as_psf(torch.ones(3, 3, 3)))


def test_check_says_how_much_light_is_kept():
    scene = torch.zeros(1, 9, 9)
    scene[0, 4, 4] = 2.0
    psf = as_psf(torch.full((1, 3, 3), 0.1))
    (line,) = image.hooks.check(image(scene, psf), scene, psf)
    assert line.ok
    assert line.text == "flux kept in the image 90.00%"
    assert "no light" in image.hooks.check(scene * 0, scene * 0, psf)[0].text


def test_smooth_sizes():
    assert [fft_length(n) for n in (1, 7, 11, 3072, 4095)] == [1, 8, 12, 3072, 4096]
