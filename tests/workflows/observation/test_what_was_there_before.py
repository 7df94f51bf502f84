"""A step that adds to a file, makes or removes one may find out what was there before, which no
key covers.
"""

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest

from neusee.workflows.observation.observed_call import observed
from neusee.workflows.observation.taints import Covered


def try_to(function, *arguments):
    try:
        return function(*arguments)
    except OSError:
        return None


def count(folder):
    with open(folder / "mark", "a+") as file:
        file.write("1")
        file.seek(0)
        return len(file.read())


def length(folder):
    with open(folder / "mark", "a") as file:
        return file.tell()


def overwrite(folder):
    os.close(os.open(folder / "mark", os.O_WRONLY | os.O_CREAT))


def exclusive(folder):
    try_to(lambda: open(folder / "mark", "x").close())


def linked(folder):
    with tempfile.TemporaryDirectory() as other:
        Path(other, "a").write_text("1")
        try_to(os.link, Path(other, "a"), folder / "mark")


def moved_folder(folder):
    with tempfile.TemporaryDirectory() as other:
        os.mkdir(Path(other, "a"))
        try_to(os.rename, Path(other, "a"), folder / "mark")


DEPENDING = {
    "a count": count,
    "a length": length,
    "an overwriting open": overwrite,
    "a file that must be new": exclusive,
    "a touch": lambda folder: (folder / "mark").touch(),
    "a folder": lambda folder: try_to(os.mkdir, folder / "mark"),
    "a folder or one that is there": lambda folder: try_to(
        lambda: (folder / "mark").mkdir(exist_ok=True)
    ),
    "a symbolic link": lambda folder: try_to(os.symlink, "x", folder / "mark"),
    "a hard link": linked,
    "a removal": lambda folder: try_to(os.unlink, folder / "mark"),
    "a removal of a folder": lambda folder: try_to(os.rmdir, folder / "mark"),
    "a move": lambda folder: try_to(os.rename, folder / "mark", folder / "moved"),
    "new rights": lambda folder: try_to(os.chmod, folder / "mark", 0o600),
    "a new time": lambda folder: try_to(os.utime, folder / "mark"),
    "a new length": lambda folder: try_to(os.truncate, folder / "mark", 0),
}


@pytest.mark.parametrize("there", [True, False])
@pytest.mark.parametrize("kind", DEPENDING)
def test_what_depends_on_what_was_there_is_found(kind, there, tmp_path, taints, layer):
    if there:
        (tmp_path / "mark").write_text("1")
    found = taints(lambda: DEPENDING[kind](tmp_path))
    assert ("write", "mark") in found or ("file", "mark") in found


def test_a_folder_that_is_moved_onto_another_is_found(tmp_path, taints, layer):
    (tmp_path / "mark").mkdir()
    assert ("write", "mark") in taints(lambda: moved_folder(tmp_path))


def anew(folder):
    (folder / "out.txt").write_text("1")
    return (folder / "out.txt").read_text()


def replaced(folder):
    with tempfile.NamedTemporaryFile("w", dir=folder, delete=False) as file:
        file.write("1")
    os.replace(file.name, folder / "out.txt")


def scratch(folder):
    kept = tempfile.mkdtemp(dir=folder)
    with open(Path(kept, "log"), "a") as file:
        file.write("1")
    os.mkdir(Path(kept, "inner"))
    os.unlink(Path(kept, "log"))
    descriptor, name = tempfile.mkstemp(dir=folder)
    os.close(descriptor)
    os.unlink(name)


def gone_at_the_end(folder):
    with tempfile.TemporaryDirectory() as other:
        for _ in range(2):
            with open(Path(other, "log"), "a") as file:
                file.write("1")
        shutil.copytree(other, Path(other).with_suffix(".b"))
        shutil.rmtree(Path(other).with_suffix(".b"))


def always_there(folder):
    Path(tempfile.gettempdir()).mkdir(exist_ok=True)
    with open(os.devnull, "a") as file:
        file.write("1")


@pytest.mark.parametrize("step", [anew, replaced, scratch, gone_at_the_end, always_there])
@pytest.mark.parametrize("there", [True, False])
def test_a_file_that_is_written_anew_or_is_temporary_is_none(step, there, tmp_path, taints, layer):
    if there:
        (tmp_path / "out.txt").write_text("0")
    assert taints(lambda: step(tmp_path)) == []


def test_a_taint_says_how_a_log_is_written(tmp_path):
    found = observed(lambda: length(tmp_path), Covered(frozenset(), lambda name: True))[1]
    assert [each.what for each in found] == [str(tmp_path / "mark")]
    assert 'depends=["unaffected:mark"]' in found[0].fix
    assert 'mode "w"' in found[0].fix


def test_marks_of_a_covered_file_are_found_and_a_copy_of_it_is_none(tmp_path, taints, layer):
    file = tmp_path / "scan.csv"
    file.write_text("1")

    def copy():
        with tempfile.TemporaryDirectory() as other:
            return Path(shutil.copy2(file, other)).read_text()

    assert taints(lambda: os.listxattr(file), file) == [("attribute", "scan.csv")]
    assert taints(copy, file) == []


def test_marks_of_an_open_file_are_found(tmp_path, taints, watched):
    file = tmp_path / "scan.csv"
    file.write_text("1")

    def step():
        with open(file) as opened:
            return os.listxattr(opened.fileno())

    assert taints(step, file) == [("attribute", "scan.csv")]


def test_what_a_child_process_makes_is_found(tmp_path, taints, watched):
    assert ("write", "mark") in taints(
        lambda: subprocess.run(["mkdir", str(tmp_path / "mark")], check=True)
    )
