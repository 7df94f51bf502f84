"""The folder of a run, which gets its final name when all files are written, and the link ``latest`` to this folder."""

from __future__ import annotations

import csv
import os
import shutil
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Any

from neusee.workflows.keys.regular_file import head_of
from neusee.workflows.report.run_crate import write_crate

_NAME = 4096  #: bytes of the name of a folder, at most
_OTHER_FOLDER = "name another folder with --out"
_ABANDONED = 3600.0  #: s without a change, after which an unfinished folder is removed


class NotWritten(OSError):
    """Error for a folder of results that could not be written; no part of the folder is left."""


@dataclass
class RunFolder:
    """The folder of a run, which has a temporary path until all files are written, and then its final path."""

    path: Path
    said: dict[str, Any] = field(default_factory=dict)  #: for the crate: command, recipe, inputs, versions, seconds
    taken: dict[str, Path] = field(default_factory=dict)  #: by name: the stored file that was added to the folder

    def place(self, name: str) -> Path:
        """Return the path of a file that is to be written into the folder of a run, and make the folder above it."""
        path = self.path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def write(self, name: str, content: str | bytes) -> Path:
        """Write a file into the folder of a run, and return the path of the file."""
        path = self.place(name)
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    def write_rows(self, name: str, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
        """Write a CSV file with a header line into the folder of a run."""
        with (self.path / name).open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(header)
            writer.writerows([_plain(cell) for cell in row] for row in rows)

    def take(self, name: str, source: Path) -> None:
        """Add a stored file to the folder of a run as a hard link, or as a copy if the file system refuses the link."""
        path = self.place(name)
        self.taken[name] = source
        try:
            os.link(source, path)
        except OSError:
            shutil.copyfile(source, path)


def writable_folder(out: str | os.PathLike[str]) -> Path:
    """Return the folder in which a command makes its folder of results; raise ValueError if nothing can be written.

    A folder that does not exist yet is not made: the nearest existing folder above it must be writable.
    """
    root = existing = Path(out)
    try:
        existing = next(path for path in (root, *root.absolute().parents) if path.exists() or path.is_symlink())
        if root.is_symlink() and os.environ.get("NEUSEE_NO_CODE"):  # a stranger's folder may have put it there
            raise ValueError(f"{root} is a link, which --no-code does not follow: {_OTHER_FOLDER}")
        if existing.is_dir():
            os.rmdir(tempfile.mkdtemp(prefix=".neusee.", dir=existing))
            return root
        text = f"{existing} is not a folder, so that no results can be written to {root}"
    except OSError as error:
        text = f"the folder {existing} cannot be written ({error.strerror}), so that {root} cannot hold results"
    raise ValueError(f"{text}: {_OTHER_FOLDER}")


@contextmanager
def new_run(root: Path, recipe: str, key: str) -> Iterator[RunFolder]:
    """Create a run folder with a temporary name; rename it after the ``with`` block, or remove it after an error.

    Raises `NotWritten` for an error of a file.
    """
    try:
        with _folder(root, recipe, key) as run:
            yield run
    except OSError as error:
        text = f"the folder of results in {root} cannot be written ({error}), and no part of it is left"
        raise NotWritten(text) from error


@contextmanager
def _folder(root: Path, recipe: str, key: str) -> Iterator[RunFolder]:
    root.mkdir(parents=True, exist_ok=True)
    _sweep(root)
    name = f"{date.today().isoformat()}_{recipe}_{key[:8]}"
    run = RunFolder(root / f".{name}.{os.getpid()}.part")
    shutil.rmtree(run.path, ignore_errors=True)
    run.path.mkdir()
    try:
        yield run
        write_crate(run.path, name, run.said)
        run.path = _rename(run.path, root / name)
    except BaseException:
        shutil.rmtree(run.path, ignore_errors=True)
        raise
    _point(root, run.path.name)


def _sweep(root: Path) -> None:
    """Remove the unfinished folders of killed runs, in which no file has changed for an hour."""
    for part in root.glob(".*.part"):
        try:
            if _is_being_written(part):
                continue
            if time.time() - max(p.stat().st_mtime for p in (part, *part.rglob("*"))) > _ABANDONED:
                shutil.rmtree(part, ignore_errors=True)
        except OSError:  # another process has already removed the folder
            continue


def _is_being_written(part: Path) -> bool:
    """Return True if the process that made an unfinished folder runs on this machine, whatever the clock says."""
    number = part.suffixes[-2].removeprefix(".") if len(part.suffixes) > 1 else ""
    try:
        os.kill(int(number), 0)
    except (ValueError, OverflowError, ProcessLookupError):
        return False
    except OSError:  # of another user
        return True
    return True


def _rename(part: Path, target: Path) -> Path:
    """Rename the complete folder of a run to the first free name: ``name``, ``name_2``, ``name_3`` …"""
    number = 1
    while True:
        path = target if number == 1 else target.with_name(f"{target.name}_{number}")
        if not path.exists():
            try:
                return part.rename(path)
            except OSError:
                if not path.exists():  # no other run took the name: the file system refused the rename
                    raise
        number += 1


def _point(root: Path, name: str) -> None:
    """Make ``latest`` a symbolic link to the folder of a run, or a file with its name if links are not possible."""
    part = root / f".latest.{os.getpid()}"
    try:
        part.symlink_to(name, target_is_directory=True)
    except OSError:
        part.write_text(name + "\n", encoding="utf-8")
    try:
        part.replace(root / "latest")
    except OSError:
        part.unlink(missing_ok=True)
        raise


def find_run(where: str, root: Path) -> Path:
    """Return the folder of a run; ``where`` is ``latest``, the name of a folder in ``root`` or a path."""
    for path in (root / where, Path(where)):
        if path.is_file():
            path = path.with_name(head_of(path, _NAME).decode("utf-8", "replace").strip())
        if (path / "provenance.json").is_file():
            return path
    raise FileNotFoundError(f"no run at {where}: give the name of a folder in {root}, a path, or `latest`")


def _plain(cell: Any) -> Any:
    """Return a cell with a number of Python in place of one of NumPy, whose text its print options decide."""
    return cell.item() if hasattr(cell, "dtype") and not cell.ndim else cell
