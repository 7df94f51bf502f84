"""The posterior of a sensor: its peak, what is not told, draws that go on to the last bit,
checks that can fail.
"""

import importlib
import json
from dataclasses import replace

import emcee
import numpy as np
import pytest

from neusee.workflows.calibration import emcee_sampler
from neusee.workflows.calibration.identifiability import identify
from neusee.workflows.calibration.log_posterior import SensorPosterior, find_mode, initial_theta
from neusee.workflows.calibration.posterior_checks import checks, importance_samples
from neusee.workflows.cli import app
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.result_store import Store

SMALL = "flats.shape=[64, 64]"
SEEN = "sensor.gain=0.37 DN/e-"  # the well ends before the converter


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return Store(tmp_path_factory.mktemp("cache"))


def problem(store, *words):
    return SensorPosterior.of(load("calibrate", [SMALL, *words]), store)


def mode(found):
    return find_mode(found, initial_theta(found))


@pytest.mark.parametrize(
    "words", [(), (SEEN,), ("reading=as_printed",), (SEEN, "sensor.read_noise=2 e-")]
)
def test_the_peak_is_where_the_frames_were_made(store, words):
    p = problem(store, *words)
    best, params = mode(p), p.recipe.steps[p.step].params
    assert best.settled
    truth = p.theta({name: params[name] for name in p.names})
    sd = np.sqrt(best.covariance.diagonal())
    told = [i for i, name in enumerate(p.names) if identify(p, best).kinds[name] == "estimate"]
    assert len(told) >= 4
    assert np.all(np.abs(best.theta - truth)[told] < 5 * np.maximum(sd, 1e-12)[told])
    assert best.log >= float(p.log_posterior(truth[None])[0])


@pytest.mark.slow
def test_the_width_at_the_peak_is_that_of_the_posterior(store):
    p = problem(store, "reading=as_printed")
    law = importance_samples(p, mode(p), 1)
    assert law.tail < 0.7
    # hardly told from 0, so that its logarithm has a long lower tail
    dark = p.names.index("dark_current")
    peak, whole = np.sqrt(mode(p).covariance.diagonal()), law.sd()
    np.testing.assert_allclose(np.delete(peak, dark), np.delete(whole, dark), rtol=0.15)
    assert 1.1 < whole[dark] / peak[dark] < 2.0


def test_what_no_frame_tells_is_said_in_words(store):
    p = problem(store)
    told = identify(p, mode(p))
    assert told.kinds["full_well"] == "lower"
    well = "full well: only a lower limit: no frame is saturated by the well"
    # for so few pixels
    dark = "dark current: only an upper limit: no dark was exposed for long enough"
    assert sorted(told.directions) == [dark, well]
    assert told.estimated == ("gain", "offset", "read_noise", "quantum_efficiency")
    seen = problem(store, SEEN)
    assert list(identify(seen, mode(seen)).directions) == [dark]


def test_the_snooker_is_refused_by_name():
    with pytest.raises(ValueError, match="18 % too narrow"):
        emcee_sampler.move("DESnookerMove")
    with pytest.raises(ValueError, match="unknown move"):
        emcee_sampler.move("walk")


class Stop(Exception):
    pass


def test_what_is_stopped_goes_on_to_the_last_bit(store, tmp_path, monkeypatch):
    monkeypatch.setattr(emcee_sampler, "_FIRST_STEPS", 20)
    monkeypatch.setattr(emcee_sampler, "_MOST_STEPS", 40)
    p = problem(store, SEEN)
    best, lines = mode(p), []

    def stop(line):
        lines.append(line)
        if len(lines) == 2:
            raise Stop

    whole = emcee_sampler.sample(
        p, best, tmp_path / "whole.h5", emcee_sampler.Sampling(seed=3, walkers=16)
    )
    with pytest.raises(Stop):
        emcee_sampler.sample(
            p, best, tmp_path / "cut.h5", emcee_sampler.Sampling(seed=3, walkers=16), progress=stop
        )
    kept = emcee.backends.HDFBackend(str(tmp_path / "cut.h5"), name="ensemble3", read_only=True)
    assert 20 < kept.iteration < 40
    again = emcee_sampler.sample(
        p, best, tmp_path / "cut.h5", emcee_sampler.Sampling(seed=3, walkers=16)
    )
    assert np.array_equal(whole.draws, again.draws)
    assert np.array_equal(whole.log, again.log)
    other = emcee_sampler.sample(
        p, best, tmp_path / "other.h5", emcee_sampler.Sampling(seed=4, walkers=16)
    )
    assert not np.array_equal(whole.draws, other.draws)
    assert not list(tmp_path.glob("*.part"))


