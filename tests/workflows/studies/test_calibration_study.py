"""Simulation-based calibration: a right posterior passes, planted faults fail, and a study goes
on where it stopped.
"""

import json
import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from emcee.moves import DESnookerMove
from scipy.stats import binom
from typer.testing import CliRunner

from neusee.nodes.calibrate import _sensor_likelihood as _linear_sensor
from neusee.workflows.calibration import emcee_sampler
from neusee.workflows.calibration.log_posterior import SensorPosterior, find_mode, initial_theta
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies import calibration_study
from neusee.workflows.studies import posterior_tests as simulated_sensors
from neusee.workflows.studies.posterior_tests import (
    DRAWS,
    ENOUGH,
    PosteriorDraws,
    SensorSimulation,
    SensorSimulator,
    chance_band,
    coverage_limits,
    rank_tests,
    rank_truth,
    sensitivity,
    walk_draws,
    with_narrow_prior,
)
from neusee.workflows.studies.run_study import count_failures, study_recipe

pytestmark = pytest.mark.usefixtures("one_thread")

SEEN = ["sensor.gain=0.37 DN/e-"]  #: 9435 DN fill the well, and the converter goes on
DITHERED = [*SEEN, "reading.rounding=dithered_floor"]
OPEN = ["~levels.full", "~steps.prior.with.full_well"]  #: nothing is full
PIXELS = 64
COUNT = 10_000  #: draws that are weighed


def log_density(mode, samples):
    """Of the normal law about a mode, up to a constant."""
    off = samples - mode.theta
    return -0.5 * np.sum(off * np.linalg.solve(mode.covariance, off.T).T, axis=1)


def resampled(problem, mode, seed):
    """Draws about the peak, taken by what the posterior says of them: independent, and no walk.

    The law is a quarter wider than the posterior, in the full well, which has edges, half. As right
    as that is wide enough: it asks that twice as many draws are left as are taken.
    """
    rng = np.random.default_rng(seed)
    at = problem.names.index("full_well") if "full_well" in problem.names else None
    wider = np.where(np.arange(len(mode.theta)) == at, 1.5, 1.25)
    covariance = mode.covariance * wider * wider[:, None]
    law = replace(mode, covariance=covariance)
    drawn = law.draw(COUNT, rng)
    log = problem.log_posterior(drawn) - log_density(law, drawn)
    weights = np.exp(log - log.max())
    weights /= weights.sum()
    if 1 / (weights @ weights) < 2 * DRAWS:
        raise ValueError(f"only {1 / (weights @ weights):.0f} of {COUNT} draws are left")
    return PosteriorDraws(drawn[rng.choice(COUNT, DRAWS, replace=False, p=weights)])


def simulated(tmp_path, count, overrides, sampler=resampled, pixels=PIXELS):
    simulator = SensorSimulator(
        load("calibrate", overrides), Store(tmp_path / "store"), pixels, sampler, "test"
    )
    return simulator, [simulator.simulation(i) for i in range(count)]


def failing(simulations):
    return {v.name for v in rank_tests(simulations) if v.failed}


def forget_the_floor(monkeypatch):
    """As if dithered numbers were rounded to the nearest: mean m and variance v + 1/12."""
    monkeypatch.setitem(_linear_sensor.ROUNDED, "dithered_floor", _linear_sensor.ROUNDED["nearest"])


# --- the posterior is right -----------------------------------------------------------------------


@pytest.mark.slow
def test_a_right_posterior_passes(tmp_path):
    _, found = simulated(tmp_path, 60, [*DITHERED, *OPEN], pixels=128)
    assert not [s.refused for s in found if s.refused]
    assert not failing(found)


@pytest.mark.slow
def test_a_forgotten_floor_is_found(tmp_path, monkeypatch):
    forget_the_floor(monkeypatch)
    _, found = simulated(tmp_path, 60, [*DITHERED, *OPEN], pixels=128)
    assert {"offset", "read_noise"} <= failing(found)
    z = {v.name: v.z_mean for v in rank_tests(found)}
    assert z["offset"] < -0.7  # half a number too low
    assert z["read_noise"] > 0.7  # a twelfth of a number squared too much


