"""Commands that compute nothing answer without torch: a process in which the import of torch
fails runs them.
"""

import contextlib
import io
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from neusee.nodes import node
from neusee.workflows.graph.errors import Location
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.simulation.simulate_recipe import simulate
from neusee.workflows.store.result_store import Store

ROOT = Path(__file__).parents[3]
KEYS = ("ab" + "0" * 30, "cd" + "0" * 30)
#: runs each command of the standard input, and writes exit code, standard output and standard error
#: of each as JSON
PROGRAM = """
import contextlib, io, json, sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("torch", "kornia"):
            raise RuntimeError(f"{name} is imported")

sys.meta_path.insert(0, Refuse())
from neusee.workflows.cli.app import main

answers = []
for words in json.load(sys.stdin):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main(words)
        except SystemExit as ended:
            answers.append([ended.code or 0, out.getvalue(), err.getvalue()])
assert "torch" not in sys.modules
json.dump(answers, sys.stdout)
"""


@node()
def counted(*, value: float) -> torch.Tensor:
    """Give a number. Units: DN."""
    return torch.tensor([value, 2 * value], dtype=torch.float64)


@pytest.fixture
def place(tmp_path):
    """A cache with two results of one step."""
    store, date = Store(tmp_path / "cache"), "2026-01-01T00:00:00+00:00"
    for number, key in enumerate(KEYS):
        origin = {"node": "toy.add", "code": "c", "params": {"amount": number}, "inputs": []}
        about = {
            "step": "raw",
            "recipe": "small",
            "seconds": 1.0,
            "date": date,
            "device": "cpu",
            "origin": origin,
        }
        assert store.put(key, torch.ones(2000), about)
    return tmp_path


def asked(place, *commands):
    """Run commands in one process without torch."""
    env = {
        **os.environ,
        "NEUSEE_CACHE": str(place / "cache"),
        "HOME": str(place),
        "PYTHONPATH": str(ROOT / ".src"),
    }
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        input=json.dumps([command.split() for command in commands]),
        cwd=place,
        env=env,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def here(place, monkeypatch, command):
    """Run a command in this process, which has torch."""
    from neusee.workflows.cli.app import main

    monkeypatch.setenv("NEUSEE_CACHE", str(place / "cache"))
    monkeypatch.chdir(place)
    out, err = io.StringIO(), io.StringIO()
    with (
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        pytest.raises(SystemExit) as ended,
    ):
        main(command.split())
    return [ended.value.code or 0, out.getvalue(), err.getvalue()]


def test_commands_that_compute_nothing_say_the_same_without_torch(place, monkeypatch):
    commands = {
        "--version": 0,
        "--help": 0,
        "plan --help": 0,
        "recipes": 0,
        "cache ls": 0,
        "cache pin ab": 0,
        "cache unpin ab": 0,
        "cache why cd": 0,
        "cache why x": 2,
        "cache gc --dry-run": 0,
        "run nosuch": 2,
        "plan nosuch.yaml": 2,
        "report nowhere": 2,
    }
    answers = asked(place, *commands)
    for (command, code), answer in zip(commands.items(), answers, strict=True):
        assert answer == here(place, monkeypatch, command), command
        assert answer[0] == code, command
    assert "amount 0 -> 1" in answers[[*commands].index("cache why cd")][1]


def test_the_page_of_a_run_is_written_again_without_torch(place):
    step = Step("raw", counted, {"value": 3.0}, {}, Location("<script>.yaml", 3, 1), {})
    recipe = Recipe("small", "A small recipe.", 5, 1e-3, ("raw",), {"raw": step}, ())
    done = simulate(recipe, Store(place / "cache"), place / "runs", ["neusee", "run", "small"])
    before = done.page.read_bytes()
    done.page.unlink()
    assert asked(place, "report latest") == [[0, "runs/latest/report.html\n", ""]]
    assert done.page.read_bytes() == before


def test_a_recipe_that_was_checked_before_is_checked_without_torch(tmp_path, monkeypatch):
    """Its final values, and the first mistakes that are made in it."""
    (tmp_path / "cache").mkdir()
    env = {**os.environ, "NEUSEE_CACHE": str(tmp_path / "cache"), "PYTHONPATH": str(ROOT / ".src")}
    words = [sys.executable, "-m", "neusee", "validate", "first_light"]
    subprocess.run(words, cwd=tmp_path, env=env, check=True, capture_output=True)
    commands = {
        "validate first_light --json": 0,
        "config first_light": 0,
        "validate first_light sensor.read_nois=20": 2,
        "run first_light sensor.read_noise=20": 2,
        "plan first_light sensor.bits=99 doe=axico": 2,
        "config first_light steps.restored.node=restore.wienr": 2,
    }
    answers = asked(tmp_path, *commands)
    for (command, code), answer in zip(commands.items(), answers, strict=True):
        assert answer == here(tmp_path, monkeypatch, command), command
        assert answer[0] == code, command
