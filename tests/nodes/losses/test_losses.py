"""Losses: their limits, their gradients, and that a gradient step does what they promise."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.nodes.losses import (
    background_loss,
    charbonnier,
    fft_l1,
    log_error,
    mrae,
    suppression_loss,
)
from neusee.nodes.values import Psf


def rand(*shape):
    return torch.rand(
        *shape, dtype=torch.float64, generator=torch.Generator().manual_seed(len(shape))
    )


def as_psf(kernel):
    return Psf(kernel, torch.tensor([0.5, 0.1], dtype=torch.float64))


@settings(max_examples=40, deadline=None)
@given(st.floats(8, 64), st.booleans(), st.floats(-12, 0))
def test_lsr_agrees_with_its_reference(power, log, size):
    psf = as_psf(rand(2, 4, 5) * 10**size)
    torch.testing.assert_close(
        suppression_loss(psf, power=power, log=log),
        suppression_loss.hooks.reference(psf, power=power, log=log),
    )


def test_lsr_lies_just_above_the_peak():
    kernel = 1e-9 * rand(2, 32, 32)
    kernel[:, 3, 3] = torch.tensor([0.5, 0.1])
    assert float(suppression_loss(as_psf(kernel))) == pytest.approx(2.0, rel=1e-6)
    even = torch.ones(2, 8, 8, dtype=torch.float64) * torch.tensor([0.5, 0.1])[:, None, None]
    assert float(suppression_loss(as_psf(even), power=16)) == pytest.approx(2 * 64 ** (1 / 16))
    assert float(suppression_loss(as_psf(even), power=16, log=True)) == pytest.approx(
        2 * math.log(64) / 16
    )


def test_lsr_does_not_underflow_in_single_precision():
    kernel = torch.full((2, 4, 4), 1e-9)
    found = suppression_loss(as_psf(kernel), power=64)
    assert float(found) == pytest.approx(
        float(suppression_loss.hooks.reference(as_psf(kernel), power=64)), rel=1e-5
    )
    assert torch.isfinite(suppression_loss(as_psf(torch.zeros(2, 4, 4))))


@pytest.mark.parametrize("log", [False, True])
def test_lsr_gradient(log):
    kernel = (1e-3 * rand(2, 4, 4)).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda k: suppression_loss(as_psf(k), log=log), (kernel,), eps=1e-8, atol=1e-5
    )
    assert torch.autograd.gradgradcheck(
        lambda k: suppression_loss(as_psf(1e-3 * k), log=log), (rand(2, 2, 2).requires_grad_(),)
    )


def test_bsr_counts_lost_light():
    scene, point = rand(2, 4, 4), torch.zeros(2, 3, 3, dtype=torch.float64)
    point[:, 1, 1] = 1.0
    assert float(background_loss(as_psf(point), scene)) == pytest.approx(2.0)
    assert float(background_loss(as_psf(point / 2), scene)) == pytest.approx(4.0)
    assert float(background_loss(as_psf(point * 0), scene)) == 2.0
    aside = point.roll(1, -1)  # the last column of the scene leaves the field
    share = scene[..., :-1].sum((1, 2)) / scene.sum((1, 2))
    assert float(background_loss(as_psf(aside), scene)) == pytest.approx(float((1 / share).sum()))


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 6), st.integers(1, 6), st.floats(0, 1e3))
def test_charbonnier_lies_within_sqrt_epsilon_of_the_absolute_difference(y, x, scale):
    a, b = scale * rand(3, y, x), scale * rand(3, y, x).flip(0)
    l1 = float((a - b).abs().mean())
    assert l1 - 1e-9 <= float(charbonnier(a, b)) <= l1 + 1e-3 + 1e-9
    assert float(charbonnier(a, a)) == pytest.approx(1e-3)


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 8), st.integers(1, 8))
def test_fft_l1_does_not_grow_with_the_picture(y, x):
    noise, nothing = rand(y, x), torch.zeros(y, x, dtype=torch.float64)
    rms = float(noise.square().mean().sqrt())
    found = float(fft_l1(noise, nothing))
    # Parseval, then Cauchy and Schwarz
    assert rms / math.sqrt(x * y) - 1e-12 <= found <= rms + 1e-12
    point = nothing.clone()
    point[0, 0] = 1.0
    assert float(fft_l1(point, nothing)) == pytest.approx(1 / math.sqrt(x * y))


def test_a_decibel_of_the_log_error_is_one_of_the_psnr_in_every_picture():
    """Against scikit-image, for pictures within the range of a display; beyond it the loss has a
    slope of its own.
    """
    from skimage.metrics import peak_signal_noise_ratio

    def shown(x):
        x = x.numpy()
        return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)

    truth = rand(2, 3, 8, 9)
    estimate = (
        truth + torch.tensor([0.1, 1e-2])[:, None, None, None] * (rand(2, 3, 8, 9).flip(1) - 0.5)
    ).clamp(0, 1)
    each = [
        peak_signal_noise_ratio(shown(t), shown(e), data_range=1)
        for t, e in zip(truth, estimate, strict=True)
    ]
    assert float(log_error(estimate, truth)) == pytest.approx(
        -math.log(10) / 10 * np.mean(each), abs=0.02
    )
    dark = torch.full((3, 4, 4), -0.5, dtype=torch.float64, requires_grad=True)
    log_error(dark, torch.zeros(3, 4, 4, dtype=torch.float64)).backward()
    assert bool((dark.grad < 0).all())


@pytest.mark.parametrize("loss", [charbonnier, fft_l1, log_error])
def test_gradients_of_the_restoration_losses(loss):
    a, b = rand(3, 4, 5).requires_grad_(), rand(1, 3, 4, 5)[0].flip(1)
    assert torch.autograd.gradcheck(lambda x: loss(x, b), (a,))
    assert torch.autograd.gradgradcheck(lambda x: loss(x, b), (a,), atol=1e-4)
    same = b.clone().requires_grad_()
    loss(same, b).backward()
    assert torch.isfinite(same.grad).all()
    with pytest.raises(ValueError, match="differ"):
        loss(a, b[:2])


def test_mrae_is_the_published_measure_above_its_floor_and_bounded_below():
    truth = torch.tensor([0.5, 0.1, 0.0])
    estimate = torch.tensor([0.4, 0.12, 0.01], requires_grad=True)
    assert float(mrae(estimate.detach()[:2], truth[:2], floor=0.01)) == pytest.approx(
        (0.2 + 0.2) / 2
    )
    loss = mrae(estimate, truth, floor=0.02)
    torch.testing.assert_close(
        loss.detach().double(),
        mrae.hooks.reference(estimate.detach(), truth, floor=0.02),
        rtol=1e-6,
        atol=0,
    )
    loss.backward()
    assert float(estimate.grad.abs().max()) <= 1 / 0.02 / 3 * (1 + 1e-6)
    with pytest.raises(ValueError, match="differ"):
        mrae(estimate, truth[:2])
