"""With `--no-code`, a recipe of a stranger runs no code, writes nowhere else and shows no file
that is not his.
"""

from __future__ import annotations

import csv
import os
import re
import signal
import sys
from html.parser import HTMLParser

import numpy as np
import pytest

from neusee.workflows.cli import app
from tests.workflows.cli import hostile_recipes
from tests.workflows.cli.hostile_recipes import HOSTILE, SECRET

pytestmark = [pytest.mark.usefixtures("one_thread"), pytest.mark.filterwarnings("ignore")]

PATIENCE = 600  #: s after which a command counts as one that waits for ever
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC
CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f\x80-\x9f\u202a-\u202e\u2066-\u2069]")
#: while a command runs: the files that were opened, to read and to write
_seen: dict[str, set[str]] = {}
_hooked: list[bool] = []


def _hear(event, arguments):
    if not _seen or event not in (
        "open",
        "subprocess.Popen",
        "os.system",
        "os.exec",
        "os.posix_spawn",
    ):
        return
    if event != "open" and arguments[0] != "fc-list":  # with which matplotlib looks for fonts
        _seen["started"].add(f"{event} {arguments[0]}")
    elif isinstance(arguments[0], str | bytes | os.PathLike):
        path, mode, flags = os.fsdecode(arguments[0]), arguments[1], arguments[2] or 0
        writes = any(c in mode for c in "wxa+") if isinstance(mode, str) else bool(flags & WRITES)
        _seen["written" if writes else "read"].add(os.path.realpath(path))


@pytest.fixture
def told(tmp_path, monkeypatch, capfd):
    """Call commands in the folder of a stranger, with what they opened; a call that never ends
    fails.
    """
    for name in ("stranger", "secret", "home"):
        (tmp_path / name).mkdir()
    write_secrets(tmp_path / "secret")
    write_secrets(tmp_path / "home")
    # of the compiled libraries
    monkeypatch.setenv("XDG_CACHE_HOME", os.path.expanduser("~/.cache"))
    monkeypatch.delenv("NEUSEE_CACHE", raising=False)  # it is below the home folder then
    for name, value in {"HOME": "home", "STRANGER": "secret"}.items():
        monkeypatch.setenv(name, str(tmp_path / value))
    monkeypatch.setenv("NEUSEE_NO_CODE", "")
    monkeypatch.chdir(tmp_path / "stranger")
    if not _hooked:
        sys.addaudithook(_hear)
        _hooked.append(True)

    def told(*words):
        _seen.update(read=set(), written=set(), started=set())
        before = signal.signal(signal.SIGALRM, lambda *_: pytest.fail(f"{words} did not end"))
        signal.alarm(PATIENCE)
        try:
            with pytest.raises(SystemExit) as end:
                app.main([*words, "--no-code"])
        finally:
            signal.alarm(0)
            signal.signal(signal.SIGALRM, before)
            seen = dict(_seen)
            _seen.clear()
        return end.value.code or 0, "".join(capfd.readouterr()), seen

    return told


def write_secrets(folder):
    from PIL import Image

    (folder / "secret.csv").write_text(SECRET + "\n" + "\n".join(["0.5"] * 40) + "\n")
    (folder / "secret.yaml").write_text(f"password: {SECRET}\n")
    np.save(folder / "secret.npy", np.full((8, 8, 4), hostile_recipes.NUMBER, np.float32))
    Image.fromarray(np.full((8, 8, 3), 77, np.uint8)).save(folder / "secret.png")


class Page(HTMLParser):
    """The elements of a page that a stranger may have put there."""

    def __init__(self):
        super().__init__()
        self.found = []

    def handle_starttag(self, tag, attrs):
        self.found += [
            (tag, name, value)
            for name, value in attrs
            if name.startswith("on") and "stranger" in value
        ]
        self.tag = tag

    def handle_data(self, data):
        if getattr(self, "tag", "") == "script" and "stranger" in data:
            self.found.append(("script", "", data))


