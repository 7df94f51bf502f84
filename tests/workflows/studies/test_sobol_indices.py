"""Sobol indices against closed forms, their intervals against repetitions, and what a polynomial
cannot tell.
"""

import math

import numpy as np
import pytest
from scipy.special import ndtr

from neusee.workflows.recipe.distributions.law_text import read_law
from neusee.workflows.recipe.distributions.shapes import Discrete, LogNormal, Normal, Uniform
from neusee.workflows.studies.sobol_indices import (
    Candidates,
    OrthonormalPolynomials,
    fit_polynomial,
    indices,
)

RNG = np.random.default_rng


def ishigami(z):
    """Ishigami and Homma, First Int. Symp. on Uncertainty Modeling and Analysis (1990), with a =
    7 and b = 0.1.
    """
    x = math.pi * (2 * ndtr(z) - 1)
    return np.sin(x[:, 0]) + 7 * np.sin(x[:, 1]) ** 2 + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0])


def ishigami_indices():
    """Return first and total indices in closed form."""
    alone, second = 0.5 * (1 + 0.1 * math.pi**4 / 5) ** 2, 49 / 8
    together = 0.01 * math.pi**8 * (1 / 18 - 1 / 50)
    whole = alone + second + together
    first = np.array([alone, second, 0.0]) / whole
    return first, np.array([alone + together, second, together]) / whole


WEIGHTS = np.array([0.0, 1.0, 4.5, 9.0, 99.0, 99.0])


def g_function(z):
    """Saltelli and Sobol, Reliab. Eng. Syst. Saf. 50 (1995) 225."""
    return np.prod((np.abs(4 * ndtr(z) - 2) + WEIGHTS) / (1 + WEIGHTS), 1)


def g_indices():
    """Return first and total indices in closed form."""
    parts = 1 / 3 / (1 + WEIGHTS) ** 2
    whole = np.prod(1 + parts) - 1
    return parts / whole, parts * np.prod(1 + parts) / (1 + parts) / whole


CASES = {"ishigami": (ishigami, ishigami_indices(), 3), "g": (g_function, g_indices(), 6)}


def found_indices(name, count, seed):
    function, _, inputs = CASES[name]
    z = RNG(seed).standard_normal((count, inputs))
    return indices([Uniform(-1.0, 1.0)] * inputs, z, function(z))


@pytest.mark.parametrize(("name", "count", "error"), [("ishigami", 256, 2e-3), ("g", 512, 0.06)])
def test_indices_are_those_of_the_closed_form(name, count, error):
    found = found_indices(name, count, 1)
    for rows, exact in zip((found.first, found.total), CASES[name][1], strict=True):
        assert [row.value for row in rows] == pytest.approx(exact, abs=error)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "count"), [("ishigami", 64), ("ishigami", 128), ("g", 64), ("g", 128)]
)
def test_intervals_contain_the_closed_form_in_95_of_100(name, count):
    inside = []
    for seed in range(10):
        found = found_indices(name, count, 100 + seed)
        for rows, exact in zip((found.first, found.total), CASES[name][1], strict=True):
            inside += [
                row.low - 1e-12 <= x <= row.high + 1e-12 for row, x in zip(rows, exact, strict=True)
            ]
    assert np.mean(inside) >= 0.95


@pytest.mark.parametrize("count", [64, 200])
@pytest.mark.parametrize(
    "function",
    [
        lambda z: z[:, 0] + 1e-3 * z[:, 1],
        lambda z: np.exp(2 * z[:, 0]) + z[:, 1],
        lambda z: np.sign(z[:, 0]) * (z[:, 1] > 1),
        lambda z: (z[:, 0] > 1.0).astype(float),
        lambda z: np.sin(40 * z[:, 0]),
        lambda z: z[:, 0] * z[:, 1] * z[:, 2],
    ],
    ids=["line", "tail", "steps", "rare", "noise", "together"],
)
def test_a_first_index_never_contradicts_the_total(function, count):
    """A first index of 0.21 ± 0.54 beside a total of 7.6e-5 comes from two methods."""
    z = RNG(7).standard_normal((count, 3))
    found = indices([Normal()] * 3, z, function(z))
    for first, total in zip(found.first, found.total, strict=True):
        assert 0 <= first.low <= first.value <= first.high <= 1
        assert 0 <= total.low <= total.value <= total.high <= 1
        assert first.value <= total.value
        assert first.low <= total.low
        assert first.high <= total.high
    assert sum(first.value for first in found.first) <= 1 + 1e-12


