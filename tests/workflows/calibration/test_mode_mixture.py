"""The density of a posterior whose parameter is hardly told from 0, beside the integral over a
grid in NumPy.
"""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_t

from neusee.workflows.calibration.camera_density import TailDensity, with_prior_tails
from neusee.workflows.calibration.importance_sampling import fit_about_mode
from neusee.workflows.calibration.posterior_mixture import Mixture, normalised

#: a dark current and its standard error; the width of its prior, a logarithm
FOUND, ERROR, WIDTH = 0.7, 0.25, 2.3


def log_posterior(theta):
    """A dark current, as a logarithm, and an offset that frames tell together with it."""
    current = np.exp(theta[..., 0])
    told = ((current - FOUND) / ERROR) ** 2 + ((theta[..., 1] + 0.5 * current - 2.0) / 0.1) ** 2
    return -0.5 * (told + (theta[..., 0] / WIDTH) ** 2)


def quantile(values, weight, share):
    order = np.argsort(values)
    return values[order][np.searchsorted(np.cumsum(weight[order]), share)]


@pytest.fixture(scope="module")
def drawn():
    """Samples of the fitted density, and their weights."""
    # at the mode, in whitened numbers
    jacobian = np.array([[FOUND / ERROR, 0.0], [5 * FOUND, 10.0]])
    covariance = np.linalg.inv(jacobian.T @ jacobian + np.diag([WIDTH**-2, 0.0]))
    mode = SimpleNamespace(
        theta=np.array([np.log(FOUND), 2.0 - 0.5 * FOUND]), covariance=covariance
    )
    coordinates = SimpleNamespace(widths=frozenset(), linear=frozenset({"offset"}), bent=False)
    problem = SimpleNamespace(
        names=("dark_current", "offset"), coordinates=coordinates, log_posterior=log_posterior
    )
    _, samples, log = fit_about_mode(problem, mode, 4000, np.random.default_rng(5))
    return samples, normalised(log)


@pytest.mark.parametrize("share", [0.005, 0.02, 0.1, 0.5, 0.9])
def test_the_long_lower_tail_has_its_weight(drawn, share):
    grid = np.linspace(-12, 2, 4001)
    offsets = np.linspace(0.5, 3.0, 801)
    cells = np.exp(log_posterior(np.stack(np.meshgrid(grid, offsets, indexing="ij"), -1)))
    density = cells.sum(1) / cells.sum()
    # of the share, for weights that are not equal
    error = np.sqrt(2 * share * (1 - share) / len(drawn[0]))
    below = drawn[1][drawn[0][:, 0] < quantile(grid, density, share)].sum()
    assert below == pytest.approx(share, abs=4 * error)


def test_no_sample_has_a_large_weight(drawn):
    """Without a component for the tail the largest of 4000 weights is 0.0021, eight times the
    mean.
    """
    assert drawn[1].max() < 1e-3


def test_body_and_tails_are_one_density():
    """By another library: two mixtures of other shares and degrees of freedom, of which one
    counts for a twentieth.
    """
    body = Mixture(
        np.array([0.3, 0.7]),
        np.array([[0.0, 1.0], [2.0, 0.0]]),
        np.stack([np.eye(2), 3 * np.eye(2)]),
        20.0,
    )
    tails = Mixture(
        np.ones(1), np.array([[-4.0, 1.0]]), np.array([[[2.0, 0.0], [0.5, 1.0]]]), np.array([6.0])
    )
    samples = np.random.default_rng(3).normal(0.0, 3.0, (20, 2))
    logs = [
        np.log(share * part) + multivariate_t(centre, root @ root.T, df=df).logpdf(samples)
        for share, mixture, df in ((0.95, body, 20.0), (0.05, tails, 6.0))
        for part, centre, root in zip(mixture.shares, mixture.centres, mixture.roots, strict=True)
    ]
    found = TailDensity(body, tails).log_density(samples)
    assert found - logsumexp(logs, axis=0) == pytest.approx(np.full(20, np.log(np.pi)), abs=1e-9)


def test_each_width_has_a_part_with_its_prior():
    """By SciPy: body and parts as one density; the shares are those of samples with known parts
    in the tails.
    """
    rng = np.random.default_rng(6)
    body = Mixture(np.ones(1), np.array([[-5.0, -4.0]]), np.array([[[0.3, 0.0], [0.1, 0.4]]]), 30.0)
    prior = multivariate_t([-6.0, -4.5], np.diag([1.1**2, 0.9**2]), df=6)
    coordinates = SimpleNamespace(whitened=lambda x: (x - [0.0, -6.0, -4.5]) / [1.0, 1.1, 0.9])
    problem, mode = (
        SimpleNamespace(whitened=coordinates.whitened),
        SimpleNamespace(theta=np.array([1.0, -5.0, -4.0])),
    )
    samples = body.draw(20000, rng)
    samples[:3000, 0] = prior.rvs(3000, rng)[:, 0]  # 15 % have the prior of the first width
    found = with_prior_tails(
        body, problem, mode, np.array([False, True, True]), (samples, np.full(20000, 1 / 20000))
    )
    share = found.shares[1:]
    assert share == pytest.approx([0.15, 0.03], abs=0.03)
    covariance = np.array([[0.09, 0.03], [0.03, 0.17]])
    first = np.diag([1.1**2, covariance[1, 1] - 0.03**2 / 0.09])
    second = np.diag([covariance[0, 0] - 0.03**2 / 0.17, 0.9**2])
    places = rng.normal(-5.0, 1.5, (20, 2))
    known = logsumexp(
        [
            np.log(found.shares[0])
            + multivariate_t([-5.0, -4.0], covariance, df=30).logpdf(places),
            np.log(share[0]) + multivariate_t([-6.0, -4.0], first, df=6).logpdf(places),
            np.log(share[1]) + multivariate_t([-5.0, -4.5], second, df=6).logpdf(places),
        ],
        axis=0,
    )
    assert found.log_density(places) - known == pytest.approx(np.full(20, np.log(np.pi)), abs=1e-6)
