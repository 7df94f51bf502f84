"""A stored answer is given only while everything that decided it is as it was, and is what the
command would say.
"""

import json
import os
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from neusee.workflows.answers import repeated_command, stored_answer
from neusee.workflows.answers import repeated_command as installed_program
from neusee.workflows.report.run_crate import CRATE


def rewrite(path, text):
    """Write another text of the same length, and give the file its old time."""
    about = path.stat()
    assert len(text) == about.st_size
    path.write_text(text)
    os.utime(path, ns=(about.st_atime_ns, about.st_mtime_ns))


def hide(place, name):
    (place.root / name).parent.mkdir(parents=True, exist_ok=True)
    (place.root / name).write_text("x = 1\n")


def reinstall(place):
    os.utime(place.root / "site-packages" / "torch-2.6.dist-info", ns=(0, 10**18))


def exchange(place, name):
    """Put a link to another file in the place of a file."""
    path = place.root / name
    path.rename(place.root / "old")
    (place.root / "new").write_text("other: 1\n")
    path.symlink_to(place.root / "new")


CHANGES = {
    "a word": lambda p, m: p.words.append("a.c=2"),
    "the order of words": lambda p, m: p.words.reverse(),
    "a word is split": lambda p, m: p.words.__setitem__(
        slice(None), ["safety", "mine.yaml", "a.b", "=1"]
    ),
    "the working folder": lambda p, m: m.setattr(os, "getcwd", lambda: "/elsewhere"),
    "a variable of neusee": lambda p, m: m.setenv("NEUSEE_CACHE_VERIFY", "never"),
    "the budget": lambda p, m: m.setenv("NEUSEE_CACHE_BUDGET", "1 TB"),
    "folders of recipes": lambda p, m: m.setenv("NEUSEE_RECIPES", str(p.root)),
    "no code": lambda p, m: m.setenv("NEUSEE_NO_CODE", "1"),
    "the language": lambda p, m: m.setenv("LC_ALL", "de_DE.UTF-8"),
    "a variable of the user": lambda p, m: m.setenv("MY_NODE_READS", "this"),
    "a variable less": lambda p, m: m.delenv("PATH"),
    "the width": lambda p, m: p.terminal.__setitem__(0, 120),
    "a terminal in place of a file": lambda p, m: p.terminal.__setitem__(2, [True, "utf-8"]),
    "the encoding": lambda p, m: p.terminal.__setitem__(2, [False, "ascii"]),
    "the version of Python": lambda p, m: m.setattr(sys, "version", "3.13.9"),
    "an option of Python": lambda p, m: m.setitem(sys._xoptions, "dev", True),
    "the search path of modules": lambda p, m: m.setattr(sys, "path", [*sys.path, "/more"]),
    "the machine": lambda p, m: m.setattr(os, "uname", lambda: ("Linux", "other")),
    "the recipe, of the same size and time": lambda p, m: rewrite(
        p.work / "mine.yaml", "title: MINE\n"
    ),
    "the recipe becomes a link": lambda p, m: exchange(p, "work/mine.yaml"),
    "an option": lambda p, m: rewrite(p.work / "laser" / "green.yaml", "wavelength: 533 nm\n"),
    "an option is gone": lambda p, m: (p.work / "laser" / "red.yaml").symlink_to("green.yaml"),
    "a new option beside the recipe": lambda p, m: hide(p, "work/sensor/neusee.yaml"),
    "a new option beside an extended recipe": lambda p, m: hide(p, "other/laser/green.yaml"),
    "a new recipe beside the recipe": lambda p, m: hide(p, "work/safety_pointer.yaml"),
    "a new option of the user": lambda p, m: hide(
        p, "home/.config/neusee/recipes/laser/green.yaml"
    ),
    "an option of the user is no file any more": lambda p, m: (
        (p.root / "home/.config/neusee/recipes/laser/red.yaml").unlink(),
        (p.root / "home/.config/neusee/recipes/laser/red.yaml").mkdir(),
    ),
    "a file that was missing": lambda p, m: hide(p, "work/wanted.txt"),
    "a link to nothing where a file was missing": lambda p, m: (p.work / "wanted.txt").symlink_to(
        "nowhere"
    ),
    "an input file, of the same size and time": lambda p, m: rewrite(p.work / "table.csv", "1,3\n"),
    "an input file is gone": lambda p, m: (p.work / "table.csv").unlink(),
    "a pipe in place of an input file": lambda p, m: (
        (p.work / "table.csv").unlink(),
        os.mkfifo(p.work / "table.csv"),
    ),
    "a source file, of the same size and time": lambda p, m: rewrite(
        p.program / "nodes" / "physics.py", "c = 4e8\n"
    ),
    "a new source file": lambda p, m: hide(p, "program/nodes/more.py"),
    "a source file is renamed": lambda p, m: (p.program / "nodes/physics.py").rename(
        p.program / "nodes/optics.py"
    ),
    "a template": lambda p, m: rewrite(p.program / "workflows" / "page.html.j2", "<b>\n"),
    "the version of neusee": lambda p, m: rewrite(p.program / "__init__.py", "version = 2\n"),
    "a package is installed": lambda p, m: hide(p, "site-packages/scipy-1.13.dist-info/METADATA"),
    "another version of a package": lambda p, m: (
        p.root / "site-packages" / "torch-2.6.dist-info"
    ).rename(p.root / "site-packages" / "torch-2.7.dist-info"),
    "a package is installed again": lambda p, m: reinstall(p),
    "a module that hides a package": lambda p, m: hide(p, "modules/scipy.py"),
    "a folder that hides a package": lambda p, m: hide(p, "modules/colour/__init__.py"),
    "a graphics device": lambda p, m: m.setattr(
        installed_program, "_devices", lambda: ["nvidia0", "driver 600"]
    ),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_what_has_changed_is_computed_anew(place, monkeypatch, change):
    assert not place.again()
    change(place, monkeypatch)
    command = repeated_command.Command(place.words, place.terminal, place.disk)
    assert command.answer() is None


@pytest.mark.parametrize(
    "change",
    [
        lambda p, m: m.setenv("SHLVL", "7"),
        lambda p, m: m.setenv("NEUSEE_CACHE_SECRET", ""),
        lambda p, m: os.utime(p.work / "mine.yaml"),
        lambda p, m: hide(p, "program/nodes/__pycache__/physics.cpython-311.pyc"),
        lambda p, m: hide(p, "work/notes.txt"),
        lambda p, m: hide(p, "runs/other/recipe.yaml"),
    ],
    ids=[
        "depth of shells",
        "no secret",
        "time of a file",
        "bytecode",
        "a file that nobody reads",
        "another run",
    ],
)
def test_what_decides_nothing_costs_nothing(place, monkeypatch, change):
    change(place, monkeypatch)
    assert not place.again()


def test_a_repeated_command_writes_the_same_folder_with_its_own_date(place):
    place.with_a_real_page()
    first = place.work / place.ask().rpartition(" ")[2].removesuffix("/report.html")
    text = place.ask()
    assert place.computed == 2, "with that of the fixture"
    third = place.work / text.rpartition(" ")[2].removesuffix("/report.html")
    assert third != first
    assert os.readlink(place.work / "runs" / "latest") == third.name
    names = sorted(
        path.relative_to(first).as_posix() for path in first.rglob("*") if path.is_file()
    )
    assert names == sorted(
        path.relative_to(third).as_posix() for path in third.rglob("*") if path.is_file()
    )
    document, again = (
        json.loads((folder / "provenance.json").read_text()) for folder in (first, third)
    )
    assert again["seconds"] != document["seconds"]
    assert again | {"date": 0, "seconds": 0} == document | {"date": 0, "seconds": 0}
    page = (third / "report.html").read_text()
    assert again["date"] in page
    assert f"{again['seconds']:.3g}" in page
    assert "@neusee" not in page
    crate = {each["@id"]: each for each in json.loads((third / CRATE).read_text())["@graph"]}
    assert third.name.startswith(crate["./"]["name"])
    assert crate["./"]["datePublished"][:19] >= again["date"][:19]
    for name in set(names) - {CRATE}:
        assert crate[name]["contentSize"] == str((third / name).stat().st_size)
        if name not in ("provenance.json", "report.html"):
            assert (third / name).read_bytes() == (first / name).read_bytes(), name


def test_the_folder_of_an_earlier_run_is_not_needed(place):
    for path in sorted((place.work / "runs").rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() and not path.is_symlink() else path.unlink()
    assert not place.again()
    assert (place.work / "runs" / "latest" / "figures" / "curve.png").read_bytes() == b"PNG"


# --- answers that are not kept --------------------------------------------------------------------


def doubtful(place, monkeypatch, meanwhile=lambda: None):
    """Compute a new command; return True if no answer of it is kept."""
    place.words.append("another=1")
    assert place.again(meanwhile)
    return place.again()


def test_a_new_command_is_kept(place, monkeypatch):
    assert not doubtful(place, monkeypatch)


@pytest.mark.parametrize(
    "name",
    ["work/mine.yaml", "work/laser/green.yaml", "work/table.csv", "program/nodes/physics.py"],
)
def test_a_file_that_changes_while_the_command_runs_is_not_kept(place, monkeypatch, name):
    def change():
        time.sleep(0.02)  # a tick of the clock of the file system
        (place.root / name).write_text((place.root / name).read_text())

    assert doubtful(place, monkeypatch, change)


def test_a_source_that_changed_just_before_the_command_is_not_kept(place, monkeypatch):
    monkeypatch.setattr(repeated_command, "_IMPORTED", 3600 * 10**9)
    assert doubtful(place, monkeypatch)


def test_a_command_with_a_warning_is_not_kept(place, monkeypatch):
    place.warns = True
    assert doubtful(place, monkeypatch)


def test_a_command_that_has_printed_a_warning_is_not_kept(place, monkeypatch):
    from neusee.workflows.cli.command_frame import print_warning

    assert doubtful(place, monkeypatch, lambda: print_warning("something is odd"))


def test_a_recipe_that_runs_code_of_its_own_is_not_kept(place, monkeypatch):
    monkeypatch.setattr(repeated_command, "_own_code", lambda: ["mine"])
    assert doubtful(place, monkeypatch)


def test_code_of_its_own_is_found_among_the_modules():
    found = list(repeated_command._own_code())
    assert __name__ in found or any(name.startswith("test") for name in found)
    assert not [
        name
        for name in found
        if name.partition(".")[0] in ("neusee", "torch", "numpy", "json", "pytest")
    ]


def test_a_file_format_that_is_read_without_python_is_not_kept(place, monkeypatch):
    monkeypatch.setattr(repeated_command, "_NATIVE", ("json",))
    assert doubtful(place, monkeypatch)


def test_a_folder_as_an_input_is_not_kept(place, monkeypatch):
    (place.work / "table.csv").unlink()
    (place.work / "table.csv").mkdir()
    assert doubtful(place, monkeypatch)


def test_a_recipe_in_the_folder_of_the_cache_is_not_kept(place, monkeypatch):
    monkeypatch.setattr(
        type(place), "disk", property(lambda self: repeated_command.Disk(self.work))
    )
    assert doubtful(place, monkeypatch)


@pytest.mark.parametrize("where", ["s3://bucket/cache", "file:///tmp/cache"])
def test_a_cache_at_a_url_has_no_answers(monkeypatch, where):
    monkeypatch.delitem(sys.modules, "torch", raising=False)
    monkeypatch.setenv("NEUSEE_CACHE", where)
    assert repeated_command.begin(["safety"], []) is None


def test_a_process_that_has_imported_torch_asks_for_no_answer(monkeypatch, tmp_path):
    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path))
    monkeypatch.setitem(sys.modules, "torch", sys)
    assert repeated_command.begin(["safety"], []) is None
    monkeypatch.delitem(sys.modules, "torch")
    assert repeated_command.begin(["safety"], []) is not None


