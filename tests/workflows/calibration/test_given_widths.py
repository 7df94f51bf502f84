"""The density that guides the walkers of a real camera, a wrong guide, and a wrong model of well
or converter.
"""

import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import multivariate_t

from neusee.workflows.calibration import emcee_sampler
from neusee.workflows.calibration.camera_density import GivenWidths
from neusee.workflows.calibration.identifiability import identify
from neusee.workflows.calibration.importance_sampling import draw_guide
from neusee.workflows.calibration.log_posterior import SensorPosterior, search_mode
from neusee.workflows.calibration.posterior_checks import checks, importance_samples
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.result_store import Store

_spec = importlib.util.spec_from_file_location(
    "plain", Path(__file__).parents[2] / "benchmarks" / "plain_camera.py"
)
plain = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(plain)
pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def camera(tmp_path_factory):
    problem = SensorPosterior.of(load("calibrate_camera"), Store(tmp_path_factory.mktemp("store")))
    return problem, search_mode(problem)


def test_the_density_given_the_widths_is_that_of_another_library(camera):
    others = GivenWidths(*camera)
    widths = camera[1].theta[others.at] + np.array([[0.0, 0.0, 0.0], [1.0, -0.5, 1.5]])
    step, root = others.law(widths)
    samples = others.draw(widths, (step, root), np.random.default_rng(1))
    off = []
    for i in range(2):
        law = multivariate_t(step[i], np.linalg.inv(root[i] @ root[i].T), df=20)
        z = (samples[i, ~others.at] - others.theta[~others.at]) / others.unit
        off.append(law.logpdf(z) - others.log_density(samples[[i]], (step[[i]], root[[i]]))[0])
    # what `Mixture` leaves out as well, so that a mixture of both is one density; and the units of
    # the coordinates
    constant = np.log(np.abs(others.unit)).sum() - 0.5 * len(others.unit) * np.log(np.pi)
    assert off == pytest.approx([constant, constant], abs=1e-9)


@pytest.mark.parametrize("change", [(0.0, 0.0, 0.0), (1.0, 0.3, 2.0), (-2.0, -0.3, -2.0)])
def test_all_other_parameters_are_drawn_as_the_widths_imply(camera, change):
    """Far from the mode of the widths too, weights of the posterior hardly differ: with a wide
    drift, and with none.
    """
    problem, mode = camera
    others = GivenWidths(problem, mode)
    widths = np.repeat(mode.theta[None, others.at] + change, 1000, 0)
    law = others.law(widths)
    samples = others.draw(widths, law, np.random.default_rng(1))
    log = problem.log_posterior(samples) - others.log_density(samples, law)
    weight = np.exp(log - log.max())
    assert weight.sum() ** 2 / (weight**2).sum() > 600


def test_a_proposal_has_the_ratio_of_its_densities(camera):
    guide = draw_guide(*camera, np.random.default_rng(1))
    own = guide.samples[:8]
    drawn, ratio = guide.density.propose(own, np.random.default_rng(2))
    expected = guide.density.log_density(own) - guide.density.log_density(drawn)
    assert ratio == pytest.approx(expected, abs=1e-9)
    weight = np.exp(guide.log - guide.log.max())
    assert weight.sum() ** 2 / (weight**2).sum() > 0.75 * len(weight)


@pytest.mark.slow
def test_walkers_whose_guide_gives_a_wrong_ratio_fail_the_checks(camera, tmp_path, monkeypatch):
    """The factor of Metropolis and Hastings left out: R-hat, tau and effective size all look
    right.
    """
    problem, mode = camera
    law = importance_samples(problem, mode, 1)
    right = law.guide.density

    class Wrong:
        def propose(self, own, rng):
            drawn, ratio = right.propose(own, rng)
            return drawn, 0 * ratio

    monkeypatch.setattr(emcee_sampler, "_FIRST_STEPS", 150)
    monkeypatch.setattr(emcee_sampler, "_MOST_STEPS", 150)
    name, told = "importance sampling agrees with the chains", identify(problem, mode)
    for density, mark in ((right, "pass"), (Wrong(), "fail")):
        guide = law.guide._replace(density=density)
        chains = emcee_sampler.sample(
            problem, mode, tmp_path / f"{mark}.h5", emcee_sampler.Sampling(seed=1), guide=guide
        )
        found = {
            c.name: c.mark for c in checks(problem, mode, told, replace(chains, long=True), law)
        }
        assert found[name] == mark
        assert found["ensembles agree"] == "pass"


# --- the well before the read noise, and numbers that are cut -------------------------------------


def pixels_alike(folder, camera, *changes):
    recipe = plain.frames_recipe(camera, 1, folder, size=48, lit=10, darks=3)
    return SensorPosterior.of(load(str(recipe), list(changes)), Store(folder / "store"))


def of_mode(problem):
    mode = search_mode(problem)
    return {name: float(x) for name, x in problem.parameters(mode.theta).items()}, mode


@pytest.mark.slow
def test_a_well_before_the_read_noise_is_refused_in_a_sentence_and_described_without_its_saturated_levels(
    tmp_path,
):
    """Before, the search stopped at a gain of 18 DN/e-, and walkers walked from there."""
    camera = plain.PlainCamera(well=9000.0)
    with pytest.raises(
        ValueError, match=r"none of \d+ searches ends at a mode .* set share: 0.7 in the step of"
    ):
        search_mode(pixels_alike(tmp_path, camera))
    problem = pixels_alike(tmp_path, camera, "steps.sufficient.with.share=0.7")
    found, mode = of_mode(problem)
    assert found["gain"] == pytest.approx(0.25, rel=0.04)
    assert found["read_noise"] == pytest.approx(12, rel=0.04)
    assert identify(problem, mode).kinds["full_well"] == "lower"


