"""What once failed at the extremes: each case with its closed form, or against float64."""

import math

import pytest
import torch

from neusee.nodes import losses, metrics
from neusee.nodes._precision import refuse_half, refuse_not_finite, single
from neusee.nodes.values import Psf


def psf_of(intensity, clear_peak=0.1):
    return Psf(intensity, torch.full((len(intensity),), clear_peak, dtype=torch.float64))


def slope_of(loss, x):
    x = x.clone().requires_grad_()
    return torch.autograd.grad(loss(x), x)[0]


# --- losses at zero ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("log", [False, True])
@pytest.mark.parametrize("scale", [0.0, 1e-40, 1e-32])
def test_an_opaque_mask_has_a_finite_loss_and_no_slope(log, scale):
    dark = torch.full((2, 5, 5), scale)
    loss = float(losses.lsr(psf_of(dark), log=log))
    assert loss == pytest.approx(2 * math.log(1e-30) if log else 0.0, abs=1e-5 * abs(loss) + 1e-29)
    assert float(slope_of(lambda x: losses.lsr(psf_of(x), log=log), dark).abs().max()) == 0


def test_the_log_of_the_lsr_is_the_same_in_both_precisions_when_one_band_is_dark():
    psf = torch.rand(2, 5, 5, generator=torch.Generator().manual_seed(1))
    psf[0] = 0
    single_, double = (float(losses.lsr(psf_of(x), log=True)) for x in (psf, psf.double()))
    assert single_ == pytest.approx(double, rel=1e-6)


def test_the_reference_of_the_lsr_has_a_slope_where_some_pixels_are_black():
    psf = torch.rand(1, 5, 5, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    psf[0, :2] = 0
    usual, truth = (slope_of(lambda x, f=f: f(psf_of(x)), psf) for f in (losses.lsr, losses.lsr.ref))
    torch.testing.assert_close(usual, truth)


def test_a_penalty_at_zero_slope_is_one_and_pulls_nowhere():
    still = torch.zeros(3, 2, 4, 4)
    assert float(losses.gradient_penalty(still)) == 1.0
    assert float(slope_of(losses.gradient_penalty, still).abs().max()) == 0.0


@pytest.mark.parametrize("size", [1e-30, 1e-12, 1.0, 1e12])
def test_the_penalty_and_its_slope_follow_the_closed_form(size):
    slopes = torch.randn(3, 8, generator=torch.Generator().manual_seed(1)) * size
    norm = slopes.double().norm(dim=1, keepdim=True)
    expected = 2 * (norm - 1) / 3 * slopes.double() / norm
    assert float(losses.gradient_penalty(slopes)) == pytest.approx(float((norm - 1).square().mean()), rel=1e-5)
    torch.testing.assert_close(slope_of(losses.gradient_penalty, slopes).double(), expected, rtol=1e-5, atol=1e-7)


def test_the_penalty_can_be_differentiated_twice_as_training_needs():
    slopes = torch.randn(2, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(losses.gradient_penalty, slopes)
    assert torch.autograd.gradgradcheck(losses.gradient_penalty, slopes)


@pytest.mark.parametrize("loss", [losses.charbonnier, losses.fft_l1])
def test_equal_pictures_have_a_loss_near_zero_and_no_slope(loss):
    picture = torch.rand(3, 6, 7, generator=torch.Generator().manual_seed(1))
    assert 0 <= float(loss(picture, picture)) <= 1.001e-3
    assert float(slope_of(lambda x: loss(x, picture), picture).abs().max()) == 0


def test_spectra_of_smooth_differences_have_the_slope_of_float64():
    """Nearly all of their coefficients are 0, and of 0 in single precision only the rounding is left."""
    ramp = torch.linspace(0, 1e4, 32).expand(3, 32, 32)
    truth = torch.rand(3, 32, 32, generator=torch.Generator().manual_seed(1))
    usual, exact = (slope_of(lambda x: losses.fft_l1(x, truth.to(x)), x) for x in (ramp, ramp.double()))
    torch.testing.assert_close(usual.double(), exact, rtol=0, atol=1e-6 * float(exact.abs().max()))


# --- pictures without light -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [0.0, 1e-40])
def test_no_light_has_no_contrast_and_its_slope_is_zero(scale):
    dark = torch.full((2, 9, 8), scale)
    assert all(float(x.abs().max()) == 0 for x in metrics.mtf(psf_of(dark)))
    assert float(slope_of(lambda x: metrics.mtf(psf_of(x)).rms.sum(), dark).abs().max()) == 0


def test_the_median_contrast_of_a_symmetric_psf_has_no_slope_by_chance():
    """Equal frequencies are sorted by their rounding."""
    line = torch.exp(-torch.linspace(-2, 2, 9).square())
    found = metrics.mtf(psf_of((line[:, None] * line)[None].requires_grad_()))
    assert found.rms.requires_grad
    assert not found.median.requires_grad
    assert not found.low.requires_grad


# --- precision --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("half", [torch.float16, torch.bfloat16])
def test_half_precision_is_computed_in_single(half):
    psf = psf_of(torch.rand(2, 16, 16, generator=torch.Generator().manual_seed(1)).to(half))
    wide = Psf(psf.intensity.float(), psf.clear_peak)
    one, two = (torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(s)).to(half) for s in (1, 2))
    for loss in (losses.charbonnier, losses.fft_l1, losses.bsr):
        assert loss(one, two).dtype == torch.float32
        assert float(loss(one, two)) == pytest.approx(float(loss(one.float(), two.float())), rel=1e-6)
    assert float(losses.lsr(psf)) == pytest.approx(float(losses.lsr(wide)), rel=1e-6)
    torch.testing.assert_close(metrics.mtf(psf).rms, metrics.mtf(wide).rms)


def test_what_half_precision_cannot_hold_is_refused_and_the_rest_widened():
    half = torch.ones(2, dtype=torch.float16)
    assert single(half).dtype == torch.float32
    assert single(half.double()).dtype == torch.float64
    with pytest.raises(ValueError, match=r"height is float16.*float32"):
        refuse_half(path=half.float(), height=half)
    with pytest.raises(ValueError, match="height holds values that are not finite: no light"):
        refuse_not_finite("no light", path=half, height=half / 0)


# --- numbers that are none --------------------------------------------------------------------------------------------


def test_a_ratio_of_what_is_no_number_is_none():
    picture = torch.rand(2, 5, 5, generator=torch.Generator().manual_seed(1))
    broken = picture.clone()
    broken[0, 2, 2] = math.nan
    for pair in ((broken, picture), (picture, broken)):
        assert math.isnan(float(losses.bsr(*pair)))
    assert math.isnan(float(losses.lsr(psf_of(broken))))
    assert math.isnan(float(losses.gradient_penalty(broken)))
