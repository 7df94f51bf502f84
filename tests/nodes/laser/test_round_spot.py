"""The spot of a tapered, defocused beam behind a round lens, against SciPy's quadrature and
closed forms.
"""

import functools
import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.optimize import minimize_scalar
from scipy.special import j0

from neusee.nodes.laser import (
    beam,
    defocused_peak,
    density_in_spot,
    round_spot,
    sensor_density,
    spot_peak,
)


def by_quadrature(reach, fill, waves):
    parts = (
        quad(
            lambda r, f=f: (
                2 * r * j0(reach * r) * math.exp(-fill * r * r) * f(2 * math.pi * waves * r * r)
            ),
            0,
            1,
            limit=2000,
            epsabs=1e-13,
        )[0]
        for f in (math.cos, math.sin)
    )
    return sum(x * x for x in parts)


@functools.cache
def nodes():
    return np.polynomial.legendre.leggauss(900)


def by_sum(reach, fill, waves):
    """The same by Gauss-Legendre nodes, for whole curves."""
    at, weights = nodes()
    radius = (at + 1) / 2
    field = j0(np.outer(reach, radius)) @ (
        radius * weights * np.exp((-fill + 2j * np.pi * waves) * radius**2)
    )
    return np.abs(field) ** 2


@pytest.mark.parametrize(
    ("fill", "waves"), [(0, 0), (1, 0), (0.5, 3), (5, 12), (0, 40), (2, 30), (0.3, 11), (3, 9.6)]
)
def test_the_spot_is_the_integral_over_the_pupil_in_every_regime(fill, waves):
    size = 2 * math.hypot(fill, 2 * math.pi * waves)
    reach = np.array(
        [
            0.5,
            3,
            9.5,
            0.3 * size,
            0.6 * size,
            0.68 * size,
            0.9 * size,
            size,
            1.2 * size,
            1.6 * size + 35,
            300,
        ]
    )
    expected = [by_quadrature(v, fill, waves) for v in reach]
    found = round_spot(torch.tensor(reach), fill, waves).numpy()
    np.testing.assert_allclose(found, expected, rtol=2e-4, atol=1e-11)


@pytest.mark.parametrize(("fill", "waves"), [(0.0, 12.0), (0.3, 34.4), (5.0, 3.0)])
def test_a_lens_that_is_focused_too_near_has_the_spot_of_one_that_is_focused_too_far(fill, waves):
    """The sign of the defocus conjugates the field. At the edge of a wide spot the light was 1e5
    times too much.
    """
    size = 2 * math.hypot(fill, 2 * math.pi * waves)
    reach = torch.linspace(0.0, 2 * size, 400, dtype=torch.float64)
    np.testing.assert_array_equal(
        round_spot(reach, fill, -waves).numpy(), round_spot(reach, fill, waves).numpy()
    )


@pytest.mark.parametrize(("fill", "waves"), [(0.0, 30.0), (1.0, 50.0), (6.0, 60.0)])
def test_the_edge_of_a_wide_spot_is_that_of_the_integral(fill, waves):
    size = 2 * math.hypot(fill, 2 * math.pi * waves)
    reach = np.linspace(0.6 * size, 1.6 * size + 40, 300)
    expected = by_sum(reach, fill, waves)
    mean = np.convolve(expected, np.ones(9) / 9, "same")
    assert (
        np.abs(round_spot(torch.tensor(reach), fill, waves).numpy() - expected).max()
        < 2e-3 * mean.max()
    )


def test_a_beam_far_narrower_than_the_lens_has_a_gaussian_spot_without_wings():
    """The closed form of a Gaussian beam: no rim, no rings; out of focus it is a wider Gaussian."""
    fill, waves, reach = 68.0, 34.0, torch.linspace(0, 120, 50, dtype=torch.float64)
    kappa = complex(fill, -2 * math.pi * waves)
    expected = torch.exp(-reach.square() * (0.5 / kappa).real) / abs(kappa) ** 2
    torch.testing.assert_close(round_spot(reach, fill, waves), expected, rtol=1e-9, atol=0.0)


