"""Frames that tell too little, or of sensors far from the usual: what is said before and after
anything is drawn.
"""

import math

import numpy as np
import pytest
import torch

from neusee.workflows.calibration import emcee_sampler
from neusee.workflows.calibration.identifiability import identify
from neusee.workflows.calibration.log_posterior import (
    LaplaceFit,
    SensorPosterior,
    find_mode,
    initial_theta,
)
from neusee.workflows.keys.cache_key import stream_seed
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.posterior_tests import SensorSimulator, walk_draws

pytestmark = pytest.mark.usefixtures("one_thread")

SEEN = ["flats.shape=[64, 64]", "sensor.gain=0.37 DN/e-"]
PHOTONS = {  #: by level
    path.split(".")[1]: setting.value
    for path, setting in load("calibrate").config.settings.items()
    if path.startswith("levels.") and path.endswith(".photons")
}
LONG = ("dark_1s", "dark_3s", "dark_10s")


def only(*levels):
    return [f"~levels.{name}" for name in PHOTONS if name not in levels]


@pytest.fixture
def fitted(tmp_path):
    """Problem, truth, peak and what is known, of the packaged calibration with overrides."""

    def fitted(*overrides):
        recipe = load("calibrate", [*SEEN, *overrides])
        problem = SensorPosterior.of(recipe, Store(tmp_path / "store"))
        truth = {name: float(recipe.steps["density"].params[name]) for name in problem.names}
        mode = find_mode(problem, initial_theta(problem))
        return problem, truth, mode, identify(problem, mode)

    return fitted


def away(problem, truth, mode):
    """How far the truth lies from the peak, in standard deviations of the normal law."""
    off = problem.theta(truth) - mode.theta
    return math.sqrt(max(0.0, off @ np.linalg.solve(mode.covariance, off)))


def test_short_darks_alone_give_an_upper_limit_of_the_dark_current(fitted):
    problem, truth, mode, told = fitted(*(f"~levels.{name}" for name in LONG))
    assert not told.refused
    assert told.kinds == dict.fromkeys(problem.names, "estimate") | {"dark_current": "upper"}
    assert sum(s < 3 for s in told.strengths) == 1
    assert told.directions == [
        "dark current: only an upper limit: no dark was exposed for long enough"
    ]
    drawn = walk_draws(problem, mode, 1).samples
    limit = float(np.quantile(problem.parameters(drawn)["dark_current"].numpy(), 0.95))
    assert truth["dark_current"] < limit < 100 * truth["dark_current"]


def test_saturated_frames_alone_are_refused(fitted):
    _, _, _, told = fitted(*only("full"), "+levels.fuller={photons: 200000, exposure: 0.1 s}")
    assert told.refused.startswith("5 of 6 parameters cannot be determined from these frames")
    assert not told.estimated
    assert sum(s < 3 for s in told.strengths) == 5
    assert told.strengths[0] > 1000  # the one number that is known: the well in DN


def test_one_flat_and_its_repetition_are_refused(fitted):
    _, _, _, told = fitted(*only("flat_1375"), "+levels.again={photons: 1375, exposure: 0.1 s}")
    assert told.refused.startswith("4 of 6 parameters")
    assert len(told.directions) == 4
    assert not told.estimated


def test_a_single_level_is_refused_in_words(fitted):
    _, _, _, told = fitted(*only("flat_1375"))
    assert told.refused.startswith("4 of 6 parameters")


def test_one_flat_and_one_dark_list_what_they_leave_open(fitted):
    _, _, _, told = fitted(*only("flat_1375", "dark_100ms"))
    assert set(told.directions) == {
        "full well: not from these frames",
        "dark current: only an upper limit: no dark was exposed for long enough",
    }
    assert not {"full_well", "dark_current"} & set(told.estimated)


RIDGE = "+steps.prior.with.spread=[1, 2]"  #: the noise of the light is not that of counting


def test_a_free_fano_factor_is_one_direction_that_frames_do_not_know(fitted):
    problem, truth, mode, told = fitted(RIDGE)
    assert [s < 3 for s in told.strengths] == [False] * 5 + [True] * 2
    assert told.strengths[-1] < 0.1
    assert (
        told.directions[0]
        == "dark current: not from these frames: no value in electrons without the gain"
    )
    said = told.directions[1]
    assert "only together" in said
    assert all(
        word in said for word in ("gain", "offset", "read noise", "full well", "quantum efficiency")
    )
    both = mode.covariance.diagonal() ** 0.5
    # the slope of the photon-transfer curve itself is known
    assert both[problem.names.index("gain")] < 0.1
    assert away(problem, truth, mode) < 5


