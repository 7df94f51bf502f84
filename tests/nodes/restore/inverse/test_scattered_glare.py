"""Light of a laser that a lens scatters: found from speckle that NumPy draws, and removed better
than without.
"""

from functools import partial

import numpy as np
import pytest
import torch

from neusee.nodes.restore import wiener, wiener_by_field, wiener_spread
from neusee.nodes.restore.inverse import RADII, _glare, shared_level, visible, with_smooth
from neusee.nodes.values import Bands, MeasuredPsf, Psf

SIDE, READ, WELL = 96, 5.0, 25000.0
ONE = torch.ones(1, dtype=torch.float64)
BANDS = Bands(550e-9 * ONE, 1e-8 * ONE, ONE)
COLOUR = np.array([0.05, 0.3, 1.0])[:, None, None]  #: of the laser in red, green and blue
WHITE = torch.tensor([[0.9], [1.0], [0.6]], dtype=torch.float64)  #: responses


def blurred(picture, width):
    """A picture on a torus, convolved with a Gaussian of a standard deviation in pixels."""
    fy, fx = np.fft.fftfreq(SIDE)[:, None], np.fft.fftfreq(SIDE)
    return np.fft.ifft2(
        np.fft.fft2(picture) * np.exp(-2 * (np.pi * width) ** 2 * (fy**2 + fx**2))
    ).real


def speckle(rng):
    """A field of complex Gaussian numbers of variance 1, about two pixels wide."""
    field = rng.standard_normal((2, SIDE, SIDE))
    field = blurred(field[0], 0.7) + 1j * blurred(field[1], 0.7)
    return field / np.sqrt(np.mean(np.abs(field) ** 2))


def scene(rng):
    fy, fx = np.fft.fftfreq(SIDE)[:, None], np.fft.fftfreq(SIDE)
    rough = (
        np.fft.fft2(rng.standard_normal((4, SIDE, SIDE))) * (fy**2 + fx**2 + SIDE**-2.0) ** -0.75
    )
    rough = np.fft.ifft2(rough).real
    rough /= rough.std((1, 2), keepdims=True)
    return 5000 * WHITE.numpy()[:, :, None] * np.exp(0.3 * (0.975 * rough[3] + 0.22 * rough[:3]))


def frame(strength, shares, seed):
    """The scene, a frame of it with a laser, and the laser as a clean lens would show it:
    (channel, y, x) each.
    """
    rng = np.random.default_rng(seed)
    y, x = np.indices((SIDE, SIDE))
    away = np.hypot(y - 40, x - 55)
    told = strength * np.cos(2.0 * away) ** 2 / (1 + away) ** 3
    wide = sum(
        share * blurred(told, radius / 1.7) for share, radius in zip(shares, RADII, strict=True)
    )
    light = COLOUR * np.abs(np.sqrt(told) + np.sqrt(wide) * speckle(rng)) ** 2
    true = scene(rng)
    seen = rng.poisson(true + light) + READ * rng.standard_normal(true.shape)
    return true, np.minimum(seen, WELL), COLOUR * told


def restored(seen, told, scatter, node=wiener, **more):
    seen, told = torch.from_numpy(seen), torch.from_numpy(told)
    psf = Psf(torch.ones(1, 1, 1, dtype=torch.float64), ONE)
    inputs = [seen, psf, ONE, WHITE, BANDS, seen >= WELL, *more.pop("before", []), [told]]
    how = {} if scatter else {"doubt": None, "least_doubt": 0.3}
    return node(*inputs, scatter=scatter, read_noise=READ, **how, **more).numpy()


def rms(found, true, clipped):
    return np.sqrt(np.mean((found - true)[~clipped] ** 2))


def noise(seen, mean):
    return torch.maximum(seen, mean) + READ**2


@pytest.mark.slow
@pytest.mark.parametrize("planted", [(0.3, 0.0, 0.02), (0.05, 0.0, 0.05), (0.05, 0.0, 0.01)])
def test_speckle_tells_how_much_is_scattered(planted):
    found = []
    for seed in range(3):
        _, seen, told = frame(1e7, planted, seed)
        seen, told = torch.from_numpy(seen), torch.from_numpy(told)
        known = (seen < WELL).double()
        glare = visible([told], [None], known)
        found.append(_glare._likeliest(seen, known, with_smooth(glare), partial(noise, seen)))
    strength, narrow, _, wide = np.exp(np.log(np.array(found)).mean(0))
    assert 0.7 < strength < 1.4
    assert planted[2] / 2.5 < wide < 2 * planted[2]
    assert planted[0] / 3 < narrow < 3 * planted[0]


