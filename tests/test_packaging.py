"""What is built from this folder: the files of the wheel and of the source archive, and links
where one edits.
"""

import importlib.util
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

import neusee

ROOT = Path(__file__).parents[1]
ROOMS = ("nodes", "workflows", "recipes")
# Python 3.11.0 to 3.11.3 have no filter
SAFELY = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        importlib.util.find_spec("hatchling") is None, reason="hatchling is not installed"
    ),
]


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The wheel and the source archive, built without a network."""
    folder = tmp_path_factory.mktemp("dist")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-d", folder],
        cwd=ROOT,
        check=True,
        capture_output=True,
    )
    (wheel,), (archive,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    return wheel, archive


def source():
    """Every file of the program, by its path below the package."""
    hidden = ("__pycache__",)
    rooms = [
        p
        for room in ROOMS
        for p in (ROOT / room).rglob("*")
        if p.is_file() and not set(hidden) & set(p.parts)
    ]
    package = [
        ROOT / ".src" / "neusee" / name for name in ("__init__.py", "__main__.py", "py.typed")
    ]
    return {str(p.relative_to(ROOT)) for p in rooms} | {p.name for p in package}


def test_the_wheel_holds_every_file_once(built):
    names = zipfile.ZipFile(built[0]).namelist()
    assert len(names) == len(set(names))
    here = {
        name.removeprefix("neusee/")
        for name in names
        if not name.startswith(f"neusee-{neusee.__version__}.dist-info")
    }
    assert here == source()
    assert any(name.endswith("licenses/LICENSE") for name in names)


def test_the_version_is_that_of_the_package(built):
    assert [path.name.split("-")[1].removesuffix(".tar.gz") for path in built] == [
        neusee.__version__
    ] * 2


def test_the_source_archive_holds_all_that_builds_and_checks_it(built):
    top = f"neusee-{neusee.__version__}/"
    with tarfile.open(built[1]) as archive:
        names = [name.removeprefix(top) for name in archive.getnames()]
    assert len(names) == len(set(names))
    package = {f".src/neusee/{name}" if "/" not in name else name for name in source()}
    tests = {str(p.relative_to(ROOT)) for p in (ROOT / "tests").rglob("*.py")}
    whole = {
        "README.md",
        "LICENSE",
        "CHANGELOG.md",
        "CITATION.cff",
        "pyproject.toml",
        ".ci/run",
        ".ci/source_links.py",
    }
    assert package | tests | whole <= set(names)
    assert [
        name for name in names if name.startswith(tuple(f".src/neusee/{room}" for room in ROOMS))
    ] == []


def test_a_wheel_made_of_the_source_archive_is_the_same(built, tmp_path):
    with tarfile.open(built[1]) as archive:
        archive.extractall(tmp_path, **SAFELY)
    (unpacked,) = tmp_path.iterdir()
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", tmp_path / "dist"]
    subprocess.run(command, cwd=unpacked, check=True, capture_output=True)
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    assert sorted(zipfile.ZipFile(wheel).namelist()) == sorted(zipfile.ZipFile(built[0]).namelist())


def test_an_unpacked_archive_that_is_installed_for_editing_gets_its_links(built, tmp_path):
    with tarfile.open(built[1]) as archive:
        archive.extractall(tmp_path, **SAFELY)
    (unpacked,) = tmp_path.iterdir()
    build = f"import hatchling.build; hatchling.build.build_editable({str(tmp_path)!r})"
    subprocess.run([sys.executable, "-c", build], cwd=unpacked, check=True, capture_output=True)
    links = [unpacked / ".src" / "neusee" / room for room in ROOMS]
    assert [link.is_symlink() and link.resolve() == unpacked / link.name for link in links] == [
        True
    ] * 3
    env = {"PYTHONPATH": str(unpacked / ".src"), "PATH": ""}
    code = "import neusee.nodes; print(neusee.nodes.__file__)"
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=env,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.startswith(str(unpacked))
