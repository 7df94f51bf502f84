"""Intervals between pipelines on the same pictures: they hold the truth as often as closed forms
say.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.special import ndtr, ndtri
from scipy.stats import t as student

from neusee.workflows.evaluation import confidence_intervals
from neusee.workflows.evaluation.confidence_intervals import (
    MetricTable,
    gain,
    gains_by_strength,
    less,
    mean,
    ratio,
)

PHOTOGRAPHS, PICTURES, TIMES = 12, 4, 400
ROOM = 3 * math.sqrt(0.95 * 0.05 / TIMES)  #: three standard errors of the share that is counted
OWNER = np.repeat(np.arange(PHOTOGRAPHS), PICTURES)


@pytest.fixture
def quick(monkeypatch):
    """A tenth of the draws, because an interval is computed hundreds of times."""
    monkeypatch.setattr(confidence_intervals, "_BOOTSTRAP_DRAWS", 1000)


def alike(rng, between=1.0, within=0.5):
    """Differences of pictures of which four have a photograph in common, with the true mean 0."""
    return np.repeat(
        between * rng.standard_normal(PHOTOGRAPHS), PICTURES
    ) + within * rng.standard_normal(len(OWNER))


def share_held(intervals, truth):
    return float(np.mean([x.low <= truth <= x.high for x in intervals]))


@pytest.mark.slow
def test_the_interval_over_photographs_covers_and_the_one_over_pictures_fails_as_its_closed_form_says(
    quick,
):
    """Over pictures the standard error lacks a factor: 1.96 of them hold 71 % of the means, in
    closed form.
    """
    rng, zero = np.random.default_rng(1), np.zeros(len(OWNER))
    drawn = [alike(rng) for _ in range(TIMES)]
    assert share_held([less(zero, x, OWNER, 1) for x in drawn], 0.0) == pytest.approx(
        0.95, abs=ROOM
    )
    lacking = math.sqrt((1.0 + 0.25) / (PICTURES * 1.0 + 0.25))
    wanted = 2 * ndtr(ndtri(0.975) * lacking) - 1
    assert wanted == pytest.approx(0.71, abs=0.01)
    found = share_held([less(zero, x, np.arange(len(x)), 1) for x in drawn], 0.0)
    assert found == pytest.approx(wanted, abs=3 * math.sqrt(wanted * (1 - wanted) / TIMES) + 0.02)


def test_the_interval_of_a_skewed_gain_covers_its_closed_form(quick):
    """Errors of lognormal photographs: the true ratio of the means is exp of half the difference
    of the variances.
    """
    rng, held = np.random.default_rng(2), []
    truth = 1 - 0.9 * math.exp((0.7**2 - 0.5**2) / 2)
    for _ in range(TIMES):
        common = rng.standard_normal(20)
        own = 0.9 * np.exp(0.7 * (0.8 * common + 0.6 * rng.standard_normal(20)))
        held.append(gain(own, np.exp(0.5 * common), np.arange(20), 1))
    assert share_held(held, truth) == pytest.approx(0.95, abs=ROOM + 0.015)


def test_the_interval_of_a_gain_is_that_of_fieller():
    """Fieller (1954): the ratios that a t test of top minus ratio times bottom does not refuse."""
    rng = np.random.default_rng(3)
    reference = 1 + 0.2 * rng.standard_normal(300)
    values = 0.5 * reference + 0.3 + 0.1 * rng.standard_normal(300)
    q = student.ppf(0.975, 299) ** 2 / 300
    (vv, vr), (_, rr) = np.cov(values, reference)
    a, b, c = (
        reference.mean() ** 2 - q * rr,
        values.mean() * reference.mean() - q * vr,
        values.mean() ** 2 - q * vv,
    )
    roots = [(b + sign * math.sqrt(b * b - a * c)) / a for sign in (1, -1)]
    found = gain(values, reference, np.arange(300), 1)
    width = roots[0] - roots[1]
    assert [found.low, found.high] == pytest.approx([1 - x for x in roots], abs=0.05 * width)


def test_a_mean_of_several_pictures_of_a_photograph_is_that_of_the_means_of_photographs():
    values = alike(np.random.default_rng(4))
    own = values.reshape(PHOTOGRAPHS, PICTURES).mean(1)
    wanted = student.ppf(0.975, PHOTOGRAPHS - 1) * own.std(ddof=1) / math.sqrt(PHOTOGRAPHS)
    found = mean(values, OWNER)
    assert found.mean == pytest.approx(own.mean())
    assert found.half == pytest.approx(wanted, rel=1e-9)
    assert math.isnan(mean(values, np.zeros(len(values))).half)


def test_five_skewed_photographs_hold_the_truth_and_reach_beyond_student(quick):
    """Student's interval of five lognormal values holds 92.4 % (1000 samples of
    `bench_intervals.py`).
    """
    rng, held, truth = np.random.default_rng(6), [], math.exp(0.125)
    least = student.ppf(0.975, 4) / math.sqrt(5)
    for k in range(TIMES):
        x = np.exp(0.5 * rng.standard_normal(5))
        found = less(np.zeros(5), x, np.arange(5), k)
        held.append(found)
        assert min(x.mean() - found.low, found.high - x.mean()) >= least * x.std(ddof=1)
    assert share_held(held, truth) > 0.93


def test_draws_repeat_and_equal_pipelines_have_no_difference():
    x = 1 + np.random.default_rng(5).random(9)
    every = np.arange(9)
    assert ratio(x, x[::-1].copy(), every, 3) == ratio(x, x[::-1].copy(), every, 3)
    assert ratio(x, x[::-1].copy(), every, 3) != ratio(x, x[::-1].copy(), every, 4)
    same = gain(x, x, every, 3)
    assert (same.mean, same.low, same.high) == (0.0, 0.0, 0.0)
    assert math.isnan(gain(x[:4], x[4:8], every[:4], 3).low)
    assert math.isnan(gain(x, x[::-1].copy(), every // 3, 3).low)  # three photographs


def test_a_gain_at_a_strength_takes_the_scenes_that_have_it():
    x = np.array([[1.0, 2.0], [1.0, 2.0], [3.0, math.nan]])
    one, half = (MetricTable((0.0, 1.0), {"l1 small": k * x}, np.arange(3.0)) for k in (1.0, 0.5))
    assert [interval.mean for interval in gains_by_strength(half, one, 1)] == pytest.approx(
        [0.5, 0.5]
    )
