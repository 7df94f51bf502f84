"""The share of each input in the scatter of a number: variance-based indices by SALib, for independent inputs."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]

EXPLAINED = 0.9  #: share of the variance that the polynomial must tell of draws that it has not seen
_SALTELLI = 1024  #: points of the polynomial by input
_BY_TERM = 3  #: draws that a term of the polynomial asks for


@dataclass(frozen=True)
class SobolIndices:
    """Shares of a variance, by input."""

    first: Sequence[float]  #: what the input does by itself, from the draws
    first_error: Sequence[float]  #: half of its 95 % interval
    total: Sequence[float]  #: with what it does together with others, of a polynomial
    total_error: Sequence[float]
    explained: float  #: share of the variance that the polynomial tells of draws that it has not seen

    @property
    def explains_enough(self) -> bool:
        """Return True if the polynomial explains enough of the variance for its indices to mean anything."""
        return self.explained >= EXPLAINED


def require_salib() -> None:
    """Raise `ImportError` with the command that installs SALib, where SALib is missing."""
    try:
        import SALib  # noqa: F401
    except ImportError:
        raise ImportError("the study of uncertainty needs SALib: pip install 'neusee[uncertainty]'") from None


def indices(names: Sequence[str], z: FloatArray, y: FloatArray, seed: int) -> SobolIndices:
    """Return the shares of the variance of a number ``y`` (draw,) by standard normal inputs ``z`` (draw, input).

    First-order indices are those of RBD-FAST, from the draws only; total ones those of Saltelli's points (Sobol,
    Jansen) on a polynomial of second order that is fitted to the draws.
    """
    from SALib.analyze import rbd_fast, sobol
    from SALib.sample import sobol as points

    count = len(names)
    problem: dict[str, Any] = {
        "num_vars": count,
        "names": list(names),
        "bounds": [[0.0, 1.0]] * count,
        "dists": ["norm"] * count,
    }
    fitted, explained = _fit(z, y)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pandas warns, and so do indices next to nothing
        first = rbd_fast.analyze(problem, z, y, seed=seed)
        at = points.sample(problem, _SALTELLI, calc_second_order=False, seed=seed)
        total = sobol.analyze(problem, _terms(at, len(fitted)) @ fitted, calc_second_order=False, seed=seed)
    found = (first["S1"], first["S1_conf"], total["ST"], total["ST_conf"])
    # a share without an error by resampling gets an error of 1
    alone, alone_error, whole, whole_error = ([float(x) for x in np.nan_to_num(v, nan=1.0)] for v in found)
    return SobolIndices(alone, alone_error, whole, whole_error, explained)


def _fit(z: FloatArray, y: FloatArray) -> tuple[FloatArray, float]:
    """Return the coefficients, and the share of the variance that the polynomial predicts of draws left out (PRESS)."""
    many = _count(z.shape[1], 2)
    terms = _terms(z, many if many * _BY_TERM <= len(z) else _count(z.shape[1], 1))
    fitted = np.asarray(np.linalg.lstsq(terms, y, rcond=None)[0], np.float64)
    q, _ = np.linalg.qr(terms)
    left = (y - terms @ fitted) / (1.0 - (q**2).sum(1)).clip(1e-9)
    return fitted, float(1.0 - (left**2).mean() / y.var())


def _count(inputs: int, order: int) -> int:
    return 1 + inputs + (inputs * (inputs + 1) // 2 if order == 2 else 0)


def _terms(z: FloatArray, count: int) -> FloatArray:
    """Return Hermite's polynomials: one, each input, and products of two inputs where ``count`` has room for them."""
    columns = [np.ones(len(z)), *z.T]
    if count > len(columns):
        pairs = combinations_with_replacement(range(z.shape[1]), 2)
        columns += [z[:, i] * z[:, j] - (i == j) for i, j in pairs]
    return np.stack(columns, 1)
