"""Means and standard deviations of quantities over random draws, and standard errors of the standard deviations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
_CONSTANT = 1e-12  #: share of the largest value; a quantity with a smaller standard deviation is constant


@dataclass(frozen=True)
class Scatter:
    """The mean, standard deviation and quantiles over all draws, for each element of one quantity."""

    mean: FloatArray
    sd: FloatArray
    low: FloatArray  #: 5 %
    high: FloatArray  #: 95 %
    error: float  #: relative error of the greatest standard deviation; 0 if the quantity is constant

    @property
    def is_constant(self) -> bool:
        """Return True if the quantity has the same finite value in all draws."""
        return bool(np.isfinite(self.mean).all()) and not float(self.sd.max()) > 0


def scatter(values: FloatArray, sequences: int = 0) -> Scatter:
    """Return mean, standard deviation and quantiles of ``values`` (draw, element) over the draws.

    With ``sequences``, draw i belongs to the scrambled Sobol sequence i % sequences; otherwise draws are independent.
    """
    with np.errstate(invalid="ignore"):  # a quantity that is infinite in a draw has no standard deviation
        mean, sd = values.mean(0), values.std(0, ddof=1)
        low, high = np.quantile(values, [0.05, 0.95], axis=0)
    sd = np.where(sd > _CONSTANT * np.abs(values).max(0), sd, 0.0)
    worst = values[:, int(sd.argmax())]
    error = 0.0 if not sd.max() > 0 else _of_sequences(worst, sequences) if sequences else _jackknife(worst)
    return Scatter(mean, sd, low, high, error)


def _jackknife(x: FloatArray) -> float:
    """Estimate the relative standard error of the standard deviation of independent draws ``x`` by the jackknife."""
    n = len(x)
    apart = (x - x.mean()) ** 2
    without = np.sqrt((apart.sum() - apart * n / (n - 1)).clip(0.0) / (n - 2))
    error = math.sqrt((n - 1) / n * float(((without - without.mean()) ** 2).sum()))
    return error / float(x.std(ddof=1))


def _of_sequences(x: FloatArray, count: int) -> float:
    """Estimate the relative standard error of the standard deviation from the variance in each Sobol sequence."""
    squares = (x - x.mean()) ** 2
    each = np.array([squares[i::count].mean() for i in range(count)])
    return float(each.std(ddof=1) / math.sqrt(count) / each.mean() / 2)


def worst_known(found: Mapping[str, Scatter]) -> str:
    """Return the name of the quantity whose standard deviation has the largest relative error."""
    return max(found, key=lambda each: found[each].error)
