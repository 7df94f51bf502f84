"""Confidence intervals over scenes: of means, and of differences from a reference scene by scene."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Numbers = NDArray[np.float64]

CONFIDENCE = 0.95
_AGAIN = 10_000  #: bootstrap sets of scenes for a ratio
_AT_ONCE = 500  #: sets in memory at once
_FEW = 5  #: least scenes for a bootstrap
METRICS = ("l1", "psnr", "ssim", "l1 small", "psnr small", "ssim small", "saturated", "peak", "damaged")


@dataclass(frozen=True)
class Interval:
    """A mean and its 95 % confidence interval; the limits are NaN where there is one scene, or too few."""

    mean: float
    low: float
    high: float

    @property
    def half(self) -> float:
        """Return half the width."""
        return (self.high - self.low) / 2

    @property
    def excludes_zero(self) -> bool:
        """Return True if zero lies outside."""
        return self.low > 0 or self.high < 0


@dataclass(frozen=True)
class MetricTable:
    """All points of one pipeline: (scene, strength) by metric, NaN where a scene has no laser to vary."""

    strengths: tuple[float, ...]
    values: Mapping[str, Numbers]

    def scenes(self, metric: str) -> Numbers:
        """Return the mean over strengths of each scene."""
        found: Numbers = np.nanmean(self.values[metric], axis=1)
        return found

    def at(self, metric: str, strength: int) -> Numbers:
        """Return the value at one strength of each scene that has one."""
        column = self.values[metric][:, strength]
        found: Numbers = column[~np.isnan(column)]
        return found


def mean(values: Sequence[float] | Numbers) -> Interval:
    """Return the mean over scenes with the interval of Student's t."""
    x = np.asarray(values, dtype=np.float64)
    centre = float(x.mean()) if len(x) else math.nan
    if len(x) < 2:
        return Interval(centre, math.nan, math.nan)
    from scipy.stats import t

    half = float(t.ppf((1 + CONFIDENCE) / 2, len(x) - 1)) * float(x.std(ddof=1)) / math.sqrt(len(x))
    return Interval(centre, centre - half, centre + half)


def difference(values: Numbers, reference: Numbers) -> Interval:
    """Return the mean of the differences scene by scene with the interval of Student's t."""
    return mean(values - reference)


def gain(values: Numbers, reference: Numbers, seed: int) -> Interval:
    """Return by which share of the reference's mean a metric is lower, such as L1 by 10.1 %.

    The interval is that of the bootstrap: it draws the same scenes of both again, with a seed of its own.
    """
    found = 1.0 - float(values.mean()) / float(reference.mean())
    if len(values) < _FEW:
        return Interval(found, math.nan, math.nan)
    rng = np.random.default_rng(seed)
    drawn: list[Numbers] = []
    for _ in range(0, _AGAIN, _AT_ONCE):
        at = rng.integers(0, len(values), (_AT_ONCE, len(values)))
        drawn.append(1.0 - values[at].mean(1) / reference[at].mean(1))
    low, high = np.quantile(drawn, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Interval(found, float(low), float(high))


def compare_with(values: MetricTable, reference: MetricTable, seed: int) -> dict[str, Interval]:
    """Return how much lower a pipeline's L1 is than the reference's: as it is, as a share, and of small pictures."""
    own, other = values.scenes("l1"), reference.scenes("l1")
    return {
        "l1 less": difference(other, own),
        "l1 gain": gain(own, other, seed),
        "l1 small gain": gain(values.scenes("l1 small"), reference.scenes("l1 small"), seed),
    }


def metric_table(points: Sequence[Mapping[float, Mapping[str, float]]], strengths: Sequence[float]) -> MetricTable:
    """Return points by scene and strength as arrays."""
    each = {
        metric: np.array([[point.get(k, {}).get(metric, math.nan) for k in strengths] for point in points])
        for metric in METRICS
    }
    return MetricTable(tuple(strengths), each)