def test_no_member_of_a_ridge_is_estimated(fitted):
    _, _, _, told = fitted(RIDGE)
    assert not told.estimated


def test_the_sentence_of_a_ridge_names_the_spread(fitted):
    _, _, _, told = fitted(RIDGE)
    assert "spread" in told.directions[1]


def test_the_sentence_of_a_ridge_ends(fitted):
    _, _, _, told = fitted(RIDGE)
    assert not [said for said in told.directions if said.rstrip().endswith("with")]


QUIET = ("sensor.read_noise=0.05 e-", "sensor.dark_current=0.2 e-")  #: 0.02 DN


def test_frames_too_coarse_for_the_read_noise_are_counted_number_by_number(fitted):
    problem, _, _, told = fitted(*QUIET)
    short = (problem.levels.photons == 0) & (problem.levels.exposure == 0.1)
    assert problem.levels.pixels[short].tolist() == [0]
    assert 1 <= int((problem.levels.cell_level == 0).sum()) <= 3
    assert told.kinds["read_noise"] != "estimate"


@pytest.mark.slow
def test_a_coarse_read_noise_lies_within_its_interval(fitted):
    problem, truth, mode, _ = fitted(*QUIET)
    found = problem.parameters(walk_draws(problem, mode, 1).samples)
    for name in ("read_noise", "gain", "offset", "dark_current"):
        low, high = np.quantile(found[name].numpy(), [0.005, 0.995])
        assert low < truth[name] < high, name


@pytest.mark.slow
def test_a_read_noise_below_the_numbers_is_an_upper_limit(fitted):
    """Of a dark current that leaves an electron in a pixel of twenty, numbers tell even so:
    electrons are counted.
    """
    problem, truth, mode, told = fitted(QUIET[0])
    assert told.kinds["read_noise"] == "upper"
    assert "read noise: only an upper limit: the converter is too coarse for it" in told.directions
    draws = problem.parameters(walk_draws(problem, mode, 1).samples)["read_noise"].numpy()
    assert truth["read_noise"] < np.quantile(draws, 0.95) < 1


def test_the_law_is_not_fooled_by_numbers_that_do_not_scatter(fitted, tmp_path):
    """By mean and variance alone the read noise would be 3 sigma off: one twelfth does not hold
    there.
    """
    problem, truth, _, _ = fitted(*QUIET)
    found = problem.likelihood(problem.theta(truth)[None])
    assert float(found.deviance.sum()) < float(found.degrees_of_freedom.sum()) + 5 * math.sqrt(
        2 * float(found.degrees_of_freedom.sum())
    )
    noisier = {**truth, "read_noise": 0.5}
    assert float(problem.likelihood(problem.theta(noisier)[None]).log) < float(found.log) - 20


# --- where walkers start --------------------------------------------------------------------------


def starts(problem, mode, tmp_path):
    runs = [
        emcee_sampler.start_ensemble(
            problem, mode, tmp_path / "none.h5", i, emcee_sampler.Sampling(1, 64, "de")
        )
        for i in range(4)
    ]
    return np.concatenate([run.initial_theta for run in runs])


def test_walkers_start_by_the_law_about_the_peak_never_by_the_prior(fitted, tmp_path):
    problem, _, mode, _ = fitted(
        "~levels.full", "~steps.prior.with.full_well", "sensor.dark_current=0.2 e-"
    )
    found = starts(problem, mode, tmp_path)
    assert len(np.unique(found, axis=0)) == 256
    z = (found - mode.theta) @ np.linalg.inv(np.linalg.cholesky(mode.covariance)).T
    assert np.abs(z.mean(0)).max() < 5 / 256**0.5
    assert np.abs(np.cov(z.T) - np.eye(len(problem.names))).max() < 0.4
    prior = problem.whitened(
        problem.theta(problem.coordinates.draw(256, torch.Generator().manual_seed(0)))
    )
    assert problem.whitened(found).std(0).max() < 0.1 * prior.std(0).min()
    assert (problem.log_posterior(found) > mode.log - 30).all()
    bad = problem.log_posterior(
        problem.theta(problem.coordinates.draw(256, torch.Generator().manual_seed(0)))
    )
    assert np.median(bad) < mode.log - 1e4


