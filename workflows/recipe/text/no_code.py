"""The switch ``--no-code``, with which a recipe is read as that of a stranger."""

from __future__ import annotations

import os
from pathlib import Path

#: any text but an empty one refuses recipes that name code, or files that are not in their folder
VARIABLE = "NEUSEE_NO_CODE"


def is_strange() -> bool:
    """Return True if recipes count as those of strangers."""
    return bool(os.environ.get(VARIABLE))


def is_inside(path: str | os.PathLike[str], folder: str | os.PathLike[str]) -> bool:
    """Return True if a path leads to something in a folder, whatever links are on the way."""
    return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))
