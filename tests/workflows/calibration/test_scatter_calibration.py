"""The scatter of a lens from simulated pictures: coverage of the intervals, limits, and chains
against weights.
"""

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.stats import binom, chi2

from neusee.nodes import calibrate
from neusee.workflows.calibration import (
    calibration_figures,
    emcee_sampler,
    importance_sampling,
    posterior_checks,
)
from neusee.workflows.calibration.calibration_figures import ring_radii
from neusee.workflows.calibration.calibration_page import unit_of
from neusee.workflows.calibration.identifiability import identify, identify_from_draws
from neusee.workflows.calibration.importance_sampling import draw_guide, draw_samples
from neusee.workflows.calibration.log_posterior import find_mode, initial_theta
from neusee.workflows.calibration.posterior_checks import importance_samples
from neusee.workflows.calibration.posterior_mixture import normalised
from tests.workflows.calibration.simulated_lenses import (
    CAMERA,
    LENS,
    PRIOR,
    TRUTH,
    drawn_truth,
    picture,
    problem_of,
    recipe_prior,
    rings_of,
)

WIDE = {**PRIOR, "b0": (15.0, 30.0), "l": (0.004, 10.0), "s": (-2.5, 0.5)}
SHAPE = ("b0", "l", "s")


def fitted(truth, seed=1, prior=PRIOR, size=128):
    problem = problem_of(rings_of(picture(truth, np.random.default_rng(seed), size)), prior)
    return problem, find_mode(problem, initial_theta(problem))


def shape_of(problem, samples):
    """Return ln b0, ln l and s of samples (draw, free), as an array (draw, 3)."""
    found = problem.parameters(samples)
    return np.stack([found["b0"].log(), found["l"].log(), found["s"]], -1)


def weighted(problem, mode, seed):
    samples, log = draw_samples(problem, mode, np.random.default_rng(seed))
    return shape_of(problem, samples), normalised(log)


def told(problem, mode):
    """Return what `neusee calibrate` says that the picture tells."""
    samples, log = draw_samples(problem, mode, np.random.default_rng(1))
    return identify_from_draws(problem, mode, identify(problem, mode), samples, normalised(log))


def test_the_mean_of_a_ring_is_wing_and_scatter():
    """Each expected mean against SciPy: the BSDF at the pixels, and what the lens scatters in
    all.
    """
    rings = rings_of(picture(TRUTH, np.random.default_rng(1)))
    fixed = {**LENS, "gain": CAMERA["gain"], "read_noise": CAMERA["read_noise"]}
    found = calibrate.stray_light(rings, **TRUTH, **fixed).mean.numpy()
    b0, l, s = (TRUTH[name] for name in SHAPE)  # noqa: E741
    total = quad(
        lambda v: 2 * np.pi * b0 * (1 + np.exp(2 * v) / l**2) ** (s / 2) * np.exp(2 * v), -20, 0
    )[0]
    ring, weight, part = (x.numpy() for x in (rings.ring, rings.weight, rings.square))
    square = np.bincount(ring, weight * part) / np.bincount(ring, weight)
    radius = np.sqrt(square) * LENS["pixel_pitch"]
    fringe = LENS["wavelength"] * LENS["focal_length"] / LENS["diameter"]
    core = (1 - total) * fringe * LENS["pixel_pitch"] ** 2 / (np.pi**3 * radius**3)
    veil = (
        b0
        * (LENS["pixel_pitch"] / LENS["focal_length"]) ** 2
        * (1 + (radius / LENS["focal_length"] / l) ** 2) ** (s / 2)
    )
    # a ring is one pixel wide
    assert np.abs(found / (TRUTH["electrons"] * (core + veil)) - 1).max() < 3e-3


def test_coordinates_are_one_to_one_and_their_density_is_that_of_the_prior():
    coordinates = problem_of(rings_of(picture(TRUTH, np.random.default_rng(1)))).coordinates
    truth = {**TRUTH, "scatter": 0.005}
    place = coordinates.place(truth)
    back = coordinates.parameters(place)
    assert all(
        float(back[name]) == pytest.approx(truth[name], rel=1e-12) for name in coordinates.names
    )
    jacobian = torch.autograd.functional.jacobian(
        lambda x: coordinates.scaled(coordinates.parameters(x)), place
    )
    stretch = torch.linalg.det(jacobian).abs().log()
    flat = -0.5 * coordinates.whitened(back).square().sum()
    assert float(coordinates.log_prior(back)) == pytest.approx(float(flat + stretch), abs=1e-9)


@pytest.mark.slow
def test_a_lobe_within_the_saturated_pixels_gives_limits_and_no_value():
    narrow = {**TRUTH, "b0": 15.0 * 20**2.2, "l": 0.004 / 20, "s": -2.2}
    problem, mode = fitted(
        narrow, prior=WIDE | {"b0": (15.0 * 20**2.2, 30.0), "l": (2e-4, 10.0)}, size=256
    )
    found = told(problem, mode)
    assert (found.kinds["l"], found.kinds["b0"]) == ("upper", "lower")
    assert "b0 and l only as b0 l^(-s): l lies within the saturated pixels" in found.directions
    assert found.kinds["s"] == "estimate"


