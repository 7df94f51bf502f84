"""The pictures of the handbook, which the commands of its pages draw."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import neusee
from neusee.workflows.handbook.guide_pages import Picture

_FINE = (0, 3)  #: exit codes after which the folder of results is whole


class NoPicture(RuntimeError):
    """Error for a command of a page that failed, or that did not write the picture that the page shows."""


def draw_pictures(
    pictures: Iterable[Picture], work: Path, target: Path, progress: Callable[[str], None], strict: bool = True
) -> dict[Picture, str]:
    """Run each command once in the folder ``work``, copy the pictures to ``target`` and return their file names.

    Commands run in their order, and `runs/latest` is what the one before wrote.
    If a command fails, a ``strict`` build raises `NoPicture`; any other build says so and goes on without the picture.
    """
    by_words: dict[tuple[str, ...], list[Picture]] = {}
    for picture in pictures:
        by_words.setdefault(picture.words, []).append(picture)
    target.mkdir(parents=True, exist_ok=True)
    progress(f"commands that draw pictures: {len(by_words)}; what the cache holds is not computed again")
    names: dict[Picture, str] = {}
    for number, (words, wanted) in enumerate(by_words.items(), 1):
        try:
            results = _run(words, work, work / f"results_{number}")
            _name_latest(results, work)
            names |= {picture: _take(picture, results, target) for picture in wanted}
        except NoPicture as error:
            if strict:
                raise
            progress(f"no picture: {error}")
        progress(f"command {number} of {len(by_words)}: neusee {' '.join(words)}")
    return names


def _run(words: tuple[str, ...], work: Path, results: Path) -> Path:
    """Run a command of neusee and return the folder that it wrote."""
    package = str(Path(neusee.__file__).parents[1])
    paths = os.pathsep.join([package, *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(
        [sys.executable, "-m", "neusee", *words, "--out", str(results)],
        cwd=work,
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
    )
    folders = [path for path in results.glob("*") if path.is_dir() and not path.is_symlink()]
    if done.returncode not in _FINE or len(folders) != 1:
        raise NoPicture(
            f"neusee {' '.join(words)} ended with exit code {done.returncode}: {done.stderr.strip()[-500:]}"
        )
    return folders[0]


def _name_latest(results: Path, work: Path) -> None:
    """Make a folder of results the `runs/latest` of the commands that follow, as it is for a reader who types them."""
    latest = work / "runs" / "latest"
    latest.parent.mkdir(exist_ok=True)
    latest.unlink(missing_ok=True)
    latest.symlink_to(results.resolve(), target_is_directory=True)


def _take(picture: Picture, results: Path, target: Path) -> str:
    """Copy a picture out of a folder of results and return its new name."""
    found = sorted(results.glob(picture.file))
    if not found:
        there = ", ".join(sorted(str(path.relative_to(results)) for path in results.rglob("*.png"))) or "no picture"
        raise NoPicture(f"neusee {' '.join(picture.words)} wrote no {picture.file}; it wrote {there}")
    digest = hashlib.sha256(" ".join([*picture.words, picture.file]).encode()).hexdigest()[:12]
    name = f"{digest}{found[0].suffix}"
    shutil.copyfile(found[0], target / name)
    return name