def test_a_well_at_the_edge_of_what_a_number_allows_is_a_mode(tmp_path):
    """A number of the highest level needs a well above 4094.5 DN; the search stopped beside the
    mode, five times.

    All coordinates but the well climb as a normal distribution does in which the well is known.
    """
    camera = plain.PlainCamera(
        gain=0.28060026336017463,
        quantum_efficiency=0.4869228126458359,
        temporal_dark_noise=12.654416007552552,
        dark_current=40.76179425444259,
        dark_signal=0.28060026336017463 * 228.42966898792622,
        full=14880.76151056754 - 228.42966898792622,
        first=0.0,
    )
    recipe = plain.frames_recipe(camera, [46, 2], tmp_path, size=48, lit=10, darks=4)
    priors = {
        "gain": "[0.25 DN/e-, 1.1]",
        "offset": "[240 e-, 20 e-]",
        "read_noise": "[12 e-, 1.1]",
        "dark_current": "[40 e-, 1.5]",
        "full_well": "[14000 e-, 1.05]",
        "quantum_efficiency": "[0.5, 1.05]",
    }
    changes = [f"steps.prior.with.{name}={prior}" for name, prior in priors.items()]
    problem = SensorPosterior.of(load(str(recipe), changes), Store(tmp_path / "store"))
    mode = search_mode(problem)
    assert mode.settled
    at = problem.names.index("full_well")
    nearby = mode.theta + 1e-2 * np.sqrt(mode.covariance.diagonal()) * np.eye(6) * np.array(
        [[[1]], [[-1]]]
    )
    assert (problem.log_posterior(nearby.reshape(-1, 6)) < mode.log).all()
    assert problem.log_posterior(mode.theta[None] - 1e-4 * np.eye(6)[[at]]) == -np.inf


@pytest.mark.slow
def test_hot_pixels_do_not_end_the_search(tmp_path):
    """A coarse dark level had a variance of 0 between its ends, and the search ended with `SVD
    did not converge`.
    """
    stacks = []

    class Hot(plain.PlainCamera):
        def frames(self, rng, photons, exposure, size=96, count=2):
            stack = super().frames(rng, photons, exposure, size, count)
            if photons == 0 and exposure > 0.03:
                stack = np.clip(stack, 56, 64)
                stack[:, 0, :30], stack[0, 1, 0] = 65, 55
                stacks.append(stack)
            return stack

    found, _ = of_mode(pixels_alike(tmp_path, Hot(temporal_dark_noise=4.2)))
    assert stacks
    assert found["gain"] == pytest.approx(0.25, rel=0.1)


def test_a_converter_that_cuts_is_calibrated_right_and_the_wrong_choice_moves_the_offset_alone(
    tmp_path,
):
    camera = plain.PlainCamera(truncates=True)
    right, mode = of_mode(pixels_alike(tmp_path, camera, "rounding=truncation"))
    wrong, _ = of_mode(pixels_alike(tmp_path, camera, "rounding=nearest"))
    # 1.7 e- follow from 1 % of the gain
    assert right["offset"] == pytest.approx(240.0, abs=4 * 1.7)
    assert 0.25 * (right["offset"] - wrong["offset"]) == pytest.approx(0.5, abs=0.02)
    for name in ("gain", "read_noise", "quantum_efficiency", "dark_current"):
        at = list(right).index(name)
        sd = right[name] * float(mode.covariance[at, at]) ** 0.5
        assert abs(wrong[name] - right[name]) < 0.1 * sd, name


GUESSES = {
    "calibrate_camera": (["camera.gain=2.5 DN/e-"], ["camera.gain=0.025 DN/e-"], ["camera.temporal_dark_noise=60 e-"],
                         ["camera.temporal_dark_noise=2.4 e-", "camera.lamp=0.5", "camera.drift=1"]),
    "calibrate": ([f"steps.{step}.with.{name}={value}" for step, name, value in (
        ("prior", "gain", "[27 DN/e-, 10]"), ("density", "gain", "27 DN/e-"), ("prior", "full_well", "[500000 e-, 10]"),
        ("density", "full_well", "500000 e-"), ("prior", "read_noise", "[52 e-, 5]"),
        ("density", "read_noise", "52 e-"))],),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("recipe", GUESSES)
def test_bad_guesses_of_the_recipe_end_at_the_same_mode(recipe, tmp_path):
    """Gain off tenfold, noise fivefold, a well of which nothing is known."""
    small = ["flats.shape=[64, 64]"] if recipe == "calibrate" else []
    right, mode = of_mode(SensorPosterior.of(load(recipe, small), Store(tmp_path / "store")))
    sd = dict(zip(right, mode.covariance.diagonal() ** 0.5, strict=True))
    for guess in GUESSES[recipe]:
        found, _ = of_mode(
            SensorPosterior.of(load(recipe, [*small, *guess]), Store(tmp_path / "store"))
        )
        for name in ("gain", "quantum_efficiency"):
            assert abs(np.log(found[name] / right[name])) < 0.3 * sd[name], (guess, name)
