"""Commands on files that need too much memory, or are no files: exit code 2 and one located
sentence.
"""

import os

import numpy as np
import pytest

from neusee.nodes import input_files
from neusee.workflows.cli import app
from neusee.workflows.engine.machine_resources import limited
from tests import file_bombs as bombs

RECIPE = """# A picture.
outputs: [picture]
steps:
  picture: {{node: scene.{node}, with: {{file: {file}}}}}
"""


@pytest.fixture
def neusee(tmp_path, monkeypatch, capfd):
    """Run a command on a recipe of one file; give the exit code and what is printed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path / "cache"))

    def neusee(node, file, *words):
        (tmp_path / "mine.yaml").write_text(RECIPE.format(node=node, file=file))
        with pytest.raises(SystemExit) as end:
            app.main([*words[:1], "mine.yaml", *words[1:]])
        return end.value.code or 0, "".join(capfd.readouterr())

    return neusee


@pytest.mark.parametrize("command", ["run", "plan"])
def test_the_limit_of_a_command_holds_for_what_it_reads(neusee, tmp_path, command):
    bombs.exr(tmp_path / "a.exr", size=(7000, 7000))
    code, said = neusee("exr", "a.exr", command, "--memory", "1.5 GB")
    assert code == 2
    assert "mine.yaml:4:43   steps.picture.with.file = a.exr" in said
    assert (
        "would need 1.76 GB of memory to read (7000 x 7000 pixels in 3 channels), more than the"
        in said
    )
    assert (
        "are left of the limit of 1.5 GB: raise the limit by --memory, crop the file, or give"
        " another file" in said
    )


@pytest.mark.parametrize(("node", "name"), [("photograph", "a.png"), ("exr", "a.exr")])
def test_a_pipe_is_no_picture(neusee, tmp_path, node, name):
    os.mkfifo(tmp_path / name)
    code, said = neusee(node, name, "validate")
    assert code == 2
    assert f"{name} is not a regular file" in said


def test_a_pipe_in_the_place_of_a_record_of_code_makes_no_run_wait(neusee, tmp_path):
    from PIL import Image

    Image.fromarray(np.arange(192, dtype=np.uint8).reshape(8, 8, 3)).save(tmp_path / "a.png")
    assert neusee("photograph", "a.png", "run", "--quiet")[0] == 0
    records = [
        *(tmp_path / "cache").rglob("code.json"),
        *(tmp_path / "cache" / "code").glob("*.json"),
    ]
    assert records
    for path in records:
        path.unlink()
        os.mkfifo(path)
    assert neusee("photograph", "a.png", "run", "--quiet")[0] == 0


# --- the rule itself ------------------------------------------------------------------------------


def test_what_is_free_is_compared_where_no_limit_is_set(monkeypatch):
    monkeypatch.setattr(input_files, "_measures", [lambda: input_files.Room(50e6)])
    input_files.needs(50e6, "a.npy", "numbers")
    with pytest.raises(input_files.BeyondMemory) as refused:
        input_files.needs(3.7e9, "a.npy", "numbers")
    assert (
        str(refused.value)
        == "a.npy would need 3.7 GB of memory to read (numbers), more than the 50 MB that are"
        " free: "
        "free memory, crop the file, or give another file"
    )


def test_a_small_file_is_read_whatever_is_free(monkeypatch):
    monkeypatch.setattr(input_files, "_measures", [lambda: input_files.Room(-1e9)])
    input_files.needs(input_files.SMALL, "a.npy", "numbers")
    with pytest.raises(input_files.BeyondMemory, match="more than the 0 bytes that are free"):
        input_files.needs(input_files.SMALL + 1, "a.npy", "numbers")


def test_the_least_limit_of_the_process_counts():
    with limited(1e15), limited(1e14):
        room = input_files._measures[-1]()
        assert room.limit == 1e14
        assert room.free <= input_files.free_memory().free + 1e9
    assert input_files._measures[-1]().limit is None


def test_a_line_that_is_too_long_is_named(tmp_path):
    (tmp_path / "a.csv").write_text("a,b\n" + "1" * (input_files.LINE + 1))
    with pytest.raises(ValueError, match=r"a\.csv:2 has more than 1000000 characters"):
        list(input_files.lines_of(tmp_path / "a.csv"))
    (tmp_path / "a.csv").write_text("a,b\r\n" + "1" * input_files.LINE)
    assert [len(line) for line in input_files.lines_of(tmp_path / "a.csv")] == [5, input_files.LINE]