def test_what_has_ended_draws_nothing_more(store, tmp_path, monkeypatch):
    """It ended because tau had settled since the round before, which is not seen of the last
    round alone.
    """
    for name, value in {
        "_FIRST_STEPS": 40,
        "_LEAST_TAUS": 0.0,
        "_DISCARDED_TAUS": 0.0,
        "_SURE_TAUS": 1e9,
        "_SETTLED_CHANGE": 0.2,
    }.items():
        monkeypatch.setattr(emcee_sampler, name, value)
    p = problem(store, SEEN)
    best = mode(p)
    first = emcee_sampler.sample(
        p, best, tmp_path / "c.h5", emcee_sampler.Sampling(seed=3, walkers=16, effective_size=1)
    )
    assert first.long
    monkeypatch.setattr(emcee.moves.DEMove, "get_proposal", None)
    again = emcee_sampler.sample(
        p, best, tmp_path / "c.h5", emcee_sampler.Sampling(seed=3, walkers=16, effective_size=1)
    )
    assert again.long
    assert again.steps == first.steps
    assert np.array_equal(again.draws, first.draws)


def test_draws_that_cannot_be_kept_are_drawn_and_said(store, tmp_path, monkeypatch):
    monkeypatch.setattr(emcee_sampler, "_FIRST_STEPS", 20)
    monkeypatch.setattr(emcee_sampler, "_MOST_STEPS", 20)
    (tmp_path / "file").write_text("no folder")
    p, said = problem(store, SEEN), []
    best = mode(p)
    found = emcee_sampler.sample(
        p,
        best,
        tmp_path / "file" / "c.h5",
        emcee_sampler.Sampling(seed=3, walkers=16),
        progress=said.append,
    )
    kept = emcee_sampler.sample(
        p, best, tmp_path / "c.h5", emcee_sampler.Sampling(seed=3, walkers=16)
    )
    assert np.array_equal(found.draws, kept.draws)
    assert sum("an interruption would lose them" in line for line in said) == 1


def test_a_damaged_file_of_draws_is_drawn_anew(store, tmp_path, monkeypatch):
    monkeypatch.setattr(emcee_sampler, "_FIRST_STEPS", 20)
    monkeypatch.setattr(emcee_sampler, "_MOST_STEPS", 20)
    p = problem(store, SEEN)
    best = mode(p)
    first = emcee_sampler.sample(
        p, best, tmp_path / "c.h5", emcee_sampler.Sampling(seed=3, walkers=16)
    )
    (tmp_path / "c.h5").write_bytes((tmp_path / "c.h5").read_bytes()[:3000])
    assert np.array_equal(
        emcee_sampler.sample(
            p, best, tmp_path / "c.h5", emcee_sampler.Sampling(seed=3, walkers=16)
        ).draws,
        first.draws,
    )


@pytest.fixture(scope="module")
def drawn(store, tmp_path_factory):
    """Enough draws for checks, not for a result."""
    p = problem(store, SEEN)
    best = mode(p)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(emcee_sampler, "_FIRST_STEPS", 400)
        patch.setattr(emcee_sampler, "_MOST_STEPS", 400)
        chains = emcee_sampler.sample(
            p, best, tmp_path_factory.mktemp("draws") / "c.h5", emcee_sampler.Sampling(seed=3)
        )
    return p, best, identify(p, best), replace(chains, long=True)


def marks(drawn, **changes):
    p, best, told, chains = drawn
    found = checks(p, best, told, replace(chains, **changes), importance_samples(p, best, 1))
    return {check.name: check.mark for check in found}