def test_shares_of_a_polynomial_are_exact():
    """y = 3 a + 2 b + 2 a b + (c**2 - 1) / 2: variances 9, 4, 4 and 1/2, of 80 draws."""
    z = RNG(1).standard_normal((80, 4))
    a, b, c, _ = z.T
    found = indices([Normal()] * 4, z, 3 * a + 2 * b + 2 * a * b + c**2 / 2)
    whole = 9 + 4 + 4 + 0.5
    assert found.explains_enough
    assert [row.value for row in found.total] == pytest.approx(
        [13 / whole, 8 / whole, 0.5 / whole, 0.0], abs=1e-9
    )
    assert [row.value for row in found.first] == pytest.approx(
        [9 / whole, 4 / whole, 0.5 / whole, 0.0], abs=1e-9
    )
    assert max(row.high - row.low for row in found.first) < 1e-6


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("discrete(1 weight 0.2, 2 weight 0.5, 7 weight 0.3)", lambda x: x**2),
        ("triangular(0, 1, 4)", lambda x: x**2),
        ("truncated(normal(2, 1), 0, inf)", lambda x: x**2),
        ("beta(0.5, 0.7)", lambda x: x**2),
        ("loguniform(1, 100)", np.log),
        ("lognormal(3, 2)", np.log),
    ],
)
def test_each_law_has_polynomials_of_its_own(text, values):
    """y = f(x) + w with an exact polynomial f: the share of x is var(f) / (var(f) + 1), by
    quadrature.
    """
    shape = read_law(text).shape
    z = RNG(2).standard_normal((200, 2))
    found = indices([shape, Normal()], z, values(shape.at(z[:, 0])) + z[:, 1])
    u = (np.arange(400_000) + 0.5) / 400_000
    variance = values(shape.at(_scores(u))).var()
    assert found.explained == pytest.approx(1.0, abs=1e-9)
    assert found.first[0].value == pytest.approx(variance / (variance + 1), rel=2e-3)


def _scores(u):
    from scipy.special import ndtri

    return ndtri(u)


@pytest.mark.parametrize(
    "shape", [Normal(), Uniform(0.0, 3.0), LogNormal(2.0, 3.0)], ids=["normal", "uniform", "log"]
)
def test_polynomials_are_orthonormal_to_the_tenth_degree(shape):
    basis = OrthonormalPolynomials.of(shape)
    nodes, weights = np.polynomial.hermite_e.hermegauss(80)
    values = basis.at(nodes)
    if isinstance(shape, Uniform):
        nodes, weights = np.polynomial.legendre.leggauss(40)
        values = basis.at(_scores((nodes + 1) / 2))
    assert basis.degree == 10
    assert (values * weights / weights.sum()) @ values.T == pytest.approx(np.eye(11), abs=1e-7)


def test_a_few_separate_values_have_as_few_polynomials():
    basis = OrthonormalPolynomials.of(
        Discrete.of(np.array([1.0, 2.0, 7.0]), np.array([0.2, 0.5, 0.3]))
    )
    assert basis.degree == 2


def test_a_fit_is_that_of_least_squares():
    rng = RNG(4)
    z = rng.standard_normal((60, 2))
    y = 2 + 3 * z[:, 0] - z[:, 0] * z[:, 1] + 1e-3 * rng.standard_normal(60)
    candidates = Candidates.of([Normal()] * 2, z)
    fit = fit_polynomial(candidates, y)
    matrix = np.concatenate([np.ones((60, 1)), candidates.columns[:, fit.terms]], 1)
    assert fit.at(candidates.columns) == pytest.approx(
        matrix @ np.linalg.lstsq(matrix, y, rcond=None)[0], abs=1e-9
    )
    assert {candidates.powers[term] for term in fit.terms} >= {(1, 0), (1, 1)}


def test_what_a_polynomial_cannot_tell_is_in_every_interval():
    z = RNG(1).standard_normal((400, 2))
    found = indices([Normal()] * 2, z, np.sign(np.sin(25 * z[:, 0])))
    assert not found.explains_enough
    assert found.first[0].high > 0.9
    assert found.total[1].high > 0.9


def test_shares_of_one_draw_that_differs_are_numbers():
    z, y = RNG(1).standard_normal((64, 1)), np.full(64, 3.0)
    y[0] = 4.0
    found = indices([Normal()], z, y)
    (first,), (total,) = found.first, found.total
    assert np.isfinite(
        [first.low, first.value, first.high, total.low, total.value, total.high]
    ).all()
    assert not found.explains_enough