@pytest.mark.parametrize(("fill", "waves"), [(0, 0), (0, 0.3), (0, 1), (0, 2.5), (0, 7.7), (0, 15.8), (0, 49), (0, 51),
                                            (0, 61.3), (1, 1), (0.3, 4.1), (2, 30), (9, 3)])  # fmt: skip
def test_the_peak_is_the_largest_value_of_the_integral_at_any_radius(fill, waves):
    reach = np.linspace(0, 4.4 * math.pi * waves + 8, 200 + int(120 * waves))
    curve = by_sum(reach, fill, waves)
    place, step = reach[curve.argmax()], reach[1]
    top = minimize_scalar(
        lambda v: -by_sum(np.array([v]), fill, waves)[0],
        bounds=(max(place - step, 0), place + step),
        method="bounded",
        options={"xatol": 1e-6},
    )
    largest = max(curve[0], -top.fun)
    assert defocused_peak(waves, fill) == pytest.approx(largest, rel=1e-4)
    assert defocused_peak(-waves, fill) == defocused_peak(waves, fill)


def test_the_peak_has_no_jump_at_any_defocus():
    """It once jumped by a factor of two at 50 waves."""
    waves = np.linspace(49.5, 50.5, 41)
    peaks = np.array([defocused_peak(x) for x in waves]) * (np.pi * waves) ** 2
    assert np.abs(np.diff(peaks)).max() < 0.1


def test_the_peaks_of_many_beams_at_once_are_upper_bounds_and_close():
    rng = np.random.default_rng(3)
    fill = np.where(rng.random(60) < 0.3, 0.0, rng.uniform(0, 6, 60))
    waves = np.concatenate([rng.uniform(0, 3, 20), rng.uniform(0, 10, 20), rng.uniform(8, 90, 20)])
    exact = np.array([defocused_peak(w, a) for w, a in zip(waves, fill, strict=True)])
    ratio = spot_peak(torch.tensor(fill), torch.tensor(waves)).numpy() / exact
    assert ratio.min() > 1 - 2e-4
    assert ratio.max() < 1.07
    assert ratio[waves < 8].max() < 1.006


@pytest.mark.slow
def test_the_largest_peak_within_a_range_of_defocus_misses_none():
    rng = np.random.default_rng(4)
    for fill, waves in zip(rng.uniform(0, 2, 12), rng.uniform(0, 80, 12), strict=True):
        found = float(spot_peak(torch.tensor(fill), torch.tensor(waves), 0.01))
        largest = max(defocused_peak(x, fill) for x in np.linspace(0.99 * waves, 1.01 * waves, 21))
        assert found > largest * (1 - 2e-4)
        assert found < largest * 1.07


def test_in_focus_the_density_in_the_spot_is_that_of_the_closed_form():
    laser = beam(532e-9, power=1.0, divergence=1e-3)
    at, lens = (
        torch.tensor([3.0, 30.0, 300.0], dtype=torch.float64),
        torch.tensor(12e-3, dtype=torch.float64),
    )
    focal = torch.tensor(50e-3, dtype=torch.float64)
    found = density_in_spot(laser, at, lens, focal, torch.zeros(3, dtype=torch.float64))
    torch.testing.assert_close(
        found, sensor_density(laser, at, 12e-3, 50e-3, 1.0), rtol=1e-9, atol=0.0
    )


@pytest.mark.parametrize(
    ("fill", "waves", "ends"),
    [(0.0, 40.0, (800, 900)), (2.0, 30.0, (620, 700)), (1.0, 0.0, (70, 90))],
)
def test_the_wings_are_exact_in_the_unit_of_their_own_mean(fill, waves, ends):
    """Dazzle reads them where they are 1e-9 of the peak."""
    reach = np.linspace(*ends, 60)
    expected = by_sum(reach, fill, waves)
    found = round_spot(torch.tensor(reach), fill, waves).numpy()
    assert np.abs(found - expected).max() < 1e-6 * expected.mean()