def test_a_folder_of_results_that_cannot_be_written_is_left_to_the_command(place):
    (place.work / "runs").rename(place.work / "away")
    (place.work / "runs").write_text("not a folder")
    command = repeated_command.Command(place.words, place.terminal, place.disk)
    assert command.answer() is None


def forge(place, **changed):
    """Write the stored answer again with other fields, under a seal that is right."""
    disk, name = place.disk, place.stored.stem
    stored_answer.write_answer(
        disk, name, replace(stored_answer.read_answer(disk, name), **changed)
    )


@pytest.mark.parametrize("where", ["..", "/tmp", "runs/../..", "", "runs2"])
def test_an_answer_that_names_another_folder_of_results_is_not_given(place, where):
    forge(place, out=where)
    assert place.again()


@pytest.mark.parametrize(
    "document", [b"", b"[]", b"{}{", b"\xff", b'{"seconds": "long", "date": 3, "versions": 1}']
)
def test_an_answer_with_a_document_that_is_none_is_not_given(place, document):
    files = dict(stored_answer.read_answer(place.disk, place.stored.stem).files)
    forge(place, files=files | {"provenance.json": document})
    assert place.again()
    assert not list((place.work / "runs").glob(".*.part"))


@pytest.mark.parametrize(
    "words", [["--out", "there"], ["--out=there"], ["--out", "there/"], ["--out", "./there"]]
)
def test_a_named_folder_of_results_is_used_again(place, words):
    place.words += words
    place.out = Path("there")
    assert place.again()
    assert not place.again()
    assert len(list((place.work / "there").glob("2*"))) == 2


