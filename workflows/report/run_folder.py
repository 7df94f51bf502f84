"""The folder of a run: complete or not there, never overwritten, the newest called ``latest``."""

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

_ABANDONED = 3600.0  #: seconds after which a folder that nobody finished was left by a killed run


@dataclass
class RunFolder:
    """Where a run is being written; afterwards, where it stays."""

    path: Path

    def write(self, name: str, content: str | bytes) -> Path:
        """Write a file below the folder, making its folder where needed."""
        path = self.path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    def write_rows(self, name: str, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
        """Write a CSV file."""
        with (self.path / name).open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(header)
            writer.writerows(rows)

    def take(self, name: str, source: Path) -> None:
        """Share a stored file: a second name for it, or a copy where that cannot be."""
        path = self.path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(source, path)
        except OSError:
            shutil.copyfile(source, path)


@contextmanager
def new_run(root: Path, recipe: str, key: str) -> Iterator[RunFolder]:
    """A folder under a temporary name that gets its own name when all is written, and is removed otherwise."""
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
    """Remove what killed runs left half written; what a run is still writing is younger."""
    for part in root.glob(".*.part"):
        try:
            if time.time() - max(p.stat().st_mtime for p in (part, *part.rglob("*"))) > _ABANDONED:
                shutil.rmtree(part, ignore_errors=True)
        except OSError:  # another process was quicker
            continue


def _settle(part: Path, wanted: Path) -> Path:
    """Give a complete folder the first free name: ``name``, ``name_2``, ``name_3`` …"""
    number = 1
    while True:
        path = wanted if number == 1 else wanted.with_name(f"{wanted.name}_{number}")
        if not path.exists():
            try:
                return part.rename(path)
            except OSError:
                if not path.exists():  # not a race with another run: the disk itself refused
                    raise
        number += 1


def _point(root: Path, name: str) -> None:
    """Let ``latest`` name the newest run: a link, or a file that holds the name where links fail."""
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
    """The folder that ``latest``, a name under ``root`` or a path means."""
    for path in (root / where, Path(where)):
        if path.is_file():
            path = path.with_name(path.read_text(encoding="utf-8").strip())
        if (path / "provenance.json").is_file():
            return path
    raise FileNotFoundError(f"no run at {where}: give a folder under {root}, a path, or `latest`")
