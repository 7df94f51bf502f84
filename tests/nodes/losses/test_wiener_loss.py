"""The loss of what a Wiener filter leaves wrong: closed forms, its reference, its gradient, and
the filter itself.
"""

import math

import pytest
import torch

from neusee.nodes.losses import wiener
from neusee.nodes.restore.inverse import fall
from neusee.nodes.values import Bands, Psf


def rand(*shape, seed=1):
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def given(kernel, channels=2):
    """A PSF with what a camera sees of its bands."""
    count = len(kernel)
    centres = torch.linspace(450e-9, 650e-9, count, dtype=torch.float64)
    bands = Bands(centres, torch.full_like(centres, 10e-9), torch.ones_like(centres))
    return (
        Psf(kernel, torch.full((count,), 0.1)),
        rand(count, seed=2),
        rand(channels, count, seed=3),
        bands,
    )


def kernels(*shape, seed=1):
    found = rand(*shape, seed=seed).pow(20)
    return found / found.sum((-2, -1), keepdim=True)


@pytest.mark.parametrize("shape", [(3, 16, 16), (2, 15, 16), (3, 16, 15), (1, 1, 7)])
@pytest.mark.parametrize("how", [{}, {"noise": 0.1, "colour": 0.3}, {"up_to": 0.2}])
def test_it_agrees_with_its_reference(shape, how):
    psf, *rest = given(kernels(*shape))
    torch.testing.assert_close(wiener(psf, *rest, **how), wiener.hooks.reference(psf, *rest, **how))
    single = psf._replace(intensity=psf.intensity.float())
    assert float(wiener(single, *rest, **how)) == pytest.approx(
        float(wiener.hooks.reference(psf, *rest, **how)), abs=1e-5
    )


def test_a_point_leaves_what_the_noise_hides_and_no_light_leaves_nothing():
    point, noise = torch.zeros(2, 16, 16, dtype=torch.float64), 0.05
    point[:, 8, 8] = 1.0
    # with mirrors, without the mean
    power = torch.cat([fall((16, 16)), fall((16, 16))[:, 1:8]], 1).flatten()[1:]
    hidden = float((power / (power / noise + 1)).sum() / power.sum())
    assert float(wiener(*given(point), noise=noise)) == pytest.approx(math.log(hidden), rel=1e-6)
    assert float(wiener(*given(torch.zeros_like(point)), noise=noise)) == pytest.approx(
        0.0, abs=1e-9
    )


def test_it_is_the_error_that_filtering_leaves():
    """Pictures of the prior, blurred, with noise, filtered: the mean square error of many."""
    psf, light, responses, bands = given(kernels(1, 16, 16), channels=1)
    rng, noise = torch.Generator().manual_seed(5), 0.02
    power = torch.cat([fall((16, 16)), fall((16, 16))[:, 1:8].roll(-1, 0).flip((0, 1))], 1)
    power[0, 0] = 0.0
    white = torch.randn(4000, 16, 16, dtype=torch.float64, generator=rng)
    scene = torch.fft.fft2(white) * power.sqrt()
    transfer = torch.fft.fft2(psf.intensity[0])
    seen = transfer * scene + math.sqrt(noise) * torch.fft.fft2(
        torch.randn(4000, 16, 16, dtype=torch.float64, generator=rng)
    )
    found = seen * power * transfer.conj() / (power * transfer.abs().square() + noise)
    share = float((found - scene)[:, power > 0].abs().square().sum() / scene.abs().square().sum())
    assert float(wiener(psf, light, responses, bands, noise=noise)) == pytest.approx(
        math.log(share), abs=0.01
    )


def test_bands_that_agree_leave_no_colour_wrong():
    alike = kernels(1, 16, 16).expand(3, 16, 16).contiguous()
    grey, coloured = (float(wiener(*given(alike), colour=share)) for share in (0.0, 1.0))
    assert grey == pytest.approx(coloured, rel=1e-12)
    apart = given(kernels(3, 16, 16))
    assert float(wiener(*apart, colour=1.0)) > float(wiener(*apart, colour=0.0)) + 0.1


def test_gradient():
    kernel = kernels(2, 5, 6).requires_grad_()
    assert torch.autograd.gradcheck(lambda k: wiener(*given(k)), (kernel,))
    own, truth = (
        torch.autograd.grad(f(*given(kernel)), kernel)[0] for f in (wiener, wiener.hooks.reference)
    )
    torch.testing.assert_close(own, truth)


def test_a_dark_band_and_a_blind_channel_stay_finite():
    kernel = kernels(2, 6, 6).float()
    kernel[0] = 0.0
    psf, light, responses, bands = given(kernel.requires_grad_())
    responses[1] = 0.0
    (slope,) = torch.autograd.grad(wiener(psf, light, responses, bands), kernel)
    assert bool(slope.isfinite().all())


def test_bands_that_differ_are_refused():
    psf, light, responses, bands = given(kernels(3, 6, 6))
    with pytest.raises(ValueError, match="bands: use one"):
        wiener(psf, light[:2], responses, bands)


def test_what_is_no_number_is_seen():
    broken = kernels(1, 6, 6)
    broken[0, 1, 2] = math.nan
    assert math.isnan(float(wiener(*given(broken))))
