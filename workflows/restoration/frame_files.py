"""The files of the frames that a user names: single files, or all frames of a folder."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from neusee.nodes.sensor import FRAME_SUFFIXES
from neusee.workflows.graph.diagnostics import Diagnostic, Location, RecipeError


def named_frames(words: Iterable[str], folder: Path) -> list[Path]:
    """Return the absolute paths of frames; a folder stands for its frames, sorted by name.

    Raises `RecipeError` with every word that is no file, no folder, or a folder without frames.
    """
    found, problems = list[Path](), list[Diagnostic]()
    for number, word in enumerate(words, 1):
        files = list(_named(folder / Path(word).expanduser()))
        if not files:
            problems.append(Diagnostic(Location(f"argument {number}"), word, _absent(folder / word)))
        found += files
    if problems:
        raise RecipeError(problems)
    return list(dict.fromkeys(found))


def _named(path: Path) -> Iterator[Path]:
    if path.is_file():
        yield path
    elif path.is_dir():
        inside = (each for each in path.iterdir() if each.is_file() and not each.name.startswith("."))
        yield from sorted(each for each in inside if each.suffix.lower() in FRAME_SUFFIXES)


def _absent(path: Path) -> str:
    if path.is_dir():
        return f"the folder has no frames: give files that end in {', '.join(FRAME_SUFFIXES)}"
    return "no such file or folder: give the path of a frame, or of a folder of frames"
