"""The light that stays in the field equals the sum over the pixels of an image without a border."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.nodes.optics import image, light_in_field
from neusee.nodes.values import Psf


def rand(*shape, dtype=torch.float64):
    return torch.rand(*shape, dtype=dtype, generator=torch.Generator().manual_seed(sum(shape)))


sizes = st.integers(1, 9)


@settings(max_examples=40, deadline=None)
@given(sizes, sizes, st.integers(1, 20), st.integers(1, 20))
def test_any_size_of_scene_and_psf(y, x, m, n):
    cube, kernel = rand(5, y, x) - 0.3, rand(5, m, n)
    expected = image(cube, Psf(kernel, kernel[:, 0, 0]), border="zero").sum((1, 2))
    kept, whole = light_in_field(kernel, cube)
    torch.testing.assert_close(kept, expected, rtol=1e-11, atol=1e-11)
    torch.testing.assert_close(whole, cube.sum((1, 2)), rtol=1e-11, atol=1e-11)


def test_single_precision():
    cube, kernel = (
        rand(31, 97, 101, dtype=torch.float32),
        rand(31, 64, 80, dtype=torch.float32) / 5120,
    )
    expected = image(cube.double(), Psf(kernel.double(), kernel[:, 0, 0])).sum((1, 2))
    torch.testing.assert_close(light_in_field(kernel, cube)[0], expected, rtol=1e-6, atol=0)


def test_gradients_of_scene_and_psf():
    planes, kernel = rand(3, 3, 2).requires_grad_(), rand(3, 2, 3).requires_grad_()
    assert torch.autograd.gradcheck(lambda p, k: light_in_field(k, p)[0], (planes, kernel))
