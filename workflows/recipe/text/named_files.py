"""Files that a recipe names: with ``--no-code`` those in its own folder alone, so that it shows none of the reader."""

from __future__ import annotations

from pathlib import Path

from neusee.workflows.graph.diagnostics import Location
from neusee.workflows.recipe.text.no_code import VARIABLE, is_inside, is_strange
from neusee.workflows.recipe.text.option_groups import shared_folders


def refuse_outside(path: Path, mark: Location) -> None:
    """Raise ValueError for a file that a recipe of a stranger names outside the folder of the YAML file.

    ``mark`` is the place of the path. An argument of the reader, and a file in the reader's own folders of recipes, may
    name any file.
    """
    if not is_strange() or _is_argument(mark):
        return
    folder = Path(mark.folder)
    if is_inside(path, folder) or any(folder.is_relative_to(own) for own in shared_folders()):
        return
    raise ValueError(
        f"is not in the folder of {Path(mark.file).name.partition(':')[0]}, and with {VARIABLE} or --no-code a recipe "
        "reads no other files: give the path as an argument, which may name any file"
    )


def _is_argument(mark: Location) -> bool:
    """Return True for a place on the command line; what a recipe passes on as one has the place in the recipe."""
    return not mark.line and ":" not in mark.file
