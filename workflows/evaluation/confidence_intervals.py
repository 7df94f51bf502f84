"""Confidence intervals of mean image errors over scenes, and of the differences between two methods in these scenes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.float64]
CONFIDENCE = 0.95
FEW = 5  #: smallest number of photographs for the bootstrap
METRICS = ("l1", "psnr", "ssim", "l1 small", "psnr small", "ssim small", "saturated", "peak", "above")


@dataclass(frozen=True)
class Interval:
    """A mean over scenes and its 95 % confidence interval, with NaN as limits if there are too few photographs."""

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
    photographs: Numbers  #: (scene,) the number of the photograph of each scene

    def scenes(self, metric: str) -> Numbers:
        """Return the mean of a metric over all laser strengths, for each scene."""
        means: Numbers = np.nanmean(self.values[metric], axis=1)
        return means

    def mean(self, metric: str) -> Interval:
        """Return the mean of a metric over strengths and scenes, and its confidence interval."""
        return mean(self.scenes(metric), self.photographs)

    def at(self, metric: str, strength: int) -> Interval:
        """Return the mean of a metric at one laser strength, over the scenes that have a value, and its interval."""
        column = self.values[metric][:, strength]
        kept = ~np.isnan(column)
        return mean(column[kept], self.photographs[kept])


def sums_by_photograph(values: Numbers, photographs: Numbers) -> Numbers:
    """Return the sum of the values of the pictures of each photograph."""
    _, number = np.unique(photographs, return_inverse=True)
    return np.bincount(number.reshape(-1), weights=values).astype(np.float64)


def mean(values: Sequence[float] | Numbers, photographs: Sequence[float] | Numbers | None = None) -> Interval:
    """Return the mean over scenes of a metric, and its confidence interval from Student's t distribution.

    ``photographs`` has the number of the photograph of each scene; without it each scene has a photograph of its own.
    The interval is over photographs: several scenes of one photograph count as one draw.
    """
    x = np.asarray(values, dtype=np.float64)
    owner = np.asarray(range(len(x)) if photographs is None else photographs, dtype=np.float64)
    centre, count = float(x.mean()) if len(x) else math.nan, len(np.unique(owner))
    if count < 2:
        return Interval(centre, math.nan, math.nan)
    from scipy.stats import t

    rest = sums_by_photograph(x - centre, owner)
    spread = math.sqrt(float((rest**2).sum()) * count / (count - 1)) / len(x)
    half = float(t.ppf((1 + CONFIDENCE) / 2, count - 1)) * spread
    return Interval(centre, centre - half, centre + half)


def metric_table(
    points: Sequence[Mapping[float, Mapping[str, float]]],
    strengths: Sequence[float],
    photographs: Sequence[int] | None = None,
) -> MetricTable:
    """Arrange the metrics of one mask and restorer as arrays (scene, laser strength).

    ``photographs`` has the number of the photograph of each scene; without it every scene has its own.
    """
    each = {
        metric: np.array([[point.get(k, {}).get(metric, math.nan) for k in strengths] for point in points])
        for metric in METRICS
    }
    owner = range(len(points)) if photographs is None else photographs
    return MetricTable(tuple(strengths), each, np.array(owner, dtype=np.float64))
