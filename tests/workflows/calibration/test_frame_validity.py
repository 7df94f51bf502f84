"""Frames of a camera in NumPy through ``neusee calibrate``: refused before any draw, or with
wider intervals.
"""

import importlib.util
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from neusee.nodes.calibrate import FrameTest, Hidden, open_errors
from neusee.workflows.calibration.emcee_sampler import Chains
from neusee.workflows.calibration.frame_validity import (
    IntervalEstimate,
    ModelSpread,
    frame_checks,
    hidden_checks,
    hidden_faults,
    inspect_recipe,
    lines,
    relative_shifts,
    widened,
    widened_models,
)
from neusee.workflows.calibration.log_posterior import SensorPosterior
from neusee.workflows.cli import app
from neusee.workflows.recipe.distributions.joint_distribution import Z_90
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.result_store import Store

_spec = importlib.util.spec_from_file_location(
    "numpy_camera", Path(__file__).parents[2] / "nodes/calibrate/numpy_camera.py"
)
numpy_camera = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(numpy_camera)

PRIOR = """\
  prior:
    node: calibrate.camera_prior
    with: {gain: [0.125 DN/e-, 10], quantum_efficiency: [0.5, 2], temporal_dark_noise: [8 e-, 5]}
  camera:
    node: calibrate.camera
    from: {levels: levels}
    with: {gain: 0.125 DN/e-, quantum_efficiency: 0.5, dark_signal: 100, temporal_dark_noise: 8 e-}
outputs: [camera]
"""
FRAMES = """\
steps:
  frames: {node: calibrate.frames, each: measured, with: {files: "${item.files}"}}
  level:
    node: calibrate.reduce
    each: measured
    from: frames
    with: {photons: "${item.photons}", exposure: "${item.exposure}", scatter: steady}
  levels: {node: calibrate.levels, from: level}
"""
MIXED = numpy_camera.Camera(1, faults={"mixing": 0.1}, lit=6, darks=2)


def in_files(folder, camera):
    rows = []
    for name, photons, exposure, frames in camera.levels():
        file = f"{name.replace(' ', '_')}.npy"
        np.save(folder / file, frames.astype(np.uint16))
        rows.append(
            f"  {file[:-4]}: {{files: {file}, photons: {photons:.6f}, exposure: {exposure:.6g} s}}"
        )
    (folder / "mine.yaml").write_text(
        "\n".join(["# Frames in files.", "measured:", *rows, FRAMES + PRIOR])
    )


def described(folder, camera):
    lines = ["v 4.0", f"n {camera.bits} {camera.size} {camera.size}"]
    for name, photons, exposure, frames in camera.levels():
        lines.append(
            f"b {exposure * 1e9:.3f} {photons:.4f}" if photons else f"d {exposure * 1e9:.3f}"
        )
        for i, frame in enumerate(frames):
            np.save(folder / f"{name.replace(' ', '_')}_{i}.npy", frame[None].astype(np.uint16))
            lines.append(f"i {name.replace(' ', '_')}_{i}.npy")
    (folder / "set.txt").write_text("\n".join(lines))
    steps = (
        "steps:\n  levels: {node: calibrate.descriptor, with: {file: set.txt, scatter: steady}}\n"
    )
    (folder / "mine.yaml").write_text("# A descriptor.\n" + steps + PRIOR)


@pytest.mark.parametrize("write", [in_files, described])
def test_mixed_frames_are_refused_before_any_draw(write, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path / "cache"))
    write(tmp_path, MIXED)
    with pytest.raises(SystemExit) as ended:
        app.main(["calibrate", "mine.yaml", "--out", "runs"])
    assert ended.value.code == 3
    printed = capsys.readouterr()
    assert (
        "frames, refused: white noise: the noise of neighbouring pixels correlates by 0.0"
        in printed.out + printed.err
    )
    (folder,) = (x for x in (tmp_path / "runs").iterdir() if x.is_dir() and not x.is_symlink())
    document = json.loads((folder / "posterior.json").read_text())
    assert document["failed"] == 1
    assert document["parameters"] == {}
    assert {row["name"]: row["verdict"] for row in document["frames"]}["white noise"] == "refused"
    assert not (folder / "draws.npz").exists()
    assert not (tmp_path / "cache" / "posterior").exists()
    assert "Not fit for use" in (folder / "report.html").read_text()