@pytest.mark.slow
@pytest.mark.parametrize("strength", [1e6, 1e8])
def test_a_picture_is_restored_better_when_light_is_scattered_and_as_well_when_not(strength):
    errors = []
    for seed in (3, 4):
        for shares in ((0.2, 0.01, 0.02), (0.0, 0.0, 0.0)):
            true, seen, told = frame(strength, shares, seed)
            clipped = seen >= WELL
            errors.append(
                [rms(restored(seen, told, scatter), true, clipped) for scatter in (True, False)]
            )
    errors = np.log(np.array(errors).reshape(2, 2, 2)).mean(0)
    assert errors[0, 0] < errors[0, 1] - 0.05
    assert errors[1, 0] < errors[1, 1] + 0.05


@pytest.mark.slow
@pytest.mark.parametrize("strength", [1e7, 1e9])
def test_the_interval_knows_of_scattered_light(strength):
    shares = []
    for seed in (6, 7):
        true, seen, told = frame(strength, (0.2, 0.01, 0.02), seed)
        known = seen < WELL
        error = restored(seen, told, True) - true
        more = {
            "before": [torch.eye(3, dtype=torch.float64)],
            "rng": torch.Generator().manual_seed(seed),
        }
        spread = restored(seen, told, True, wiener_spread, **more)
        shares.append(np.mean(np.abs(error)[known] < 1.7 * spread[known]))
    assert 0.8 < np.mean(shares) < 0.99


def test_a_channel_that_glare_covers_takes_the_level_of_others():
    white = torch.tensor([0.9, 1.0, 0.6], dtype=torch.float64)[:, None, None]
    level = white * torch.tensor([100.0, 100.0, 7.0], dtype=torch.float64)[:, None, None]
    trust = torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)[:, None, None]
    torch.testing.assert_close(shared_level(level, trust, white), 100.0 * white)
    torch.testing.assert_close(
        shared_level(100.0 * white, torch.zeros_like(trust), white), 100.0 * white
    )
    own = shared_level(level, torch.ones_like(trust), white)
    assert 7.0 < float(own[2] / white[2]) < 9.0


def test_without_glare_or_known_pixels_nothing_is_scattered():
    _, seen, told = frame(1e6, (0.2, 0.01, 0.02), 9)
    nothing = np.zeros_like(told)
    assert np.array_equal(restored(seen, nothing, True), restored(seen, nothing, False))
    covered = np.stack([np.full_like(seen[0], WELL), *seen[1:]])
    assert np.isfinite(restored(covered, told, True)).all()
    assert np.isfinite(restored(np.full_like(seen, WELL), told, True)).all()


def test_the_result_has_a_derivative_with_respect_to_the_glare():
    _, seen, told = frame(1e6, (0.2, 0.01, 0.02), 9)
    seen, told = (
        torch.from_numpy(seen[:, 20:44, 40:64].copy()),
        torch.from_numpy(told[:, 20:44, 40:64].copy()),
    )
    told.requires_grad_(True)
    psf = Psf(torch.ones(1, 1, 1, dtype=torch.float64), ONE)
    found = wiener(
        seen, psf, ONE, WHITE, BANDS, seen >= WELL, [told], scatter=True, read_noise=READ
    )
    (slope,) = torch.autograd.grad(found.sum(), told)
    assert bool(slope.isfinite().all())
    assert bool((slope != 0).any())


def test_a_measured_psf_takes_scattered_light_too():
    true, seen, told = frame(1e7, (0.2, 0.01, 0.02), 3)
    one = torch.ones(1, 1, 3, 1, 1, dtype=torch.float64)
    rest = torch.zeros(1, 4, dtype=torch.float64)
    measured = MeasuredPsf(
        one, 0 * one, one[None].float(), rest, rest[0, :3], rest[0, :3], one[:, :, 0, 0, 0], one
    )
    seen, told = torch.from_numpy(seen), torch.from_numpy(told)
    errors = []
    for how in ({"scatter": True}, {"doubt": None, "least_doubt": 0.3}):
        found = wiener_by_field(seen, measured, seen >= WELL, [told], read_noise=READ, **how)
        errors.append(rms(found.numpy(), true, seen.numpy() >= WELL))
    assert errors[0] < errors[1]
