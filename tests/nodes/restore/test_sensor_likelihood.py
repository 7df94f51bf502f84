"""The likelihood of measured electrons against SciPy, and measurements against the moments of
their distribution.
"""

import dataclasses

import numpy as np
import pytest
import torch
from scipy import stats

from neusee.nodes.restore import MeasuringSensor, clipped, measuring_sensor

SENSOR = MeasuringSensor(
    well=25500.0,
    gain=1 / 0.37,
    bits=16,
    offset=390.0,
    read_noise=10.5,
    dark=0.25,
    distribution="gaussian",
    spread=1.0,
)
EXPECTED = np.array(
    [-30.0, 0.0, 3.0, 250.0, 8000.0, 24000.0, 25000.0, 25110.0, 25400.0, 26500.0, 40000.0]
)
READING = {
    "charge": {
        "mean": "additive",
        "mean_shift": 0.0,
        "drawn_in": "electrons",
        "distribution": "poisson",
        "spread": 1.0,
    },
    "dark": {"mean": 0.25, "exposure": None},
    "read": {"offset": 390.0, "read_noise": 10.5},
    "well": {"capacity": 25500.0},
    "digital": {"gain": 1 / 0.37, "bits": 16, "rounding": "nearest"},
    "signal": {"offset_subtracted": True},
}


def sigma(expected):
    """Standard deviation of the measured electrons, from the variances of EMVA 1288."""
    return np.sqrt(np.maximum(expected, 0.0) + 10.5**2 + 0.37**2 / 12)


def tensor(values):
    return torch.tensor(values, dtype=torch.float64)


def test_a_known_pixel_has_the_density_of_the_normal_distribution():
    measured = EXPECTED + np.linspace(-3, 3, EXPECTED.size) * sigma(EXPECTED)
    found = SENSOR.surprise(tensor(EXPECTED), tensor(measured), torch.ones(EXPECTED.size))
    np.testing.assert_allclose(
        found, -stats.norm.logpdf(measured, EXPECTED, sigma(EXPECTED)), rtol=1e-13
    )


@pytest.mark.parametrize(("dtype", "rtol"), [(torch.float64, 1e-12), (torch.float32, 2e-4)])
def test_a_clipped_pixel_has_the_upper_tail_of_the_normal_distribution(dtype, rtol):
    found = SENSOR.surprise(
        tensor(EXPECTED).to(dtype), torch.zeros(()).to(dtype), torch.zeros(EXPECTED.size)
    )
    z = (SENSOR.level - EXPECTED) / sigma(EXPECTED)
    np.testing.assert_allclose(found, -stats.norm.logsf(z), rtol=rtol, atol=1e-30)


def test_the_level_is_the_least_number_that_is_marked_as_clipped():
    for sensor in (
        SENSOR,
        dataclasses.replace(SENSOR, bits=12),
        dataclasses.replace(SENSOR, well=9000.3),
    ):
        raw = torch.arange(2**sensor.bits, dtype=torch.float64)
        marked = clipped(raw, full_well=sensor.well, gain=sensor.gain, bits=sensor.bits)
        first = int(marked.nonzero()[0])
        assert sensor.level == pytest.approx((first - 0.5) / sensor.gain - sensor.offset, rel=1e-14)


