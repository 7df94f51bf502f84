"""Threshold of damage from own shots: at each level how many shots there were, and how many of them damaged.

The share of damaged shots is fitted by a lognormal law, Phi((ln level - ln median) / ln factor), with the largest
likelihood (probit regression). Where no level has both damaged and undamaged shots between the levels, the data hold a
bracket and no spread.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_ROUNDS = 200  #: of Fisher scoring, at most
_CLOSE = 1e-10  #: change of the parameters at which the fit ends
_TINY = 1e-12  #: least probability of a shot in the weights

Numbers = NDArray[np.float64]


@dataclass(frozen=True)
class Shots:
    """Shots at one level."""

    level: float  #: W/m2 or J/m2
    count: int
    damaged: int


@dataclass(frozen=True)
class FittedThreshold:
    """A threshold from shots: a law with spread, or the bracket that the data leave."""

    median: float  #: in the unit of the levels
    factor: float | None  #: geometric standard deviation of the threshold; None where the data do not show it
    median_factor: float | None  #: geometric standard deviation of the median; None where the data do not show it
    low: float | None = None  #: highest level without any damage; None for a law with spread
    high: float | None = None  #: lowest level at which every shot damaged; None for a law with spread


def fit_shots(shots: Sequence[Shots]) -> FittedThreshold:
    """Return the threshold that shots at several levels show, with the spread and the uncertainty of its median.

    The uncertainty of the median is that of the Fisher information. Where at most one level has both damaged and
    undamaged shots and the others are in order, the threshold is between the highest level without any damage and the
    lowest level at which every shot damaged, and no spread is stated.

    Raises ValueError for shots at fewer than two levels, without any or with only damage, and for damage that gets
    rarer with the level.
    Source: ISO 21254-2 (damage probability over level); McCullagh, Nelder, Generalized Linear Models, ch. 2.5.
    """
    levels = np.array([shot.level for shot in shots])
    count = np.array([shot.count for shot in shots], np.float64)
    damaged = np.array([shot.damaged for shot in shots], np.float64)
    if len(np.unique(levels)) < 2:
        raise ValueError("the shots have one level: a threshold needs several levels")
    if not damaged.any():
        raise ValueError("no shot was damaged: the threshold is above all levels, so add higher levels")
    if (damaged == count).all():
        raise ValueError("every shot was damaged: the threshold is below all levels, so add lower levels")
    if levels[damaged < count].max() <= levels[damaged > 0].min():
        return _separated(levels, count, damaged)
    return _probit(np.log(levels), count, damaged)


def _separated(levels: Numbers, count: Numbers, damaged: Numbers) -> FittedThreshold:
    """Return the bracket of shots whose levels do not overlap; raise ValueError where one of its ends is missing."""
    none, every = levels[damaged == 0], levels[damaged == count]
    if not none.size:
        raise ValueError("no level is without damage: add lower levels")
    if not every.size:
        raise ValueError("no level damaged with every shot: add higher levels, or more shots at each level")
    low, high = float(none.max()), float(every.min())
    return FittedThreshold(math.sqrt(low * high), None, None, low, high)


def _probit(logs: Numbers, count: Numbers, damaged: Numbers) -> FittedThreshold:
    """Return the lognormal law of largest likelihood; raise ValueError for damage that gets rarer with the level."""
    from scipy.special import ndtr, ndtri

    centre = float(logs.mean())
    design = np.stack([np.ones_like(logs), logs - centre], 1)
    start = ndtri((damaged + 0.5) / (count + 1))
    values, *_ = np.linalg.lstsq(design * np.sqrt(count)[:, None], start * np.sqrt(count), rcond=None)
    information = np.eye(2)
    for _ in range(_ROUNDS):
        predicted = design @ values
        share = np.clip(ndtr(predicted), _TINY, 1 - _TINY)
        density = np.exp(-(predicted**2) / 2) / math.sqrt(2 * math.pi)
        weight = count * density**2 / (share * (1 - share))
        information = design.T @ (design * weight[:, None])
        score = design.T @ (density * (damaged - count * share) / (share * (1 - share)))
        step = np.linalg.solve(information, score)
        values = values + step
        if np.abs(step).max() < _CLOSE * (1 + np.abs(values).max()):
            break
    offset, slope = float(values[0]), float(values[1])
    if not (math.isfinite(slope) and slope > 0):
        raise ValueError("damage gets rarer with the level: no threshold can be fitted to these shots")
    covariance = np.linalg.inv(information)
    gradient = np.array([-1 / slope, offset / slope**2])
    deviation = math.sqrt(float(gradient @ covariance @ gradient))
    return FittedThreshold(math.exp(centre - offset / slope), math.exp(1 / slope), math.exp(deviation))