@pytest.mark.slow
def test_good_draws_pass_and_each_fault_is_found(drawn):
    good = marks(drawn)
    assert set(good.values()) <= {"pass", "warn"}
    chains = drawn[3]
    assert marks(drawn, long=False)["chains are long enough"] == "fail"
    shifted = chains.draws.copy()
    shifted[0] += 0.5 * chains.flat.std(0)
    assert marks(drawn, draws=shifted)["ensembles agree"] == "fail"
    log = chains.log.copy()
    log[1, :, 5] -= 100.0
    lost = replace(chains, log=log)
    assert emcee_sampler.stranded(lost.log) == 1
    assert marks(drawn, log=log)["no walker is stranded"] == "fail"
    assert marks(drawn, log=chains.log - 10.0)["the best draw is near the mode"] == "fail"
    assert marks(drawn, draws=chains.draws[:, :20])["draws are numerous enough"] == "fail"
    narrow = chains.flat.mean(0) + 0.8 * (chains.draws - chains.flat.mean(0))
    assert marks(drawn, draws=narrow)["importance sampling agrees with the chains"] in (
        "fail",
        "warn",
    )


def test_draws_too_narrow_fail_where_importance_sampling_can_tell(drawn, monkeypatch):
    p, best, told, chains = drawn
    law = replace(importance_samples(p, best, 1), tail=0.2)
    narrow = replace(chains, draws=chains.flat.mean(0) + 0.8 * (chains.draws - chains.flat.mean(0)))
    found = {check.name: check.mark for check in checks(p, best, told, narrow, law)}
    assert found["importance sampling agrees with the chains"] == "fail"


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path / "cache"))
    return tmp_path


def said(capsys, *arguments):
    with pytest.raises(SystemExit) as ended:
        app.main(["calibrate", "calibrate", SMALL, *arguments])
    return ended.value.code, capsys.readouterr()


@pytest.mark.slow
def test_short_chains_end_in_a_red_page_and_code_three(here, capsys, monkeypatch):
    monkeypatch.setattr(emcee_sampler, "_FIRST_STEPS", 60)
    monkeypatch.setattr(emcee_sampler, "_MOST_STEPS", 60)
    code, printed = said(capsys, SEEN, "--walkers", "16")
    assert code == 3, printed.err
    assert "chains are long enough" in printed.err
    page = (here / "runs" / "latest" / "report.html").read_text()
    assert 'role="alert"' in page
    document = json.loads((here / "runs" / "latest" / "posterior.json").read_text())
    assert document["failed"] >= 1
    assert set(np.load(here / "runs" / "latest" / "draws.npz")) == set(document["parameters"])


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["first_light"], 1, "no step of the node calibrate.density"),
        (["calibrate", "--move", "snooker"], 1, "too narrow"),
    ],
)
def test_mistakes_are_told_before_anything_is_drawn(here, capsys, words, code, message):
    with pytest.raises(SystemExit) as ended:
        app.main(["calibrate", *words])
    assert ended.value.code == code
    assert message in capsys.readouterr().err
    assert not (here / "cache" / "posterior").exists()


@pytest.mark.slow
def test_the_whole_command_finds_the_sensor_and_draws_nothing_twice(here, capsys, monkeypatch):
    code, printed = said(capsys, SEEN)
    assert code == 0, printed.err
    document = json.loads((here / "runs" / "latest" / "posterior.json").read_text())
    draws = np.load(here / "runs" / "latest" / "draws.npz")
    for name, row in document["parameters"].items():
        low, high = np.quantile(draws[name], [0.005, 0.995])
        assert low <= row["nominal"] <= high, name
    gain = document["parameters"]["gain"]
    assert abs(document["least_squares"]["gain"]["value"] - gain["mean"]) < 0.1 * gain["mean"]
    assert (
        "Beside the least squares of EMVA 1288"
        in (here / "runs" / "latest" / "report.html").read_text()
    )
    data = importlib.import_module("arviz").from_netcdf(here / "runs" / "latest" / "posterior.nc")
    assert set(data.posterior) == set(document["parameters"])
    monkeypatch.setattr(emcee.moves.DEMove, "get_proposal", None)  # nothing is drawn again
    code, printed = said(capsys, SEEN, "--quiet")
    assert code == 0, printed.err