@pytest.mark.parametrize("known", [0.0, 1.0])
@pytest.mark.parametrize("floor", [0.0, 500.0])
@pytest.mark.parametrize("spread", [1.0, 0.7])
def test_the_slope_is_that_of_finite_differences(known, floor, spread):
    sensor = dataclasses.replace(SENSOR, spread=spread)
    expected = tensor([-30.0, 3.0, 250.0, 8000.0, 24900.0, 25110.0, 25400.0, 26000.0])
    measured, mask, step = expected + 17.0, torch.full_like(expected, known), 1e-3

    def value(u):
        return sensor.surprise(u, measured, mask, floor)

    # Richardson's extrapolation of central differences
    coarse, fine = ((value(expected + h) - value(expected - h)) / (2 * h) for h in (2 * step, step))
    found = sensor.surprise_slope(expected, measured, mask, floor)
    torch.testing.assert_close(found, (4 * fine - coarse) / 3, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("known", [0.0, 1.0])
def test_the_slope_is_finite_for_every_expectation(dtype, known):
    expected = torch.tensor([-1e6, 0.0, 1e3, 1e6, 1e8], dtype=dtype, requires_grad=True)
    slope = SENSOR.surprise_slope(
        expected, torch.full_like(expected, 100.0), torch.full_like(expected, known)
    )
    (curvature,) = torch.autograd.grad(slope.sum(), expected)
    assert slope.isfinite().all()
    assert curvature.isfinite().all()


@pytest.mark.filterwarnings("ignore:`torch.jit.script`")  # of torch
@pytest.mark.parametrize("known", [0.0, 1.0])
def test_the_slope_passes_the_transforms_of_torch_func(known):
    expected = tensor([3.0, 250.0, 24900.0, 25200.0])

    def value(u):
        return SENSOR.surprise(u, torch.full_like(u, 240.0), torch.full_like(u, known)).sum()

    def slope(u):
        return SENSOR.surprise_slope(u, torch.full_like(u, 240.0), torch.full_like(u, known))

    torch.testing.assert_close(torch.func.grad(value)(expected), slope(expected), rtol=1e-8, atol=0)
    one_by_one = torch.func.vmap(slope)(expected[:, None])[:, 0]
    torch.testing.assert_close(one_by_one, slope(expected))
    forward = torch.func.jvp(slope, (expected,), (torch.ones_like(expected),))[1]
    backward = torch.func.vjp(slope, expected)[1](torch.ones_like(expected))[0]
    torch.testing.assert_close(forward, backward)  # each slope depends on its own pixel alone


@pytest.mark.parametrize("distribution", ["gaussian", "poisson"])
@pytest.mark.parametrize("expected", [120.0, 9000.0])
def test_measurements_have_the_mean_and_the_variance_of_the_likelihood(distribution, expected):
    sensor = dataclasses.replace(SENSOR, distribution=distribution)
    count = 200_000
    drawn = sensor.measured(
        torch.full((count,), expected), torch.Generator().manual_seed(3)
    ).double()
    whole = torch.tensor(expected + sensor.dark, dtype=torch.float64)
    variance = float(sensor.variance(whole))
    assert abs(float(drawn.mean() - whole)) < 4 * (variance / count) ** 0.5
    assert abs(float(drawn.var()) / variance - 1) < 4 * (2 / count) ** 0.5


def test_a_measurement_above_the_well_reaches_the_level():
    drawn = SENSOR.measured(torch.full((1000,), 40_000.0), torch.Generator().manual_seed(3))
    assert (drawn >= SENSOR.level).all()
    below = SENSOR.measured(torch.full((1000,), 20_000.0), torch.Generator().manual_seed(3))
    assert (below < SENSOR.level).all()


def test_a_sensor_is_read_from_the_parameters_of_its_steps():
    assert measuring_sensor(**READING) == dataclasses.replace(SENSOR, distribution="poisson")


@pytest.mark.parametrize(
    ("step", "name", "value"),
    [
        ("charge", "mean", "literal"),
        ("charge", "mean_shift", 0.2),
        ("charge", "drawn_in", "photons"),
        ("digital", "rounding", "dithered_floor"),
        ("signal", "offset_subtracted", False),
    ],
)
def test_a_sensor_whose_mean_is_not_the_expectation_is_refused(step, name, value):
    changed = {**READING, step: {**READING[step], name: value}}
    with pytest.raises(ValueError, match=f"with {name} {value!r}.*use `reading: coherent`"):
        measuring_sensor(**changed)
