"""The photon-transfer curve: slope = gain, intercept = read noise, within sampling error (EMVA
1288).
"""

import math

import pytest
import torch

from neusee.nodes.sensor import photon_transfer
from neusee.nodes.units import read_quantity

TABLE = {
    "full_well": 25500.0,
    "quantum_efficiency": 0.56,
    "offset": 390.0,
    "read_noise": 10.5,
    "dark": 0.002,
}


def curve(pixels=40_000, levels=40, **how):
    return photon_transfer(
        **{**TABLE, **how}, pixels=pixels, levels=levels, rng=torch.Generator().manual_seed(5)
    )


def fit(points):
    """Weighted straight line of variance against signal: slope, intercept and their standard
    errors.
    """
    x, y, expected = points.T
    weight = 1.0 / (expected * math.sqrt(1 / 20_000)) ** 2
    design = torch.stack([x, torch.ones_like(x)], 1)
    cov = torch.linalg.inv(design.T @ (weight[:, None] * design))
    best = cov @ design.T @ (weight * y)
    return best, cov.diagonal().sqrt()


@pytest.mark.slow
@pytest.mark.parametrize("distribution", ["gaussian", "poisson"])
@pytest.mark.parametrize(
    ("gain", "unit", "rounding"),
    [
        (0.37, "e-/DN", "nearest"),
        (0.37, "DN/e-", "nearest"),
        (2.0, "e-/DN", "truncation"),
        (2.0, "e-/DN", "dithered_floor"),
    ],
)
def test_slope_is_the_gain_and_intercept_the_read_noise(gain, unit, rounding, distribution):
    slope = read_quantity(f"{gain} {unit}", "DN/e-")
    points = curve(gain=slope, rounding=rounding, distribution=distribution)
    below = points[:, 0] < 0.8 * min(25110 * slope, 65535 - 390 * slope)
    # under 20 e- a Gaussian is cut at 0
    bright = below & (points[:, 0] / slope > 20) | (points[:, 0] == 0)
    best, error = fit(points[bright])
    floor = slope**2 * (10.5**2 + 0.002) + (1 / 6 if rounding == "dithered_floor" else 1 / 12)
    assert abs(float(best[0]) - slope) < 4 * float(error[0])
    assert abs(float(best[1]) - floor) < 4 * float(error[1])
    assert float(error[0]) < 0.005 * slope


@pytest.mark.parametrize("rounding", ["nearest", "truncation", "dithered_floor"])
def test_what_is_predicted_in_the_dark_is_measured_where_rounding_is_most_of_the_noise(rounding):
    points = curve(gain=1.0, read_noise=0.8, rounding=rounding, levels=2, pixels=1_000_000)
    assert float(points[0, 1]) == pytest.approx(float(points[0, 2]), abs=0.01)


def test_shape_dark_level_and_saturation():
    points = curve(gain=1 / 0.37)
    assert points.shape == (40, 3)
    assert points.dtype == torch.float64
    assert float(points[0, 0]) == 0.0
    assert float(points[-1, 1]) < 0.01 * float(points[-1, 2])  # full: no variance is left
    assert bool((points[:, 0].diff() > -1).all())
    assert torch.isfinite(points).all()


@pytest.mark.parametrize(("levels", "pixels"), [(1, 1), (2, 1), (3, 2)])
def test_the_smallest_experiment(levels, pixels):
    points = curve(gain=1 / 0.37, levels=levels, pixels=pixels)
    assert points.shape == (levels, 3)
    assert torch.isfinite(points).all()
    assert (
        "no flat" in photon_transfer.hooks.check(points, full_well=25500.0, gain=1 / 0.37)[0].text
        or levels > 2
    )


def test_check_judges_the_slope():
    points = curve(gain=1 / 0.37)
    assert photon_transfer.hooks.check(points, full_well=25500.0, gain=1 / 0.37)[0].ok
    points[:, 1] *= 2
    assert not photon_transfer.hooks.check(points, full_well=25500.0, gain=1 / 0.37)[0].ok
