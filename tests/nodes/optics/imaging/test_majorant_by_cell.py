"""The bound of an image by cells of pixels is never below the image, whatever the sizes and the
border.
"""

import pytest
import torch

from neusee.nodes.optics import _band_image, _channel_image, _convolution_plan


def image_of(off, kernel, reflect):
    """The sum over the shifts of a kernel, one by one, in float64."""
    (m, n), (y, x) = kernel.shape, off.shape
    around = (n - 1 - n // 2, n // 2, m - 1 - m // 2, m // 2)
    if reflect:
        wide, at = torch.nn.functional.pad(off[None], around, mode="reflect")[0], (m - 1, n - 1)
    else:
        wide, at = torch.nn.functional.pad(off, (n, n, m, m)), (m + m // 2, n + n // 2)
    total = torch.zeros_like(off)
    for i in range(m):
        for j in range(n):
            total += kernel[i, j] * wide[at[0] - i : at[0] - i + y, at[1] - j : at[1] - j + x]
    return total


def given_of(psf, size, reflect):
    rows = torch.tensor([[1.0, 0.2, 0.5], [0.1, 0.7, 0.3]], dtype=torch.float64)
    basis, nothing = torch.ones(3, 1, dtype=torch.float64), torch.zeros(2, 3, dtype=torch.float64)
    gram = torch.ones(1, 1, dtype=torch.float64)
    return _convolution_plan.ImageFacts(
        rows,
        basis,
        nothing,
        gram[0],
        gram,
        9 if reflect else 1,
        _convolution_plan.psf_light(psf),
        size,
        reflect,
    )


@pytest.mark.parametrize("reflect", [False, True])
@pytest.mark.parametrize(
    ("size", "window"), [((48, 48), (32, 32)), ((41, 30), (17, 24)), ((24, 37), (9, 36))]
)
def test_no_pixel_is_above_the_bound_of_its_cell(size, window, reflect):
    torch.manual_seed(sum(size))
    off = torch.rand(size).pow(8)
    psf = torch.rand(3, *window).pow(6)
    given = given_of(psf, size, reflect)
    kernel = (
        given.rows.abs().amax(0)[:, None, None]
        * _band_image.within_reach(_band_image.within_reach(psf, -2, size[0]), -1, size[1]).double()
    ).sum(0)
    image = image_of(off.double(), kernel, reflect)
    bound = _channel_image.majorant_by_cell(off, psf, given)
    assert bound.shape == (-(-size[0] // 8), -(-size[1] // 8))
    above = bound.repeat_interleave(8, 0).repeat_interleave(8, 1)[: size[0], : size[1]]
    assert bool((above * (1 + 1e-6) >= image).all())


def test_the_bound_of_an_even_error_is_the_image_itself():
    psf = torch.rand(3, 24, 24)
    given = given_of(psf, (40, 40), True)
    bound = _channel_image.majorant_by_cell(torch.full((40, 40), 0.3), psf, given)
    light = 0.3 * (given.rows.amax(0)[:, None, None] * psf).sum()
    torch.testing.assert_close(bound, light.expand(5, 5), rtol=1e-6, atol=0.0)
