"""Sobol indices: the share of each input in a variance, from a polynomial fit."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from neusee.workflows.recipe.distributions.shapes import FloatArray, Shape

# --- polynomial fit -------------------------------------------------------------------------------

# A sparse polynomial of independent inputs, fitted to draws of an output, and how well it predicts
# other draws.
#
# Each input has polynomials that are orthonormal under its own distribution, so that the variance
# of the fitted polynomial is the sum of its squared coefficients. Terms are added one after
# another, each the one that explains most of what is left (orthogonal matching pursuit), until the
# error of prediction without the predicted draw no longer falls.
#
# Source: Blatman and Sudret, J. Comput. Phys. 230 (2011) 2345, for sparse polynomials and the
#         corrected error.


Powers = tuple[int, ...]  #: degree of each input in a term

_DEGREE = 10  #: largest degree of a term
_TOGETHER = 3  #: largest number of inputs in a term
_CANDIDATES = 400  #: largest number of candidate terms of a fit
#: exponent of the hyperbolic norm of the degrees; below 1 it favours terms of few inputs
_HYPERBOLIC = 0.75
#: largest norms of two smaller sets of terms: up to squares and products of two inputs, and
#: somewhat more
_NORMS = (2.6, 5.0)
_BY_TERM = 3  #: smallest number of draws for each selected term
_PATIENCE = 12  #: number of further terms that are tried without a gain
_EXACT = 1e-13  #: remaining share of the variance below which a polynomial counts as exact
#: relative norm of a term's part orthogonal to the selected terms, below which the term depends on
#: them
_SMALLEST = 1e-7


@dataclass(frozen=True)
class OrthonormalPolynomials:
    """Polynomials of one input that are orthonormal under its distribution, defined by a three-term
    recurrence.
    """

    shape: Shape
    centres: FloatArray  #: (degree,) coefficients of the recurrence
    norms: FloatArray  #: (degree + 1,)

    @classmethod
    def of(cls, shape: Shape, degree: int = _DEGREE) -> OrthonormalPolynomials:
        """Compute the recurrence for a distribution (Stieltjes); the degree is lower for a
        distribution of few discrete values.
        """
        coordinates, weights = shape.measure()
        centres, norms = list[float](), [1.0]
        previous_polynomial, polynomial = np.zeros_like(coordinates), np.ones_like(coordinates)
        while len(centres) < min(degree, len(coordinates) - 1):
            # p_(n+1) = ((x - centre) p_n - norm_n p_(n-1)) / norm_(n+1), under the weights
            centre = float(weights @ (coordinates * polynomial**2))
            next_polynomial = (
                (coordinates - centre) * polynomial - norms[-1] * previous_polynomial
                if centres
                else (coordinates - centre) * polynomial
            )
            norm = float(np.sqrt(weights @ next_polynomial**2))
            previous_polynomial, polynomial = polynomial, next_polynomial / norm
            centres.append(centre)
            norms.append(norm)
        return cls(shape, np.array(centres), np.array(norms))

    @property
    def degree(self) -> int:
        """Return the largest degree."""
        return len(self.centres)

    def at(self, z: FloatArray) -> FloatArray:
        """Return the polynomials (degree + 1, draw) at the standard normal numbers ``z`` of the
        input.
        """
        coordinates = self.shape.coordinate(z)
        values = [np.ones_like(coordinates)]
        previous_polynomial = np.zeros_like(coordinates)
        for degree, centre in enumerate(self.centres):
            next_polynomial = (coordinates - centre) * values[-1] - (
                self.norms[degree] * previous_polynomial if degree else 0.0
            )
            previous_polynomial = values[-1]
            values.append(next_polynomial / self.norms[degree + 1])
        return np.stack(values)


@dataclass(frozen=True)
class Candidates:
    """The candidate terms of a fit, evaluated at all draws."""

    powers: tuple[Powers, ...]  #: without the constant term
    columns: FloatArray  #: (draw, term)
    #: sizes of the nested sets of candidates, each the first terms of ``powers``
    sizes: tuple[int, ...]

    @classmethod
    def of(cls, shapes: Sequence[Shape], z: FloatArray) -> Candidates:
        """Return products of the inputs' polynomials at the draws ``z`` (draw, input), low degrees
        first.
        """
        bases = [OrthonormalPolynomials.of(shape) for shape in shapes]
        values = [basis.at(z[:, input_number]) for input_number, basis in enumerate(bases)]
        powers = _low_degrees([basis.degree for basis in bases])
        columns = [_product(values, power) for power in powers]
        norms = np.array([_norm(power) for power in powers])
        # powers are sorted by norm, so that each set is a leading part of the terms
        sizes = {int((norms <= largest_norm).sum()) for largest_norm in (*_NORMS, math.inf)}
        return cls(powers, np.stack(columns, 1), tuple(sorted(sizes)))


def _product(values: Sequence[FloatArray], power: Powers) -> FloatArray:
    """Return a term (draw,): the product of the inputs' polynomials of the degrees in ``power``.

    ``values`` has the polynomials (degree + 1, draw) of each input.
    """
    product = np.ones(values[0].shape[1])
    for input_values, degree in zip(values, power, strict=True):
        if degree:
            product = product * input_values[degree]
    return product


def _low_degrees(degrees: Sequence[int]) -> tuple[Powers, ...]:
    """Return the degrees of the candidate terms in rising order of their hyperbolic norm."""
    candidates: list[tuple[float, Powers]] = []
    for input_count in range(1, min(_TOGETHER, len(degrees)) + 1):
        for inputs in combinations(range(len(degrees)), input_count):
            for power in _degrees_of(inputs, degrees):
                candidates.append((_norm(power), power))
    return tuple(power for _, power in sorted(candidates)[:_CANDIDATES])


def _norm(power: Powers) -> float:
    """Return the hyperbolic norm of the degrees of a term."""
    return float(sum(degree**_HYPERBOLIC for degree in power) ** (1 / _HYPERBOLIC))


def _degrees_of(inputs: Sequence[int], degrees: Sequence[int]) -> Iterator[Powers]:
    """Yield the degrees of all terms in which exactly the ``inputs`` occur."""
    degrees_of_term = [0] * len(degrees)

    def fill(place: int, left: int) -> Iterator[Powers]:
        if place == len(inputs):
            yield tuple(degrees_of_term)
            return
        inputs_after = len(inputs) - place - 1
        # leave a degree of at least 1 for each further input
        for degree in range(1, min(degrees[inputs[place]], left - inputs_after) + 1):
            degrees_of_term[inputs[place]] = degree
            yield from fill(place + 1, left - degree)

    yield from fill(0, _DEGREE)


@dataclass(frozen=True)
class PolynomialFit:
    """A fitted polynomial: its constant, and the coefficients of its terms."""

    constant: float
    terms: NDArray[np.int64]  #: (term,) indices of candidates
    coefficients: FloatArray  #: (term,)

    @cached_property
    def variances(self) -> FloatArray:
        """Return the contribution of each term to the variance of the polynomial."""
        return np.asarray(self.coefficients**2, np.float64)

    def at(self, columns: FloatArray) -> FloatArray:
        """Return the polynomial at draws, from the candidate terms ``columns`` (draw, term)."""
        return np.asarray(self.constant + columns[:, self.terms] @ self.coefficients, np.float64)


def fit_polynomial(
    candidates: Candidates, y: FloatArray, draws: FloatArray | None = None
) -> PolynomialFit:
    """Fit a sparse polynomial to ``y`` (draw,).

    Terms are selected among those of low degree, among more, and among all; the selection with the
    least error of prediction counts. The booleans ``draws`` (draw,) select the draws of the fit;
    None for all.
    """
    columns, values = (
        (candidates.columns, y) if draws is None else (candidates.columns[draws], y[draws])
    )
    selections = [_select_terms(columns[:, :count], values) for count in candidates.sizes]
    _, terms = min(selections, key=lambda selection: selection[0])
    # a column of ones for the constant
    matrix = np.concatenate([np.ones((len(values), 1)), columns[:, terms]], 1)
    solution = np.linalg.lstsq(matrix, values, rcond=None)[0]
    return PolynomialFit(
        float(solution[0]), np.array(terms, np.int64), np.asarray(solution[1:], np.float64)
    )


def _select_terms(columns: FloatArray, y: FloatArray) -> tuple[float, list[int]]:
    """Return the terms of a sparse polynomial by orthogonal matching pursuit, with their prediction
    error.

    ``columns`` are the candidate terms (draw, term). Returned are the mean squared prediction error
    and the indices of the selected terms.
    """
    count, exact_residual = len(y), _EXACT * len(y) * float(y.var())
    # at least _BY_TERM draws for each term and the constant
    limit = min(columns.shape[1], max(1, count // _BY_TERM) - 1)
    # orthonormal columns: the constant is the first
    basis = [np.full(count, count**-0.5)]
    residual, leverage = y - y.mean(), np.full(count, 1.0 / count)
    lengths = np.sqrt((columns**2).sum(0))
    selected: list[int] = []
    best_count, best_error = 0, _error_of_prediction(residual, leverage, 1)
    while (
        len(selected) < limit
        and len(selected) - best_count < _PATIENCE
        and residual @ residual > exact_residual
    ):
        term = _next_term(columns, residual, lengths)
        orthogonal_part = _apart(columns[:, term], basis)
        norm = float(np.sqrt(orthogonal_part @ orthogonal_part))
        independent = norm > _SMALLEST * lengths[term]
        # infinite length: the term is not selected again
        lengths[term] = np.inf
        if not independent:
            limit = min(limit, int(np.isfinite(lengths).sum()) + len(selected))
            continue
        selected.append(term)
        basis.append(orthogonal_part / norm)
        residual = residual - (basis[-1] @ residual) * basis[-1]
        # diagonal of the projection onto the basis
        leverage = leverage + basis[-1] ** 2
        error = _error_of_prediction(residual, leverage, len(basis))
        if error < best_error:
            best_count, best_error = len(selected), error
    return best_error, selected[:best_count]


def _next_term(columns: FloatArray, left: FloatArray, lengths: FloatArray) -> int:
    """Return the index of the term most parallel to the residual ``left``; terms of infinite length
    are skipped.
    """
    return int((np.abs(columns.T @ left) / lengths).argmax())


def _apart(column: FloatArray, basis: Sequence[FloatArray]) -> FloatArray:
    """Return the part of a column orthogonal to an orthonormal basis, projected twice against
    rounding.
    """
    matrix = np.stack(basis)
    for _ in range(2):
        column = column - (matrix @ column) @ matrix
    return column


def _error_of_prediction(left: FloatArray, leverage: FloatArray, terms: int) -> float:
    """Return the leave-one-out mean squared prediction error, corrected for the number of terms."""
    count = len(left)
    # leave-one-out residual: residual / (1 - leverage)
    errors_without = (left / (1.0 - leverage).clip(1e-9)) ** 2
    return float(errors_without.mean()) * count / max(1, count - terms)


# --- sobol indices --------------------------------------------------------------------------------

# Sobol indices: the share of each independent input in the variance of an output.
#
# First and total indices are those of one polynomial in closed form (Sudret, Reliab. Eng. Syst.
# Saf. 93 (2008) 964), so that a first index is never larger than the total index of the same input.
# The share of the variance that the polynomial does not predict for draws outside its fit may
# belong to any input: every interval contains this share.


#: smallest predicted share of the variance for which the indices are informative
EXPLAINED = 0.9
GROUPS = 8  #: groups of draws, each left out of a fit once
#: 97.5 % quantile of Student's distribution with GROUPS - 1 degrees of freedom
_T = 2.3646242515927849


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
    #: share of the variance that the polynomial predicts for draws outside its fit
    explained: float

    @property
    def explains_enough(self) -> bool:
        """Return True if the polynomial explains enough of the variance for narrow intervals."""
        return self.explained >= EXPLAINED


def indices(shapes: Sequence[Shape], z: FloatArray, y: FloatArray) -> SobolIndices:
    """Return the Sobol indices of independent inputs in the variance of ``y`` (draw,).

    Args:
        shapes: distribution of each input
        z: standard normal numbers (draw, input) from which the inputs follow

    The interval combines the scatter between fits without an eighth of the draws (jackknife over
    `GROUPS` groups; each Sobol sequence is one group) and, upward, the share that the polynomial
    does not explain.
    """
    largest_deviation = float(np.abs(y - y.mean()).max())
    scaled_output = (y - y.mean()) / largest_deviation
    candidates = Candidates.of(shapes, z)
    fit = fit_polynomial(candidates, scaled_output)
    group = np.arange(len(y)) % GROUPS
    shares_by_group: list[FloatArray] = []
    prediction_errors = np.empty(len(y))
    for left_out_group in range(GROUPS):
        training = group != left_out_group
        fit_without_group = fit_polynomial(candidates, scaled_output, training)
        prediction_errors[~training] = scaled_output[~training] - fit_without_group.at(
            candidates.columns[~training]
        )
        shares_by_group.append(_shares(fit_without_group, candidates, len(shapes)))
    explained = float(np.clip(1.0 - (prediction_errors**2).mean() / scaled_output.var(), 0.0, 1.0))
    jackknife_shares = np.stack(shares_by_group)
    # jackknife: (n - 1) / n times the sum of squares
    jackknife_variance = (GROUPS - 1) * jackknife_shares.var(0)
    half_widths = _T * np.sqrt(jackknife_variance)
    return _with_intervals(_shares(fit, candidates, len(shapes)), half_widths, explained)


def _shares(fit: PolynomialFit, candidates: Candidates, inputs: int) -> FloatArray:
    """Return the first and the total index (2, input) in the variance of a fitted polynomial."""
    # (term, input): whether the input occurs in the term
    occurs = np.array([candidates.powers[term] for term in fit.terms]).reshape(-1, inputs) > 0
    occurs_alone = occurs & (occurs.sum(1, keepdims=True) == 1)
    variance = fit.variances.sum()
    if not variance > 0:
        return np.zeros((2, inputs))
    return np.asarray(
        np.stack([fit.variances @ occurs_alone, fit.variances @ occurs]) / variance, np.float64
    )


def _with_intervals(shares: FloatArray, half: FloatArray, explained: float) -> SobolIndices:
    """Return the indices relative to the whole variance, from first and total shares (2, input) of
    the polynomial's variance.

    ``half`` are the half-widths of the intervals. The interval of a first index is limited by that
    of the total index.
    """
    values = explained * shares
    low = np.clip(values - explained * half, 0.0, 1.0)
    # what the polynomial does not explain may belong to any input
    high = np.clip(values + explained * half + 1.0 - explained, 0.0, 1.0)
    # row 0: first, row 1: total
    low[1] = np.maximum(low[1], np.minimum(low[0], values[1]))
    high[0] = np.minimum(high[0], np.maximum(high[1], values[0]))
    intervals = [
        [
            IndexInterval(
                float(values[kind, input_number]),
                float(low[kind, input_number]),
                float(high[kind, input_number]),
            )
            for input_number in range(shares.shape[1])
        ]
        for kind in range(2)
    ]
    return SobolIndices(intervals[0], intervals[1], explained)
