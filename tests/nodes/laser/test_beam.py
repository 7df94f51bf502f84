"""The Gaussian beam, against closed forms and against integrals of its profile over the aperture
by SciPy.
"""

import math

import numpy as np
import pytest
import torch
from scipy import integrate, special, stats

from neusee.nodes import ParameterError
from neusee.nodes.laser import (
    axis_density,
    axis_irradiance,
    beam,
    beam_radius,
    curvature_radius,
    defocus_at,
    density_in_spot,
    peak_on_sensor,
    power_through,
    scintillation,
    sensor_density,
    share_through,
    underfilled,
)

POINTER = beam(532e-9, power=5e-3, divergence=1e-3)
LIDAR = beam(
    905e-9, pulse_energy=1e-6, pulse_duration=5e-9, repetition_rate=1e5, waist=2e-3, divergence=3e-3
)
DISTANCES = (0.0, 0.3, 7.0, 100.0, 5e3)
lasers = pytest.mark.parametrize("laser", [POINTER, LIDAR], ids=["pointer", "lidar"])
distances = pytest.mark.parametrize("distance", DISTANCES)


def profile(laser, distance):
    """Irradiance over the radius, from the text book: total power P, 1/e2 radius w by the
    quadrature sum.
    """
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
    field, _ = integrate.quad(
        lambda r: 2 * math.pi * r * math.sqrt(irradiance(r)), 0, radius, epsrel=1e-12
    )
    peak = 0.8 * 0.9 * field**2 / (laser.wavelength * focal) ** 2
    assert peak_on_sensor(laser, distance, 2 * radius, focal, 0.8, 0.9) == pytest.approx(
        peak, rel=1e-9
    )


def test_an_overfilled_lens_has_the_airy_peak_and_the_airy_pattern_holds_its_power():
    incoming = power_through(POINTER, 5e3, 11e-3)
    peak = peak_on_sensor(POINTER, 5e3, 11e-3, 0.11, 1.0)
    assert peak == pytest.approx(incoming * math.pi * 5.5e-3**2 / (532e-9 * 0.11) ** 2, rel=1e-5)
    scale = math.pi * 11e-3 / (532e-9 * 0.11)

    def airy(r):
        return peak * (2 * special.j1(scale * r) / (scale * r)) ** 2 if r else peak

    rings = special.jn_zeros(1, 40) / scale
    caught, _ = integrate.quad(
        lambda r: 2 * math.pi * r * airy(r), 0, rings[-1], limit=400, points=list(rings[:-1])
    )
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
    assert curvature_radius(POINTER, 100.0) == pytest.approx(
        100 * (1 + (rayleigh / 100) ** 2), rel=1e-12
    )
    assert curvature_radius(POINTER, rayleigh) == pytest.approx(2 * rayleigh)


def test_one_width_is_completed_by_a_perfect_beam_and_two_give_the_third():
    assert POINTER.waist == pytest.approx(2 * 532e-9 / (math.pi * 1e-3))
    assert POINTER.m_squared == 1.0
    wide = beam(1e-6, power=1.0, waist=1e-3)
    assert (wide.divergence, wide.m_squared) == (pytest.approx(2e-6 / (math.pi * 1e-3)), 1.0)
    assert beam(1e-6, power=1.0, waist=1e-3, m_squared=3.0).divergence == pytest.approx(
        3 * wide.divergence
    )
    assert beam(1e-6, power=1.0, divergence=1e-3, m_squared=3.0).waist == pytest.approx(
        3 * 2e-6 / (math.pi * 1e-3)
    )
    assert beam(1e-6, power=1.0, waist=1e-3, divergence=2e-3).m_squared == pytest.approx(
        2e-6 * math.pi / 2e-6
    )


def test_a_width_at_1_over_e_is_smaller_by_the_root_of_two():
    safety = beam(532e-9, power=5e-3, waist=1e-3, divergence=1e-3, convention="1/e")
    w = beam_radius(safety, 100.0)
    irradiance = profile(safety, 100.0)
    assert irradiance(math.hypot(1e-3, 0.05)) / irradiance(0) == pytest.approx(math.exp(-1))
    assert w == pytest.approx(math.sqrt(2) * math.hypot(1e-3, 0.05))


