"""Folder of a run. A folder appears only when complete and is never overwritten. ``latest`` names the newest folder."""

from __future__ import annotations

import csv
import os
import shutil
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

_ABANDONED = 3600.0  #: s without a change, after which an unfinished folder counts as left by a killed run


@dataclass
class RunFolder:
    """The folder of a run: a temporary path while the run is being written, the final path afterwards."""

    path: Path

    def write(self, name: str, content: str | bytes) -> Path:
        """Write a file below the folder and create the parent folders."""
        path = self.path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    def write_rows(self, name: str, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
        """Write a CSV file with a header line."""
        with (self.path / name).open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(header)
            writer.writerows(rows)

    def take(self, name: str, source: Path) -> None:
        """Add a stored file to the folder as a hard link, or as a copy if the file system refuses the link."""
        path = self.path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(source, path)
        except OSError:
            shutil.copyfile(source, path)


@contextmanager
def new_run(root: Path, recipe: str, key: str) -> Iterator[RunFolder]:
    """Yield a folder with a temporary name; rename the folder after the block, or remove it if the block fails."""
    root.mkdir(parents=True, exist_ok=True)
    _sweep(root)
    name = f"{date.today().isoformat()}_{recipe}_{key[:8]}"
    run = RunFolder(root / f".{name}.{os.getpid()}.part")
    shutil.rmtree(run.path, ignore_errors=True)
    run.path.mkdir()
    try:
        yield run
        run.path = _settle(run.path, root / name)
    except BaseException:
        shutil.rmtree(run.path, ignore_errors=True)
        raise
    _point(root, run.path.name)


def _sweep(root: Path) -> None:
    """Remove the unfinished folders of killed runs; the folder of a run in progress has changed more recently."""
    for part in root.glob(".*.part"):
        try:
            if time.time() - max(p.stat().st_mtime for p in (part, *part.rglob("*"))) > _ABANDONED:
                shutil.rmtree(part, ignore_errors=True)
        except OSError:  # another process has already removed the folder
            continue


def _settle(part: Path, wanted: Path) -> Path:
    """Rename a complete folder to the first free name: ``name``, ``name_2``, ``name_3`` …"""
    number = 1
    while True:
        path = wanted if number == 1 else wanted.with_name(f"{wanted.name}_{number}")
        if not path.exists():
            try:
                return part.rename(path)
            except OSError:
                if not path.exists():  # no other run took the name: the file system refused the rename
                    raise
        number += 1


def _point(root: Path, name: str) -> None:
    """Point ``latest`` to the newest run, by a symbolic link, or by a file with the name if links are refused."""
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
    """Return the folder of a run, given as ``latest``, as a name under ``root`` or as a path."""
    for path in (root / where, Path(where)):
        if path.is_file():
            path = path.with_name(path.read_text(encoding="utf-8").strip())
        if (path / "provenance.json").is_file():
            return path
    raise FileNotFoundError(f"no run at {where}: give the name of a folder under {root}, a path, or `latest`")
