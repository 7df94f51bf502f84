"""How likely levels are: against every pixel looked at alone, against simulation, and as
information.
"""

import functools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.nodes.calibrate import Sufficient, density, expose, levels, log_cell, reduce, sufficient

PAPER = {
    "gain": 0.37,
    "quantum_efficiency": 0.56,
    "offset": 390.0,
    "read_noise": 10.5,
    "dark_current": 0.002,
    "full_well": 25500.0,
}
LIGHT = [
    (0.0, 0.1),
    (0.0, 10.0),
    (200.0, 0.1),
    (3000.0, 0.1),
    (30000.0, 0.1),
    (43000.0, 0.1),
    (90000.0, 0.1),
]
KINDS = ["nearest", "truncation", "dithered_floor"]


def frames(light=LIGHT, size=48, seed=0, rounding="nearest", distribution="gaussian", **other):
    rng, p = torch.Generator().manual_seed(seed), {**PAPER, **other}
    return [
        expose(
            photons=photons,
            exposure=exposure,
            shape=(size, size),
            quantum_efficiency=p["quantum_efficiency"],
            dark_current=p["dark_current"],
            dark_exposure=0.1,
            offset=p["offset"],
            read_noise=p["read_noise"],
            full_well=p["full_well"],
            gain=p["gain"],
            rounding=rounding,
            distribution=distribution,
            rng=rng,
        )
        for photons, exposure in light
    ]


def measured(stacks, light=LIGHT):
    return levels(
        [reduce(x, photons=p, exposure=t) for x, (p, t) in zip(stacks, light, strict=True)]
    )


@functools.cache
def below_the_well(seed):
    light = LIGHT[:5]
    return sufficient(measured(frames(light, seed=seed), light))


def weigh(data, **other):
    how = {"dark_exposure": 0.1, **PAPER, **other}
    return density(data, **how)


def by_pixel(stacks, rounding, light=LIGHT, **other):
    """Every pixel by its cell, Gaussian before rounding."""
    p, total = {**PAPER, **other}, 0.0
    k = p["gain"]
    for x, (photons, exposure) in zip(stacks, light, strict=True):
        electrons, dark = p["quantum_efficiency"] * photons, p["dark_current"] * exposure / 0.1
        mean = torch.tensor(k * (p["offset"] + dark + electrons), dtype=torch.float64)
        sd = torch.tensor(
            k * math.sqrt(p["read_noise"] ** 2 + dark + electrons), dtype=torch.float64
        )
        well = torch.tensor(k * p["full_well"], dtype=torch.float64)
        total += float(log_cell(x.double().flatten(), mean, sd, well, rounding, 65535).sum())
    return total


@pytest.mark.parametrize("rounding", KINDS)
def test_what_it_says_of_two_sensors_is_what_every_pixel_says(rounding):
    """A level at 0.97 of the well is cut at 2 to 3 standard deviations, the last one whole."""
    stacks = frames(rounding=rounding)
    data = sufficient(measured(stacks))
    assert 0 < len(data.cell_value) < 40
    for other in (
        {"read_noise": 10.8},
        {"quantum_efficiency": 0.5602},
        {"offset": 391.0},
        {"dark_current": 0.02},
    ):
        exact = by_pixel(stacks, rounding, **other) - by_pixel(stacks, rounding)
        found = float(
            weigh(data, rounding=rounding, **other).log - weigh(data, rounding=rounding).log
        )
        assert found == pytest.approx(exact, abs=0.02 + 1e-3 * abs(exact)), other


@pytest.mark.parametrize("rounding", KINDS)
def test_a_well_other_than_that_seen_cannot_be(rounding):
    data = sufficient(measured(frames(rounding=rounding)))
    at = {
        w: float(weigh(data, rounding=rounding, full_well=w).log)
        for w in (25480.0, 25500.0, 25520.0)
    }
    assert at[25500.0] > -math.inf
    assert at[25480.0] == -math.inf
    assert at[25520.0] < at[25500.0] - 1e6


def test_without_a_saturated_level_the_well_has_a_lower_end_only():
    light = LIGHT[:5]
    data = sufficient(measured(frames(light), light))
    assert len(data.cell_value) == 0
    low, near, far = (float(weigh(data, full_well=w).log) for w in (16900.0, 25500.0, 1e6))
    assert near == pytest.approx(far, abs=1e-9)
    assert low < near - 100


def test_walkers_are_weighed_as_one_by_one():
    data = sufficient(measured(frames()))
    noise = torch.tensor([10.0, 10.5, 11.0], dtype=torch.float64)
    together = weigh(data, read_noise=noise, told=True)
    for i, x in enumerate(noise.tolist()):
        alone = weigh(data, read_noise=x)
        assert float(alone.log) == pytest.approx(float(together.log[i]), rel=1e-13)
        torch.testing.assert_close(alone.deviance, together.deviance[i])
        torch.testing.assert_close(alone.scaled, together.scaled[i])
    quick = weigh(data, read_noise=noise, told=False)
    assert torch.equal(quick.log, together.log)
    assert quick.deviance.numel() == 0


