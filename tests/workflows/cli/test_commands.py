"""The command line: the words, what they print, and the exit codes."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys

import pytest

from neusee.workflows.cli import app

RECIPE = """\
# An axicon, cut off at half its height.
seed: 3
tolerance: 1e-3
mask: {waves: 2, samples: 24, max_height: 1.2 um}
steps:
  stop:
    node: optics.stop
    with: {samples: "${mask.samples}", pitch: 10 um, diameter: 240 um}
  cone:
    node: doe.axicon
    from: stop
    with: {waves: "${mask.waves}"}
  made:
    node: doe.fabricate
    from: cone
    with: {material: fused silica, max_height: "${mask.max_height}"}
outputs: [made]
expect:
  the middle is flat: {step: made, at: [0, 0], value: PROMISED, rtol: 1e-6}
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A working folder with a recipe of its own and a cache of its own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path / "cache"))
    (tmp_path / "mine.yaml").write_text(RECIPE.replace("PROMISED", "0"))
    return tmp_path


@pytest.fixture
def neusee(here, capfd):
    """Call the command line; give the exit code, stdout and stderr."""

    def call(*words: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as end:
            app.main(list(words))
        return (end.value.code or 0, *capfd.readouterr())

    return call


def test_help_comes_at_once_and_without_torch():
    """And without typer, or any module that takes long to import."""
    slow = {
        "torch",
        "pydantic",
        "rich",
        "typer",
        "click",
        "dataclasses",
        "inspect",
        "json",
        "subprocess",
    }
    code = (
        "import sys\nbefore = set(sys.modules)\nfrom neusee.workflows.cli.app import main\ntry:"
        " main(['--help'])\nexcept SystemExit: pass\nassert not"
        f" {slow | {'importlib.metadata', 'importlib.resources', 'logging'}!r} & (set(sys.modules)"
        " - before)"
    )
    bare, ours = (min(_seconds(text)[0] for _ in range(3)) for text in ("pass", code))
    assert ours < 5 * bare
    assert "run" in _seconds(code)[1]


def _seconds(code):
    """Processor time of Python for the code, which a busy machine hardly changes, and what the
    code prints.
    """
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    env = {**os.environ, "COLUMNS": "80"}
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=env
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, found.stdout


def test_run_prints_steps_numbers_verdict_path_and_three_commands(neusee, here):
    code, out, err = neusee("run", "mine.yaml")
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert "An axicon" in lines[0]
    assert lines[1].startswith("checked  3 steps of 3 nodes")
    rows = {line.split()[0]: line.split() for line in lines if line.startswith("  ")}
    assert rows["cone"][1:3] == ["cpu", "run"]
    assert rows["made"][1:3] == ["cpu", "run"]
    assert "1 of 1 expected numbers within tolerance" in out
    page = here / next(line for line in lines if line.startswith("report")).split()[1]
    assert page.is_file()
    assert len([line for line in lines if line.startswith("  neusee ")]) == 3
    assert "\x1b" not in out


def test_a_second_run_is_cached_and_says_what_slept(neusee):
    neusee("run", "mine.yaml")
    _, out, _ = neusee("run", "mine.yaml")
    assert "cached" in next(line for line in out.splitlines() if line.startswith("  made"))
    assert "2 steps were not needed" in out
    assert "3 cached" in out


def test_a_changed_value_runs_only_what_follows(neusee):
    neusee("run", "mine.yaml")
    _, out, _ = neusee("run", "mine.yaml", "mask.max_height=1.3 um", "--json")
    states = {s["step"]: s["state"] for s in json.loads(out)["steps"]}
    assert states == {"stop": "not needed", "cone": "cached", "made": "run"}


def test_a_row_says_why_it_ran(neusee):
    _, out, _ = neusee("run", "mine.yaml")
    assert "->" not in out
    _, out, _ = neusee("run", "mine.yaml", "mask.max_height=1.3 um")
    made = next(line for line in out.splitlines() if line.startswith("  made"))
    assert "mask.max_height 1.2 -> 1.3 um (argument 2)" in made
    _, out, _ = neusee("run", "mine.yaml", "mask.waves=3")
    rows = {line.split()[0]: line for line in out.splitlines() if line.startswith("  ")}
    assert "mask.waves 2 -> 3" in rows["cone"]
    assert "after cone" in rows["made"]


def test_json_is_one_document_and_quiet_is_the_path(neusee, here):
    code, out, _ = neusee("run", "mine.yaml", "--json")
    document = json.loads(out)
    assert code == 0
    assert (here / document["report"]).is_file()
    assert document["recipe"] == "mine"
    _, out, _ = neusee("run", "--quiet", "mine.yaml")
    assert out.count("\n") == 1
    assert (here / out.strip()).is_file()


def test_out_names_the_folder(neusee, here):
    _, out, _ = neusee("run", "mine.yaml", "--quiet", "--out", "elsewhere/deep")
    assert out.startswith("elsewhere/deep/")
    assert (here / "elsewhere" / "deep" / "latest" / "report.html").is_file()


def test_a_missed_number_is_exit_code_three(neusee, here):
    (here / "mine.yaml").write_text(RECIPE.replace("PROMISED", "1"))
    code, out, _ = neusee("run", "mine.yaml")
    assert code == 3
    assert "0 of 1 expected numbers" in out
    assert "missed: the middle is flat" in out


def test_mistakes_come_all_at_once_located_and_nothing_runs(neusee, here):
    code, out, err = neusee("run", "mine.yaml", "mask.wavs=3", "mask.max_height=1.2")
    assert (code, out) == (2, "")
    assert "did you mean mask.waves?" in err
    assert "needs a unit" in err
    assert err.splitlines()[-1] == "2 problems, nothing was run"
    assert "Traceback" not in err
    assert not (here / "runs").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["run", "mine.yaml", "--bogus"], "--bogus"),
        (["run", "mine.yaml", "stray"], "stray: not a change of a value"),
        (["nodes", "doe.flatt"], "doe.flat"),
        (["report", "nowhere"], "no run at nowhere"),
        (["explode"], "explode"),
        (["run", "mine.yaml", "--device", "toaster"], "--device toaster"),
        (["run", "no_such_recipe"], "no_such_recipe"),
    ],
)
def test_a_bad_word_is_one_line_and_exit_code_two(neusee, words, said):
    code, out, err = neusee(*words)
    assert (code, out) == (2, "")
    assert said in err
    assert "Traceback" not in err
    assert len(err.splitlines()) <= 2


