"""The loss of contrast: against its reference, its limits, its gradient, and that it follows the
median.
"""

import math

import pytest
import torch

from neusee.nodes import doe, optics
from neusee.nodes.losses import contrast
from neusee.nodes.metrics import limits, mtf
from neusee.nodes.values import Bands, Psf

STOP = optics.stop(samples=135, pitch=59.84e-6, diameter=8.0784e-3)


def rand(*shape, seed=1):
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def as_psf(kernel, peak=0.1):
    return Psf(kernel, torch.full((len(kernel),), peak, dtype=torch.float64))


def behind(height, window=128):
    """PSFs at three wavelengths."""
    centres = torch.tensor([450e-9, 550e-9, 650e-9], dtype=torch.float64)
    bands = Bands(centres, torch.full_like(centres, 10e-9), torch.ones_like(centres))
    pupil = optics.pupil(height, doe.material(bands), bands, STOP)
    return optics.psf(pupil, focal_length=0.11, pixel_pitch=2.9e-6, shape=(window, window))


@pytest.mark.parametrize("shape", [(2, 16, 16), (1, 15, 16), (1, 16, 15), (1, 1, 7)])
@pytest.mark.parametrize("size", [1e-12, 1.0])
def test_it_agrees_with_its_reference(shape, size):
    for psf in (as_psf(size * rand(*shape)), as_psf(size * rand(*shape).pow(20), peak=0.3)):
        torch.testing.assert_close(contrast(psf), contrast.hooks.reference(psf))
        single = psf._replace(intensity=psf.intensity.float())
        assert float(contrast(single)) == pytest.approx(
            float(contrast.hooks.reference(psf)), rel=1e-5
        )


def test_a_point_has_all_contrast_and_even_light_none():
    point, even = torch.zeros(1, 16, 16), torch.ones(1, 16, 16)
    point[0, 8, 8] = 1.0
    inside = torch.hypot(*torch.meshgrid(*[torch.fft.fftfreq(16)] * 2, indexing="ij"))
    count = int((inside[:, :9] <= math.sqrt(0.4 / math.pi)).sum())
    assert float(contrast(as_psf(point))) == pytest.approx(0.0, abs=1e-6)
    assert float(contrast(as_psf(even), floor=1e-3)) == pytest.approx(
        -math.log(1e-3) * (1 - 1 / count), rel=1e-4
    )


@pytest.mark.parametrize("up_to", [0.05, 0.1, 0.5])
def test_a_gaussian_loses_up_to_a_frequency_what_its_transform_says(up_to):
    """OTF of exp(-r^2 / (2 s^2)): exp(-2 pi^2 s^2 f^2); the mean of its logarithm by the mean
    square frequency.
    """
    at, s = torch.arange(64, dtype=torch.float64) - 32, 2.0
    line = torch.exp(-at.square() / (2 * s**2))
    psf = as_psf((line[:, None] * line)[None], peak=0.1)
    fy, fx = (
        torch.fft.fftfreq(64, dtype=torch.float64)[:, None],
        torch.fft.rfftfreq(64, dtype=torch.float64),
    )
    square = fy.square() + fx.square()
    kept = square[square.sqrt() <= min(up_to, math.sqrt(0.4 / math.pi))]
    whole = 2 * math.pi**2 * s**2 * float(kept.mean())
    assert float(contrast(psf, floor=1e-12, up_to=up_to)) == pytest.approx(whole, rel=1e-9)
    torch.testing.assert_close(
        contrast(psf, up_to=up_to), contrast.hooks.reference(psf, up_to=up_to)
    )


def test_gradient():
    kernel = rand(2, 5, 6).requires_grad_()
    assert torch.autograd.gradcheck(lambda k: contrast(as_psf(k)), (kernel,))
    assert torch.autograd.gradgradcheck(lambda k: contrast(as_psf(k)), (kernel,))
    own, truth = (
        torch.autograd.grad(f(as_psf(kernel)), kernel)[0]
        for f in (contrast, contrast.hooks.reference)
    )
    torch.testing.assert_close(own, truth)


@pytest.mark.parametrize("scale", [0.0, 1e-40])
def test_a_dark_band_counts_as_no_contrast_and_pulls_nowhere(scale):
    kernel = torch.stack([torch.full((6, 6), scale), rand(6, 6).float()]).requires_grad_()
    loss = contrast(as_psf(kernel))
    (slope,) = torch.autograd.grad(loss, kernel)
    rest = float(contrast(as_psf(kernel.detach()[1:])))
    assert float(loss.detach()) == pytest.approx(-math.log(1e-4) + rest, rel=1e-5)
    assert float(slope[0].abs().max()) == 0
    assert bool(slope.isfinite().all())


def test_what_is_no_number_is_seen():
    broken = rand(1, 6, 6)
    broken[0, 1, 2] = math.nan
    assert math.isnan(float(contrast(as_psf(broken))))


def test_half_precision_is_computed_in_single():
    psf = as_psf(rand(1, 8, 8).half())
    assert float(contrast(psf)) == pytest.approx(
        float(contrast(as_psf(psf.intensity.float()))), rel=1e-6
    )


def test_it_orders_masks_as_their_median_contrast_does():
    heights = [
        doe.flat(STOP),
        doe.vortex(STOP, charge=4),
        doe.half_rings(STOP, waves=(8.0,)),
        doe.axicon(STOP, waves=8.0),
    ]
    found = [behind(height) for height in heights]
    lost = [float(contrast(psf, floor=1e-5)) for psf in found]
    medians = [float(mtf(psf).median.log().sum()) for psf in found]
    assert sorted(range(4), key=lost.__getitem__) == sorted(
        range(4), key=medians.__getitem__, reverse=True
    )
    assert all(abs(a + b) < 0.45 * 3 for a, b in zip(lost, medians, strict=True))  # nats a band


def test_a_step_along_its_gradient_raises_the_median():
    height = (
        1e-6 * torch.randn(135, 135, generator=torch.Generator().manual_seed(2))
    ).requires_grad_()
    before = behind(height)
    (slope,) = torch.autograd.grad(contrast(before), height)
    after = behind((height - 3e-8 * slope / slope.abs().max()).detach())
    assert float(mtf(after).median.sum()) > float(mtf(before).median.sum())


def test_limits_hold_and_meet_at_even_light():
    even = limits(as_psf(torch.full((1, 16, 16), 1e-3, dtype=torch.float64)))
    assert float(even.floor) == pytest.approx(1e-3 / 0.1)
    assert float(even.rms) == pytest.approx(float(even.bound)) == pytest.approx(1 / 16)
    for height in (doe.flat(STOP), doe.axicon(STOP, waves=8.0)):
        psf = behind(height)
        found, measured = limits(psf), mtf(psf)
        lsr = psf.intensity.amax((-2, -1)).double() / psf.clear_peak
        assert bool((found.rms <= found.bound).all())
        assert bool((measured.median <= found.median).all())
        assert bool((measured.rms <= found.passed).all())
        assert bool((lsr >= found.floor).all())
    assert all(float(x.abs().max()) == 0 for x in limits(as_psf(torch.zeros(1, 4, 4))))