@pytest.mark.slow
def test_a_dithered_well_passes(tmp_path):
    _, found = simulated(tmp_path, 60, DITHERED)
    assert not [s.refused for s in found if s.refused]
    assert not failing(found)


@pytest.mark.slow
def test_a_well_beyond_the_converter_ranks_uniformly(tmp_path):
    """Of it only the least is known: its posterior is the prior, cut off."""
    _, found = simulated(tmp_path, 60, [])
    assert not [s.refused for s in found if s.refused]
    lower = [s for s in found if s.kinds["full_well"] == "lower"]
    assert 20 < len(lower) < 60
    assert not failing(found)


@pytest.mark.slow
def test_walkers_pass(tmp_path):
    """A part of `bench_sbc.py`, which draws thousands of sensors.

    Draws of half of the right width fail in some of the six parameters always, of 0.6 of it with
    0.85; the 50 sensors of `test_many_walkers_pass` find more.
    """
    _, found = simulated(tmp_path, 20, SEEN, walk_draws, 64)
    assert not [s.refused for s in found if s.refused]
    assert not any(s.stranded or not s.independent for s in found)
    assert not failing(found)


@pytest.mark.long
def test_a_move_that_is_wrong_is_found(tmp_path, monkeypatch):
    """The snooker of emcee to 3.1.6, which `calibrate` refuses: its draws are too narrow in
    every direction.
    """
    monkeypatch.setitem(emcee_sampler._MOVES, "snooker", DESnookerMove)
    _, found = simulated(tmp_path, 80, SEEN, partial(walk_draws, move_name="snooker"), 128)
    assert len(failing(found)) >= 5


@pytest.mark.long
def test_many_walkers_pass(tmp_path):
    """Draws of 0.7 of the right width fail in some of the six parameters with 0.92."""
    _, found = simulated(tmp_path, 50, SEEN, walk_draws, 128)
    assert not [s.refused for s in found if s.refused]
    assert not any(s.stranded or not s.independent for s in found)
    assert not failing(found)


@pytest.mark.long
def test_walkers_pass_where_the_well_is_beyond_the_converter(tmp_path):
    """Weighed draws of such a well and walks where it is seen are tested above."""
    _, found = simulated(tmp_path, 40, [], walk_draws, 128)
    assert not [s.refused for s in found if s.refused]
    assert not any(s.stranded or not s.independent for s in found)
    assert not failing(found)


# --- bars -----------------------------------------------------------------------------------------


def test_many_parameters_together_raise_no_more_false_alarms_than_one():
    """One in a hundred studies of right posteriors, whatever the number of parameters."""
    rng, names, alarms, studies = np.random.default_rng(1), "abcdefghijkl", 0, 150
    for _ in range(studies):
        ranks = rng.integers(0, DRAWS + 1, (200, len(names))).tolist()
        same = dict.fromkeys(names, True), dict.fromkeys(names, 0.0)
        found = rank_tests(
            [SensorSimulation({}, dict(zip(names, row, strict=True)), *same) for row in ranks]
        )
        alarms += not all(verdict.uniform for verdict in found)
    assert alarms <= binom.ppf(0.999, studies, 0.01)


def uniform(count, width=1.0, shift=0.0, seed=0):
    """Simulations of a normal posterior whose draws are ``width`` as wide as they should be, and
    ``shift`` beside.
    """
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        truth, x = rng.normal(), shift + width * rng.normal(size=DRAWS)
        rank, z = int((x < truth).sum()), float((x.mean() - truth) / x.std())
        found.append(SensorSimulation({"a": truth}, {"a": rank}, {"a": 5 <= rank < 95}, {"a": z}))
    return found


@pytest.mark.parametrize("count", [60, 200, 1000])
def test_bars_let_right_draws_pass(count):
    assert sum(failing(uniform(count, seed=seed)) == {"a"} for seed in range(20)) <= 2


