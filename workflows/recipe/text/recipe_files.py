"""Locations of the files of recipes and options, and the files that an untrusted
recipe may read.
"""

from __future__ import annotations

import functools
import os
import re
import sys
from collections.abc import Iterable, Iterator
from importlib.resources import files
from pathlib import Path

from neusee.workflows.graph.errors import Diagnostic, Location, RecipeError, nearest

# --- no code --------------------------------------------------------------------------------------

# The switch ``--no-code``, with which every recipe counts as untrusted.


#: any text but an empty one refuses recipes that name code, or files outside their folder
NO_CODE_VARIABLE = "NEUSEE_NO_CODE"


def is_strange() -> bool:
    """Return True if recipes count as untrusted."""
    return bool(os.environ.get(NO_CODE_VARIABLE))


def is_inside(path: str | os.PathLike[str], folder: str | os.PathLike[str]) -> bool:
    """Return True if a path is in a folder after all links are resolved."""
    return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))


# --- folders --------------------------------------------------------------------------------------

# A recipe is a YAML file. A group is a folder, and each YAML file in it is an option. Folders are
# searched in order: beside the recipe, those of the variable ``NEUSEE_RECIPES``, the folder of the
# user, the packaged recipes.


NAME = re.compile(r"[\w-]+")
RECIPES_VARIABLE = "NEUSEE_RECIPES"  #: folders with recipes and groups, separated as in ``PATH``
SUFFIXES = (".yaml", ".yml")


@functools.cache
def packaged() -> Path:
    """Return the folder of the recipes that are installed with neusee."""
    return Path(str(files("neusee.recipes")))


def user_folder() -> Path:
    """Return the user's folder for recipes and groups, at the place where the operating system
    keeps the configuration of programs.
    """
    home = Path.home()
    if sys.platform == "win32":
        base = Path(os.environ.get("APPDATA") or home / "AppData" / "Roaming")
    elif sys.platform == "darwin":
        base = home / "Library" / "Application Support"
    else:
        base = Path(os.environ.get("XDG_CONFIG_HOME") or home / ".config")
    return base / "neusee" / "recipes"


def shared_folders() -> tuple[Path, ...]:
    """Return the folders that every recipe searches: those of ``NEUSEE_RECIPES``, of the user,
    and the packaged one.
    """
    named_folders = (
        Path(name).expanduser().absolute()
        for name in os.environ.get(RECIPES_VARIABLE, "").split(os.pathsep)
        if name
    )
    return tuple(dict.fromkeys((*named_folders, user_folder(), packaged())))


def search_folders(recipe: Path, extended: Iterable[Path], folder: Path) -> tuple[Path, ...]:
    """Return the folders in which the groups of a recipe are searched: its own folder (for a
    packaged recipe: ``folder``), those of the recipes that it extends, and the shared folders.
    """
    first_folder = folder if recipe.parent == packaged() else recipe.parent
    extended_folders = [file.parent for file in extended if file.parent != packaged()]
    return tuple(dict.fromkeys((first_folder, *extended_folders, *shared_folders())))


def shown(path: Path, folder: Path) -> str:
    """Return the path of a file relative to the packaged recipes or to ``folder``, or else the
    full path.
    """
    for base_folder in (packaged(), folder):
        if path.is_relative_to(base_folder):
            return path.relative_to(base_folder).as_posix()
    return str(path)


def groups_of(*folders: Path) -> dict[str, list[str]]:
    """Return the names of the options of each group; a group is a folder of YAML files in one of
    ``folders``.
    """
    options: dict[str, set[str]] = {}
    for folder in folders:
        for path in folder.glob("*/*.yaml"):
            options.setdefault(path.parent.name, set()).add(path.stem)
    return {group: sorted(options[group]) for group in sorted(options)}


def option_file(group: str, option: str, folders: tuple[Path, ...]) -> Path | None:
    """Return the first file of an option in ``folders``, or None."""
    if not NAME.fullmatch(group) or not NAME.fullmatch(option):
        return None
    for folder in folders:
        path = folder / group / f"{option}.yaml"
        if path.is_file():
            return path
    return None


# --- recipes by name ------------------------------------------------------------------------------


def locate(recipe: str | Path, folder: Path) -> Path:
    """Return the path of a recipe file from a name, such as that of a packaged recipe, or from a
    path to ``.yaml``.
    """
    shared = shared_folders()
    if str(recipe).endswith(SUFFIXES):
        path = folder / Path(recipe).expanduser()
        if path.exists() and not path.is_dir():
            return path
        message = f"no such file; {similar_file(str(recipe), path, folder)}"
    else:
        file = next(files_named(str(recipe), shared), None)
        if file is not None:
            return file
        message = f"no such recipe; {nearest(str(recipe), names_in(shared))}"
    raise RecipeError([Diagnostic(Location("recipe"), str(recipe), message)])


def files_named(name: str, folders: Iterable[Path]) -> Iterator[Path]:
    """Yield the files of the recipes with a name, in the order of the folders."""
    if NAME.fullmatch(name):
        paths = (folder / f"{name}.yaml" for folder in folders)
        yield from (path for path in paths if path.is_file())


def names_in(folders: Iterable[Path]) -> list[str]:
    names: list[str] = []
    for folder in folders:
        names += [path.stem for path in folder.glob("*.yaml")]
    return names


def similar_file(name: str, path: Path, folder: Path) -> str:
    """Return a hint with the recipe files in the folder of a ``path`` that does not exist."""
    similar = path.parent.glob("*.yaml")
    return nearest(
        name, [str(file.relative_to(folder)) for file in similar if file.is_relative_to(folder)]
    )


def hiding_notes(path: Path, recipe: str | Path) -> list[str]:
    """Return a note if the name of a recipe means a file of the user, which hides a packaged
    recipe.
    """
    hides = (
        path.parent != packaged()
        and path.stem == str(recipe)
        and (packaged() / path.name).is_file()
    )
    return [f"{recipe} is {path}, which hides the packaged recipe"] if hides else []


# --- named files ----------------------------------------------------------------------------------

# Files that a recipe names: with ``--no-code`` only those in its own folder, so that a recipe
# cannot show other files of the reader.


def refuse_outside(path: Path, mark: Location) -> None:
    """Raise ValueError for a file outside the folder of the YAML file, if the recipe is untrusted.

    ``mark`` is the place of the path. An argument of the reader, and a file in the reader's own
    folders of recipes, may name any file.
    """
    if not is_strange() or _is_argument(mark):
        return
    folder = Path(mark.folder)
    if is_inside(path, folder) or any(
        folder.is_relative_to(shared_folder) for shared_folder in shared_folders()
    ):
        return
    raise ValueError(
        f"is not in the folder of {Path(mark.file).name.partition(':')[0]}, and with "
        f"{NO_CODE_VARIABLE} or --no-code a recipe reads no other files: give the path as an "
        "argument, which may name any file"
    )


def _is_argument(mark: Location) -> bool:
    """Return True for a place on the command line; an argument that a recipe itself states has its
    place in the recipe.
    """
    return not mark.line and ":" not in mark.file
