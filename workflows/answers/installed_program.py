"""Digest of the program as it is installed: its source files, the packages beside it, and the graphics devices."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]  #: of the package neusee
SOURCES = ("nodes", "workflows")  #: folders of the package of which every file counts
SITES = ("site-packages", "dist-packages")  #: names of folders of installed packages
_ABOUT = (".dist-info", ".egg-info", ".egg-link", ".pth")
_CODE = (".py", ".so", ".pyd", ".zip")
_DRIVER = "/proc/driver/nvidia/version"


class ProgramState(NamedTuple):
    """Digest of the installed program, and when the newest of its source files changed."""

    digest: str
    changed: int  #: ns since 1970


def standard_library() -> str:
    """Return the folder of Python's own modules."""
    return os.path.dirname(os.path.realpath(os.__file__))


def program_state(root: Path = ROOT) -> ProgramState:
    """Return the state of the program, with the content of each of its source files; import nothing.

    Raises `OSError` if the package is not a folder of files.
    """
    text, changed = hashlib.blake2b(digest_size=16), 0
    for name in _source_files(root):
        with open(root / name, "rb") as file:
            stat, content = os.fstat(file.fileno()), file.read()
        text.update(b"%s\0%d\0" % (os.fsencode(name), len(content)) + content)
        changed = max(changed, stat.st_mtime_ns, stat.st_ctime_ns)
    text.update(
        repr([[_importable(folder) for folder in dict.fromkeys(sys.path)], _devices()]).encode(errors="replace")
    )
    return ProgramState(text.hexdigest(), changed)


def _source_files(root: Path) -> list[str]:
    """Return the paths of all source files relative to the package, sorted."""
    found = [name for name in ("__init__.py", "__main__.py") if (root / name).is_file()]
    for folder in SOURCES:
        inside = [os.path.join(folder, name) for name in _below(os.fspath(root / folder))]
        if not inside:
            raise FileNotFoundError(f"{root / folder} has no source files")
        found += inside
    return sorted(found)


def _below(folder: str, above: str = "") -> Iterator[str]:
    with os.scandir(folder) as entries:
        for entry in entries:
            name = f"{above}{entry.name}"
            if entry.name == "__pycache__":
                continue
            if entry.is_dir():
                yield from _below(entry.path, f"{name}/")
            else:
                yield name


def _importable(folder: str) -> list[tuple[str, int]]:
    """Return what a folder of the search path can import: installed packages with their time, or files of code.

    The folders of Python itself count by the version of Python.
    """
    where = os.path.realpath(folder or ".")
    installed = os.path.basename(where) in SITES
    if not installed and f"{where}/".startswith(f"{standard_library()}/"):
        return []
    try:
        with os.scandir(where) as entries:
            kept = [each for each in entries if (each.name.endswith(_ABOUT) if installed else _is_code(each))]
            return sorted((each.name, each.stat().st_mtime_ns if installed else 0) for each in kept)
    except OSError as error:
        return [(type(error).__name__, 0)]


def _is_code(entry: os.DirEntry[str]) -> bool:
    return entry.name.endswith(_CODE) or os.path.isfile(f"{entry.path}/__init__.py")


def _devices() -> list[str]:
    """Return the names of the graphics devices and the version of their driver."""
    names = sorted(name for name in os.listdir("/dev") if name.startswith(("nvidia", "kfd", "dri")))
    try:
        return [*names, Path(_DRIVER).read_text(errors="replace")]
    except OSError:
        return names
