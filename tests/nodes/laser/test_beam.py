"""The Gaussian beam, against closed forms and against integrals of its profile over the aperture by SciPy."""

import math

import numpy as np
import pytest
import torch
from scipy import integrate, special

from neusee.nodes import ParameterError
from neusee.nodes.laser import (
    axis_density,
    axis_irradiance,
    beam,
    beam_radius,
    curvature_radius,
    peak_on_sensor,
    power_through,
    sensor_density,
    share_through,
    underfilled,
)

POINTER = beam(532e-9, power=5e-3, divergence=1e-3)
LIDAR = beam(905e-9, pulse_energy=1e-6, pulse_duration=5e-9, repetition_rate=1e5, waist=2e-3, divergence=3e-3)
DISTANCES = (0.0, 0.3, 7.0, 100.0, 5e3)
lasers = pytest.mark.parametrize("laser", [POINTER, LIDAR], ids=["pointer", "lidar"])
distances = pytest.mark.parametrize("distance", DISTANCES)


def profile(laser, distance):
    """Irradiance over the radius, from the text book: total power P, 1/e2 radius w by the quadrature sum."""
    w = math.hypot(laser.waist, laser.divergence * distance / 2)
    return lambda r: 2 * laser.power / (math.pi * w**2) * math.exp(-2 * (r / w) ** 2)


@lasers
@distances
def test_power_through_an_aperture_is_the_integral_of_the_profile(laser, distance):
    irradiance = profile(laser, distance)
    power, _ = integrate.quad(lambda r: 2 * math.pi * r * irradiance(r), 0, 4e-3, epsrel=1e-12)
    assert power_through(laser, distance, 8e-3) == pytest.approx(power, rel=1e-9)
    assert power_through(laser, distance, 8e-3, 0.3) == pytest.approx(0.3 * power, rel=1e-9)


@lasers
@distances
def test_all_power_passes_a_wide_aperture_and_the_radius_is_that_of_1_over_e2(laser, distance):
    w = beam_radius(laser, distance)
    assert power_through(laser, distance, 8 * w) == pytest.approx(laser.power, rel=1e-12)
    irradiance = profile(laser, distance)
    assert irradiance(w) / irradiance(0) == pytest.approx(math.exp(-2))
    assert axis_irradiance(laser, distance, 0.5) == pytest.approx(0.5 * irradiance(0), rel=1e-12)


@lasers
@distances
def test_peak_behind_a_lens_is_the_square_of_the_diffraction_integral(laser, distance):
    """The field sqrt(I) adds in phase on the axis: |2 pi int sqrt(I) r dr|^2 / (lambda f)^2."""
    irradiance, radius, focal = profile(laser, distance), 5.5e-3, 0.11
    field, _ = integrate.quad(lambda r: 2 * math.pi * r * math.sqrt(irradiance(r)), 0, radius, epsrel=1e-12)
    peak = 0.8 * 0.9 * field**2 / (laser.wavelength * focal) ** 2
    assert peak_on_sensor(laser, distance, 2 * radius, focal, 0.8, 0.9) == pytest.approx(peak, rel=1e-9)


def test_an_overfilled_lens_has_the_airy_peak_and_the_airy_pattern_holds_its_power():
    incoming = power_through(POINTER, 5e3, 11e-3)
    peak = peak_on_sensor(POINTER, 5e3, 11e-3, 0.11, 1.0)
    assert peak == pytest.approx(incoming * math.pi * 5.5e-3**2 / (532e-9 * 0.11) ** 2, rel=1e-5)
    scale = math.pi * 11e-3 / (532e-9 * 0.11)

    def airy(r):
        return peak * (2 * special.j1(scale * r) / (scale * r)) ** 2 if r else peak

    rings = special.jn_zeros(1, 40) / scale
    caught, _ = integrate.quad(lambda r: 2 * math.pi * r * airy(r), 0, rings[-1], limit=400, points=list(rings[:-1]))
    assert caught == pytest.approx(incoming * (1 - special.j0(scale * rings[-1]) ** 2), rel=1e-5)


@pytest.mark.parametrize(("x", "expected"), [(1.0, 0.9242), (16.0, 0.125), (0.0, 1.0)])
def test_the_factor_of_an_underfilled_lens(x, expected):
    assert underfilled(x) == pytest.approx(expected, abs=5e-5)


def test_the_factor_is_smooth_and_differentiable_where_the_series_begins():
    x = torch.tensor([0.0, 0.99e-4, 1.01e-4, 0.5, 30.0], dtype=torch.float64, requires_grad=True)
    exact = np.array([1 if v == 0 else 2 / v * np.tanh(v / 2) for v in x.detach().numpy()])
    assert underfilled(x).detach().numpy() == pytest.approx(exact, rel=1e-12)
    assert torch.autograd.gradcheck(underfilled, (x,), eps=1e-7, atol=1e-5)


def test_tensors_of_distances_give_what_numbers_give_with_gradients():
    at = torch.tensor(DISTANCES[1:], dtype=torch.float64, requires_grad=True)
    for compute in (
        lambda d: beam_radius(LIDAR, d),
        lambda d: curvature_radius(LIDAR, d),
        lambda d: axis_density(LIDAR, d, 0.5),
        lambda d: share_through(LIDAR, d, 8e-3),
        lambda d: sensor_density(LIDAR, d, 8e-3, 0.11, 0.9) * 1e-6,
    ):
        one_by_one = [compute(d) for d in DISTANCES[1:]]
        assert compute(at).tolist() == pytest.approx(one_by_one, rel=1e-12)
        assert torch.autograd.gradcheck(compute, (at,), eps=1e-4, atol=1e-9, rtol=1e-4)