@pytest.mark.slow
def test_a_lobe_that_the_frame_shows_gives_values():
    problem, mode = fitted({**TRUTH, "b0": 60.0}, prior=WIDE, size=192)
    found = told(problem, mode)
    assert mode.settled
    assert [found.kinds[name] for name in SHAPE] == ["estimate"] * 3


def test_parameters_have_their_units():
    assert [unit_of(name, {}) for name in ("b0", "l", "s", "electrons")] == ["1/sr", "", "", "e-"]


@pytest.mark.parametrize(
    "count", [pytest.param(20, marks=pytest.mark.slow), pytest.param(200, marks=pytest.mark.long)]
)
def test_intervals_cover_the_truth(count, monkeypatch):
    """90 % intervals of b0, l and s, by the search that a user's run makes, from rings to interval.

    Each camera has a lens from the prior, pixels of 4 to 6.5 um, light of 10 to 40 nm and a source
    between pixels. Two statistics: how many intervals hold each truth, and the distance of all
    three from their mean, squared and in standard deviations, which shows wrong widths in few
    cameras. Each bar raises a false alarm once in 10,000.
    """
    monkeypatch.setattr(importance_sampling, "DRAWS", 600)
    held, distance = np.zeros(3), 0.0
    for seed in range(count):
        truth, draws, weight = estimated(seed)
        below = weight @ (draws < truth)
        held += (below >= 0.05) & (below <= 0.95)
        mean = weight @ draws
        spread = np.cov(draws.T, aweights=weight, ddof=0)
        distance += (truth - mean) @ np.linalg.solve(spread, truth - mean)
    assert (held >= binom.ppf(1e-4, count, 0.9)).all(), held
    assert (held <= binom.isf(1e-4, count, 0.9)).all(), held
    assert chi2.ppf(1e-4, 3 * count) < distance < chi2.isf(1e-4, 3 * count)


def estimated(seed):
    """Return ln b0, ln l and s of a drawn camera, and their weighted draws."""
    draw = np.random.default_rng([7, seed])
    truth = drawn_truth(draw)
    lens = {**LENS, "pixel_pitch": draw.uniform(4e-6, 6.5e-6)}
    centre = tuple(63.5 + draw.uniform(-0.5, 0.5, 2))
    frame = picture(truth, draw, centre=centre, lens=lens, band=draw.uniform(10e-9, 40e-9))
    problem = problem_of(rings_of(frame), lens=lens)
    return [np.log(truth["b0"]), np.log(truth["l"]), truth["s"]], *weighted(
        problem, find_mode(problem, initial_theta(problem)), seed
    )


#: by planted fault: the lens, further surfaces, and a prior that is wrong
FAULTS = {
    "none": ({"b0": 60.0}, (), {}),
    "two surfaces": ({"b0": 6000.0, "l": 0.001, "s": -3.0}, [(120.0, 0.006, -6.0, 1.0)], {}),
    "a wrong prior": ({"b0": 60.0}, (), {"s": (-1.0, 0.2)}),
}


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_what_one_surface_or_the_prior_cannot_explain_is_told(fault):
    lens, more, prior = FAULTS[fault]
    rings = rings_of(picture({**TRUTH, **lens}, np.random.default_rng(1), more=more))
    problem = problem_of(rings, {**recipe_prior(), **prior})
    law = importance_samples(problem, find_mode(problem, initial_theta(problem)), 1)
    trend, surprise = posterior_checks._of_rings(problem, law, law.guide)
    marks = {
        "none": ("pass", "pass"),
        "two surfaces": ("warn", "warn"),
        "a wrong prior": ("pass", "warn"),
    }
    assert (trend.mark, surprise.mark) == marks[fault], (trend, surprise)


@pytest.mark.slow
def test_chains_agree_with_weighted_draws(tmp_path):
    problem, mode = fitted({**TRUTH, "b0": 40.0}, seed=3)
    guide = draw_guide(problem, mode, np.random.default_rng(2))
    chains = emcee_sampler.sample(
        problem,
        mode,
        tmp_path / "draws.h5",
        emcee_sampler.Sampling(seed=1, walkers=32, effective_size=300),
        guide=guide,
    )
    draws, weight = weighted(problem, mode, 1)
    mean = weight @ draws
    sd = np.sqrt(weight @ (draws - mean) ** 2)
    chain = shape_of(problem, chains.flat)
    assert np.abs((chain.mean(0) - mean) / sd).max() < 0.25
    assert np.abs(chain.std(0) / sd - 1).max() < 0.2


def test_the_figure_of_the_rings_can_be_read():
    problem, mode = fitted({**TRUTH, "b0": 60.0, "electrons": 8e9}, size=192)
    levels = problem.levels
    assert len(levels.cut_square)
    look = problem.likelihood(mode.draw(40, np.random.default_rng(1)))
    given = (*ring_radii(levels), levels.mean.numpy(), look.mean.numpy(), look.variance.numpy())
    calibration_figures.rings(*given)  # the watch on figures reads what is written
    above = calibration_figures.rings.__wrapped__(*given).axes[0]
    assert "cut off" in above.get_legend_handles_labels()[1]
    assert float(ring_radii(levels)[1].max()) < float(ring_radii(levels)[0].min())
