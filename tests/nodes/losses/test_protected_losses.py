"""Losses of a mask behind a peak limit: NumPy from the definitions, simulated pictures,
gradients, and the rival.
"""

import math

import numpy as np
import pytest
import torch

from neusee.nodes.losses import ProtectedPicture, best_stop, filtered_error, information
from neusee.nodes.metrics import stop_diameter
from neusee.nodes.values import Bands, Psf

HOW = {"light": 40.0, "read_noise": 6.0, "limit": 0.2}
EACH = pytest.mark.parametrize(
    "loss", [filtered_error, information], ids=lambda loss: loss.fn.__name__
)


def rand(*shape, seed=1):
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def given(kernel, channels=2, peak=0.3):
    """A PSF with what a camera sees of its bands."""
    count = len(kernel)
    centres = torch.linspace(450e-9, 650e-9, count, dtype=torch.float64)
    bands = Bands(centres, torch.full_like(centres, 10e-9), torch.ones_like(centres))
    clear = torch.full((count,), peak, dtype=torch.float64)
    return Psf(kernel, clear), rand(count, seed=2), rand(channels, count, seed=3), bands


def kernels(*shape, seed=1):
    found = rand(*shape, seed=seed).pow(20)
    return found / found.sum((-2, -1), keepdim=True)


@EACH
@pytest.mark.parametrize("shape", [(3, 16, 16), (2, 15, 16), (3, 16, 15), (1, 1, 7)])
@pytest.mark.parametrize(
    "how", [{}, {"veil": 30.0, "contrast": 0.4, "transmittance": 0.5}, {"up_to": 0.3, "power": 9}]
)
def test_it_agrees_with_its_reference(loss, shape, how):
    psf, *rest = given(kernels(*shape))
    expected = loss.hooks.reference(psf, *rest, **{**HOW, **how})
    torch.testing.assert_close(loss(psf, *rest, **{**HOW, **how}), expected)
    single = psf._replace(intensity=psf.intensity.float())
    assert float(loss(single, *rest, **{**HOW, **how})) == pytest.approx(float(expected), abs=1e-5)


def aperture(phase, samples=24, window=64):
    """The PSF in NumPy of a round pupil with a phase in turns, and the light in the brightest
    clear pixel.
    """
    at = (np.arange(samples) - (samples - 1) / 2) / (samples / 2)
    inside = at[:, None] ** 2 + at**2 <= 1
    field = np.zeros((window, window), complex)
    field[:samples, :samples] = inside * np.exp(2j * np.pi * phase(at[:, None], at))
    psf = np.abs(np.fft.fft2(field)) ** 2 / (inside.sum() * window**2)
    return np.fft.fftshift(psf), inside.sum() / window**2


@pytest.mark.parametrize("light", [5.0, 300.0])
@pytest.mark.parametrize("limit", [None, 0.05])
def test_equals_numpy_for_a_mask_behind_a_lens(light, limit):
    """By a code of its own: the PSF, its peak, the filter, the spectrum, the error and the bits."""
    psf, clear = aperture(lambda y, x: 1.5 * (y**3 + x**3))
    nu = np.hypot(*np.meshgrid(np.fft.fftfreq(64), np.fft.fftfreq(64), indexing="ij"))
    nu[0, 0] = np.inf
    scene = nu**-2.0
    scene *= 0.1 / scene.mean()
    grey = 1.0 if limit is None else min(1.0, limit * clear / psf.max())
    snr = (grey * light * np.abs(np.fft.fft2(psf))) ** 2 / (grey * light + 36.0) * scene
    one = torch.ones(1, dtype=torch.float64)
    inputs = (
        Psf(torch.from_numpy(psf)[None], clear * one),
        one,
        one[None],
        Bands(550e-9 * one, one, one),
    )
    how = {"light": light, "read_noise": 6.0, "limit": limit}
    lost = math.log((scene / (1 + snr)).sum() / scene.sum())
    assert float(filtered_error(*inputs, **how)) == pytest.approx(lost, rel=1e-9)
    bits = np.log2(1 + snr).ravel()[1:].mean()
    assert float(information(*inputs, **how)) == pytest.approx(-bits, rel=1e-9)


