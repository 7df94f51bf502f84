"""What a command says when it is stopped or cannot write, and commands that can be pasted into a
shell.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import shlex
import subprocess
import sys

import pytest

from neusee.workflows.api import verbs
from neusee.workflows.cli import app
from neusee.workflows.cli.command_frame import FewLines, ProgressLines, option_words

pytestmark = [pytest.mark.usefixtures("one_thread"), pytest.mark.filterwarnings("default")]

RECIPE = """
# A target through a small sensor.
sensor: {gain: 0.5 e-/DN, capacity: 200 e-, read_noise: 10 e-}
seed: 3
tolerance: 0
outputs: [raw]
steps:
  scene: {node: scene.targets, with: {kind: siemens, shape: [16, 16]}}
  full: {node: sensor.full_well, from: {electrons: scene}, with: {capacity: "${sensor.capacity}"}}
  noisy: {node: sensor.read_noise, from: {electrons: full}, with: {read_noise: "${sensor.read_noise}", offset: 390 e-}}
  raw: {node: sensor.digitize, from: {electrons: noisy}, with: {gain: "${sensor.gain}"}}
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A working folder, with a space in its name, that has a recipe and a cache of its own."""
    folder = tmp_path / "my work"
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.setenv("NEUSEE_CACHE", str(folder / "cache"))
    (folder / "night one.yaml").write_text(RECIPE)
    return folder


@pytest.fixture
def neusee(here, capfd):
    """Call the command line; give the exit code, stdout and stderr."""

    def call(*words: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as end:
            app.main(list(words))
        return (end.value.code or 0, *capfd.readouterr())

    return call


# Ctrl-C


def interrupted(*arguments, **options):
    raise KeyboardInterrupt


STOPPED = {
    "evaluate": (
        ["evaluate", "first_light", "sensor.read_noise=20 e-"],
        "the points that are finished",
    ),
    "calibrate": (["calibrate", "calibrate", "flats.shape=[32, 32]"], "the draws"),
    "train": (["train", "train_small"], "no checkpoint is written yet"),
    "study": (["study", "stability", "night one.yaml"], "the parts that are finished"),
}


@pytest.mark.parametrize("verb", STOPPED)
def test_ctrl_c_says_what_is_kept_and_how_to_go_on(verb, neusee, here, monkeypatch):
    words, kept = STOPPED[verb]
    monkeypatch.setattr(verbs, verb, interrupted)
    code, out, err = neusee(*words, "--out", "my runs")
    assert code == 130
    assert err.startswith(f"stopped: {kept}")
    again = shlex.split(err.strip().partition("to go on: ")[2])
    assert again == ["neusee", *words, "--out", "my runs"]
    assert "Traceback" not in out + err


def test_ctrl_c_in_a_run_counts_the_finished_steps(neusee, monkeypatch):
    from neusee.nodes import Node

    monkeypatch.setattr(Node, "__call__", stopping_at("sensor.digitize", Node.__call__))
    code, _, err = neusee("run", "night one.yaml", "sensor.gain=0.6 e-/DN")
    assert code == 130
    assert "stopped: 2 steps are finished, and results that take time are kept in the cache" in err


def stopping_at(path, call):
    def stopped(self, *inputs, **params):
        if self.path == path:
            raise KeyboardInterrupt
        return call(self, *inputs, **params)

    return stopped


def test_ctrl_c_in_a_training_names_the_checkpoint(neusee, here, monkeypatch):
    from neusee.workflows.training.resumable_loop import StateFile

    def trained(recipe, out, **options):
        StateFile(out / f"{recipe.name}_train_1a2b" / "state.pt").write(
            {"stage": 1, "iteration": 40}
        )
        raise KeyboardInterrupt

    monkeypatch.setattr(verbs, "train", trained)
    code, _, err = neusee("train", "train_small", "--stage", "1")
    assert code == 130
    assert (
        "the training up to iteration 40 of stage 1 is kept in runs/train_small_train_1a2b; to go"
        " on: " in err
    )


def test_nothing_is_said_to_be_kept_by_a_cache_that_keeps_nothing(neusee, here, monkeypatch):
    def failed(name, store, **options):
        store.report_failure(OSError(errno.ENOSPC, "No space left on device"))
        raise KeyboardInterrupt

    monkeypatch.setattr(verbs, "evaluate", failed)
    _, _, err = neusee("evaluate")
    assert "stopped: nothing is kept, because the cache" in err


# folders that cannot be written


@pytest.mark.parametrize(
    "command",
    [
        ["run", "night one.yaml"],
        ["sweep", "night one.yaml", "sensor.gain=1 e-/DN,2 e-/DN"],
        ["study", "stability", "night one.yaml"],
        ["evaluate"],
        ["train"],
        ["calibrate", "calibrate"],
    ],
    ids=lambda words: words[0],
)
def test_a_folder_that_is_a_file_is_refused_before_anything_runs(command, neusee, here):
    (here / "taken").write_text("")
    code, _, err = neusee(*command, "--out", "taken/runs")
    assert code == 2
    assert "taken is not a folder, so that no results can be written to taken/runs" in err
    assert not (here / "cache").exists() or not list((here / "cache").glob("??/*.json"))


@pytest.mark.slow
@pytest.mark.parametrize(
    "file", ["metrics.csv", "provenance.json", "report.html", "figures/graph.png"]
)
def test_a_disk_that_is_full_in_the_midst_of_a_report_leaves_no_folder(
    file, neusee, here, monkeypatch
):
    from neusee.workflows.report.run_folder import RunFolder

    for method in ("write", "write_rows", "take"):
        monkeypatch.setattr(RunFolder, method, filling(getattr(RunFolder, method), file))
    code, out, err = neusee("run", "night one.yaml", "sensor.gain=0.6 e-/DN")
    assert code == 1
    assert (
        "the folder of results in runs cannot be written ([Errno 28] No space left on device" in err
    )
    assert "3 steps are finished, and results that take time are kept in the cache" in err
    again = shlex.split(err.strip().partition("to go on: ")[2])
    assert again == ["neusee", "run", "night one.yaml", "sensor.gain=0.6 e-/DN"]
    assert list((here / "runs").iterdir()) == []
    monkeypatch.undo()
    monkeypatch.chdir(here)
    monkeypatch.setenv("NEUSEE_CACHE", str(here / "cache"))
    code, out, _ = neusee(*again[1:], "--json")
    assert code == 0
    assert "run" not in {step["state"] for step in json.loads(out)["steps"]}


def filling(write, file):
    """Write the files of a run until the disk has no room for the file of this name."""

    def filled(self, name, *arguments):
        if name == file:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), name)
        return write(self, name, *arguments)

    return filled


# commands to paste


def test_the_next_commands_work_when_pasted(neusee, here):
    code, out, _ = neusee("run", "night one.yaml", "sensor.gain=0.6 e-/DN")
    assert code == 0
    shown = out.partition("\nnext\n")[2].splitlines()
    commands = [shlex.split(line, comments=True) for line in shown]
    assert commands[0] == [
        "neusee",
        "run",
        "night one.yaml",
        "sensor.gain=0.6 e-/DN",
        "sensor.read_noise=20 e-",
    ]
    assert commands[1] == ["neusee", "plan", "night one.yaml", "sensor.gain=0.6 e-/DN"]
    for _, verb, *words in commands:
        checked = ("validate", *words) if verb == "run" else (verb, *words)
        assert neusee(*checked)[0] == 0, checked


def test_a_next_command_replaces_the_change_of_the_same_value(neusee):
    _, out, _ = neusee("run", "night one.yaml", "sensor.read_noise=5 e-")
    assert "neusee run 'night one.yaml' 'sensor.read_noise=20 e-'   #" in out
    assert "sensor.read_noise=5" not in out.partition("sensor.read_noise=20")[2].splitlines()[0]


def test_the_first_line_repeats_the_command_as_a_shell_reads_it(neusee):
    _, out, _ = neusee("validate", "night one.yaml", "sensor.gain=0.6 e-/DN")
    assert out.startswith("neusee run 'night one.yaml' 'sensor.gain=0.6 e-/DN': A target")


def test_the_command_of_a_page_can_be_pasted():
    options = {"pipelines": "flat+none, axicon+none", "quick": True, "data": "", "scenes": 3}
    assert option_words(options) == [
        "--pipelines",
        "flat+none, axicon+none",
        "--quick",
        "--scenes",
        "3",
    ]


def test_a_missing_extra_is_named(neusee, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    code, _, err = neusee("run", "night one.yaml", "--executor", "dask")
    assert code == 2
    assert 'distributed is not installed: pip install "neusee[distributed]"' in err


# one JSON object


@pytest.mark.slow
def test_every_long_command_prints_one_json_object(neusee, here, monkeypatch):
    from neusee.workflows.studies import leave_out_study

    monkeypatch.setattr(leave_out_study, "measure_scenes", lambda *_: [])
    calls = {
        "report": ["run", "night one.yaml"],
        "table": ["sweep", "night one.yaml", "sensor.gain=0.5 e-/DN,0.6 e-/DN"],
        "study": ["study", "leave-out", "night one.yaml"],
        "lines": ["plan", "night one.yaml"],
        "valid": ["validate", "night one.yaml"],
    }
    for key, words in calls.items():
        code, out, err = neusee(*words, "--json")
        assert (code, err) == (0, ""), words
        assert out.count("\n") == 1
        document = json.loads(out, parse_constant=pytest.fail)
        assert key in document
        assert (
            shlex.split(document["command"])[: len(words) + 1] == ["neusee", *words]
            or words[0] == "validate"
        )


def test_a_training_prints_one_json_object(neusee, monkeypatch):
    def trained(recipe, out, progress, **options):
        progress("not to be seen")
        (out / "train_small_train_1").mkdir(parents=True)
        (out / "train_small_train_1" / "training.json").write_text('{"last": {"L1": NaN}}')
        return out / "train_small_train_1"

    monkeypatch.setattr(verbs, "train", trained)
    code, out, _ = neusee("train", "train_small", "--json")
    assert code == 0
    assert json.loads(out) == {
        "folder": "runs/train_small_train_1",
        "training": {"last": {"L1": None}},
    }


@pytest.mark.parametrize("verb", ["evaluate", "calibrate"])
def test_an_evaluation_and_a_calibration_print_one_json_object(verb, neusee, here, monkeypatch):
    def done(recipe, out, progress, **options):
        progress("not to be seen")
        (here / "runs").mkdir()
        (here / "runs" / "provenance.json").write_text('{"failed": 0, "summary": [1]}')
        (here / "runs" / "posterior.json").write_text('{"failed": 0, "parameters": {}}')
        return out

    monkeypatch.setattr(verbs, verb, done)
    code, out, _ = neusee(verb, verb if verb == "calibrate" else "first_light", "--json")
    assert code == 0
    assert json.loads(out) == {"report": "runs/report.html", "failed": 0, "summary": [1]}


# the time that is left


def lines_of(capsys, *steps):
    now = [0.0]
    show = ProgressLines(False, lambda: now[0])
    for seconds, line in steps:
        now[0] += seconds
        show(line)
    return capsys.readouterr().out.splitlines()


def test_a_line_with_a_count_says_what_is_left(capsys):
    found = lines_of(
        capsys,
        (1, "3 scenes"),
        (10, "scene 1 of 3 (a)"),
        (20, "scene 2 of 3 (b)"),
        (9, "scene 3 of 3"),
    )
    assert found == [
        "3 scenes",
        "scene 1 of 3 (a); about 20 s left",
        "scene 2 of 3 (b); about 15 s left",
        "scene 3 of 3",
    ]


def test_a_calibration_says_what_is_left(capsys):
    steps = "{} of about 2000 steps of 4 x 64 walkers: tau 9.0, effective sample size 100"
    found = lines_of(capsys, (10, steps.format(500)), (10, steps.format(750)))
    assert found[1].endswith("; about 50 s left")


def test_a_study_that_goes_on_takes_the_rate_of_now(capsys):
    found = lines_of(capsys, (1, "[40/50] a"), (10, "[41/50] b"), (10, "[43/50] c"))
    assert found == ["[40/50] a", "[41/50] b; about 1 min 30 s left", "[43/50] c; about 47 s left"]


def test_a_count_at_the_end_of_a_line_counts(capsys):
    found = lines_of(capsys, (5, "dark[1/2] left out: 0.1 (1 of 3)"), (5, "psf: 0 (2 of 3)"))
    assert found == [
        "dark[1/2] left out: 0.1 (1 of 3); about 10 s left",
        "psf: 0 (2 of 3); about 5 s left",
    ]


def test_a_count_that_begins_again_takes_its_own_rate(capsys):
    found = lines_of(
        capsys, (5, "1/2 a"), (5, "2/2 b"), (60, "1/2 c"), (1, "x 64 of 200"), (1, "no count")
    )
    assert found == [
        "1/2 a; about 5 s left",
        "2/2 b",
        "1/2 c; about 1 min 00 s left",
        "x 64 of 200",
        "no count",
    ]


def test_a_run_says_how_long_it_will_take(neusee, here):
    from neusee.workflows.keys.sealed_files import seal_record

    assert "time " not in neusee("run", "night one.yaml")[1]
    journal = here / "cache" / "journal.jsonl"
    head, *lines = journal.read_bytes().splitlines()
    slow = [
        seal_record("journal", {**json.loads(line), "seconds": 30.0, "processor_seconds": 30.0})
        for line in lines
        if line
    ]
    journal.write_bytes(b"\n".join([head, *slow]))
    _, out, _ = neusee("run", "night one.yaml", "sensor.read_noise=7 e-")
    assert "time     about 1 min 01 s, as earlier runs took\n" in out  # two steps and the report


def test_a_live_table_says_what_is_left():
    from neusee.workflows.graph.recipe_graph import Event, StepRecord
    from neusee.workflows.recipe.loading import load
    from neusee.workflows.report.console import RunTable

    recipe = load("plain_lens")
    table = RunTable(recipe, ["bands", "scene"], "silent", {"bands": 40.0, "scene": 30.0})
    assert table.caption() == "about 1 min 10 s left, as earlier runs took"
    table.watch(Event("bands", StepRecord("bands", "run", "", 1.0, "key")))
    assert table.caption() == "about 30 s left, as earlier runs took"
    table.watch(Event("scene", StepRecord("scene", "run", "", 1.0, "key")))
    assert (table.caption(), table.finished) == ("", 2)


def test_a_printed_command_goes_through_a_real_shell(neusee, here):
    _, out, _ = neusee("run", "night one.yaml")
    line = out.partition("\nnext\n")[2].splitlines()[0]
    with contextlib.suppress(FileNotFoundError):
        found = subprocess.run(
            ["sh", "-c", f"neusee() {{ printf '%s\\n' \"$@\"; }}; {line}"],
            capture_output=True,
            text=True,
        )
        assert found.stdout.splitlines() == ["run", "night one.yaml", "sensor.read_noise=20 e-"]


@pytest.mark.slow
def test_one_list_is_printed_once(neusee, here):
    wrong = "\n".join(
        f"  s{i}: {{node: sensor.qqqqqqqq, from: {{electrons: scene}}}}" for i in range(300)
    )
    (here / "wrong.yaml").write_text(f"{RECIPE}{wrong}\n")
    code, _, err = neusee("validate", "wrong.yaml")
    assert code == 2
    assert "300 problems, nothing was run" in err
    assert err.count("full_well, ") <= 1
    assert err.count("see the names above") == 99
    assert "and 200 more like these" in err
    assert len(err.splitlines()) == 102


def test_lines_of_steps_are_few_in_a_file(capsys):
    """Lines of steps at 1, 2 … 400 s: printed after half a minute, and then each time after
    twice as long.
    """
    now = [0.0]
    show = FewLines(False, lambda: now[0])
    show("frames: 13 of 13 tests passed")
    for second in range(1, 401):
        now[0] = float(second)
        show(f"{second} of about 400 steps of 4 x 64 walkers")
    show("not identifiable: lamp")
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["frames:", "30", "60", "120", "240", "not"]
    assert lines[1].endswith("; about 6 min 10 s left")
