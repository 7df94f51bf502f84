"""Height maps of few numbers: their polynomials, their gradients, the line of a streak and a
stop that is learnt.
"""

import math

import numpy as np
import pytest
import torch
from numpy.polynomial.legendre import legval2d
from scipy.special import eval_legendre

from neusee.nodes import doe, optics
from neusee.nodes.doe import LearntStop, Polynomials, Streak
from neusee.nodes.doe._parametrisations import legendre

STOP = optics.stop(samples=64, pitch=5e-6, diameter=320e-6)
LINE = (np.arange(64) - 31.5) / 32
INSIDE = LINE[:, None] ** 2 + LINE**2 <= 1
HOW = {"wavelength": 550e-9, "material": "fused silica"}


def seeded(seed=1):
    return torch.Generator().manual_seed(seed)


def turns(height):
    return height.detach().double().numpy() / doe.wave_height("fused silica", 550e-9)


def test_polynomials_are_those_of_legendre_with_a_root_mean_square_of_1():
    at, weights = np.polynomial.legendre.leggauss(20)
    found = torch.stack(legendre(torch.from_numpy(at), 9)).numpy()
    expected = [math.sqrt(2 * k + 1) * eval_legendre(k, at) for k in range(10)]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found * weights / 2 @ found.T, np.eye(10), atol=1e-12)


def test_a_sum_of_products_is_that_of_numpy_and_has_no_tilt():
    shape = Polynomials(5, 2.0, **HOW, rng=seeded())
    numbers = np.zeros((6, 6))
    places = [(i, total - i) for total in range(2, 6) for i in range(total + 1)]
    for (i, j), value in zip(places, shape.waves.tolist(), strict=True):
        numbers[i, j] = value * math.sqrt((2 * i + 1) * (2 * j + 1))
    expected = legval2d(LINE[:, None] + 0 * LINE, 0 * LINE[:, None] + LINE, numbers)
    found = turns(shape(STOP))
    np.testing.assert_allclose(
        found[INSIDE], (expected - expected[INSIDE].min())[INSIDE], atol=1e-5
    )
    assert (found[~INSIDE] == 0).all()
    assert float(shape.waves.detach().norm()) == pytest.approx(2, rel=1e-6)


def test_a_streak_varies_along_one_direction_and_throws_its_light_into_a_line():
    shape = Streak(8, 2.0, **HOW, rng=seeded(3))
    angle = float(shape.angle.detach())
    along = LINE * math.cos(angle) + LINE[:, None] * math.sin(angle)
    sums = np.polynomial.legendre.legval(
        along, [0, 0, *(x * math.sqrt(2 * k + 5) for k, x in enumerate(shape.waves.tolist()))]
    )
    np.testing.assert_allclose(
        turns(shape(STOP))[INSIDE], (sums - sums[INSIDE].min())[INSIDE], atol=1e-5
    )
    field = INSIDE * np.exp(2j * math.pi * turns(shape(STOP)))
    light = np.abs(np.fft.fftshift(np.fft.fft2(field, (256, 256)))) ** 2
    v, u = np.meshgrid(np.arange(256) - 128, np.arange(256) - 128, indexing="ij")
    v, u = v - (light * v).sum() / light.sum(), u - (light * u).sum() / light.sum()
    (narrow, wide), axes = np.linalg.eigh([[(light * a * b).sum() for a in (v, u)] for b in (v, u)])
    assert wide > 4 * narrow
    assert abs(axes[:, 1] @ [math.sin(angle), math.cos(angle)]) > 0.98


@pytest.mark.parametrize("kind", [Polynomials, Streak])
def test_the_gradient_is_the_slope_of_the_height(kind):
    shape = kind(4, 1.0, **HOW, rng=seeded())
    weights = 1e6 * torch.randn(64, 64, generator=seeded(2), dtype=torch.float64)

    def value():
        height = shape(STOP).double()
        return (weights * (height - height[32, 32])).sum() / 64

    value().backward()
    for parameter in shape.parameters():
        for place in range(len(parameter)):
            sides = list[float]()
            for step in (2e-3, -4e-3):
                parameter.data[place] += step
                sides.append(float(value().detach()))
            parameter.data[place] += 2e-3
            slope = (sides[0] - sides[1]) / 4e-3
            assert float(parameter.grad[place]) == pytest.approx(slope, rel=2e-3, abs=0.02)


def test_a_learnt_stop_is_open_at_1_and_passes_the_square_of_its_diameter():
    wide, half = LearntStop(0.9999999), LearntStop(0.5)
    assert bool((wide(STOP)[torch.from_numpy(INSIDE)] == 1).all())
    assert float(half.diameter().detach()) == pytest.approx(0.5)
    area = half(STOP).double().sum() / INSIDE.sum()
    assert float(area.detach()) == pytest.approx(0.25, rel=0.05)
    (slope,) = torch.autograd.grad(area, half.logit)
    share = torch.sigmoid(half.logit.detach())
    assert float(slope) == pytest.approx(2 * 0.5 * 0.9 * float(share * (1 - share)), rel=0.1)
    sharp = doe.shade(STOP, diameter=0.5).amplitude
    assert float((half(STOP).detach() - sharp).abs().sum()) < 0.1 * float(sharp.sum())


def test_a_start_is_seeded():
    for kind in (Polynomials, Streak):
        first, again, other = (kind(6, 1.0, **HOW, rng=seeded(seed)) for seed in (1, 1, 2))
        assert torch.equal(first(STOP), again(STOP))
        assert not torch.equal(first(STOP), other(STOP))
