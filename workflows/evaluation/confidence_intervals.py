"""Confidence intervals of mean image errors, and of differences between two pipelines."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# --- confidence intervals -------------------------------------------------------------------------

# Confidence intervals of mean image errors over scenes, and of differences between two methods in
# these scenes.


Numbers = NDArray[np.float64]
CONFIDENCE = 0.95
FEW_PHOTOGRAPHS = 5  #: least number of photographs for the bootstrap
METRICS = (
    "l1",
    "psnr",
    "ssim",
    "l1 small",
    "psnr small",
    "ssim small",
    "saturated",
    "peak",
    "above",
)


@dataclass(frozen=True)
class Interval:
    """A mean over scenes with its 95 % confidence interval; the limits are NaN for too few
    photographs.
    """

    mean: float
    low: float
    high: float

    @property
    def half(self) -> float:
        """Return the half-width of the confidence interval."""
        return (self.high - self.low) / 2

    @property
    def excludes_zero(self) -> bool:
        """Return True if zero lies outside the confidence interval."""
        return self.low > 0 or self.high < 0


@dataclass(frozen=True)
class MetricTable:
    """The metrics of one pipeline as arrays (scene, laser strength); NaN marks a missing value."""

    strengths: tuple[float, ...]
    values: Mapping[str, Numbers]
    photographs: Numbers  #: (scene,) index of the photograph of each scene

    def scenes(self, metric: str) -> Numbers:
        """Return the mean of a metric over all laser strengths, for each scene."""
        means: Numbers = np.nanmean(self.values[metric], axis=1)
        return means

    def mean(self, metric: str) -> Interval:
        """Return the mean of a metric over strengths and scenes, and its confidence interval."""
        return mean(self.scenes(metric), self.photographs)

    def at(self, metric: str, strength: int) -> Interval:
        """Return the mean of a metric at one laser strength over the scenes with a value, and its
        interval.
        """
        column = self.values[metric][:, strength]
        valid = ~np.isnan(column)
        return mean(column[valid], self.photographs[valid])


def sums_by_photograph(values: Numbers, photographs: Numbers) -> Numbers:
    """Return the sum of ``values`` for each photograph."""
    # indices from 0, as required by `bincount`
    _, number = np.unique(photographs, return_inverse=True)
    return np.bincount(number.reshape(-1), weights=values).astype(np.float64)


def mean(
    values: Sequence[float] | Numbers, photographs: Sequence[float] | Numbers | None = None
) -> Interval:
    """Return the mean of a metric over scenes, and its confidence interval by Student's t
    distribution.

    ``photographs`` has the index of each scene's photograph; without it each scene has its own. The
    interval is over photographs: several scenes of one photograph count as one sample.
    """
    scene_values = np.asarray(values, dtype=np.float64)
    photograph_of_scene = np.asarray(
        range(len(scene_values)) if photographs is None else photographs, dtype=np.float64
    )
    mean_value, count = (
        float(scene_values.mean()) if len(scene_values) else math.nan,
        len(np.unique(photograph_of_scene)),
    )
    if count < 2:
        return Interval(mean_value, math.nan, math.nan)
    from scipy.stats import t

    residuals = sums_by_photograph(scene_values - mean_value, photograph_of_scene)
    # sandwich estimator: residuals of one photograph are summed before squaring
    standard_error = math.sqrt(float((residuals**2).sum()) * count / (count - 1)) / len(
        scene_values
    )
    half_width = float(t.ppf((1 + CONFIDENCE) / 2, count - 1)) * standard_error
    return Interval(mean_value, mean_value - half_width, mean_value + half_width)


def metric_table(
    points: Sequence[Mapping[float, Mapping[str, float]]],
    strengths: Sequence[float],
    photographs: Sequence[int] | None = None,
) -> MetricTable:
    """Return the metrics of one pipeline as arrays (scene, laser strength).

    ``photographs`` has the index of each scene's photograph; without it each scene has its own.
    """
    values = {
        metric: np.array(
            [
                [point.get(strength, {}).get(metric, math.nan) for strength in strengths]
                for point in points
            ]
        )
        for metric in METRICS
    }
    photograph_of_scene = range(len(points)) if photographs is None else photographs
    return MetricTable(tuple(strengths), values, np.array(photograph_of_scene, dtype=np.float64))


# --- paired intervals -----------------------------------------------------------------------------

# Confidence intervals of the difference between two pipelines on the same pictures, by resampling
# of photographs.
#
# Pictures of one photograph are not independent: the bootstrap resamples whole photographs. It
# resamples the error of the mean in units of its own standard error (bootstrap-t), because
# quantiles of the plain bootstrap contain the truth for eight to twelve skewed photographs in 81 to
# 89 instead of 95 of 100 cases.


_BOOTSTRAP_DRAWS = 10_000  #: number of bootstrap samples, each a set of photographs
#: below this number of photographs, neither limit may be closer than that of Student's t
#: distribution
_SMALL = 30
_AT_ONCE = 500  #: bootstrap samples in memory at once


def ratio(top: Numbers, bottom: Numbers, photographs: Numbers, seed: int) -> Interval:
    """Return the ratio of the sums of two values over pictures, and its 95 % interval over
    photographs.

    Args:
        top, bottom: (picture,) values of the same unit, or 1 as ``bottom`` for the mean of ``top``
        photographs: (picture,) the number of the photograph of each picture
        seed: of the draws

    The limits are NaN for fewer than five photographs. For fewer than thirty each end is that of
    the bootstrap or of Student's t distribution, whichever lies farther away, times the root of
    n/(n - 1), by which drawn sets of n photographs scatter too little; skewed photographs need
    both.
    Source: Davison and Hinkley, Bootstrap Methods and their Application (1997), section 5.2.1,
            studentized bootstrap.
    """
    top_sums, bottom_sums = (
        sums_by_photograph(top, photographs),
        sums_by_photograph(bottom, photographs),
    )
    ratio_of_sums, count = float(top_sums.sum() / bottom_sums.sum()), len(top_sums)
    if count < FEW_PHOTOGRAPHS:
        return Interval(ratio_of_sums, math.nan, math.nan)
    residuals = top_sums - ratio_of_sums * bottom_sums
    standard_error = _standard_error((residuals**2).sum(), bottom_sums.sum(), count)
    # quantiles of the studentised error over the bootstrap samples
    low_error, high_error = np.quantile(
        _drawn_errors(residuals, bottom_sums, seed), _LIMITS, method="inverted_cdf"
    )
    if count < _SMALL:
        quantile, widening = _student(count - 1), math.sqrt(count / (count - 1))
        low_error, high_error = (
            widening * min(low_error, -quantile),
            widening * max(high_error, quantile),
        )
    # the upper quantile of the error gives the lower limit
    return Interval(
        ratio_of_sums,
        *(
            float(ratio_of_sums - drawn_error * standard_error) if standard_error else ratio_of_sums
            for drawn_error in (high_error, low_error)
        ),
    )


def _student(freedom: int) -> float:
    """Return the upper quantile of Student's t distribution for `CONFIDENCE`."""
    from scipy.stats import t

    return float(t.ppf(_LIMITS[1], freedom))