def test_clean_frames_pass_and_a_table_says_what_is_not_tested(tmp_path):
    in_files(tmp_path, replace(MIXED, faults={}))
    recipe = load("mine.yaml", folder=tmp_path)
    tests = inspect_recipe(recipe, Store(tmp_path / "store"))
    assert {test.verdict for test in tests} == {"passed"}
    assert list(lines(tests)) == [f"frames: {len(tests)} of {len(tests)} tests passed"]
    assert {check.mark for check in frame_checks(tests)} == {"pass"}
    (check,) = hidden_checks(tests, ("mixing", "lag"))
    assert (check.name, check.mark) == ("intervals include lag and mixing", "pass")
    assert "gain by " in check.found
    assert hidden_checks(tests, ("pattern",)) == []  # the temporal variance leaves patterns out
    alone = inspect_recipe(load("calibrate_camera"), Store(tmp_path / "store"))
    assert [test.name for test in alone] == ["the dark noise exceeds rounding"]
    assert [check.mark for check in frame_checks(alone)] == ["pass", "warn"]


WIDER = [
    FrameTest("a", 5.0, 4.0, "widened", "", {"gain": 0.012, "noise": 0.008}),
    FrameTest("b", 5.0, 4.0, "widened", "", {"gain": 0.005}),
]


def test_intervals_grow_by_the_errors_that_may_follow(tmp_path):
    assert relative_shifts(WIDER) == {"gain": pytest.approx(0.013), "noise": pytest.approx(0.008)}
    problem = SensorPosterior.of(load("calibrate_camera"), Store(tmp_path / "store"))
    params = problem.recipe.steps[problem.step].params
    centre = problem.theta({name: float(params[name]) for name in problem.names})
    draws = np.broadcast_to(centre, (4, 500, 20, len(centre))).copy()
    chains = Chains(draws, np.zeros((4, 500, 20)), 0.3, 10.0, 500, True)
    assert widened(problem, chains, [], 1) is chains
    after = problem.parameters(widened(problem, chains, WIDER, 1).draws)
    logs = {
        name: after[name].log() - math.log(params[name]) for name in ("gain", "quantum_efficiency")
    }
    logs["noise"] = after["temporal_dark_noise"].log() - math.log(params["temporal_dark_noise"])
    assert float(logs["gain"].std()) == pytest.approx(0.013, rel=0.03)
    # their product is measured
    torch.testing.assert_close(logs["gain"], -logs["quantum_efficiency"])
    assert float(logs["noise"].std()) == pytest.approx(math.hypot(0.013, 0.008), rel=0.03)
    assert float(after["dark_signal"].std()) < 1e-9  # DN
    mixed = FrameTest(
        "c", 1.0, 4.0, "passed", "", hidden=(Hidden("mixing", 0.03, 0.004, 0.02, gain=1.0),)
    )
    moved = problem.parameters(widened(problem, chains, [mixed], 1).draws)["gain"].log() - math.log(
        params["gain"]
    )
    # nothing is corrected
    assert abs(float(moved.mean())) < 4 * float(moved.std()) / math.sqrt(moved.numel())
    assert float(moved.std()) == pytest.approx(open_errors(mixed.hidden)["gain"], rel=0.03)


def test_a_camera_that_is_known_to_have_no_mixing_hides_none(tmp_path):
    known = SensorPosterior.of(
        load("calibrate_camera", ["steps.prior.with.mixing=none"]), Store(tmp_path / "store")
    )
    assert known.coordinates.prior.may_hide == ("lag", "pattern")
    hidden = (
        Hidden("mixing", 0.01, 0.004, 0.02, gain=1.0),
        Hidden("lag", 0.01, 0.004, 0.02, gain=1.0, positive=True),
    )
    passed = [FrameTest(h.fault, 1.0, 4.0, "passed", "", hidden=(h,)) for h in hidden]
    assert hidden_faults(passed, known.coordinates.prior.may_hide) == [hidden[1]]
    found = replace(passed[0], verdict="widened")  # what the frames show counts, whatever is known
    assert hidden_faults([found], known.coordinates.prior.may_hide) == [hidden[0]]


def test_stated_intervals_grow_as_the_draws_do():
    one = IntervalEstimate(2.0, 2.0 * math.exp(-0.02), 2.0 * math.exp(0.02))
    models = [ModelSpread(name, (one,), one) for name in ("gain", "temporal_dark_noise", "bend")]
    gain, noise, bend = (model.stated for model in widened_models(models, WIDER, ()))
    assert math.log(gain.high / 2) == pytest.approx(math.hypot(0.02, Z_90 * 0.013))
    assert math.log(2 / noise.low) == pytest.approx(
        math.hypot(0.02, Z_90 * math.hypot(0.013, 0.008))
    )
    assert bend == one
    mixed = FrameTest(
        "c", 1.0, 4.0, "passed", "", hidden=(Hidden("mixing", 0.03, 0.004, 0.02, gain=1.0),)
    )
    gain = widened_models(models, [mixed], ("mixing",))[0].stated
    assert gain.value == 2.0
    assert math.log(gain.high / 2) == pytest.approx(
        math.hypot(0.02, Z_90 * open_errors(mixed.hidden)["gain"])
    )
    assert widened_models(models, [mixed], ())[0].stated == one