def test_pulse_trains_know_mean_power_energy_and_peak_power():
    assert (LIDAR.power, LIDAR.peak_power, LIDAR.is_pulsed) == (
        pytest.approx(0.1),
        pytest.approx(200.0),
        True,
    )
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
    assert beam(
        532e-9, power=1.0, waist=1e-3, divergence=2 * exact, m_squared=2.02
    ).m_squared == pytest.approx(2.0)
    train = {"pulse_energy": 1e-3, "pulse_duration": 1e-9, "repetition_rate": 1e3, "waist": 1e-3}
    assert beam(532e-9, power=1.01, **train).power == pytest.approx(1.0)


# --- borders --------------------------------------------------------------------------------------

PULSED = {"pulse_energy": 1e-6, "waist": 1e-3}


def test_a_pulse_as_long_as_the_period_is_refused_and_a_shorter_one_is_not():
    with pytest.raises(ParameterError, match="does not fit into the period"):
        beam(905e-9, pulse_duration=0.125, repetition_rate=8.0, **PULSED)
    assert beam(
        905e-9, pulse_duration=0.1249, repetition_rate=8.0, **PULSED
    ).power == pytest.approx(8e-6)


@pytest.mark.parametrize(
    ("off", "agrees"), [(1.019, True), (0.9815, True), (1.021, False), (0.979, False)]
)
def test_statements_agree_within_two_per_cent(off, agrees):
    train = {"pulse_duration": 1e-9, "repetition_rate": 1e3, "power": 1e-3 * off, **PULSED}
    shaped = {
        "power": 1.0,
        "waist": 1e-3,
        "divergence": 3 * 2e-6 / (math.pi * 1e-3),
        "m_squared": 3 * off,
    }
    for statements, wavelength in ((train, 905e-9), (shaped, 1e-6)):
        if agrees:
            beam(wavelength, **statements)
        else:
            with pytest.raises(ParameterError, match="leave one of the three out"):
                beam(wavelength, **statements)


@pytest.mark.parametrize(
    ("quality", "found"), [(0.981, 1.0), (0.979, None), (1.0, 1.0), (1.5, 1.5)]
)
def test_two_per_cent_below_diffraction_are_rounding_and_count_as_a_perfect_beam(quality, found):
    shape = {"waist": 1e-3, "divergence": quality * 2e-6 / (math.pi * 1e-3)}
    if found is None:
        with pytest.raises(ParameterError, match="no beam has less than 1"):
            beam(1e-6, power=1.0, **shape)
    else:
        assert beam(1e-6, power=1.0, **shape).m_squared == pytest.approx(found)


def test_a_perfect_beam_may_be_stated_and_zero_is_no_power():
    assert beam(1e-6, power=1.0, waist=1e-3, m_squared=1.0).m_squared == 1.0
    with pytest.raises(ParameterError, match="below 1"):
        beam(1e-6, power=1.0, waist=1e-3, m_squared=0.9999)
    with pytest.raises(ParameterError, match="finite number above 0"):
        beam(1e-6, power=0.0, waist=1e-3)
    with pytest.raises(ParameterError, match="finite number above 0"):
        beam(1e-6, power=math.inf, waist=1e-3)


@pytest.mark.parametrize("x", [5e-5, 1e-4, 2e-4, 0.05, 0.3])
def test_the_series_of_an_underfilled_lens_agrees_with_the_closed_form_to_its_last_digit(x):
    """1 - x^2 / 12 + x^4 / 120, from the series of the hyperbolic tangent."""
    exact = 2 / x * math.tanh(x / 2) if x > 0.01 else 1 - x**2 / 12 + x**4 / 120
    assert 1 - underfilled(x) == pytest.approx(1 - exact, rel=1e-6, abs=1e-15)
    assert float(1 - underfilled(torch.tensor(x, dtype=torch.float64))) == pytest.approx(
        1 - exact, rel=1e-6, abs=1e-15
    )


def test_a_pinhole_far_away_passes_what_its_area_says():
    """1 - exp(-x) of a tiny x has no digits left if it is computed as it stands."""
    share = share_through(POINTER, 1e6, 1e-6)
    assert share == pytest.approx(
        axis_density(POINTER, 1e6) * math.pi * (0.5e-6) ** 2, rel=1e-9, abs=0
    )


# --- along the axis -------------------------------------------------------------------------------


