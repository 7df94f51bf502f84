"""A cache that fails costs only time: each command says so once, goes on, and ends well."""

from __future__ import annotations

import importlib.util
import json
import re
import sys
from pathlib import Path

import pytest

from neusee.workflows.cli import app

_SPEC = importlib.util.spec_from_file_location(
    "cache_faults", Path(__file__).with_name("cache_faults.py")
)
cache_faults = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(cache_faults)

pytestmark = [pytest.mark.usefixtures("one_thread"), pytest.mark.filterwarnings("default")]

RECIPE = """
# A target through a small sensor.
sensor: {gain: 0.5 e-/DN, capacity: 200 e-}
seed: 3
tolerance: 0
outputs: [raw, saturated]
steps:
  scene: {node: scene.targets, with: {kind: siemens, shape: [300, 300]}}
  full: {node: sensor.full_well, from: {electrons: scene}, with: {capacity: "${sensor.capacity}"}}
  raw: {node: sensor.digitize, from: {electrons: full}, with: {gain: "${sensor.gain}"}}
  saturated: {node: sensor.crop, from: {image: raw}, with: {shape: [8, 8]}}
"""
CAMERA = [
    "optics.samples=48",
    "optics.pitch=168 um",
    "optics.bands=3",
    "optics.window=[16, 16]",
    "scene.shape=[24, 24]",
    "sensor.shape=[16, 16]",
]
LIFT = [
    "patch.shape=[8, 8]",
    "patch.leaves=8",
    "train_lift.iterations=1",
    "train_lift.batch=1",
    "train_lift.keep=1",
    "train_lift.warmup=1",
    "train_lift.validation_batches=1",
    "train_lift.ema_decay=0.5",
]
COMMANDS = {
    "run": ["run", "mine.yaml"],
    "sweep": ["sweep", "mine.yaml", "sensor.gain=0.5 e-/DN,0.6 e-/DN"],
    "study": ["study", "leave-out", "mine.yaml"],
    "evaluate": ["evaluate", "first_light", *CAMERA, "--pipelines", "flat+none", "--scenes", "1", "--strengths", "0",
                 "--small", "11"],
    "train": ["train", "train_lift", *LIFT],
    "calibrate": ["calibrate", "calibrate", "flats.shape=[32, 32]", "--draws", "100", "--walkers", "16"],
}  # fmt: skip
FAST = {
    "sweep": ("a full disk", "a file in its place", "errors of the device"),
    "study": ("the folder /proc",),
}
#: one fault of each kind for commands that take seconds: every command uses the one store, and the
#: run, the sweep and the study meet all faults
SEVERAL = ("a disk that fills up", "a file in its place", "a device that breaks later")
FEW = {
    "evaluate": SEVERAL,
    "train": SEVERAL,
    "calibrate": ("a read-only mount", "a device that breaks later"),
}
CASES = [
    pytest.param(
        command,
        fault,
        marks=() if command == "run" or fault in FAST.get(command, ()) else pytest.mark.slow,
    )
    for command in COMMANDS
    for fault in FEW.get(command, cache_faults.FAULTS)
]


@pytest.fixture
def call(tmp_path, monkeypatch, capfd):
    """Call the command line in a folder of its own; the exit code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yaml").write_text(RECIPE)

    def call(*words):
        with pytest.raises(SystemExit) as end:
            app.main(list(words))
        return (end.value.code or 0, *capfd.readouterr())

    return call


def shorten(command, monkeypatch):
    """Cut what takes longer than what is tested: chains, pictures of an evaluation, costs of
    scenes.
    """
    if command == "calibrate":
        from neusee.workflows.calibration import emcee_sampler

        monkeypatch.setattr(emcee_sampler, "_MOST_STEPS", 250)
    elif command == "evaluate":
        from neusee.workflows.evaluation import evaluation_page

        monkeypatch.setattr(evaluation_page, "draw_pictures", lambda result: {})
        monkeypatch.setattr(evaluation_page, "sections", lambda *_: [])
    elif command == "study":
        from neusee.workflows.studies import leave_out_study

        monkeypatch.setattr(leave_out_study, "measure_scenes", lambda *_: [])


@pytest.mark.slow
@pytest.mark.parametrize(("command", "fault"), CASES)
def test_a_cache_that_fails_costs_one_warning(command, fault, call, tmp_path, monkeypatch):
    shorten(command, monkeypatch)
    with cache_faults.failing_cache(fault, tmp_path / "cache") as cache:
        monkeypatch.setenv("NEUSEE_CACHE", str(cache))
        code, out, err = call(*COMMANDS[command])
    short = command == "calibrate"  # its chains are cut here, and its page says so
    assert code == (3 if short else 0), out + err
    told = [line for line in (out + err).splitlines() if line.startswith("warning")]
    assert (
        len([line for line in told if command != "sweep" or not line.startswith("warning:")]) == 1
    ), told
    assert str(cache) in told[0]
    assert re.search(r"cannot be (written|read) \(\[Errno \d+\] .*\): the run goes on", told[0])
    pages = list((tmp_path / "runs").glob("[!.l]*/provenance.json"))
    assert len(pages) == (command not in ("sweep", "train"))
    for page in pages:
        assert json.loads(page.read_text())["warnings"] == [
            told[0].removeprefix("warning").removeprefix(":").strip()
        ]
        assert re.search("cannot be (written|read)", page.with_name("report.html").read_text())


def test_a_read_only_cache_is_read_and_told(call, tmp_path, monkeypatch):
    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path / "cache"))
    # an output is stored, however quickly it is computed
    command = [*COMMANDS["run"], 'outputs=["scene", "raw"]']
    call(*command, "--quiet")
    with cache_faults.without_privileges():
        folders = [
            path for path in (tmp_path / "cache", *(tmp_path / "cache").rglob("*")) if path.is_dir()
        ]
        for path in folders:
            path.chmod(0o555)
        code, out, err = call(*command, "sensor.gain=0.6 e-/DN", "--json")
        for path in folders:
            path.chmod(0o755)
    assert code == 0, err
    states = {step["step"]: step["state"] for step in json.loads(out)["steps"]}
    assert states["scene"] != "run"
    assert states["raw"] == "run"
    assert err.startswith("warning: the cache")
    assert len(json.loads(out)["warnings"]) == 1


@pytest.mark.parametrize("mode", [0o555, 0o000])
def test_results_that_may_not_be_written_are_refused_before_anything_runs(
    mode, call, tmp_path, monkeypatch
):
    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path / "cache"))
    (tmp_path / "closed").mkdir(mode=mode)
    with cache_faults.without_privileges():
        code, _, err = call(*COMMANDS["run"], "--out", "closed/deep/runs")
    assert code == 2
    assert err.startswith("--out: the folder ")
    assert (
        "cannot be written (Permission denied), so that closed/deep/runs cannot hold results" in err
    )
    assert not (tmp_path / "cache").exists()


def test_the_helper_does_break_what_it_says(tmp_path):
    assert sys.platform != "linux" or len(cache_faults.FAULTS) >= 12
    with cache_faults.broken(tmp_path / "cache", 5, after=1) as folder:
        with pytest.raises(OSError, match="Errno 5"):
            [(folder / name).write_text("") for name in "abc"]
        assert [path.name for path in tmp_path.rglob("?")] == ["a"]
