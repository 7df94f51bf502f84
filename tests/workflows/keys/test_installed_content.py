"""Installed packages that neusee does not declare count by the content of their files, in each
process alike.
"""

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from neusee.workflows.keys import module_digest as installed_content
from neusee.workflows.keys.module_digest import (
    BY_VERSION,
    counted,
    known_contents,
    read_memo,
    write_memo,
)
from neusee.workflows.keys.module_origin import plain
from tests.workflows.keys.forked_keys import told as keys_in

ROOT = Path(__file__).parents[3]
ASK = """
import json, sys
from neusee.workflows.keys.module_digest import counted
from neusee.workflows.keys.module_origin import version_of
print(json.dumps([counted(module, version_of(module)).parts for module in sys.argv[1:]]))
"""
EDITED = """
import thing
from pathlib import Path
from neusee.workflows.keys.module_digest import counted
{change}
print(counted("thing", "thing 1.0").edited)
"""
NODE = (
    "from neusee.nodes import node\nfrom thing import part\n\n\n@node()\ndef value():\n    return"
    " part()\n"
)


def install(folder, name="thing", body="x = 2\n", record="sha256=abc,6", requires="", extra=()):
    """Put a distribution into a folder, as pip does."""
    about = folder / f"{name}-1.0.dist-info"
    (folder / name).mkdir(parents=True, exist_ok=True)
    about.mkdir(exist_ok=True)
    (folder / name / "__init__.py").write_text(body)
    (about / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n{requires}\nText\n"
    )
    if record is not None:
        (about / "RECORD").write_text(
            "".join(f"{line}\n" for line in (f"{name}/__init__.py,{record}", *extra))
        )


def told(folder, script, *words):
    path = os.pathsep.join([str(folder), str(ROOT / ".src")])
    env = {**os.environ, "PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        [sys.executable, "-c", script, *words], env=env, cwd=folder, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def parts(folder, *modules):
    return json.loads(told(folder, ASK, *modules or ("thing",)))


@pytest.mark.slow
@pytest.mark.parametrize("record", ["sha256=abc,6", ",", None])
def test_other_files_under_the_same_version_are_other_code(tmp_path, record):
    install(tmp_path, record=record)
    [first] = parts(tmp_path)
    assert first["package thing"]["version"] == "thing 1.0"
    assert parts(tmp_path) == [first]
    install(tmp_path, body="x = 3\n", record=record)
    assert parts(tmp_path) != [first]


def test_a_file_beside_the_record_counts_and_what_no_code_reads_does_not(tmp_path):
    scripts = ("../../../bin/thing,sha256=1,2", "thing-1.0.dist-info/INSTALLER,sha256=3,4")
    install(tmp_path / "one")
    install(tmp_path / "two", extra=scripts)
    (tmp_path / "two" / "thing" / "__pycache__").mkdir()
    (tmp_path / "two" / "thing" / "__pycache__" / "a.pyc").write_bytes(b"x")
    (tmp_path / "two" / "thing" / "notes.txt").write_text("x")
    assert parts(tmp_path / "one") == parts(tmp_path / "two")
    (tmp_path / "two" / "thing" / "_local.py").write_text("x = 1\n")
    assert parts(tmp_path / "one") != parts(tmp_path / "two")


def test_a_table_that_a_record_names_counts(tmp_path):
    install(tmp_path, extra=("thing/table.csv,sha256=1,2",))
    found = []
    for text in ("1", "2"):
        (tmp_path / "thing" / "table.csv").write_text(text)
        found += parts(tmp_path)
    assert found[0] != found[1]


def test_what_a_package_requires_counts_but_not_for_its_extras(tmp_path):
    requires = (
        'Requires-Dist: helper>=1\nRequires-Dist: numpy\nRequires-Dist: unused; extra == "test"\n'
    )
    install(tmp_path, requires=requires)
    for name in ("helper", "unused"):
        install(tmp_path, name)
    [first] = parts(tmp_path)
    assert first.keys() == {"package thing", "package helper", "package numpy"}
    assert first["package numpy"].keys() == {"version"}
    install(tmp_path, "unused", body="x = 3\n")
    assert parts(tmp_path) == [first]
    install(tmp_path, "helper", body="x = 3\n")
    assert parts(tmp_path) != [first]


def test_packages_that_neusee_declares_count_by_their_version():
    """Their wheels differ between platforms and devices, and machines share results."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = [
        each
        for name, found in project["optional-dependencies"].items()
        for each in found
        if name not in ("test", "bench", "docs")
    ]
    names = {
        plain(re.match(r"[\w.-]+", each)[0]) for each in [*project["dependencies"], *extras]
    } - {"neusee"}
    assert names == BY_VERSION
    assert counted("scipy.fft", "scipy 1").parts == {"package scipy": {"version": "scipy 1"}}


def test_a_package_that_changes_after_its_import_is_told(tmp_path):
    install(tmp_path)
    assert told(tmp_path, EDITED.format(change="")) == ""
    change = "Path(thing.__file__).write_text('x = 3')"
    assert told(tmp_path, EDITED.format(change=change)) == "thing"


@pytest.mark.slow
def test_the_key_of_an_own_node_has_the_files_of_an_installed_helper(tmp_path):
    folders = [tmp_path / name for name in ("one", "again", "other")]
    for folder, number in zip(folders, (2.0, 2.0, 3.0), strict=True):
        install(folder, body=f"def part():\n    return {number}\n")
        (folder / "mine.py").write_text(NODE)
    first, again, other = (keys_in(folder)[0] for folder in folders)
    assert re.fullmatch(r"[0-9a-f]{32}", first), first
    assert again == first
    assert re.fullmatch(r"[0-9a-f]{32}", other), other
    assert other != first


def test_a_package_whose_stamps_are_known_is_not_read_again(tmp_path, monkeypatch):
    name = "pytest"  # installed long ago, and no package of neusee
    first = installed_content._content(name, name)
    write_memo(tmp_path / "code.json", {})
    known_contents.clear()
    read_memo(tmp_path / "code.json")
    monkeypatch.setattr(
        installed_content, "_digest_of", lambda file: pytest.fail(f"{file} was read")
    )
    assert installed_content._content(name, name) == first