def test_tilde_and_plus_reach_the_recipe(neusee):
    code, out, _ = neusee(
        "config", "mine.yaml", "~mask.max_height", "+mask.max_height=2 um", "mask.waves=-1"
    )
    assert code == 0
    assert "waves: -1" in out
    assert "max_height: 2 um" in out
    code, _, err = neusee("run", "mine.yaml", "~mask.nothing")
    assert code == 2
    assert "mask.nothing" in err


def test_without_a_name_the_changes_go_to_first_light(neusee):
    code, _, err = neusee("validate", "sensor.quantum_eficiency=0.5")
    assert code == 2
    assert "did you mean sensor.quantum_efficiency?" in err
    assert "argument 1" in err


def test_a_failure_while_running_is_exit_code_one_and_has_no_stack(neusee, monkeypatch):
    from neusee.workflows.engine import step_job

    def burst(*args, **kwargs):
        raise MemoryError("no room for 31 bands")

    monkeypatch.setattr(step_job, "call", burst)
    code, _, err = neusee("run", "mine.yaml")
    assert code == 1
    assert "no room for 31 bands" in err
    assert "Traceback" not in err
    with pytest.raises(RuntimeError, match="no room"):
        app.main(["run", "mine.yaml", "--debug"])


def test_plan_computes_nothing_and_knows_what_is_stored(neusee, here):
    code, out, _ = neusee("plan", "mine.yaml")
    assert code == 0
    assert "3 of 3 steps would run" in out
    assert not (here / "runs").exists()
    neusee("run", "mine.yaml", "--quiet")
    _, out, _ = neusee("plan", "mine.yaml")
    assert "0 of 3 steps would run" in out
    _, out, _ = neusee("plan", "mine.yaml", "mask.max_height=1.3 um")
    rows = {line.split()[0]: line.split() for line in out.splitlines()}
    assert rows["cone"][1] == "stored"
    assert rows["made"][1] == "cpu"
    steps = {
        row["step"]: row
        for row in json.loads(neusee("plan", "mine.yaml", "mask.max_height=1.3 um", "--json")[1])[
            "steps"
        ]
    }
    assert steps["cone"]["state"] == "stored"
    assert (steps["made"]["state"], steps["made"]["where"]) == ("run", "cpu")


def test_plan_follows_what_would_be_left_out(neusee, here):
    text = RECIPE.replace("PROMISED", "0").replace(
        "  made:",
        "  near:\n    node: sensor.dark_current\n    from: cone\n    with: {mean: 0 e-}\n  made:",
    )
    (here / "mine.yaml").write_text(
        text.replace("from: cone\n    with: {material", "from: near\n    with: {material")
    )
    neusee("run", "mine.yaml", "--quiet")
    _, out, _ = neusee("plan", "mine.yaml")
    rows = {line.split()[0]: line for line in out.splitlines()}
    assert "left out" in rows["near"]
    assert "0 of 4 steps would run" in out


def test_config_can_be_run_again(neusee, here):
    _, out, _ = neusee("config", "mine.yaml", "mask.waves=3")
    (here / "again.yaml").write_text(out)
    first = json.loads(neusee("run", "mine.yaml", "mask.waves=3", "--json")[1])
    second = json.loads(neusee("run", "again.yaml", "--json")[1])
    assert {s["step"]: s["key"] for s in first["steps"]} == {
        s["step"]: s["key"] for s in second["steps"]
    }
    assert "argument 2" in out


def test_report_is_written_again(neusee, here):
    neusee("run", "mine.yaml", "--quiet")
    page = here / "runs" / "latest" / "report.html"
    before = page.read_text()
    page.unlink()
    code, out, _ = neusee("report", "latest")
    assert code == 0
    assert (here / out.strip()).read_text() == before


def test_recipes_nodes_schema_and_cache_say_what_there_is(neusee, here):
    _, out, _ = neusee("recipes")
    assert out.splitlines()[0].startswith("axicon")
    assert "laser: drawn, green" in out
    _, out, _ = neusee("nodes")
    assert "doe.axicon" in out
    _, out, _ = neusee("nodes", "doe.fabricate")
    assert "max_height  length from 1e-10 m to 10 mm" in out
    assert "Source:" in out
    _, out, _ = neusee("nodes", "optics.stop")
    assert "reading.aperture" in out
    neusee("run", "mine.yaml", "--quiet")
    _, out, _ = neusee("cache", "ls")
    assert "cone" in out
    assert str(here / "cache") in out


def test_the_schema_is_json(neusee):
    code, out, _ = neusee("schema")
    assert code == 0
    assert json.loads(out)["title"] == "neusee recipe"


def test_a_reader_that_goes_away_is_no_error(here):
    words = f"{sys.executable} -m neusee.workflows.cli recipes | head -n 1"
    found = subprocess.run(
        ["bash", "-o", "pipefail", "-c", words],
        capture_output=True,
        text=True,
        env=dict(os.environ),
    )
    assert found.stdout.startswith("axicon")
    assert "Traceback" not in found.stderr