def test_the_deviance_of_the_truth_is_chi_squared():
    """Of 40 measurements: mean and variance of the deviance against those of the law."""
    found = torch.stack([weigh(below_the_well(seed)).deviance.sum() for seed in range(40)])
    freedom = 2 * len(LIGHT[:5])
    assert abs(float(found.mean()) - freedom) < 4 * math.sqrt(2 * freedom / 40)
    assert float(found.var()) == pytest.approx(2 * freedom, rel=4 * math.sqrt(2.6 / 40))


def test_what_levels_tell_is_the_curvature_of_the_likelihood():
    """Over 30 measurements the mean second difference is Fisher's information."""
    step = {"read_noise": 0.02, "quantum_efficiency": 1e-4, "offset": 0.05, "gain": 5e-5}
    for name, h in step.items():
        sides = [PAPER[name] - h, PAPER[name], PAPER[name] + h]
        curved, told = [], []
        for seed in range(30):
            found = weigh(below_the_well(seed), **{name: torch.tensor(sides).double()})
            curved.append(float(-(found.log[0] - 2 * found.log[1] + found.log[2]) / h**2))
            told.append(float(((found.scaled[2] - found.scaled[0]) / (2 * h)).square().sum()))
        assert sum(told) == pytest.approx(sum(curved), rel=0.03), name


def test_few_electrons_are_counted_out():
    """A converter of 0.2 DN/e- and a noise of 0.4 e-: numbers of Poisson's electrons, which no
    Gaussian has.
    """
    light = [(0.0, 0.1), (2.0, 0.1), (5.0, 0.1)]
    how = {
        "gain": 0.7,
        "read_noise": 0.15,
        "offset": 20.0,
        "quantum_efficiency": 0.5,
        "dark_current": 1e-6,
    }
    stacks = frames(light, size=300, distribution="poisson", **how)
    data = sufficient(measured(stacks, light))
    assert bool((data.pixels == 0)[:2].all())
    found = weigh(data, arrivals="poisson", **how)
    assert float(found.deviance[:2].sum()) < float(
        found.degrees_of_freedom[:2].sum()
    ) + 5 * math.sqrt(2 * float(found.degrees_of_freedom[:2].sum()))
    plain = weigh(data, arrivals="gaussian", **how)
    assert float(plain.deviance[:2].sum()) > 100 * float(found.deviance[:2].sum())


@settings(max_examples=40, deadline=None)
@given(
    st.floats(-4, 4),
    st.floats(-2, 4),
    st.floats(-6, 3),
    st.floats(0, 6),
    st.sampled_from(KINDS),
    st.booleans(),
)
def test_at_any_size_of_anything_there_is_a_number_or_none(
    gain, noise, dark, well, rounding, poisson
):
    found = weigh(
        SMALL,
        gain=10.0**gain,
        read_noise=10.0**noise,
        dark_current=10.0**dark,
        full_well=10.0**well,
        rounding=rounding,
        arrivals="poisson" if poisson else "gaussian",
    )
    assert not math.isnan(float(found.log))
    assert float(found.log) < math.inf
    assert found.scaled.shape == (len(found.scaled),)


def test_levels_are_taken_apart_and_nothing_is_lost():
    whole = measured(frames())
    parts, reference = sufficient(whole), sufficient.hooks.reference(whole)
    count = parts.pixels.index_add(0, parts.cell_level, parts.cell_count)
    assert torch.equal(count, whole.pixels)
    sums = (parts.pixels * parts.mean).index_add(
        0, parts.cell_level, parts.cell_count * parts.cell_value
    )
    torch.testing.assert_close(sums / count, whole.mean, rtol=1e-12, atol=0)
    assert isinstance(reference, Sufficient)
    for one, other in zip(parts, reference, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=0)


@pytest.mark.parametrize("reach", [5, 6])
def test_a_level_whose_numbers_between_the_ends_are_coarse_keeps_all_of_them(reach):
    """Before, eleven numbers left one between the ends: a variance of 0, and derivatives of
    infinity.
    """
    normal = torch.randn(2, 48, 48, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    stack = (144 + 1.05 * normal).round().clamp(144 - reach, 144 + reach)
    # a few hot pixels pile up at the end
    stack[0, 0, 0], stack[0, 1, :40] = 144 - reach, 144 + reach
    whole = measured([stack], LIGHT[:1])
    for data in (sufficient(whole), sufficient.hooks.reference(whole)):
        assert data.cell_count.sum() == stack.numel()
        assert data.pixels.tolist() == data.variance.tolist() == [0.0]
        assert weigh(data, read_noise=2.8).scaled.isfinite().all()


SMALL = sufficient(measured(frames(size=8)))
