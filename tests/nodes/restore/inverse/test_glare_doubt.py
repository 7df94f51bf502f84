"""The doubt that a frame tells of: the glare is told rightly, with random errors, or without
dirt and defocus.
"""

import numpy as np
import pytest
import torch

from neusee.nodes.restore import wiener
from neusee.nodes.values import Bands, Psf
from tests.nodes.restore.inverse.test_uncertain_glare import around

ONE = torch.ones(1, dtype=torch.float64)
BANDS = Bands(550e-9 * ONE, 1e-8 * ONE, ONE)
SIDE, READ = 48, 5.0


def scene(rng):
    fy, fx = np.fft.fftfreq(SIDE)[:, None], np.fft.fftfreq(SIDE)
    power = np.fft.fft2(rng.standard_normal((SIDE, SIDE))) * (fy**2 + fx**2 + SIDE**-2.0) ** -0.75
    rough = np.fft.ifft2(power).real
    return 2000 + 400 * (rough - rough.mean()) / rough.std()


def spot(strength=2e5):
    y, x = np.indices((SIDE, SIDE))
    return strength / (1 + (y - 20) ** 2 + (x - 29) ** 2) ** 1.5


def frame(glare, rng):
    true = scene(rng)
    noise = np.sqrt(np.maximum(true, 0) + np.abs(glare) + READ**2)
    return true, np.minimum(true + glare + noise * rng.standard_normal(true.shape), 15000.0)


def lens(rng=None):
    """The light of a point behind a round aperture; with ``rng``, with grains of dirt and 0.1
    wave of defocus.
    """
    at = (np.arange(2 * SIDE) - SIDE + 0.5) / 40
    v, u = np.meshgrid(at, at, indexing="ij")
    field = (v**2 + u**2 < 1).astype(complex)
    if rng is not None:
        field *= np.exp(0.2j * np.pi * (v**2 + u**2))
        for y, x, r in zip(*rng.uniform(-1, 1, (2, 40)), rng.uniform(0.03, 0.06, 40), strict=True):
            field[(v - y) ** 2 + (u - x) ** 2 < r**2] = 0
    light = np.fft.fftshift(np.abs(np.fft.fft2(field)) ** 2)
    part = slice(SIDE // 2, SIDE // 2 + SIDE)
    return 3e6 * light[part, part] / light.sum()


def restored(seen, told, doubt, least=0.0):
    seen, told = (torch.from_numpy(x[None].copy()) for x in (seen, told))
    psf = Psf(torch.ones(1, 1, 1, dtype=torch.float64), ONE)
    light = [ONE, ONE[None], BANDS, seen >= 15000.0, [told]]
    return wiener(seen, psf, *light, doubt=doubt, least_doubt=least, read_noise=READ)[0].numpy()


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    ("planted", "may_be"), [(0.0, [0.0]), (0.05, [0.03, 0.1]), (0.2, [0.1, 0.3]), (1.0, [1.0, 3.0])]
)
def test_the_doubt_is_that_of_the_errors_of_the_glare(planted, may_be, seed):
    rng = np.random.default_rng([seed, int(100 * planted)])
    told = spot()
    _, seen = frame(told + planted * around(told[None])[0] * rng.standard_normal(told.shape), rng)
    found = restored(seen, told, None)
    assert any(np.array_equal(found, restored(seen, told, doubt)) for doubt in may_be)


def test_a_doubt_that_is_found_is_at_least_the_least_one_and_a_stated_one_is_kept():
    for planted, may_be in ((0.0, [0.3]), (1.0, [1.0, 3.0])):
        rng, told = np.random.default_rng([0, int(100 * planted)]), spot()
        _, seen = frame(
            told + planted * around(told[None])[0] * rng.standard_normal(told.shape), rng
        )
        found = restored(seen, told, None, least=0.3)
        assert any(np.array_equal(found, restored(seen, told, doubt)) for doubt in may_be)
        assert np.array_equal(restored(seen, told, 0.1, least=0.3), restored(seen, told, 0.1))


@pytest.mark.parametrize("seed", [3, 4])
def test_a_lens_that_is_not_as_told_costs_less_than_without_doubt_and_the_right_one_costs_nothing(
    seed,
):
    rng = np.random.default_rng(seed)
    true, seen = frame(lens(rng), rng)
    errors = [
        np.sqrt(np.mean((restored(seen, lens(), doubt) - true) ** 2)) for doubt in (0.0, None)
    ]
    assert errors[1] < 0.5 * errors[0]
    right = lens(np.random.default_rng(seed))
    free, exact = (
        np.sqrt(np.mean((restored(seen, right, doubt) - true) ** 2)) for doubt in (None, 0.0)
    )
    assert free < 1.05 * exact


def test_a_picture_without_glare_or_without_known_pixels_has_no_doubt():
    rng = np.random.default_rng(4)
    _, seen = frame(np.zeros((SIDE, SIDE)), rng)
    nothing = np.zeros_like(seen)
    assert np.array_equal(restored(seen, nothing, None), restored(seen, nothing, 0.0))
    full = np.full_like(seen, 15000.0)
    assert np.array_equal(restored(full, spot(), None), restored(full, spot(), 0.0))