def test_it_is_the_error_that_filtering_leaves():
    """Pictures with the noise of light and reading, filtered in NumPy: the mean square error of
    many.
    """
    psf, clear = aperture(lambda y, x: 1.5 * (y**3 + x**3), samples=12, window=24)
    rng, (light, read) = np.random.default_rng(4), (80.0, 5.0)
    nu = np.hypot(*np.meshgrid(np.fft.fftfreq(24), np.fft.fftfreq(24), indexing="ij"))
    nu[0, 0] = np.inf
    power = nu**-2.0
    power *= 0.1 / power.mean()
    scene = np.fft.fft2(rng.standard_normal((1500, 24, 24))) * np.sqrt(power)
    otf, noise = np.fft.fft2(np.fft.ifftshift(psf)), light + read**2
    drawn = np.fft.fft2(math.sqrt(noise) * rng.standard_normal((1500, 24, 24)))
    found = (
        (light * otf * scene + drawn)
        * power
        * light
        * otf.conj()
        / (power * light**2 * np.abs(otf) ** 2 + noise)
    )
    share = (np.abs(found - scene) ** 2).sum() / (np.abs(scene) ** 2).sum()
    one = torch.ones(1, dtype=torch.float64)
    inputs = (
        Psf(torch.from_numpy(psf)[None], clear * one),
        one,
        one[None],
        Bands(550e-9 * one, one, one),
    )
    assert float(filtered_error(*inputs, light=light, read_noise=read)) == pytest.approx(
        math.log(share), abs=0.01
    )


@EACH
def test_more_light_and_a_higher_limit_are_better_and_a_veil_is_worse(loss):
    inputs = given(kernels(2, 16, 16))
    assert float(loss(*inputs, **{**HOW, "light": 80.0})) < float(loss(*inputs, **HOW))
    assert float(loss(*inputs, **{**HOW, "limit": 0.4})) < float(loss(*inputs, **HOW))
    assert float(loss(*inputs, **HOW, veil=50.0)) > float(loss(*inputs, **HOW))
    reached = float((inputs[0].intensity / 0.3).max())
    within = {**HOW, "limit": min(1.0, 1.01 * reached)}
    assert float(loss(*inputs, **within)) == float(loss(*inputs, **{**HOW, "limit": None}))


@EACH
def test_gradient(loss):
    kernel = kernels(2, 5, 6).requires_grad_()
    assert torch.autograd.gradcheck(lambda k: loss(*given(k), **HOW, power=8.0), (kernel,))
    share = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda k, t: loss(*given(k), **HOW, power=8.0, transmittance=t),
        (kernel, share),
        nondet_tol=0,
    )
    own, truth = (
        torch.autograd.grad(f(*given(kernel), **HOW, power=8.0), kernel)[0]
        for f in (loss, loss.hooks.reference)
    )
    torch.testing.assert_close(own, truth)


@EACH
@pytest.mark.parametrize("limit", [None, 0.03])
def test_the_rival_is_no_worse_than_any_stop_and_filter_of_the_fourier_transform(loss, limit):
    """Stops of 40 to 64 samples in one pupil grid; the best of the closed form is better than
    each, by little.
    """
    window, one, found = 192, torch.ones(1, dtype=torch.float64), []
    grey = (one, one[None], Bands(550e-9 * one, one, one))
    clear = aperture(lambda y, x: 0 * y * x, 64, window)[1] * one
    how = {"light": 100.0, "read_noise": 6.0, "limit": limit}
    for samples in (28, 34, 40, 48, 64):
        psf, own = aperture(lambda y, x: 0 * y * x, samples, window)
        area = float(own / clear)
        stopped = Psf(torch.from_numpy(area * psf)[None], clear)
        found.append(float(loss(stopped, *grey, **how, transmittance=area)))
    rival, width, passed = best_stop(
        Psf(stopped.intensity, clear), *grey, ProtectedPicture(**how), measure=loss.fn.__name__
    )
    assert rival <= min(found) + 2e-3 * abs(min(found))
    assert rival > min(found) - 0.05 * abs(min(found))
    if limit is None:
        assert (width, passed) == (1.0, 1.0)
    else:
        assert width**4 * passed == pytest.approx(limit)


def test_in_the_dark_the_rival_is_a_stop_without_a_filter_behind_pixels_that_average():
    """Light decides there, and a stop passes more of it than a filter of the same peak."""
    one = torch.ones(1, dtype=torch.float64)
    lens = Psf(torch.zeros(1, 64, 64, dtype=torch.float64), 0.11 * one, 0.39 * one, one)
    grey = (one, one[None], Bands(550e-9 * one, one, one))
    _, width, passed = best_stop(
        lens, *grey, ProtectedPicture(light=3.0, read_noise=10.5, limit=0.01)
    )
    assert passed > 0.999
    assert width == pytest.approx(float(stop_diameter(lens, 0.01)), rel=1e-6)
    assert width < 0.99 * 0.01**0.25