def test_walkers_start_within_the_number_of_the_full_well(fitted, tmp_path):
    problem, _, mode, _ = fitted()
    assert (problem.log_posterior(starts(problem, mode, tmp_path)) > mode.log - 50).all()


# --- the edge of the well -------------------------------------------------------------------------


def test_numbers_at_the_end_of_the_converter_do_not_show_the_well(fitted):
    _, _, _, told = fitted("sensor.gain=0.31 e-/DN", "sensor.full_well=30000 e-")
    assert told.kinds["full_well"] == "lower"


def test_coarse_darks_do_not_show_the_well(fitted):
    _, _, _, told = fitted("~levels.full", "sensor.read_noise=1 e-", "sensor.dark_current=0.2 e-")
    assert told.kinds["full_well"] == "lower"


def test_the_search_does_not_end_at_the_edge_of_the_wells_number(tmp_path):
    """A gain of 1 % beside the truth is 20 standard deviations; a half number of the well is
    two.
    """
    simulator = SensorSimulator(load("calibrate", SEEN), Store(tmp_path), 128, walk_draws, "")
    seed = stream_seed(simulator.recipe.seed, "calibration study 22")
    truth = simulator.truth(seed)
    problem = simulator.problem(truth, seed)
    z = problem.whitened(problem.theta(truth)) + 0.1 * np.random.default_rng(
        [seed, 1]
    ).standard_normal(6)
    theta = problem.theta(problem.coordinates.from_whitened(torch.from_numpy(z)))
    theta[4] = math.log(float(problem.levels.cell_value[0]))
    assert find_mode(problem, theta).log > problem.log_posterior(problem.theta(truth)[None])[0] - 1


# --- eight decades --------------------------------------------------------------------------------


def scaled(by, unit="DN/e-"):
    """All electrons and photons ``by`` times as many, so that numbers stay what they are.

    Not fewer: of a handful of electrons a level is no Gaussian.
    """
    names = {"full_well": 25500, "read_noise": 10.5, "offset": 390, "dark_current": 0.2}
    levels = [f"levels.{name}.photons={photons * by!r}" for name, photons in PHOTONS.items()]
    sensor = [f"sensor.{name}={value * by!r} e-" for name, value in names.items()]
    gain = 0.37 / by if unit == "DN/e-" else by / 0.37
    return [
        *levels,
        *sensor,
        f"sensor.gain={gain!r} {unit}",
        f"steps.prior.with.offset=[{390 * by!r} e-, {100 * by!r} e-]",
    ]


@pytest.mark.parametrize("unit", ["DN/e-", "e-/DN"])
@pytest.mark.parametrize("decades", [0, 2, 4])
def test_peak_and_limits_do_not_care_for_the_unit(fitted, decades, unit):
    """Gains from 4e-5 to 3e4, wells to 3e8."""
    problem, truth, mode, told = fitted(*scaled(10.0**decades, unit))
    assert mode.settled
    assert not told.refused
    assert away(problem, truth, mode) < 5.5
    assert told.kinds["full_well"] in ("estimate", "none")
    assert np.isfinite(mode.covariance).all()
    assert bool(
        (
            np.linalg.eigvalsh(mode.covariance / np.outer(*[mode.covariance.diagonal() ** 0.5] * 2))
            > 0
        ).all()
    )


@pytest.mark.parametrize("decades", [-4, 4])
def test_places_are_the_same_in_another_unit_but_for_what_an_electron_and_a_photon_are(
    tmp_path, decades
):
    samples = []
    for d in (0, decades):
        recipe = load("calibrate", [*SEEN, *scaled(10.0**d)])
        problem = SensorPosterior.of(recipe, Store(tmp_path))
        samples.append(
            problem.theta(
                {name: float(recipe.steps["density"].params[name]) for name in problem.names}
            )
        )
    moved = dict(zip(problem.names, samples[1] - samples[0], strict=True))
    step = -decades * math.log(10)
    assert moved == pytest.approx(
        dict.fromkeys(moved, 0.0) | {"gain": step, "quantum_efficiency": step}, abs=1e-9
    )


def test_a_peak_is_a_normal_law():
    covariance = np.array([[1.0, 0.999], [0.999, 1.0]])
    mode = LaplaceFit(np.zeros(2), 0.0, covariance, np.eye(2), np.ones(2), True)
    drawn = mode.draw(20_000, np.random.default_rng(0))
    assert np.cov(drawn.T) == pytest.approx(covariance, abs=0.03)
