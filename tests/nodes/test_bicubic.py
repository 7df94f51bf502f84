"""Resampling by matrices: torch's numbers, derivatives of every order, and no aliasing."""

import pytest
import torch
from torch.nn.functional import interpolate
from torch.testing import assert_close

from neusee.nodes.resampling import enlarge, resize

SIZES = [
    ((16, 16), (8, 8)),
    ((37, 53), (18, 26)),
    ((9, 5), (31, 64)),
    ((8, 30), (19, 7)),
    ((1, 6), (4, 1)),
]


def drawn(*shape, dtype=torch.float64):
    return torch.randn(*shape, dtype=dtype, generator=torch.Generator().manual_seed(3))


@pytest.mark.parametrize(("dtype", "error"), [(torch.float64, 1e-12), (torch.float32, 1e-6)])
@pytest.mark.parametrize(("old", "new"), SIZES)
def test_resize_is_torch_bicubic_with_antialias(old, new, dtype, error):
    image = drawn(2, 3, *old).sigmoid().to(dtype)  # a picture, from 0 to 1
    wanted = interpolate(image, size=new, mode="bicubic", antialias=True)
    assert_close(resize(image, *new), wanted, rtol=0, atol=error)


def test_enlarge_is_torch_bicubic():
    image = drawn(5, 7)
    wanted = interpolate(image[None, None], size=(13, 9), mode="bicubic", align_corners=False)[0, 0]
    assert_close(enlarge(image, 13, 9), wanted, rtol=0, atol=1e-13)


def test_resize_keeps_a_grey_picture_and_the_finest_stripes_go_grey():
    assert_close(
        resize(torch.full((1, 11, 9), 0.3), 5, 4), torch.full((1, 5, 4), 0.3), rtol=0, atol=1e-7
    )
    stripes = torch.arange(64.0).remainder(2).expand(64, 64)
    assert float((resize(stripes, 16, 16) - 0.5)[:, 2:-2].abs().max()) < 0.02
    assert float((enlarge(stripes, 21, 21) - 0.5)[:, 2:-2].abs().max()) > 0.4


def test_resize_has_second_derivatives():
    image = drawn(1, 7, 6).requires_grad_()
    assert torch.autograd.gradgradcheck(lambda x: resize(x, 3, 9).pow(3), (image,), fast_mode=True)


def test_resize_stays_single_under_autocast_and_learns_after_inference():
    image = drawn(3, 12, 12, dtype=torch.float32)
    with torch.inference_mode():
        resize(image, 7, 10)
    with torch.autocast("cpu", torch.bfloat16):
        small = resize(image.requires_grad_(), 7, 10)
    assert small.dtype == torch.float32
    small.square().sum().backward()
    assert torch.equal(small, resize(image, 7, 10))
    assert bool(image.grad.any())
