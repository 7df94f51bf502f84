"""Intervals of distance in which an exposure exceeds a limit, for nominal values and for random draws of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neusee.workflows.recipe.distributions.shapes import FloatArray

QUANTILES = (0.05, 0.95)  #: ends of the interval that contains 90 % of the draws
_ROUNDED = 1e-9  #: relative rounding of the logarithm of a distance


@dataclass(frozen=True)
class Spread:
    """A number with the interval that contains 90 % of its draws; all three are equal if nothing is uncertain."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, value: float, draws: FloatArray) -> Spread:
        """Return a number with the interval of its draws; NaN in a draw is left out."""
        known = draws[~np.isnan(draws)]
        if not known.size:
            return cls(value, value, value)
        low, high = np.quantile(known, QUANTILES)
        return cls(value, float(low), float(high))


@dataclass(frozen=True)
class Zone:
    """An interval of distance in m, whose ends have intervals of their own."""

    near: Spread
    far: Spread
    begins_before: bool  #: whether the zone reaches below the shortest distance that is asked for
    ends_beyond: bool  #: whether the zone reaches beyond the longest distance that is asked for


@dataclass(frozen=True)
class Zones:
    """The intervals of distance in which a limit is exceeded, none or several, and how sure each statement is."""

    zones: tuple[Zone, ...]  #: at the nominal values
    none: float  #: share of the draws without any zone
    alike: float  #: share of the draws with as many zones as the nominal values; ends between zones are from these
    reach: Spread | None  #: largest distance of any zone, over the draws that have one; None without such a draw
    inside: float  #: share of the draws in which the limit is exceeded at the distance of the recipe


def crossings(distances: FloatArray, ratio: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the near and the far ends (draw, zone) of the intervals in which ``ratio`` (draw, distance) is at least 1.

    Ends between two distances are interpolated in the logarithms. Rows with fewer zones than others end with NaN. A
    zone that begins before the first distance, or ends beyond the last, has this distance as its end.
    """
    with np.errstate(divide="ignore"):
        height = np.log(np.maximum(ratio, 1e-300))
    at, inside = np.log(distances), height >= 0
    edge = np.zeros((len(inside), 1), bool)
    begins = inside & ~np.concatenate([edge, inside[:, :-1]], 1)
    ends = inside & ~np.concatenate([inside[:, 1:], edge], 1)
    return _placed(at, height, begins, -1), _placed(at, height, ends, 1)


def _placed(at: FloatArray, height: FloatArray, marks: NDArray[np.bool_], step: int) -> FloatArray:
    """Return the distance (draw, zone) where the height crosses 0 beside each marked sample, on the side ``step``."""
    row, column = np.nonzero(marks)
    other = np.clip(column + step, 0, len(at) - 1)
    inner, outer = height[row, column], height[row, other]
    share = np.where(other == column, 0.0, inner / np.where(other == column, 1.0, inner - outer))
    found = np.exp(at[column] + share * (at[other] - at[column]))
    count = marks.sum(1)
    placed = np.full((len(marks), int(count.max(initial=0))), np.nan)
    placed[row, np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)] = found
    return placed


def zones_of(
    distances: FloatArray, nominal: FloatArray, drawn: FloatArray, at: float, asked: tuple[float, float] | None = None
) -> Zones:
    """Return the zones of a limit from the ratio of exposure to limit: nominal (distance,), drawn (draw, distance).

    Zones lie between the two distances ``asked``, whether or not the distance ``at`` of the recipe does. The outer
    ends, such as the farthest distance, have the interval of all draws that have a zone; ends between two zones have
    that of the draws with as many zones as the nominal values.
    """
    within = _at(distances, drawn, at) >= 1
    if asked is not None:
        shown = (distances >= asked[0] * (1 - _ROUNDED)) & (distances <= asked[1] * (1 + _ROUNDED))
        distances, nominal, drawn = distances[shown], nominal[shown], drawn[:, shown]
    near, far = (ends[0] for ends in crossings(distances, nominal[None]))
    starts, stops = crossings(distances, drawn)
    count = (~np.isnan(starts)).sum(1)
    alike = count == len(near)
    furthest = np.nanmax(stops[count > 0], 1) if (count > 0).any() else np.zeros(0)
    first, last = starts[count > 0, :1].ravel(), len(near) - 1  # outer ends are those of every draw with a zone
    zones = tuple(
        Zone(
            Spread.of(float(near[i]), _column(starts[alike], i) if i else first),
            Spread.of(float(far[i]), _column(stops[alike], i) if i < last else furthest),
            bool(near[i] <= distances[0] * (1 + _ROUNDED)),
            bool(far[i] >= distances[-1] * (1 - _ROUNDED)),
        )
        for i in range(len(near))
    )
    reach = Spread.of(float(far.max()) if len(far) else float(np.median(furthest)), furthest) if furthest.size else None
    return Zones(zones, float((count == 0).mean()), float(alike.mean()), reach, float(within.mean()))


def _column(ends: FloatArray, zone: int) -> FloatArray:
    """Return the ends (draw,) of one of several zones; none without a draw."""
    return ends[:, zone] if len(ends) else np.zeros(0)


def _at(distances: FloatArray, ratio: FloatArray, at: float) -> FloatArray:
    """Return the ratio (draw,) at a distance, which is one of the distances."""
    column: FloatArray = ratio[:, int(np.argmin(np.abs(distances - at)))]
    return column


def sampled(first: float, last: float, also: Sequence[float] = (), count: int = 600) -> FloatArray:
    """Return distances from ``first`` to ``last`` at equal ratios, with the distances ``also`` among them."""
    return np.unique(np.concatenate([np.geomspace(first, last, count), np.asarray(also, np.float64)]))