def test_the_wavefront_of_a_perfect_beam_is_that_of_the_text_book():
    rayleigh = math.pi * POINTER.waist**2 / POINTER.wavelength
    assert curvature_radius(POINTER, 100.0) == pytest.approx(100 * (1 + (rayleigh / 100) ** 2), rel=1e-12)
    assert curvature_radius(POINTER, rayleigh) == pytest.approx(2 * rayleigh)


def test_one_width_is_completed_by_a_perfect_beam_and_two_give_the_third():
    assert POINTER.waist == pytest.approx(2 * 532e-9 / (math.pi * 1e-3))
    assert POINTER.m_squared == 1.0
    wide = beam(1e-6, power=1.0, waist=1e-3)
    assert (wide.divergence, wide.m_squared) == (pytest.approx(2e-6 / (math.pi * 1e-3)), 1.0)
    assert beam(1e-6, power=1.0, waist=1e-3, m_squared=3.0).divergence == pytest.approx(3 * wide.divergence)
    assert beam(1e-6, power=1.0, divergence=1e-3, m_squared=3.0).waist == pytest.approx(3 * 2e-6 / (math.pi * 1e-3))
    assert beam(1e-6, power=1.0, waist=1e-3, divergence=2e-3).m_squared == pytest.approx(2e-6 * math.pi / 2e-6)


def test_a_width_at_1_over_e_is_smaller_by_the_root_of_two():
    safety = beam(532e-9, power=5e-3, waist=1e-3, divergence=1e-3, convention="1/e")
    w = beam_radius(safety, 100.0)
    irradiance = profile(safety, 100.0)
    assert irradiance(math.hypot(1e-3, 0.05)) / irradiance(0) == pytest.approx(math.exp(-1))
    assert w == pytest.approx(math.sqrt(2) * math.hypot(1e-3, 0.05))


def test_pulse_trains_know_mean_power_energy_and_peak_power():
    assert (LIDAR.power, LIDAR.peak_power, LIDAR.is_pulsed) == (pytest.approx(0.1), pytest.approx(200.0), True)
    same = beam(905e-9, power=0.1, pulse_duration=5e-9, repetition_rate=1e5, waist=2e-3)
    assert same.pulse_energy == pytest.approx(1e-6)
    single = beam(905e-9, pulse_energy=1e-6, pulse_duration=5e-9, waist=2e-3)
    assert (single.power, single.peak_power) == (None, pytest.approx(200.0))
    assert (POINTER.peak_power, POINTER.is_pulsed) == (5e-3, False)
    with pytest.raises(ValueError, match="a single pulse has no mean power"):
        axis_irradiance(single, 10.0)


WRONG = {
    "negative power": ({"power": -1.0, "waist": 1e-3}, "power", "-1 is no power"),
    "not a number": ({"power": 1.0, "waist": math.nan}, "waist", "nan is no waist"),
    "negative divergence": ({"power": 1.0, "divergence": -1e-3}, "divergence", "no divergence"),
    "negative wavelength": ({"wavelength": -5e-7, "power": 1.0, "waist": 1e-3}, "wavelength", "no wavelength"),
    "no power": ({"waist": 1e-3}, "power", "give power, or pulse_energy with pulse_duration"),
    "no width": ({"power": 1.0}, "divergence", "give divergence, or waist"),
    "M2 alone": ({"power": 1.0, "m_squared": 2.0}, "divergence", "give divergence, or waist"),
    "M2 below 1": ({"power": 1.0, "waist": 1e-3, "m_squared": 0.5}, "m_squared", "below 1"),
    "below diffraction": ({"power": 1.0, "waist": 1e-3, "divergence": 1e-5}, "divergence", "no beam has less than 1"),
    "waist, divergence and M2": (
        {"power": 1.0, "waist": 1e-3, "divergence": 1e-3, "m_squared": 5.0}, "m_squared", "leave one of the three out"),
    "no duration": ({"pulse_energy": 1e-6, "waist": 1e-3}, "pulse_energy", "give pulse_duration"),
    "rate without duration": ({"power": 1.0, "repetition_rate": 1e3, "waist": 1e-3}, "repetition_rate", "duration"),
    "duration without rate": ({"power": 1.0, "pulse_duration": 1e-9, "waist": 1e-3}, "pulse_duration", "repetition"),
    "one pulse with a mean": (
        {"power": 1.0, "pulse_energy": 1.0, "pulse_duration": 1e-9, "waist": 1e-3}, "power", "no mean power"),
    "a pulse longer than its period": (
        {"pulse_energy": 1.0, "pulse_duration": 2e-3, "repetition_rate": 1e3, "waist": 1e-3},
        "pulse_duration", "period of 0.001 s"),
    "power against energy x rate": (
        {"power": 2.0, "pulse_energy": 1e-3, "pulse_duration": 1e-9, "repetition_rate": 1e3, "waist": 1e-3},
        "power", "= 1 W, not power 2 W"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_what_disagrees_is_refused_by_name(case):
    given, name, text = WRONG[case]
    with pytest.raises(ParameterError, match=text.replace("(", r"\(")) as error:
        beam(**{"wavelength": 532e-9} | given)
    assert error.value.parameter == name


def test_rounded_data_sheets_are_not_refused():
    exact = 2 * 532e-9 / (math.pi * 1e-3)
    assert beam(532e-9, power=1.0, waist=1e-3, divergence=0.99 * exact).m_squared == 1.0
    assert beam(532e-9, power=1.0, waist=1e-3, divergence=2 * exact, m_squared=2.02).m_squared == pytest.approx(2.0)
    train = {"pulse_energy": 1e-3, "pulse_duration": 1e-9, "repetition_rate": 1e3, "waist": 1e-3}
    assert beam(532e-9, power=1.01, **train).power == pytest.approx(1.0)
