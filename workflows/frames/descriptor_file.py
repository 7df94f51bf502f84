"""The descriptor file of a measurement in the data format of EMVA 1288."""

from __future__ import annotations

import re
from pathlib import Path

from neusee.workflows.keys.regular_file import text_of

_LEVEL = re.compile(r"^[bd]\s+[\d.,]+(\s|$)", re.MULTILINE)  #: a line of a descriptor that begins a light level


def descriptors_in(folder: Path) -> list[Path]:
    """Return the descriptor files of a folder."""
    return [file for file in sorted(folder.glob("*.txt")) if _LEVEL.search(_text(file))]


def _text(file: Path) -> str:
    """Return the text of a file, or nothing of what is no text file, such as a pipe."""
    try:
        return text_of(file, "utf-8-sig", "replace")
    except ValueError:
        return ""


def descriptor_of(path: Path) -> Path:
    """Return the descriptor file that a path is, or the only one in the folder that a path is.

    Raises: ValueError for a folder without a descriptor, or with several.
    """
    if not path.is_dir():
        return path
    found = descriptors_in(path)
    if len(found) == 1:
        return found[0]
    has = f"has {len(found)} descriptors" if found else "has no descriptor, a .txt with levels in lines b and d"
    raise ValueError(f"{path} {has}: name one file")


def quoted(text: str) -> str:
    """Return a text as a scalar of YAML in single quotes."""
    return "'" + text.replace("'", "''") + "'"
