"""`neusee init` makes a folder that works at once, and replaces nothing."""

import os
import re
import shlex

import pytest
import typer
from typer.main import get_command
from typer.testing import CliRunner

from neusee.workflows.cli.app import app
from neusee.workflows.cli.project_commands import FILES, NEXT
from neusee.workflows.recipe.loading import load
from tests.workflows.forked_commands import Commands


def init(*words):
    return CliRunner().invoke(app, ["init", *map(str, words)])


def test_the_recipe_of_a_new_folder_has_no_mistake(tmp_path):
    made = init(tmp_path / "lab" / "mine")
    assert (made.exit_code, made.output.count("written  ")) == (0, len(FILES))
    assert f"  cd {tmp_path / 'lab' / 'mine'}\n" in made.output
    folder = tmp_path / "lab" / "mine"
    assert {
        p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()
    } == FILES.keys()
    assert not [path for path in folder.rglob("*.*") if "NAME" in path.read_text()]
    recipe = load(folder / "my_camera.yaml")
    assert recipe.steps["bloomed[mask]"].node.path == "blooming.blooming"
    assert recipe.config["sensor.bits"].source.endswith("sensor/my_sensor.yaml:9:9")


def test_every_command_of_the_readme_parses(tmp_path):
    init(tmp_path)
    text = (tmp_path / "README.md").read_text()
    lines = [
        *re.findall(r"^    neusee ([^#\n]*)", text, re.MULTILINE),
        *(c[7:] for c in NEXT if c.startswith("neusee")),
    ]
    assert len(lines) >= 10
    program = get_command(app)
    for line in lines:
        name, command, rest = program.resolve_command(typer.Context(program), shlex.split(line))
        values = command.make_context(name, list(rest)).params
        for word in (values.get("words") or [])[:1] + [
            values[key] for key in ("place",) if key in values
        ]:
            assert (tmp_path / word).is_file(), line
    for place in re.findall(r"^\| `([^`]+)` \|", text, re.MULTILINE):
        assert (tmp_path / place).exists() or place == "runs/"


def test_nothing_is_replaced(tmp_path):
    (tmp_path / "sensor").mkdir()
    (tmp_path / "sensor" / "my_sensor.yaml").write_text("mine")
    found = init(tmp_path)
    assert found.exit_code == 2
    assert (
        f"sensor/my_sensor.yaml: there is such a file in {tmp_path} already, and none is replaced"
        in found.output
    )
    assert [path.name for path in tmp_path.iterdir()] == ["sensor"]
    assert (tmp_path / "sensor" / "my_sensor.yaml").read_text() == "mine"


def test_a_file_is_no_place_for_a_project(tmp_path):
    (tmp_path / "file").write_text("")
    for place in (tmp_path / "file", tmp_path / "file" / "below"):
        found = init(place)
        assert found.exit_code == 2
        assert (
            f"{tmp_path / 'file'} is a file, so that no project can be made in {place}"
            in found.output
        )


@pytest.mark.slow
def test_a_new_folder_runs_and_passes_its_tests_and_takes_more(tmp_path):
    init(tmp_path)
    env = {**os.environ, "NEUSEE_CACHE": str(tmp_path / ".cache"), "OMP_NUM_THREADS": "1"}
    commands = [
        "neusee new sensor night_sensor",
        "neusee new node smear --in nodes",
        "neusee new recipe other_camera",
        "neusee run my_camera.yaml outputs=[raw,lsr] --quiet",
        "neusee validate other_camera.yaml sensor=night_sensor",
        "pytest -q -p no:cacheprovider nodes tests sensor",
    ]
    forks = Commands()
    for command in commands:
        program, *words = shlex.split(command)
        code = f"import runpy\nrunpy.run_module({program!r}, run_name='__main__')"
        done = forks(*words, cwd=tmp_path, env=env, code=code)
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    forks.close()
    assert "5 passed" in done.stdout
    assert (tmp_path / "runs" / "latest" / "ro-crate-metadata.json").is_file()
