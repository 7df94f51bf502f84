"""Sobol indices, computed with SALib: the share of each independent input in an output's variance."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import Any

import numpy as np

from neusee.workflows.studies.uncertainty.scatter_estimate import FloatArray

EXPLAINED = 0.9  #: least share of the variance that the polynomial must predict for draws outside the fit
_SALTELLI = 1024  #: base number of Saltelli's points, at which the polynomial is evaluated
_BY_TERM = 3  #: least number of draws for each term of the polynomial


@dataclass(frozen=True)
class SobolIndices:
    """The first-order and total Sobol indices of each input, with their errors."""

    first: Sequence[float]  #: share of each input alone, from the draws
    first_error: Sequence[float]  #: half of the 95 % interval
    total: Sequence[float]  #: share of each input alone and together with other inputs, from a polynomial
    total_error: Sequence[float]
    explained: float  #: share of the variance that the polynomial predicts for draws outside the fit

    @property
    def explains_enough(self) -> bool:
        """Return True if the polynomial explains enough of the variance for the total indices to be reliable."""
        return self.explained >= EXPLAINED


def require_salib() -> None:
    """Raise `ImportError` with the command that installs SALib if SALib is not installed."""
    try:
        import SALib  # noqa: F401
    except ImportError:
        raise ImportError("the study of uncertainty needs SALib: pip install 'neusee[uncertainty]'") from None


def indices(names: Sequence[str], z: FloatArray, y: FloatArray, seed: int) -> SobolIndices:
    """Return the Sobol indices of the standard normal inputs ``z`` (draw, input) in the variance of ``y`` (draw,).

    First-order indices come from the draws alone, by RBD-FAST. Total indices come from Saltelli's points (Sobol,
    Jansen) on a polynomial of second order that is fitted to the draws.
    """
    from SALib.analyze import rbd_fast, sobol
    from SALib.sample import sobol as points

    count = len(names)
    problem: dict[str, Any] = {"num_vars": count, "names": list(names)}
    problem |= {"bounds": [[0.0, 1.0]] * count, "dists": ["norm"] * count}
    fitted, explained = _fit(z, y)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pandas and very small indices cause warnings
        first = rbd_fast.analyze(problem, z, y, seed=seed)
        at = points.sample(problem, _SALTELLI, calc_second_order=False, seed=seed)
        total = sobol.analyze(problem, _terms(at, len(fitted)) @ fitted, calc_second_order=False, seed=seed)
    found = (first["S1"], first["S1_conf"], total["ST"], total["ST_conf"])
    # a share without an error by resampling gets an error of 1
    alone, alone_error, whole, whole_error = ([float(x) for x in np.nan_to_num(v, nan=1.0)] for v in found)
    return SobolIndices(alone, alone_error, whole, whole_error, explained)


def _fit(z: FloatArray, y: FloatArray) -> tuple[FloatArray, float]:
    """Fit a Hermite polynomial; return the coefficients and the share of the variance that it predicts (PRESS)."""
    many = _count(z.shape[1], 2)
    terms = _terms(z, many if many * _BY_TERM <= len(z) else _count(z.shape[1], 1))
    fitted = np.asarray(np.linalg.lstsq(terms, y, rcond=None)[0], np.float64)
    q, _ = np.linalg.qr(terms)
    left = (y - terms @ fitted) / (1.0 - (q**2).sum(1)).clip(1e-9)
    return fitted, float(1.0 - (left**2).mean() / y.var())


def _count(inputs: int, order: int) -> int:
    return 1 + inputs + (inputs * (inputs + 1) // 2 if order == 2 else 0)


def _terms(z: FloatArray, count: int) -> FloatArray:
    """Return the Hermite polynomials of each draw: 1, the inputs and, if ``count`` is larger, their products."""
    columns = [np.ones(len(z)), *z.T]
    if count > len(columns):
        pairs = combinations_with_replacement(range(z.shape[1]), 2)
        columns += [z[:, i] * z[:, j] - (i == j) for i, j in pairs]
    return np.stack(columns, 1)
