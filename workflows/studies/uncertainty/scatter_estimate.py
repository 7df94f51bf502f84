"""How much numbers scatter over draws, and how well that is known."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Places = NDArray[np.float64]

_STILL = 1e-12  #: of the largest value: what varies by no more does not vary


@dataclass(frozen=True)
class Scatter:
    """Of one quantity, element by element."""

    mean: Places
    sd: Places
    low: Places  #: 5 %
    high: Places  #: 95 %
    error: float  #: relative, of the greatest standard deviation; 0 where nothing varies

    @property
    def is_constant(self) -> bool:
        """Whether the quantity does not hang on what is drawn."""
        return not float(self.sd.max()) > 0


def scatter(values: Places, sequences: int = 0) -> Scatter:
    """Of (draw, element); with ``sequences``, draw i belongs to the scrambled sequence i % sequences."""
    with np.errstate(invalid="ignore"):  # what is infinite in a draw has no deviation
        mean, sd = values.mean(0), values.std(0, ddof=1)
        low, high = np.quantile(values, [0.05, 0.95], axis=0)
    sd = np.where(sd > _STILL * np.abs(values).max(0), sd, 0.0)
    worst = values[:, int(sd.argmax())]
    error = 0.0 if not sd.max() > 0 else _of_sequences(worst, sequences) if sequences else _jackknife(worst)
    return Scatter(mean, sd, low, high, error)


def _jackknife(x: Places) -> float:
    """Relative standard error of the standard deviation of independent draws, by leaving out one after another."""
    n = len(x)
    apart = (x - x.mean()) ** 2
    without = np.sqrt((apart.sum() - apart * n / (n - 1)).clip(0.0) / (n - 2))
    error = math.sqrt((n - 1) / n * float(((without - without.mean()) ** 2).sum()))
    return error / float(x.std(ddof=1))


def _of_sequences(x: Places, count: int) -> float:
    """The same from how sequences that know nothing of each other differ in their mean square about the common mean."""
    squares = (x - x.mean()) ** 2
    each = np.array([squares[i::count].mean() for i in range(count)])
    return float(each.std(ddof=1) / math.sqrt(count) / each.mean() / 2)


def worst_known(found: Mapping[str, Scatter]) -> tuple[str, float]:
    """Return the quantity whose standard deviation is known worst, and the relative error of it."""
    name = max(found, key=lambda each: found[each].error)
    return name, found[name].error
