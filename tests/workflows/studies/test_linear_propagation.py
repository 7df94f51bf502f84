"""Linear propagation: exact where the output is linear, and its stated error holds the truth, found
by brute force with other code, where it is not.
"""

import math

import numpy as np
import pytest
from scipy import stats

from neusee.workflows.recipe.distributions.shapes import Discrete, LogNormal, Normal, Uniform
from neusee.workflows.studies.linear_propagation import (
    CHECKS,
    FAR,
    OutputRuns,
    propagate,
    without_distance,
)

NEAR = stats.norm.ppf(0.95)
DRAWS = 400_000


def estimate(function, shapes, seed=1):
    """Return the linear estimate of ``function`` of the values (draw, input) of ``shapes``."""

    def outputs(z):
        values = np.stack([shape.at(z[:, i]) for i, shape in enumerate(shapes)], 1)
        return function(values).reshape(len(z), -1)

    def one_at_a_time(score):
        directions = np.eye(len(shapes))
        scores = np.stack([-score * directions, score * directions], 1)
        return outputs(scores.reshape(-1, len(shapes))).reshape(len(shapes), 2, -1)

    z = np.random.default_rng(seed).standard_normal((CHECKS, len(shapes)))
    runs = OutputRuns(
        at_medians=outputs(np.zeros((1, len(shapes))))[0],
        near=one_at_a_time(NEAR),
        far=one_at_a_time(FAR),
        checks=outputs(z),
    )
    return propagate(shapes, z, runs)


def brute_force(function, laws):
    """Return mean and standard deviation of ``function`` over draws of laws of scipy."""
    rng = np.random.default_rng(7)
    values = np.stack([law.rvs(DRAWS, random_state=rng) for law in laws], 1)
    result = function(values)
    return result.mean(), result.std(ddof=1)


def test_a_linear_output_is_exact_whatever_the_laws():
    def output(x):
        return 3 * x[:, 0] - 2 * x[:, 1] + 0.5 * x[:, 2] + 1

    found = estimate(output, [Normal(1, 0.2), Uniform(2, 5), LogNormal(4, 1.5)])
    spread = math.log(1.5)
    lognormal_mean = 4 * math.exp(spread**2 / 2)
    variances = np.array(
        [9 * 0.2**2, 4 * 3**2 / 12, 0.25 * lognormal_mean**2 * math.expm1(spread**2)]
    )
    assert found.sd == pytest.approx(math.sqrt(variances.sum()), rel=1e-5)
    assert found.mean == pytest.approx(3 - 7 + 0.5 * lognormal_mean + 1, rel=1e-5)
    assert found.shares[:, 0] == pytest.approx(variances / variances.sum(), rel=1e-5)
    assert found.error < 1e-9


@pytest.mark.parametrize("curvature", [0.02, -0.1, 0.3])
def test_the_stated_error_of_a_quadratic_output_holds_the_truth(curvature):
    """Variance 1 + 2 b**2 and mean b of x + b x**2."""
    found = estimate(lambda x: x[:, 0] + curvature * x[:, 0] ** 2, [Normal(0, 1)])
    true_sd = math.sqrt(1 + 2 * curvature**2)
    assert found.sd == pytest.approx(1.0, rel=1e-9)
    assert found.error == pytest.approx(true_sd - 1, rel=1e-4)
    assert found.bias == pytest.approx(curvature, rel=1e-6)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize(
    "output",
    [
        lambda x: x[:, 0] + x[:, 1] + 0.2 * x[:, 0] * x[:, 1],
        lambda x: np.exp(0.2 * x[:, 0]) / (3 + 0.3 * x[:, 1]),
        lambda x: np.minimum(x[:, 0] + x[:, 1], 1.5),
        lambda x: np.minimum(x[:, 0], 2.0) + 0.3 * x[:, 1],
        lambda x: np.maximum(x[:, 0], -1.0),
    ],
    ids=["product", "smooth", "clipped", "clipped far out", "clipped below"],
)
def test_the_stated_error_holds_brute_force(output, seed):
    found = estimate(output, [Normal(0, 1), Normal(0, 1)], seed)
    mean, sd = brute_force(output, [stats.norm(), stats.norm()])
    sampling = 4 * sd / math.sqrt(DRAWS)
    assert abs(found.sd[0] - sd) <= found.error * found.sd[0] + sampling
    assert abs(found.mean[0] - mean) <= found.error_of_mean[0] + sampling


def test_a_clipped_output_is_not_known_to_a_few_percent():
    """The run at the far end shows a clipping that neither the median nor the near ends show."""
    found = estimate(lambda x: np.minimum(x[:, 0], 1.8), [Normal(0, 1)])
    assert found.sd == pytest.approx(1.0)
    assert found.error > 0.05
    assert found.reason.split(" from ")[1].startswith("the ends of the inputs")


def test_an_output_without_a_slope_has_no_error_that_could_be_told():
    assert estimate(lambda x: np.abs(x[:, 0]), [Normal(0, 1)]).error == math.inf


def test_an_output_that_does_not_vary_has_no_error():
    found = estimate(lambda x: 0 * x[:, 0] + 0.1, [Normal(0, 1)])
    assert found.is_constant
    assert found.error == 0.0


def test_correlated_inputs_have_the_variance_of_their_covariance():
    """The independent inputs of a joint normal law are those of its Cholesky factor."""
    covariance = np.array([[4.0, 1.5], [1.5, 1.0]])
    factor = np.linalg.cholesky(covariance)
    weights = np.array([1.0, -3.0])
    found = estimate(lambda z: z @ factor.T @ weights, [Normal(), Normal()])
    assert found.sd**2 == pytest.approx(weights @ covariance @ weights, rel=1e-6)
    assert found.error < 1e-9


def test_the_worst_element_of_a_curve_decides():
    found = estimate(lambda x: np.stack([x[:, 0], x[:, 0] + 0.3 * x[:, 0] ** 2], 1), [Normal(0, 1)])
    assert found.error == pytest.approx(math.sqrt(1 + 2 * 0.3**2) - 1, rel=1e-4)


def test_inputs_of_few_values_have_no_derivative():
    shape = Discrete.of(np.array([1.0, 2.0]), np.array([0.5, 0.5]))
    assert without_distance(["a", "b"], [shape, Normal()]) == ["a"]