@pytest.mark.parametrize(
    ("count", "width", "shift"), [(200, 0.7, 0), (200, 1.5, 0), (200, 1, 0.5), (1000, 0.82, 0)]
)
def test_bars_find_draws_that_are_too_narrow_too_wide_or_beside(count, width, shift):
    for seed in range(5):
        (verdict,) = rank_tests(uniform(count, width, shift, seed))
        assert verdict.failed


def test_bars_are_those_of_chance():
    assert coverage_limits(200) == (0.825, 0.960)
    assert coverage_limits(1000) == (0.870, 0.930)
    assert coverage_limits(500) == pytest.approx((0.854, 0.942))
    for count in (200, 1000):
        low, high = (round(end * count) for end in coverage_limits(count))
        assert binom.cdf(high, count, 0.9) - binom.cdf(low - 1, count, 0.9) > 0.998
    assert chance_band(200, 0.1, 0.99) == (10, 32)


def test_ranks_count_from_none_to_all(tmp_path):
    simulator = SensorSimulator(load("calibrate", SEEN), Store(tmp_path), 16, resampled, "test")
    truth = simulator.truth(3)
    other = {
        name: x * torch.linspace(0.5, 1.0, DRAWS, dtype=torch.float64) for name, x in truth.items()
    }
    found = rank_truth(simulator.nominal, truth, PosteriorDraws(simulator.nominal.theta(other)))
    assert set(found.rank) == set(simulator.nominal.names)
    assert all(DRAWS - 1 <= rank <= DRAWS for rank in found.rank.values())
    assert not any(found.inside.values())
    assert all(z < -1 for z in found.z.values())


def test_without_any_posterior_there_is_no_verdict():
    with pytest.raises(
        ValueError, match="no simulation has a posterior; reason of the first simulation: too dark"
    ):
        rank_tests([SensorSimulation({"a": 1.0}, refused="too dark")])


# --- simulations ----------------------------------------------------------------------------------


def test_a_simulation_is_by_the_parameters_that_were_drawn(tmp_path):
    simulator = SensorSimulator(load("calibrate", SEEN), Store(tmp_path), 128, resampled, "test")
    truth = simulator.truth(5)
    levels = simulator.problem(truth, 5).levels
    assert truth["gain"] != pytest.approx(0.37, rel=1e-3)
    flat = truth["gain"] * (truth["offset"] + truth["quantum_efficiency"] * 9820)
    assert float(levels.mean[11]) == pytest.approx(flat, rel=1e-3)
    dark = truth["gain"] * truth["read_noise"]
    assert float(levels.variance[0]) ** 0.5 == pytest.approx(math.hypot(dark, 12**-0.5), rel=0.02)
    assert float(levels.cell_value[-1]) == round(truth["gain"] * truth["full_well"])
    assert not torch.equal(simulator.problem(truth, 6).levels.mean, levels.mean)
    same = simulator.problem(truth, 5)
    place = simulator.nominal.theta(truth)[None]
    assert same.log_posterior(place) == pytest.approx(
        simulator.problem(truth, 5).log_posterior(place), abs=0
    )
    assert (
        float(same.likelihood(place).log)
        > float(simulator.nominal.likelihood(place).log.nan_to_num(neginf=-1e30)) + 1e4
    )


def test_the_prior_is_no_wider_than_is_sensible():
    recipe = load("calibrate", ["steps.prior.with.gain=[0.37 DN/e-, 1.01]"])
    found = with_narrow_prior(recipe, {}).steps["prior"].params
    assert found["gain"] == (0.37, 1.01)
    assert found["offset"] == (390, 20)
    assert found["dark_current"][1] == pytest.approx(math.exp(0.5))
    assert found["spread"] is None


def test_what_simulates_nothing_cannot_be_studied(tmp_path):
    recipe = load("first_light")
    with pytest.raises(ValueError, match="simulates no frames"):
        SensorSimulator(recipe, Store(tmp_path), 16, resampled, "test")


