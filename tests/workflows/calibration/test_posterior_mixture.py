"""The mixture that follows a posterior along its ridges: density, moves of walkers, and a grid
as the reference.
"""

import emcee
import numpy as np
import pytest
import torch
from scipy.stats import multivariate_t

from neusee.workflows.calibration.emcee_sampler import GuidedMove, Walk, walk_until
from neusee.workflows.calibration.importance_sampling import draw_samples
from neusee.workflows.calibration.log_posterior import find_mode, initial_theta
from neusee.workflows.calibration.posterior_mixture import Mixture, normalised
from tests.workflows.calibration.simulated_lenses import (
    TRUTH,
    picture,
    problem_of,
    recipe_prior,
    rings_of,
)

MIXTURE = Mixture(
    np.array([0.3, 0.7]),
    np.array([[0.0, 1.0], [4.0, -2.0]]),
    np.array([[[1.0, 0.0], [0.5, 0.8]], [[0.3, 0.0], [-0.2, 2.0]]]),
)


def test_the_density_of_a_mixture_is_that_of_its_components():
    places = np.random.default_rng(1).normal(size=(50, 2)) * 4
    parts = [
        multivariate_t(c, root @ root.T, df=6)
        for c, root in zip(MIXTURE.centres, MIXTURE.roots, strict=True)
    ]
    expected = np.log(
        sum(share * part.pdf(places) for share, part in zip(MIXTURE.shares, parts, strict=True))
    )
    off = MIXTURE.log_density(places) - expected
    assert np.ptp(off) < 1e-12


def test_samples_of_a_mixture_have_its_moments():
    drawn = MIXTURE.draw(40_000, np.random.default_rng(1))
    assert np.abs(drawn.mean(0) - MIXTURE.shares @ MIXTURE.centres).max() < 0.05
    # covariance of 6 degrees of freedom
    inside = 1.5 * MIXTURE.roots @ MIXTURE.roots.transpose(0, 2, 1)
    away = MIXTURE.centres - MIXTURE.shares @ MIXTURE.centres
    whole = np.einsum("k,kij->ij", MIXTURE.shares, inside + away[:, :, None] * away[:, None])
    assert np.abs(np.cov(drawn.T) / whole - 1).max() < 0.05


@pytest.mark.slow
def test_walkers_with_a_wrong_mixture_have_the_right_posterior():
    """Two peaks, 20 widths apart, with shares 0.2 and 0.8; the mixture has them as 0.3 and 0.7,
    and wider.
    """

    def weigh(places):
        return np.logaddexp(
            np.log(0.2) - 0.5 * (places**2).sum(1),
            np.log(0.8) - 0.5 * ((places - [20, 0]) ** 2).sum(1),
        )

    guide = Mixture(
        MIXTURE.shares, np.array([[0.0, 0.5], [20.0, 0.0]]), np.stack([1.5 * np.eye(2)] * 2)
    )
    backend = emcee.backends.Backend()
    backend.reset(40, 2)
    start = np.random.default_rng(1).normal(size=(40, 2))  # all at the small peak
    walk = Walk(backend, GuidedMove(emcee.moves.DEMove(), guide), np.random.RandomState(1), start)
    walk_until([walk], 1200, weigh)
    chain = backend.get_chain(discard=200, flat=True)
    assert (chain[:, 0] > 10).mean() == pytest.approx(0.8, abs=0.03)
    for peak, at in ((chain[:, 0] < 10, 0.0), (chain[:, 0] > 10, 20.0)):
        assert chain[peak].mean(0) == pytest.approx([at, 0], abs=0.1)
        assert chain[peak].std(0) == pytest.approx([1, 1], abs=0.06)


#: by lens: its numbers, the sine at which its BSDF is known, and the ends of a grid of ln BSDF
#: there, ln l, and s
RIDGES = {
    "lobe within the core": (
        {"b0": 15 * 20**2.2, "l": 2e-4, "s": -2.2},
        0.0025,
        (3.3, 4.4),
        (-16.0, -4.5),
        (-2.8, -1.8),
    ),
    "lobe beyond the frame": (
        {"b0": 1.0, "l": 0.05, "s": -2.0},
        0.0065,
        (-0.7, 0.7),
        (-9.0, 0.0),
        (-4.4, -0.2),
    ),
}
SHAPE_ONLY = {name: pair for name, pair in recipe_prior().items() if name in ("b0", "l", "s")}


def on_a_grid(problem, prior, sine, *ends, steps=(110, 48, 48)):
    """Return mean and standard deviation of ln b0, ln l and s by sums over a grid along the
    ridge.
    """
    far, log_l, s = (
        x.ravel()
        for x in np.meshgrid(*map(np.linspace, *zip(*ends, strict=True), steps), indexing="ij")
    )
    # a shift, which leaves volumes as they are
    log_b0 = far - s / 2 * np.log1p((sine / np.exp(log_l)) ** 2)
    places = np.stack([log_b0, log_l, s], -1)
    log = np.empty(len(s))
    for at in np.array_split(np.arange(len(s)), 40):
        lens = {"b0": np.exp(log_b0[at]), "l": np.exp(log_l[at]), "s": s[at]}
        named = {f"density.{name}": torch.from_numpy(x) for name, x in lens.items()}
        log[at] = problem.weigh(named)["density"].log.numpy()
    middle = [np.log(prior["b0"][0]), np.log(prior["l"][0]), prior["s"][0]]
    width = [np.log(prior["b0"][1]), np.log(prior["l"][1]), prior["s"][1]]
    log = np.where(np.isfinite(log), log, -np.inf) - 0.5 * (((places - middle) / width) ** 2).sum(1)
    weight = normalised(log)
    mean = weight @ places
    return mean, np.sqrt(weight @ (places - mean) ** 2), 1 / (weight**2).sum()


@pytest.mark.slow
@pytest.mark.parametrize("ridge", RIDGES)
def test_weighted_draws_are_those_of_a_grid_along_a_ridge(ridge):
    lens, *grid = RIDGES[ridge]
    rings = rings_of(picture({**TRUTH, **lens}, np.random.default_rng(1)))
    problem = problem_of(rings, SHAPE_ONLY, scatter=0.03)
    samples, log = draw_samples(
        problem, find_mode(problem, initial_theta(problem)), np.random.default_rng(1)
    )
    weight = normalised(log)
    found = problem.parameters(samples)
    drawn = np.stack([found["b0"].log(), found["l"].log(), found["s"]], -1)
    mean, sd, cells = on_a_grid(problem, SHAPE_ONLY, *grid)
    assert cells > 100
    assert np.abs((weight @ drawn - mean) / sd).max() < 0.2
    off = np.sqrt(weight @ (drawn - weight @ drawn) ** 2) / sd - 1
    assert np.abs(off).max() < 0.2
