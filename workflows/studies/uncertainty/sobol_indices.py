"""Sobol indices: the share of each independent input in the variance of an output.

First and total indices are those of one polynomial in closed form (Sudret, Reliab. Eng. Syst. Saf. 93 (2008) 964), so
that a first index is never larger than the total index of the same input. The share of the variance that the polynomial
does not predict for draws outside its fit may belong to any input: every interval contains this share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from neusee.workflows.recipe.distributions.shapes import FloatArray, Shape
from neusee.workflows.studies.uncertainty.polynomial_fit import Candidates, PolynomialFit, fit_polynomial

EXPLAINED = 0.9  #: smallest share of the variance that the polynomial predicts where its indices tell enough
GROUPS = 8  #: groups of draws, each left out of a fit once
_T = 2.3646242515927849  #: 97.5 % quantile of Student's distribution with GROUPS - 1 degrees of freedom


@dataclass(frozen=True)
class IndexInterval:
    """A Sobol index with its 95 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class SobolIndices:
    """The first and total Sobol indices of each input."""

    first: Sequence[IndexInterval]  #: share of each input alone
    total: Sequence[IndexInterval]  #: share of each input alone and together with other inputs
    explained: float  #: share of the variance that the polynomial predicts for draws outside its fit

    @property
    def explains_enough(self) -> bool:
        """Return True if the polynomial explains enough of the variance for narrow intervals."""
        return self.explained >= EXPLAINED


def indices(shapes: Sequence[Shape], z: FloatArray, y: FloatArray) -> SobolIndices:
    """Return the Sobol indices of independent inputs in the variance of ``y`` (draw,).

    Args: shapes: distribution of each input. z: standard normal numbers (draw, input) from which the inputs follow.
    The interval has the scatter between fits without an eighth of the draws (jackknife over `GROUPS` groups; of Sobol
    sequences each is a group), and above it the share that the polynomial does not explain.
    """
    scale = float(np.abs(y - y.mean()).max())
    normal = (y - y.mean()) / scale
    candidates = Candidates.of(shapes, z)
    fit = fit_polynomial(candidates, normal)
    group = np.arange(len(y)) % GROUPS
    parts: list[FloatArray] = []
    missed = np.empty(len(y))
    for number in range(GROUPS):
        kept = group != number
        without = fit_polynomial(candidates, normal, kept)
        missed[~kept] = normal[~kept] - without.at(candidates.columns[~kept])
        parts.append(_shares(without, candidates, len(shapes)))
    explained = float(np.clip(1.0 - (missed**2).mean() / normal.var(), 0.0, 1.0))
    scattered = np.stack(parts)
    spread = (GROUPS - 1) * scattered.var(0)
    half = _T * np.sqrt(spread)
    return _with_intervals(_shares(fit, candidates, len(shapes)), half, explained)


def _shares(fit: PolynomialFit, candidates: Candidates, inputs: int) -> FloatArray:
    """Return the first and the total index (2, input) in the variance of a fitted polynomial."""
    powers = np.array([candidates.powers[term] for term in fit.terms]).reshape(-1, inputs) > 0
    alone = powers & (powers.sum(1, keepdims=True) == 1)
    variance = fit.variances.sum()
    if not variance > 0:
        return np.zeros((2, inputs))
    return np.asarray(np.stack([fit.variances @ alone, fit.variances @ powers]) / variance, np.float64)


def _with_intervals(shares: FloatArray, half: FloatArray, explained: float) -> SobolIndices:
    """Return the indices in the whole variance; the interval of a first index lies below that of the total index."""
    values = explained * shares
    low = np.clip(values - explained * half, 0.0, 1.0)
    high = np.clip(values + explained * half + 1.0 - explained, 0.0, 1.0)
    low[1] = np.maximum(low[1], np.minimum(low[0], values[1]))
    high[0] = np.minimum(high[0], np.maximum(high[1], values[0]))
    rows = [
        [IndexInterval(float(values[k, i]), float(low[k, i]), float(high[k, i])) for i in range(shares.shape[1])]
        for k in range(2)
    ]
    return SobolIndices(rows[0], rows[1], explained)
