"""What points say together: means over scenes, differences from a reference scene by scene, each with its interval."""

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
_AGAIN = 10_000  #: sets of scenes that are drawn anew for a ratio
_AT_ONCE = 500  #: of them
_FEW = 5  #: scenes from which a bootstrap of them says anything
METRICS = ("l1", "psnr", "ssim", "l1 small", "psnr small", "ssim small", "saturated", "peak", "damaged")


@dataclass(frozen=True)
class Interval:
    """A mean and its 95 % confidence interval; of one scene, or too few, the interval is unknown (not a number)."""

    mean: float
    low: float
    high: float

    @property
    def half(self) -> float:
        """Half the width."""
        return (self.high - self.low) / 2

    @property
    def excludes_zero(self) -> bool:
        """Whether zero lies outside."""
        return self.low > 0 or self.high < 0


@dataclass(frozen=True)
class Table:
    """All points of one pipeline: by metric (scene, strength), not a number where a scene has no laser to vary."""

    strengths: tuple[float, ...]
    values: Mapping[str, Numbers]

    def scenes(self, metric: str) -> Numbers:
        """Of each scene its mean over strengths."""
        found: Numbers = np.nanmean(self.values[metric], axis=1)
        return found

    def at(self, metric: str, strength: int) -> Numbers:
        """Of each scene that has it, the value at one strength."""
        column = self.values[metric][:, strength]
        found: Numbers = column[~np.isnan(column)]
        return found


def mean(values: Sequence[float] | Numbers) -> Interval:
    """Student's t over scenes."""
    x = np.asarray(values, dtype=np.float64)
    centre = float(x.mean()) if len(x) else math.nan
    if len(x) < 2:
        return Interval(centre, math.nan, math.nan)
    from scipy.stats import t

    half = float(t.ppf((1 + CONFIDENCE) / 2, len(x) - 1)) * float(x.std(ddof=1)) / math.sqrt(len(x))
    return Interval(centre, centre - half, centre + half)


def difference(values: Numbers, reference: Numbers) -> Interval:
    """Student's t of the differences scene by scene."""
    return mean(values - reference)


def gain(values: Numbers, reference: Numbers, seed: int) -> Interval:
    """By which share of the reference's mean a metric is lower, such as L1 by 10.1 %.

    The interval is the bootstrap's: the same scenes of both are drawn again, by a seed of its own.
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


def against(values: Table, reference: Table, seed: int) -> dict[str, Interval]:
    """How much lower the L1 of a pipeline is than the reference's: as it is, as a share, and of the small pictures."""
    own, other = values.scenes("l1"), reference.scenes("l1")
    return {
        "l1 less": difference(other, own),
        "l1 gain": gain(own, other, seed),
        "l1 small gain": gain(values.scenes("l1 small"), reference.scenes("l1 small"), seed),
    }


def table(points: Sequence[Mapping[float, Mapping[str, float]]], strengths: Sequence[float]) -> Table:
    """Points by scene and strength as arrays."""
    each = {
        metric: np.array([[point.get(k, {}).get(metric, math.nan) for k in strengths] for point in points])
        for metric in METRICS
    }
    return Table(tuple(strengths), each)