def sag(radius, rim):
    """Path in m at the rim of a sphere, without a difference of two large numbers."""
    return 0.0 if math.isinf(radius) else rim**2 / (radius + math.sqrt(radius**2 - rim**2))


@pytest.mark.parametrize("focus", [2.0, 40.0, math.inf])
@pytest.mark.parametrize("distance", [3.0, 25.0, 4e3])
def test_defocus_is_the_path_at_the_rim_between_the_wavefront_and_the_sphere_of_the_focus(
    distance, focus
):
    """Of the LIDAR, whose waist of 2 mm bends the wavefront less near to it."""
    rayleigh = math.pi * LIDAR.waist**2 / (905e-9 * LIDAR.m_squared)
    path = sag(distance + rayleigh**2 / distance, 6e-3) - sag(focus, 6e-3)
    assert defocus_at(LIDAR, distance, 12e-3, focus) == pytest.approx(path / 905e-9, rel=1e-5)
    off = defocus_at(LIDAR, distance, 12e-3, focus, 0.7 * 905e-9) - defocus_at(
        LIDAR, distance, 12e-3, focus
    )
    assert off == pytest.approx(0.7, rel=1e-9)


@lasers
@pytest.mark.parametrize("waves", [0.0, 0.3, -0.45])
def test_the_density_out_of_focus_is_the_square_of_the_diffraction_integral_with_its_phase(
    laser, waves
):
    """On the axis, which is the brightest point up to half a wave: 2 pi int sqrt(I) exp(2 pi i W
    r^2) r dr.
    """
    radius, focal = 5.5e-3, 0.11
    for distance in (0.3, 7.0, 5e3):
        irradiance = profile(laser, distance)
        field = [
            lambda r, f=f, i=irradiance: (
                math.sqrt(i(r)) * f(2 * math.pi * waves * (r / radius) ** 2)
            )
            for f in (math.cos, math.sin)
        ]
        parts = [
            integrate.quad(lambda r, f=f: 2 * math.pi * r * f(r), 0, radius, epsrel=1e-11)[0]
            for f in field
        ]
        expected = (parts[0] ** 2 + parts[1] ** 2) / (laser.wavelength * focal) ** 2 / laser.power
        columns = (
            torch.tensor(x, dtype=torch.float64) for x in (distance, 2 * radius, focal, waves)
        )
        at, diameter, length, defocus = columns
        assert float(density_in_spot(laser, at, diameter, length, defocus)) == pytest.approx(
            expected, rel=1e-6
        )


@pytest.mark.parametrize(("distance", "cn2"), [(300.0, 1e-15), (1e3, 1e-14), (2e3, 3e-14)])
@pytest.mark.parametrize("worst", [0.9, 0.99])
def test_turbulence_multiplies_by_the_quantile_of_scipys_lognormal_law(distance, cn2, worst):
    """The mean of the factor is 1, and the variance of its logarithm Rytov's of a plane wave."""
    spread = math.sqrt(1.23 * cn2 * (2 * math.pi / 532e-9) ** (7 / 6) * distance ** (11 / 6))
    law = stats.lognorm(spread, scale=math.exp(-(spread**2) / 2))
    assert law.mean() == pytest.approx(1)
    expected = float(law.ppf(worst)) if spread < stats.norm.ppf(worst) else None
    found = float(scintillation(532e-9, distance, cn2, worst))
    assert found == pytest.approx(
        expected if expected else math.exp(stats.norm.ppf(worst) ** 2 / 2), rel=1e-9
    )


@pytest.mark.parametrize("worst", [0.05, 0.3, 0.5, 0.7, 0.99])
def test_turbulence_never_falls_with_the_distance_nor_is_its_factor_above_all_quantiles(worst):
    """Below one half the quantile of any spread is below 1, and still air has 1."""
    at = torch.logspace(-1, 6, 200, dtype=torch.float64)
    found = scintillation(532e-9, at, 1e-13, worst).numpy()
    assert (np.diff(found) >= -1e-12).all()
    spreads = np.linspace(1e-6, 4, 4000)
    largest = np.exp(stats.norm.ppf(worst) * spreads - spreads**2 / 2).max()
    assert found[-1] == pytest.approx(max(largest, 1.0), rel=1e-4)
    assert found[0] == pytest.approx(1, abs=2e-3)