def test_a_command_that_only_prints_has_an_answer_without_a_folder(place):
    place.says_only = True
    place.words[0] = "config"
    before = set((place.work / "runs").iterdir())
    text = place.ask()
    assert not place.again()
    assert place.ask() == text
    assert set((place.work / "runs").iterdir()) == before
    (place.work / "mine.yaml").write_text("title: yours\n")
    assert "yours" in place.ask()


def test_a_command_that_only_prints_makes_no_cache(place):
    place.says_only = True
    (place.root / "cache").rename(place.root / "gone")
    assert place.again()
    assert place.again()
    assert not (place.root / "cache").exists()


@pytest.mark.parametrize("change", ["label", "files"])
def test_an_answer_without_a_folder_has_neither_label_nor_files(place, change):
    forge(place, key="", **({"files": {}} if change == "label" else {"label": ""}))
    assert place.again()


def test_a_folder_that_was_listed_is_a_witness(place):
    (place.work / "frames").mkdir()
    place.words.append("frames=frames")
    assert place.again(lambda: os.listdir("frames"))
    assert not place.again()
    (place.work / "frames" / "one.png").write_bytes(b"")
    assert place.again(lambda: os.listdir("frames"))


@pytest.mark.parametrize("out", ["fresh", "results/of/today"])
def test_the_first_command_in_a_folder_is_kept_although_it_makes_the_folder_of_results(place, out):
    place.out = Path(out)
    place.words += ["--out", out]
    assert place.again(lambda: os.listdir("."))  # as Python does where it looks for modules
    assert (place.work / out).is_dir()
    assert not place.again()
    (place.work / "new.txt").write_text("")
    assert place.again(lambda: os.listdir("."))


def test_another_name_beside_the_folder_of_results_is_a_change(place):
    def meanwhile():
        os.listdir(".")
        (place.work / "runs2").mkdir()

    assert doubtful(place, None, meanwhile)


def test_results_in_the_folder_of_the_recipe_are_not_kept(place):
    place.words += ["--out", "."]
    place.out = Path(".")
    assert place.again()
    assert place.again()


def test_a_folder_that_changes_after_it_was_listed_is_not_kept(place):
    def meanwhile():
        os.listdir("laser")
        (place.work / "laser" / "new.yaml").write_text("")

    assert doubtful(place, None, meanwhile)


def test_a_folder_that_changed_before_it_was_listed_is_not_kept(place):
    def meanwhile():
        time.sleep(0.02)  # a tick of the clock of the file system
        (place.work / "laser" / "brief.yaml").write_text("")
        (place.work / "laser" / "brief.yaml").unlink()
        os.listdir("laser")

    assert doubtful(place, None, meanwhile)
