"""Limits of one draw of noise, against distributions of SciPy and against draws."""

import math

import pytest
import torch
from scipy import stats

from neusee.nodes import ErrorBound, TensorStats
from neusee.nodes.sensor import dark_current, digitize, photon_noise, read_noise
from neusee.nodes.sensor._noise import (
    RARITY,
    amplitude_error_drawn,
    chi_square_limit,
    poisson_rms,
    rare_events,
)

RARE = 1e-4


def facts_of(*shape):
    return TensorStats(shape, "float32", 0.0, 100.0, 1.0, 1, True)


@pytest.mark.parametrize("mean", [0.0, 1e-9, 1e-4, 0.3, 1.0, 7.0, 250.0, 1e6])
def test_rare_events_are_the_quantile_of_the_poisson_distribution(mean):
    count = rare_events(mean)
    assert count == int(stats.poisson.isf(RARE, mean))
    assert stats.poisson.sf(count, mean) <= RARE
    assert count == 0 or stats.poisson.sf(count - 1, mean) > RARE


@pytest.mark.parametrize("seed", range(20))
def test_unequal_events_are_no_more_often_above_the_limit(seed):
    """Exact distribution of the number of events, by convolution of their single distributions."""
    draw = torch.Generator().manual_seed(seed)
    chances = torch.rand(60, generator=draw, dtype=torch.float64) ** (1 + seed)
    counts = torch.ones(1, dtype=torch.float64)
    for chance in chances.tolist():
        counts = (
            torch.nn.functional.pad(counts, (0, 1)) * (1 - chance)
            + torch.nn.functional.pad(counts, (1, 0)) * chance
        )
    limit = rare_events(float(chances.sum()))
    assert float(counts[limit + 1 :].sum()) <= RARE


@pytest.mark.parametrize(("rms", "pixels"), [(1e-6, 1000), (0.01, 1000), (0.3, 500), (0.499, 500)])
def test_rounding_changes_as_many_numbers_as_the_quantile_says(rms, pixels):
    flips = rms - rms**2
    expected = math.sqrt(rms**2 + float(stats.poisson.isf(RARE, flips * pixels)) / pixels)
    assert digitize.hooks.rounding_error(rms, result=facts_of(pixels)) == pytest.approx(
        expected, rel=1e-12
    )


@pytest.mark.parametrize("rms", [0.5, 0.7, 40.0])
def test_a_larger_error_changes_the_mean_square_by_a_quarter_at_most(rms):
    expected = math.sqrt(rms**2 + float(stats.poisson.isf(RARE, 0.25 * 400)) / 400)
    assert digitize.hooks.rounding_error(rms, result=facts_of(20, 20)) == pytest.approx(
        expected, rel=1e-12
    )


@pytest.mark.parametrize("pixels", [1, 30, 1000])
def test_equal_weights_are_the_chi_square_distribution(pixels):
    limit = chi_square_limit(float(pixels), 1.0)
    assert stats.chi2.sf(limit, pixels) <= RARE
    assert limit <= 1.8 * stats.chi2.isf(RARE, pixels)


def test_the_probability_is_one_in_ten_thousand():
    assert math.exp(-RARITY) == pytest.approx(RARE, rel=1e-12)


@pytest.mark.parametrize("mean", [1e-5, 0.01, 0.5, 20.0])
def test_poisson_noise_is_above_its_limit_in_fewer_than_one_of_ten_thousand_draws(mean):
    """Rare counts in few pixels: the rms of all draws is too small for one draw up to 30 times."""
    pixels, draws = 40, 20_000
    counts = torch.poisson(
        torch.full((draws, pixels), mean, dtype=torch.float64),
        generator=torch.Generator().manual_seed(1),
    )
    rms = counts.square().mean(1).sqrt()
    limit = poisson_rms(mean, pixels)
    assert int((rms > limit).sum()) <= 2
    assert float(rms.max()) > math.hypot(mean, math.sqrt(mean))
    assert limit <= 3.0 * float(rms.max())


@pytest.mark.parametrize("darkest", [0.0, 1.0, 400.0])
@pytest.mark.parametrize("wide", [1, 7, 400])
def test_the_noise_of_other_light_is_below_its_limit_wherever_the_error_is(wide, darkest):
    """One bright pixel, some, or all pixels have all of the error."""
    before = torch.full((400,), darkest, dtype=torch.float64)
    after = before.clone()
    after[:wide] += 3.0
    error = float((after - before).square().mean().sqrt())
    change = after.sqrt() - before.sqrt()
    noise = torch.randn(5_000, 400, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    rms = (change * noise).square().mean(1).sqrt()
    assert int((rms > amplitude_error_drawn(error, darkest, 400)).sum()) <= 3


def test_the_stated_error_of_one_draw_is_above_that_of_all_draws():
    photons = ErrorBound(0.5, TensorStats((50,), "float32", 10.0, 100.0, 1.0, 50, True))
    how = {
        "quantum_efficiency": 0.5,
        "distribution": "gaussian",
        "mean_shift": 0.0,
        "mean": "additive",
        "drawn_in": "electrons",
    }
    one = photon_noise.hooks.propagate_draw(photons, result=facts_of(50), **how)
    every = photon_noise.hooks.propagate_error(photons, result=facts_of(50), **how)
    assert every < one < 6 * every
    assert (
        photon_noise.hooks.propagate_draw(
            photons, result=facts_of(50), **how | {"distribution": "poisson"}
        )
        == math.inf
    )


@pytest.mark.parametrize("pixels", [25, 2500])
@pytest.mark.parametrize(
    ("node", "params"),
    [
        (dark_current, {"mean": 0.004}),
        (dark_current, {"mean": 3.0}),
        (read_noise, {"offset": 0.0, "read_noise": 10.5}),
        (read_noise, {"offset": 5.0, "read_noise": 10.5}),
        (read_noise, {"offset": 390.0, "read_noise": 2.0}),
    ],
)
def test_one_draw_of_omitted_noise_is_below_its_limit(node, params, pixels):
    light = torch.zeros(2000, pixels, dtype=torch.float64)
    added = (
        node(light, **params, full_well=None, rng=torch.Generator().manual_seed(3))
        .square()
        .mean(1)
        .sqrt()
    )
    usual = math.hypot(
        params.get("mean", params.get("offset")),
        params.get("read_noise", params.get("mean", 0) ** 0.5),
    )
    factor = node.hooks.skip_draw(facts_of(pixels), full_well=None, **params)
    assert float(added.max()) <= factor * usual
    assert factor * usual <= 3.0 * float(added.max())


def test_no_noise_needs_no_limit():
    assert dark_current.hooks.skip_draw(facts_of(5), mean=0.0) == 1.0
    assert read_noise.hooks.skip_draw(facts_of(5), offset=0.0, read_noise=0.0) == 1.0