_LIMITS = ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2)


def _standard_error(squares: Numbers, total: Numbers, count: int) -> Numbers:
    """Return the standard error of a ratio, from the sum of the squared residuals of the
    photographs.
    """
    error: Numbers = np.sqrt(count / (count - 1) * squares) / total
    return error


def _drawn_errors(residuals: Numbers, b: Numbers, seed: int) -> Numbers:
    """Return the error of the ratio in each bootstrap sample, in units of the standard error in
    that sample.

    ``residuals`` are those of the numerators (photograph,), ``b`` are the denominators.
    """
    rng, count = np.random.default_rng(seed), len(residuals)
    # the sums for all bootstrap samples follow from one matrix product
    products = np.stack([residuals, b, residuals * residuals, residuals * b, b * b], 1)
    errors: list[Numbers] = []
    for _ in range(0, _BOOTSTRAP_DRAWS, _AT_ONCE):
        draw_counts = rng.multinomial(count, np.full(count, 1 / count), _AT_ONCE).astype(np.float64)
        residual_sum, denominator_sum, residual_squares, mixed_products, denominator_squares = (
            draw_counts @ products
        ).T
        ratio_errors = residual_sum / denominator_sum
        # sum of (residual - ratio error x denominator)^2; rounding may make it negative
        squares = np.maximum(
            residual_squares
            - 2 * ratio_errors * mixed_products
            + ratio_errors**2 * denominator_squares,
            0.0,
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            errors.append(
                np.where(
                    ratio_errors == 0,
                    0.0,
                    ratio_errors / _standard_error(squares, denominator_sum, count),
                )
            )
    return np.concatenate(errors)


def less(values: Numbers, reference: Numbers, photographs: Numbers, seed: int) -> Interval:
    """Return the decrease of a metric relative to the reference on the same pictures, in the unit
    of the metric.
    """
    return ratio(reference - values, np.ones_like(reference), photographs, seed)


def gain(values: Numbers, reference: Numbers, photographs: Numbers, seed: int) -> Interval:
    """Return the relative decrease of the mean of a metric from that of the reference, such as
    0.101 for 10.1 %.
    """
    ratio_to_reference = ratio(values, reference, photographs, seed)
    # the gain falls as the ratio rises, so that the limits swap
    return Interval(
        1.0 - ratio_to_reference.mean, 1.0 - ratio_to_reference.high, 1.0 - ratio_to_reference.low
    )


def compare_with(values: MetricTable, reference: MetricTable, seed: int) -> dict[str, Interval]:
    """Return the decrease of the L1 error relative to the reference: absolute, relative, and
    relative for small pictures.
    """
    own_l1, reference_l1, photographs = (
        values.scenes("l1"),
        reference.scenes("l1"),
        values.photographs,
    )
    small_l1 = values.scenes("l1 small"), reference.scenes("l1 small")
    return {
        "l1 less": less(own_l1, reference_l1, photographs, seed),
        "l1 gain": gain(own_l1, reference_l1, photographs, seed),
        "l1 small gain": gain(*small_l1, photographs, seed),
    }


def gains_by_strength(values: MetricTable, reference: MetricTable, seed: int) -> list[Interval]:
    """Return the relative decrease of the L1 error of the small pictures at each laser strength."""
    gains = []
    for strength_index in range(len(values.strengths)):
        own_l1, reference_l1 = (
            values.values["l1 small"][:, strength_index],
            reference.values["l1 small"][:, strength_index],
        )
        has_both = ~np.isnan(own_l1 + reference_l1)
        gains.append(
            gain(own_l1[has_both], reference_l1[has_both], values.photographs[has_both], seed)
        )
    return gains