def test_frames_that_tell_too_little_are_told(tmp_path):
    levels = {
        path.split(".")[1]
        for path in load("calibrate").config.settings
        if path.startswith("levels.")
    }
    other = "+levels.fuller={photons: 200000, exposure: 0.1 s}"
    overrides = [*SEEN, other, *(f"~levels.{name}" for name in sorted(levels - {"full"}))]
    with pytest.raises(ValueError, match="of 6 parameters cannot be determined"):
        rank_tests(simulated(tmp_path, 2, overrides)[1])


# --- the study ------------------------------------------------------------------------------------


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(calibration_study, "_WEIGHED", 100)


def studied(tmp_path, count=20, sampler=resampled, overrides=SEEN, store="store"):
    return study_recipe(
        "calibration",
        load("calibrate", ["flats.shape=[32, 32]", *overrides]),
        Store(tmp_path / store),
        tmp_path / "runs",
        simulations=count,
        pixels=32,
        sampler=sampler,
    )


@pytest.mark.slow
def test_a_study_has_a_page_and_goes_on(tmp_path, monkeypatch, quick):
    folder = studied(tmp_path)
    page, doc = (
        (folder / "report.html").read_text(),
        json.loads((folder / "provenance.json").read_text()),
    )
    assert count_failures(folder) == doc["failed"] == 0
    assert {v["name"] for v in doc["verdicts"]} == set(doc["widths"])
    assert doc["widths"]["gain"] == pytest.approx(0.1)
    assert all(
        text in page
        for text in (
            "Ranks of the truth",
            "Coverage",
            "Sensitivity to the prior",
            "All criteria hold",
        )
    )
    assert "http" not in page.replace("http://www.w3.org", "")
    assert (folder / "figures" / "ranks.png").stat().st_size > 10_000
    assert len((folder / "simulations.csv").read_text().splitlines()) == 1 + 20 * 6
    again = []
    monkeypatch.setattr(
        SensorSimulator,
        "_simulate",
        lambda self, seed: again.append(seed) or simulated_sensors.SensorSimulation({}),
    )
    second = studied(tmp_path)
    assert not again
    assert json.loads((second / "provenance.json").read_text())["verdicts"] == doc["verdicts"]


@pytest.mark.slow
def test_a_study_that_was_stopped_goes_on_with_the_same(tmp_path, monkeypatch):
    whole = [s.rank for s in simulated(tmp_path / "whole", 6, SEEN, pixels=32)[1]]
    real, done = SensorSimulator._simulate, []

    def stops(self, seed):
        if len(done) == 4:
            raise KeyboardInterrupt
        done.append(seed)
        return real(self, seed)

    monkeypatch.setattr(SensorSimulator, "_simulate", stops)
    with pytest.raises(KeyboardInterrupt):
        simulated(tmp_path, 6, SEEN, pixels=32)
    monkeypatch.setattr(
        SensorSimulator, "_simulate", lambda self, seed: done.append(seed) or real(self, seed)
    )
    assert [s.rank for s in simulated(tmp_path, 6, SEEN, pixels=32)[1]] == whole
    assert len(done) == len(set(done)) == 6


def test_another_prior_size_or_sampler_is_another_study(tmp_path, monkeypatch):
    simulated(tmp_path, 1, SEEN, pixels=32)
    made = []
    real = SensorSimulator._simulate
    monkeypatch.setattr(
        SensorSimulator, "_simulate", lambda self, seed: made.append(seed) or real(self, seed)
    )
    simulated(tmp_path, 1, SEEN, pixels=33)
    simulated(tmp_path, 1, [*SEEN, "steps.prior.with.gain=[0.37 DN/e-, 1.05]"], pixels=32)
    assert len(made) == 2
    SensorSimulator(
        load("calibrate", SEEN), Store(tmp_path / "store"), 32, resampled, "other"
    ).simulation(0)
    assert len(made) == 3