def tree(folder):
    """Return the files below a folder, with their sizes, but for the results and the cache."""
    files = (
        path
        for path in folder.rglob("*")
        if not {"runs", ".cache", ".config"} & set(path.relative_to(folder).parts[:2])
    )
    return {str(path): path.lstat().st_size for path in files}


def check_pages(folder):
    for path in folder.rglob("*"):
        if path.is_symlink() or not path.is_file():
            continue
        raw = path.read_bytes()
        assert SECRET.encode() not in raw, path
        if path.suffix == ".html":
            page = Page()
            page.feed(raw.decode())
            assert page.found == [], path
        if path.suffix == ".csv":
            cells = [cell for row in csv.reader(raw.decode().splitlines()) for cell in row]
            assert [
                cell for cell in cells if cell[:1] in ("=", "@", "+") and not _is_number(cell)
            ] == [], path


def _is_number(cell):
    try:
        float(cell)
    except ValueError:
        return False
    return True


def commands_of(name):
    """The commands that meet a recipe: a plan refuses what is refused as `validate` does, and
    brackets take the reader of YAML seconds.
    """
    if HOSTILE[name].runs:
        return ("validate", "plan", "run")
    return ("run",) if name.startswith("deep brackets") else ("validate", "run")


@pytest.mark.slow
@pytest.mark.parametrize("name", HOSTILE)
def test_a_recipe_of_a_stranger_does_no_harm(name, told, tmp_path):
    text, make, runs = HOSTILE[name]
    folder, allowed = (
        tmp_path / "stranger",
        (str(tmp_path / "stranger" / "runs"), str(tmp_path / "home" / ".cache")),
    )
    make(folder)
    (folder / "mine.yaml").write_text(text.replace("{secret}", str(tmp_path / "secret")))
    before = tree(tmp_path)
    for command in commands_of(name):
        code, said, seen = told(command, "mine.yaml")
        assert code == (0 if runs else 2), said
        assert "Traceback" not in said
        assert SECRET not in said
        assert not CONTROL.search(said), repr(said)
        assert seen["started"] == set()
        assert [
            path for path in seen["read"] if path.startswith(str(tmp_path)) and "/secret" in path
        ] == []
        own = [path for path in seen["written"] if path.startswith(str(tmp_path))]
        assert [path for path in own if not path.startswith(allowed)] == []
        assert len(said) < 20_000
    assert tree(tmp_path) == before
    assert (folder / "runs").exists() == runs
    check_pages(folder / "runs")


def test_a_folder_of_results_that_is_a_link_is_not_followed(told, tmp_path):
    (tmp_path / "stranger" / "runs").symlink_to(tmp_path / "secret")
    (tmp_path / "stranger" / "mine.yaml").write_text(hostile_recipes.PLAIN)
    before = tree(tmp_path)
    code, said, _ = told("run", "mine.yaml")
    assert code == 2
    assert (
        said == "--out: runs is a link, which --no-code does not follow: name another folder with"
        " --out\n"
    )
    assert tree(tmp_path) == before


def test_the_reader_may_name_any_file(told, tmp_path):
    (tmp_path / "stranger" / "mine.yaml").write_text(
        hostile_recipes.picture('"${my.file}"') + "my: {file: a.png}\n"
    )
    (tmp_path / "stranger" / "a.png").symlink_to(tmp_path / "secret" / "secret.png")
    code, said, _ = told("validate", "mine.yaml")
    assert code == 2
    assert said.startswith(
        "mine.yaml:6:12   my.file = a.png   is not in the folder of mine.yaml, and with"
        " NEUSEE_NO_CODE or --no-code a recipe reads no other files: give the path as an argument"
    )
    assert told("validate", "mine.yaml", "my.file=../secret/secret.png")[0] == 0


def test_the_hook_of_this_file_sees_what_is_opened(told, tmp_path):
    _seen.update(read=set(), written=set(), started=set())
    (tmp_path / "stranger" / "x").write_text("")
    (tmp_path / "stranger" / "x").read_text()
    seen = dict(_seen)
    _seen.clear()
    assert seen["read"] == seen["written"] == {str(tmp_path / "stranger" / "x")}
