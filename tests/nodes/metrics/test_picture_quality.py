"""Quality: agrees with scikit-image, says what it compares, and stays finite."""

import numpy as np
import pytest
import torch
from kornia.metrics import ssim
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from neusee.nodes.metrics import quality


def pair(size=256, noise=0.05):
    rng = np.random.default_rng(0)
    grid = np.linspace(0, 12, size)
    truth = 0.5 + 0.3 * np.sin(grid)[:, None] * np.cos(
        np.array([1.0, 1.7, 2.3])[:, None, None] * grid
    )
    return (
        np.clip(x, 0, 1).astype("float32")
        for x in (truth + noise * rng.standard_normal(truth.shape), truth)
    )


def gaussian_ssim(a, b):
    how = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "win_size": 11}
    _, full = structural_similarity(a, b, channel_axis=0, data_range=1.0, full=True, **how)
    return full[:, 5:-5, 5:-5].mean()


@pytest.mark.parametrize("shape", [(11, 11), (64, 65), (65, 11), (130, 119)])
def test_ssim_is_that_of_kornia_at_any_size(shape):
    torch.manual_seed(0)
    truth = torch.rand(3, *shape)
    estimate = (truth + 0.1 * torch.randn_like(truth)).clamp(0, 1)
    whole = ssim(estimate[None], truth[None], 11, padding="valid")
    assert float(quality(estimate, truth, domain="linear").ssim) == pytest.approx(
        float(whole.mean()), abs=1e-6
    )


def test_what_is_compared_by_stripes_has_the_gradient_of_the_whole():
    torch.manual_seed(0)
    truth, estimate = torch.rand(2, 3, 70, 20).double()
    grads = []
    for measure in (
        lambda x: quality(x, truth, domain="linear").ssim,
        lambda x: ssim(x[None], truth[None], 11, padding="valid").mean(),
    ):
        x = estimate.clone().requires_grad_()
        measure(x).backward()
        grads.append(x.grad)
    torch.testing.assert_close(*grads, rtol=1e-6, atol=1e-12)


def test_agrees_with_scikit_image():
    noisy, truth = pair()
    found = quality(torch.tensor(noisy), torch.tensor(truth), domain="linear")
    assert float(found.psnr) == pytest.approx(
        peak_signal_noise_ratio(truth, noisy, data_range=1.0), abs=2e-5
    )
    assert float(found.ssim) == pytest.approx(gaussian_ssim(truth, noisy), abs=2e-5)
    assert float(found.l1) == pytest.approx(np.abs(noisy - truth).mean(), rel=1e-5)
    assert all(x.dtype == torch.float64 and x.ndim == 0 for x in found)


def test_encoded_compares_what_a_display_shows():
    estimate, truth = torch.full((3, 16, 16), 0.0100), torch.full((3, 16, 16), 0.0125)
    encoded = [1.055 * x ** (1 / 2.4) - 0.055 for x in (0.01, 0.0125)]
    assert float(quality(estimate, truth).l1) == pytest.approx(encoded[1] - encoded[0], rel=1e-4)
    assert float(quality(estimate, truth, domain="linear").l1) == pytest.approx(0.0025, rel=1e-4)


def test_both_are_clipped_to_what_can_be_shown():
    bright, white = torch.full((3, 12, 12), 50.0), torch.ones(3, 12, 12)
    assert float(quality(bright, white).l1) == 0.0
    assert float(quality(bright, white).psnr) == pytest.approx(200.0)
    assert float(quality(-bright, white).psnr) == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("bright", [1.0, 50.0])
def test_white_in_place_of_black_is_an_error_of_exactly_one(bright, dtype):
    """1.055 - 0.055 is 1 - 6e-8 in single precision: PSNR would be 3e-7 dB in place of 0 dB."""
    found = quality(
        torch.full((3, 70, 12), bright, dtype=dtype), torch.zeros(3, 70, 12, dtype=dtype)
    )
    assert (float(found.l1), float(found.psnr)) == (1.0, 0.0)


def test_white_has_the_gradient_of_the_curve_of_srgb():
    white = torch.ones(3, 12, 12, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(quality(white, torch.zeros(3, 12, 12)).l1 * white.numel(), white)
    torch.testing.assert_close(slope, torch.full_like(slope, 1.055 / 2.4))


def test_the_border_does_not_count():
    truth = torch.rand(3, 21, 23)
    wrong = truth.clone()
    wrong[:, :5] = wrong[:, -5:] = wrong[..., :5] = wrong[..., -5:] = 0.0
    assert float(quality(wrong, truth, border=5).l1) == 0.0
    assert float(quality(wrong, truth).l1) > 0.1


def test_what_cannot_be_compared():
    with pytest.raises(ValueError, match="differ"):
        quality(torch.ones(3, 16, 16), torch.ones(3, 16, 17))
    for size, border in ((1, 0), (16, 3), (16, 40)):
        with pytest.raises(ValueError, match="11 x 11"):
            quality(torch.ones(3, size, size), torch.ones(3, size, size), border=border)


def test_check():
    picture = torch.rand(3, 16, 16)
    assert (
        quality.hooks.check(quality(picture, picture))[0].text
        == "L1 0.0000, PSNR 200.00 dB, SSIM 1.000"
    )
