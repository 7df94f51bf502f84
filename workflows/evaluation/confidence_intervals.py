"""Confidence intervals of mean image errors over scenes, and of the differences between two methods in these scenes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.float64]
CONFIDENCE = 0.95
_AGAIN = 10_000  #: sets of scenes that the bootstrap draws for the interval of a ratio
_AT_ONCE = 500  #: sets in memory at once
_FEW = 5  #: smallest number of scenes for the bootstrap
METRICS = ("l1", "psnr", "ssim", "l1 small", "psnr small", "ssim small", "saturated", "peak", "damaged")


@dataclass(frozen=True)
class Interval:
    """A mean over scenes and its 95 % confidence interval, with NaN as limits if there are too few scenes."""

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
    """The metrics of one mask and restorer as arrays (scene, laser strength), with NaN if a value is missing."""

    strengths: tuple[float, ...]
    values: Mapping[str, Numbers]

    def scenes(self, metric: str) -> Numbers:
        """Return the mean of a metric over all laser strengths, for each scene."""
        means: Numbers = np.nanmean(self.values[metric], axis=1)
        return means

    def at(self, metric: str, strength: int) -> Numbers:
        """Return the values of a metric at one laser strength, one for each scene that has a value."""
        column: Numbers = self.values[metric][:, strength]
        return column[~np.isnan(column)]


def mean(values: Sequence[float] | Numbers) -> Interval:
    """Return the mean over scenes of a metric, and its confidence interval from Student's t distribution."""
    x = np.asarray(values, dtype=np.float64)
    centre = float(x.mean()) if len(x) else math.nan
    if len(x) < 2:
        return Interval(centre, math.nan, math.nan)
    from scipy.stats import t

    half = float(t.ppf((1 + CONFIDENCE) / 2, len(x) - 1)) * float(x.std(ddof=1)) / math.sqrt(len(x))
    return Interval(centre, centre - half, centre + half)


def gain(values: Numbers, reference: Numbers, seed: int) -> Interval:
    """Return by which fraction the mean of a metric lies below the mean of the reference, such as 0.101 for 10.1 %.

    The interval comes from a bootstrap with the seed ``seed``, which draws the same scenes for both pipelines.
    """
    fraction = 1.0 - float(values.mean()) / float(reference.mean())
    if len(values) < _FEW:
        return Interval(fraction, math.nan, math.nan)
    rng = np.random.default_rng(seed)
    drawn: list[Numbers] = []
    for _ in range(0, _AGAIN, _AT_ONCE):
        at = rng.integers(0, len(values), (_AT_ONCE, len(values)))
        drawn.append(1.0 - values[at].mean(1) / reference[at].mean(1))
    low, high = np.quantile(drawn, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Interval(fraction, float(low), float(high))


def compare_with(values: MetricTable, reference: MetricTable, seed: int) -> dict[str, Interval]:
    """Return the decrease of L1 error against the reference: absolute, relative, and relative for small pictures."""
    own, other = values.scenes("l1"), reference.scenes("l1")
    return {
        "l1 less": mean(other - own),
        "l1 gain": gain(own, other, seed),
        "l1 small gain": gain(values.scenes("l1 small"), reference.scenes("l1 small"), seed),
    }


def metric_table(points: Sequence[Mapping[float, Mapping[str, float]]], strengths: Sequence[float]) -> MetricTable:
    """Arrange the metrics of one mask and restorer as arrays (scene, laser strength)."""
    each = {
        metric: np.array([[point.get(k, {}).get(metric, math.nan) for k in strengths] for point in points])
        for metric in METRICS
    }
    return MetricTable(tuple(strengths), each)
