"""Confidence intervals of the difference between two pipelines on the same pictures, drawn over photographs.

Pictures of one photograph are alike, so that they are no independent draws: the bootstrap draws whole photographs. It
draws the error of the mean in units of its own standard error (bootstrap-t), because quantiles of the plain bootstrap
hold the truth of eight to twelve skewed photographs in 81 to 89 instead of 95 of 100 cases.
"""

from __future__ import annotations

import math

import numpy as np

from neusee.workflows.evaluation.confidence_intervals import (
    CONFIDENCE,
    FEW,
    Interval,
    MetricTable,
    Numbers,
    sums_by_photograph,
)

_DRAWS = 10_000  #: sets of photographs that the bootstrap draws
_SMALL = 30  #: photographs below which neither end may lie nearer than that of Student's t distribution
_AT_ONCE = 500  #: sets in memory at once


def ratio(top: Numbers, bottom: Numbers, photographs: Numbers, seed: int) -> Interval:
    """Return the ratio of the sums of two values over pictures, and its 95 % interval over photographs.

    Args: top, bottom: (picture,) values of the same unit, or 1 as ``bottom`` for the mean of ``top``. photographs:
    (picture,) the number of the photograph of each picture. seed: of the draws.
    The limits are NaN for fewer than five photographs. For fewer than thirty each end is that of the bootstrap or of
    Student's t distribution, whichever lies farther away, times the root of n/(n - 1), by which drawn sets of n
    photographs scatter too little; skewed photographs need both.
    Source: Davison and Hinkley, Bootstrap Methods and their Application (1997), section 5.2.1, studentized bootstrap.
    """
    a, b = sums_by_photograph(top, photographs), sums_by_photograph(bottom, photographs)
    value, count = float(a.sum() / b.sum()), len(a)
    if count < FEW:
        return Interval(value, math.nan, math.nan)
    rest = a - value * b
    error = _standard_error((rest**2).sum(), b.sum(), count)
    low, high = np.quantile(_drawn_errors(rest, b, seed), _LIMITS, method="inverted_cdf")
    if count < _SMALL:
        least, wider = _student(count - 1), math.sqrt(count / (count - 1))
        low, high = wider * min(low, -least), wider * max(high, least)
    return Interval(value, *(float(value - q * error) if error else value for q in (high, low)))


def _student(freedom: int) -> float:
    from scipy.stats import t

    return float(t.ppf(_LIMITS[1], freedom))


_LIMITS = ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2)


def _standard_error(squares: Numbers, total: Numbers, count: int) -> Numbers:
    """Return the standard error of a ratio from the sum of the squared residuals of the photographs."""
    error: Numbers = np.sqrt(count / (count - 1) * squares) / total
    return error


def _drawn_errors(rest: Numbers, b: Numbers, seed: int) -> Numbers:
    """Return the error of the ratio in each drawn set of photographs, in units of the standard error in that set."""
    rng, count = np.random.default_rng(seed), len(rest)
    products = np.stack([rest, b, rest * rest, rest * b, b * b], 1)
    found: list[Numbers] = []
    for _ in range(0, _DRAWS, _AT_ONCE):
        times = rng.multinomial(count, np.full(count, 1 / count), _AT_ONCE).astype(np.float64)
        r, total, rr, rb, bb = (times @ products).T
        moved = r / total
        squares = np.maximum(rr - 2 * moved * rb + moved**2 * bb, 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            found.append(np.where(moved == 0, 0.0, moved / _standard_error(squares, total, count)))
    return np.concatenate(found)


def less(values: Numbers, reference: Numbers, photographs: Numbers, seed: int) -> Interval:
    """Return by how much a metric lies below that of the reference on the same pictures, in the unit of the metric."""
    return ratio(reference - values, np.ones_like(reference), photographs, seed)


def gain(values: Numbers, reference: Numbers, photographs: Numbers, seed: int) -> Interval:
    """Return by which fraction the mean of a metric lies below the mean of the reference, such as 0.101 for 10.1 %."""
    x = ratio(values, reference, photographs, seed)
    return Interval(1.0 - x.mean, 1.0 - x.high, 1.0 - x.low)


def compare_with(values: MetricTable, reference: MetricTable, seed: int) -> dict[str, Interval]:
    """Return the decrease of L1 error against the reference: absolute, relative, and relative for small pictures."""
    own, other, photographs = values.scenes("l1"), reference.scenes("l1"), values.photographs
    small = values.scenes("l1 small"), reference.scenes("l1 small")
    return {
        "l1 less": less(own, other, photographs, seed),
        "l1 gain": gain(own, other, photographs, seed),
        "l1 small gain": gain(*small, photographs, seed),
    }


def gains_by_strength(values: MetricTable, reference: MetricTable, seed: int) -> list[Interval]:
    """Return by which fraction the L1 error of the small pictures is lower, at each laser strength."""
    found = []
    for i in range(len(values.strengths)):
        own, other = values.values["l1 small"][:, i], reference.values["l1 small"][:, i]
        kept = ~np.isnan(own + other)
        found.append(gain(own[kept], other[kept], values.photographs[kept], seed))
    return found
