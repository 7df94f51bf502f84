"""The probability of a converter's number: against integrals by quadrature, and sums to one."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import norm

from neusee.nodes.calibrate import log_cell
from neusee.nodes.sensor import digitize, full_well

KINDS = ["nearest", "truncation", "dithered_floor"]


def log_p(values, mean, sd, well, kind, top=4095):
    numbers = [torch.as_tensor(x, dtype=torch.float64) for x in (values, mean, sd, well)]
    return log_cell(*numbers, kind, top)


def share(x, k, kind, top):
    """How often a signal gives the number k."""
    if kind == "nearest":
        return float(min(max(round(x), 0), top) == k)
    if kind == "truncation":
        return float(min(max(math.floor(x), 0), top) == k)
    low, high = math.floor(x - 0.5), math.floor(x - 0.5) + 1
    part = x - 0.5 - low
    clip = [min(max(n, 0), top) for n in (low, high)]
    return (1 - part) * (clip[0] == k) + part * (clip[1] == k)


def by_quadrature(k, mean, sd, well, kind, top):
    corners = sorted({k - 0.5, k, k + 0.5, k + 1, k + 1.5, min(max(well, k - 1), k + 2), mean})
    ends = [max(-60 * sd + mean, corners[0] - 400 * sd), *corners, corners[-1] + 60 * sd]
    ends = [*sorted(x for x in {*ends, mean - 8 * sd, mean + 8 * sd} if x < well), well]
    total = norm.sf(well, mean, sd) * share(well, k, kind, top)

    def weighed(x):
        return share(x, k, kind, top) * norm.pdf(x, mean, sd)

    for a, b in pairwise(ends):
        part, _ = quad(
            lambda x: share(x, k, kind, top) * norm.pdf(x, mean, sd),
            a,
            b,
            epsabs=0,
            epsrel=1e-11,
            limit=400,
        )
        total += part
    return total


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("well", [1e9, 12.3, 11.45, 11.0, 10.7, 10.2])
@pytest.mark.parametrize(
    ("mean", "sd"), [(10.2, 0.05), (10.6, 0.4), (9.0, 1.0), (13.0, 2.5), (4.0, 3.0)]
)
def test_agrees_with_an_integral(kind, well, mean, sd):
    for k in range(8, 14):
        exact = by_quadrature(k, mean, sd, well, kind, 4095)
        found = float(log_p(k, mean, sd, well, kind).exp())
        assert found == pytest.approx(exact, rel=1e-7, abs=1e-14), (k, exact)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("mean", "sd"), [(0.3, 0.7), (-2.0, 1.0), (7.2, 1.5), (9.0, 4.0), (3.5, 0.2)]
)
@pytest.mark.parametrize("well", [1e9, 5.4])
def test_the_ends_of_the_converter_hold_what_lies_beyond(kind, mean, sd, well):
    """A converter of three bits: 0 to 7."""
    found = log_p(torch.arange(8.0), mean, sd, well, kind, top=7).exp()
    exact = [by_quadrature(k, mean, sd, well, kind, 7) for k in range(1, 7)]
    torch.testing.assert_close(
        found[1:7], torch.tensor(exact, dtype=torch.float64), rtol=1e-7, atol=1e-13
    )
    assert float(found.sum()) == pytest.approx(1.0, abs=1e-12)


@settings(max_examples=100, deadline=None)
@given(st.floats(-5, 70), st.floats(-4, 3), st.floats(-1, 70), st.sampled_from(KINDS))
def test_the_numbers_of_a_converter_have_a_probability_of_one(mean, log_sd, well, kind):
    found = log_p(torch.arange(64.0), mean, 10**log_sd, well, kind, top=63).exp()
    assert float(found.sum()) == pytest.approx(1.0, abs=1e-9)
    assert bool((found >= 0).all())


@pytest.mark.parametrize("kind", KINDS)
def test_agrees_with_the_steps_of_the_sensor(kind):
    """Two million draws through the nodes of a recipe: chi squared of the cells."""
    rng = torch.Generator().manual_seed(5)
    k, mean, sd, well = 0.8, 31.0, 2.2, 33.1
    electrons = full_well(
        mean + sd * torch.randn(2000, 1000, generator=rng, dtype=torch.float64), capacity=well
    )
    counts = torch.bincount(digitize(electrons, gain=k, rounding=kind, rng=rng).flatten().long())
    p = log_p(torch.arange(len(counts)), k * mean, k * sd, k * well, kind).exp()
    seen = p * 2e6 > 20
    chi = ((counts - 2e6 * p)[seen].square() / (2e6 * p[seen])).sum()
    freedom = int(seen.sum()) - 1
    assert float(counts[~seen].sum()) < 200
    assert abs(float(chi) - freedom) < 5 * math.sqrt(2 * freedom)


def test_far_from_the_mean_nothing_cancels():
    """Forty standard deviations out the logarithm keeps its digits."""
    found = log_p(400.0, 0.0, 10.0, 1e9, "nearest")
    exact = norm.logsf(39.95) + math.log1p(-math.exp(norm.logsf(40.05) - norm.logsf(39.95)))
    assert float(found) == pytest.approx(exact, rel=1e-12)
    # exp(-435), by the closed form of the tail
    tail = log_p(torch.tensor([30.0]), 0.0, 1.0, 1e9, "dithered_floor")
    x = np.linspace(29.5, 31.5, 200001)
    weight = (1 - np.abs(x - 30.5)) * np.exp(-0.5 * (x**2 - 29.5**2))
    exact = math.log(np.trapezoid(weight, x) / math.sqrt(2 * math.pi)) - 0.5 * 29.5**2
    assert float(tail[0]) == pytest.approx(exact, rel=1e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_beyond_the_well_there_is_nothing(kind):
    found = log_p(torch.tensor([12.0, 40.0]), 10.0, 1.0, 10.2, kind)
    assert found.tolist() == [-math.inf, -math.inf]