@pytest.mark.slow
def test_a_study_fails_where_draws_are_too_narrow(tmp_path, quick):
    def narrow(problem, mode, seed):
        drawn = resampled(problem, mode, seed)
        return PosteriorDraws(mode.theta + 0.5 * (drawn.samples - mode.theta))

    folder = studied(tmp_path, 20, narrow)
    assert count_failures(folder) >= 6
    assert "criteria do not hold" in (folder / "report.html").read_text()
    assert 'class="n fail"' in (folder / "report.html").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("fault", [{"independent": False}, {"stranded": 1}])
def test_a_study_fails_where_one_chain_is_bad(tmp_path, fault, quick):
    first = []

    def once(problem, mode, seed):
        drawn = resampled(problem, mode, seed)
        first.append(seed)
        return PosteriorDraws(drawn.samples, **fault) if len(first) == 1 else drawn

    assert count_failures(studied(tmp_path, 6, once)) == 1


@pytest.mark.slow
def test_the_command_ends_with_one_where_a_bar_fails(tmp_path, monkeypatch):
    from neusee.workflows.cli.app import app

    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path / "store"))
    monkeypatch.setattr(calibration_study, "PIXELS", 32)
    monkeypatch.setattr(calibration_study, "walk_draws", lambda *a, **how: resampled(*a[:3]))
    command = [
        "study",
        "calibration",
        "calibrate",
        *SEEN,
        "flats.shape=[32, 32]",
        "--out",
        str(tmp_path / "runs"),
    ]
    done = CliRunner().invoke(app, [*command, "--simulations", "20"])
    assert done.exit_code == 0, done.output
    assert "20 of 20 simulations" in done.output
    assert CliRunner().invoke(app, [*command, "--move", "snooker"]).exit_code == 2


# --- priors ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sensitive(tmp_path_factory):
    recipe = load("calibrate", ["flats.shape=[64, 64]"])
    problem = SensorPosterior.of(recipe, Store(tmp_path_factory.mktemp("store")))
    return problem, {name: float(recipe.steps["density"].params[name]) for name in problem.names}


def drawn_of(problem, truth, count=4000):
    mode = find_mode(problem, initial_theta(problem))
    rng = np.random.default_rng(0)
    drawn = mode.draw(4 * count, rng)
    log = problem.log_posterior(drawn) - log_density(mode, drawn)
    weights = np.exp(log - log.max())
    return drawn[rng.choice(len(drawn), count, p=weights / weights.sum())]


def test_a_prior_matters_where_the_frames_tell_little(sensitive):
    problem, truth = sensitive
    kinds = dict.fromkeys(problem.names, "estimate") | {"full_well": "lower"}
    found = sensitivity(problem, drawn_of(problem, truth), kinds)
    assert found.left["full_well"] < ENOUGH  # its posterior is the prior, cut off
    assert all(
        found.left[name] > 0.99 for name in ("gain", "offset", "read_noise", "quantum_efficiency")
    )
    for finding in found.findings:
        assert finding.doubled["full_well"] is None
        assert abs(finding.doubled["gain"] - finding.value) < 0.05 * finding.sd


def test_weighing_anew_gives_what_a_wider_prior_gives(sensitive, tmp_path):
    """Of the dark current, of which frames and prior each tell a part."""
    problem, truth = sensitive
    kinds = dict.fromkeys(problem.names, "estimate")
    found = {f.name: f for f in sensitivity(problem, drawn_of(problem, truth), kinds).findings}[
        "dark_current"
    ]
    wide = ["flats.shape=[64, 64]", "steps.prior.with.dark_current=[0.002 e-, 100]"]  # 10 squared
    other = SensorPosterior.of(load("calibrate", wide), Store(tmp_path))
    direct = other.parameters(drawn_of(other, truth))["dark_current"]
    moved = float(direct.mean()) - found.value
    assert abs(moved) > 2 * float(direct.std()) / 4000**0.5
    assert found.doubled["dark_current"] == pytest.approx(float(direct.mean()), abs=0.1 * found.sd)
