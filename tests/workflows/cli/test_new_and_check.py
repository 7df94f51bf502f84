"""`neusee new` writes starts that pass their own tests, and replaces nothing."""

import os
import subprocess
import sys

import pytest
from typer.testing import CliRunner

from neusee.workflows.cli.app import app
from neusee.workflows.cli.project_commands import KINDS


def new(*words):
    return CliRunner().invoke(app, ["new", *words])


@pytest.mark.slow
def test_each_start_passes_its_own_test(tmp_path):
    for kind in KINDS:
        written = new(kind, f"my_{kind}", "--in", str(tmp_path))
        assert written.exit_code == 0
        assert f"my_{kind}" in written.output
        assert "NAME" not in written.output
    env = {**os.environ, "NEUSEE_CACHE": str(tmp_path / "cache")}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "."]
    ran = subprocess.run(
        command, cwd=tmp_path, env=env, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stdout
    assert f"{len(KINDS) + 1} passed" in ran.stdout  # the network has two
    assert not [path for path in tmp_path.rglob("*.py") if "NAME" in path.read_text()]


def test_nothing_is_replaced(tmp_path):
    assert new("mask", "mine", "--in", str(tmp_path)).exit_code == 0
    (tmp_path / "mine.py").write_text("mine")
    (tmp_path / "test_mine.py").unlink()
    again = new("mask", "mine", "--in", str(tmp_path))
    assert again.exit_code == 2
    assert "mine.py, " in again.output
    assert (tmp_path / "mine.py").read_text() == "mine"
    assert not (tmp_path / "test_mine.py").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["lens", "mine"],
            "there is no start of a lens: write one of node, network, mask, recipe, sensor",
        ),
        (["node", "my-node"], "my-node is no name: use small letters, digits and _"),
        (["node", "class"], "class is no name"),
        (["node", "../mine"], "../mine is no name"),
        (["node", "torch"], "torch is the name of a module of Python or of an installed package"),
        (["network", "json"], "json is the name of a module of Python"),
        (["mask", "optics"], "optics is the name of the family optics of neusee"),
    ],
)
def test_a_wrong_word_is_said(words, message, tmp_path):
    found = new(*words, "--in", str(tmp_path))
    assert found.exit_code == 2
    assert message in found.output
    assert not list(tmp_path.iterdir())
