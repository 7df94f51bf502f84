"""Real cameras from folders of frames, by a simulator of its own: honest values, and nothing
that is corrected.
"""

import json
import math

import numpy as np
import pytest
from PIL import Image

from neusee.workflows.calibration import emcee_sampler
from neusee.workflows.calibration.run_calibration import (
    CalibrationOptions,
    FramesRefused,
    find_posterior,
)
from neusee.workflows.cli import app
from neusee.workflows.frames.folder_recipe import recipe_of_folder
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.result_store import Store
from tests.drawn_chains import drawn_chains
from tests.workflows.calibration.own_real_camera import RealCamera

SLOW = pytest.mark.slow
UNEVEN = RealCamera(
    1,
    gain=0.03362,
    efficiency=0.6,
    read_noise=30.0,
    well=90_000.0,
    prnu=0.01,
    vignetting=0.15,
    flicker=0.002,
    lamp=0.003,
    brightest=1.15,
)


@pytest.fixture(autouse=True)
def drawn(monkeypatch):
    monkeypatch.setattr(emcee_sampler, "sample", drawn_chains)


def written(camera, folder):
    folder.mkdir()
    for shot in camera.shots():
        kind = f"lit_{1e3 * shot.exposure:g}ms_{shot.photons:.7g}ph" if shot.photons else shot.name
        for index, frame in enumerate(shot.frames):
            Image.fromarray(frame).save(folder / f"{kind}_{index}.png", compress_level=1)


def calibrated(camera, folder):
    """The result of a calibration of the frames of a camera, and what it tells before it draws."""
    written(camera, folder / "lab")
    store, told = Store(folder / "store"), []
    recipe = recipe_of_folder(folder / "lab", store, progress=told.append)
    return find_posterior(recipe, store, told.append, CalibrationOptions(64, "de", 1000)), told


def judged(result, camera):
    """The distance of each stated value from the truth in combined standard uncertainties of its
    budget.
    """
    truth = {
        "gain": camera.gain,
        "quantum_efficiency": camera.efficiency,
        "temporal_dark_noise": camera.read_noise,
    }
    budgets = {budget.key: budget for budget in result.budgets}
    return {name: (budgets[name].value - x) / budgets[name].combined for name, x in truth.items()}


def failed(result):
    return [f"{check.name}: {check.found}" for check in result.checks if check.mark == "fail"]


@pytest.mark.slow
def test_a_well_below_the_converter_moves_no_gain(tmp_path):
    """Neighbours of saturated levels correlate; a correction by them moved this gain by 10 % and
    4 deviations.
    """
    result, told = calibrated(UNEVEN, tmp_path)
    assert not failed(result)
    assert max(map(abs, judged(result, UNEVEN).values())) < 3
    assert not any("corrected," in line for line in told)
    marks = {check.name: check.mark for check in result.checks}
    assert marks["the posterior agrees with its least squares"] == "pass"
    assert marks["the frames are numerous enough"] == "warn"
    (row,) = (one for one in result.beside if one.name == "gain")
    assert abs(row.apart) < 2


@pytest.mark.slow
def test_a_posterior_that_is_moved_away_from_its_levels_is_refused(tmp_path, monkeypatch):
    """As by a correction: every draw of the gain 10 % too large."""

    def moved(problem, mode, file, *more):
        chains = drawn_chains(problem, mode, file, *more)
        chains.draws[..., problem.names.index("gain")] += math.log(1.1)
        return chains

    monkeypatch.setattr(emcee_sampler, "sample", moved)
    result, _ = calibrated(UNEVEN.without(seed=2), tmp_path)
    (check,) = (
        check
        for check in result.checks
        if check.name == "the posterior agrees with its least squares"
    )
    assert check.mark == "fail"
    assert "refused" in check.found


@pytest.mark.parametrize(
    "fault",
    [
        {"smoothing": 0.05},
        pytest.param({"lag": 0.05}, marks=SLOW),
        pytest.param({"demosaiced": True}, marks=SLOW),
    ],
    ids=str,
)
def test_frames_with_a_fault_are_refused_with_a_word_and_without_a_value(fault, tmp_path):
    with pytest.raises(FramesRefused, match="may follow, and nothing is corrected; "):
        calibrated(RealCamera(3, **fault), tmp_path)


@pytest.mark.slow
def test_shifted_numbers_and_hot_pixels_are_told_and_good(tmp_path):
    camera = RealCamera(4, size=(96, 96), shift=4, hot=0.005, read_spread=0.4)
    result, told = calibrated(camera, tmp_path)
    assert not failed(result)
    assert max(map(abs, judged(result, camera).values())) < 3
    assert any(line.startswith("all numbers are multiples of 16") for line in told)
    (hot,) = (line for line in told if "are hot" in line)
    assert int(hot.split(" of ")[0]) == pytest.approx(camera.hot_pixels.sum(), abs=2)
    assert told[0].startswith("dark: exposure 5 ms, from 5ms of the name: 2 files")


@pytest.mark.slow
def test_the_sensor_group_has_a_full_well_with_its_uncertainty(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path / "cache"))
    camera = UNEVEN.without(seed=5, brightest=1.3)
    written(camera, tmp_path / "lab")
    with pytest.raises(SystemExit) as ended:
        app.main(["calibrate", "lab", "--sensor", "mine"])
    printed = capsys.readouterr()
    assert ended.value.code == 0, printed.err
    assert printed.out.startswith("dark: exposure 5 ms, from 5ms of the name"), (
        "before any other line"
    )
    joint = load("first_light", ["sensor=mine"], folder=tmp_path).uncertain.joint
    at = {name: index for index, name in enumerate(joint.names)}
    well, gain = at["sensor.full_well"], at["sensor.gain"]
    assert abs(joint.mean[well] - camera.well) < 3 * joint.sd[well]
    assert 0.003 < joint.sd[well] / camera.well < 0.04
    correlation = joint.factor @ joint.factor.T
    assert correlation[well, gain] < -0.3
    (run,) = (path for path in (tmp_path / "runs").iterdir() if not path.is_symlink())
    document = json.loads((run / "posterior.json").read_text())
    assert document["failed"] == 0
    assert np.isfinite(document["least_squares"]["gain"]["error"])


@pytest.mark.parametrize(
    "seed",
    [
        pytest.param(0, marks=pytest.mark.slow),
        *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 2)),  # other numbers alone
    ],
)
def test_clean_cameras_with_the_least_data_are_as_wide_as_statistics(seed, tmp_path):
    """Of 10 fitted levels of 2 frames of 640 x 640 pixels: 2.4 times as wide before."""
    camera = RealCamera(seed, size=(648, 648), lit=18, vignetting=0.1, flicker=0.001, prnu=0.01)
    result, _ = calibrated(camera, tmp_path)
    assert not failed(result)
    assert max(map(abs, judged(result, camera).values())) < 3
    marks = {check.name: check.mark for check in result.checks}
    assert marks["the frames are numerous enough"] == "pass"
    (budget,) = (budget for budget in result.budgets if budget.key == "gain")
    alone = math.hypot(*(one.share or 0.0 for one in budget.contributions if one.kind == "A"))
    assert budget.combined < 1.5 * alone
