"""Groups of a recipe, such as ``sensor``: where the files of their options are, and options that extend others.

A group is a folder, and each YAML file in it is an option. Folders are searched in order: beside the recipe, those of
the variable ``NEUSEE_RECIPES``, the folder of the user, the packaged recipes.
"""

from __future__ import annotations

import functools
import os
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path

from neusee.workflows.graph.diagnostics import Diagnostic, Location, RecipeError, nearest
from neusee.workflows.recipe.text.no_code import VARIABLE as NO_CODE
from neusee.workflows.recipe.text.no_code import is_inside, is_strange
from neusee.workflows.recipe.text.yaml_values import Value, kind, read

NAME = re.compile(r"[\w-]+")
VARIABLE = "NEUSEE_RECIPES"  #: folders with recipes and groups, separated as in ``PATH``
_FORM = "must be one `group: option`, such as `doe: axicon`"
_INNER = "must be an option of this group, such as `- small`, or one `group: option`"


@dataclass(frozen=True, slots=True)
class Choice:
    """Entry of ``defaults``: a group and its option, or None for no option."""

    group: str
    option: str | None
    mark: Location
    shown: str  #: the entry as the user wrote it, for a message


@functools.cache
def packaged() -> Path:
    """Return the folder of the recipes that are installed with neusee."""
    return Path(str(files("neusee.recipes")))


def user_folder() -> Path:
    """Return the folder of the user for recipes and groups, as his system places the configuration of programs."""
    home = Path.home()
    if sys.platform == "win32":
        base = Path(os.environ.get("APPDATA") or home / "AppData" / "Roaming")
    elif sys.platform == "darwin":
        base = home / "Library" / "Application Support"
    else:
        base = Path(os.environ.get("XDG_CONFIG_HOME") or home / ".config")
    return base / "neusee" / "recipes"


def shared_folders() -> tuple[Path, ...]:
    """Return the folders that every recipe searches: those of ``NEUSEE_RECIPES``, of the user, and the packaged one."""
    named = (Path(name).expanduser().absolute() for name in os.environ.get(VARIABLE, "").split(os.pathsep) if name)
    return tuple(dict.fromkeys((*named, user_folder(), packaged())))


def search_folders(recipe: Path, folder: Path) -> tuple[Path, ...]:
    """Return the folders in which the groups of a recipe are searched; beside a packaged recipe is ``folder``."""
    beside = folder if recipe.parent == packaged() else recipe.parent
    return tuple(dict.fromkeys((beside, *shared_folders())))


def shown(path: Path, folder: Path) -> str:
    """Return the path of a file relative to the packaged recipes or to ``folder``, or else the full path."""
    for above in (packaged(), folder):
        if path.is_relative_to(above):
            return path.relative_to(above).as_posix()
    return str(path)


def groups_of(*folders: Path) -> dict[str, list[str]]:
    """Return the names of the options of each group; a group is a folder of YAML files in one of ``folders``."""
    options: dict[str, set[str]] = {}
    for folder in folders:
        for path in folder.glob("*/*.yaml"):
            options.setdefault(path.parent.name, set()).add(path.stem)
    return {group: sorted(options[group]) for group in sorted(options)}


def option_file(group: str, option: str, folders: tuple[Path, ...]) -> Path | None:
    """Return the first file of an option in ``folders``, or None."""
    if not NAME.fullmatch(group) or not NAME.fullmatch(option):
        return None
    return next((path for above in folders if (path := above / group / f"{option}.yaml").is_file()), None)


@dataclass
class Groups:
    """The groups of one recipe, with the mistakes that were found in their options."""

    folders: tuple[Path, ...]  #: in the order of the search
    folder: Path  #: to which paths in messages are relative
    merge: Callable[[tuple[Value, ...]], Value]
    diagnostics: list[Diagnostic] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)  #: on options that hide others of the same name

    def names(self) -> dict[str, list[str]]:
        """Return the names of the options of each group."""
        return groups_of(*self.folders)

    def option(self, choice: Choice, open_: tuple[Path, ...] = ()) -> Value | None:
        """Return the values of an option with those of the options that it extends, or None for a mistake.

        ``open_``: the files of options that are being read. An option that extends its own name extends that of the
        next folder.
        """
        group, name = choice.group, str(choice.option)
        folders = self.folders
        for path in open_:
            if (path.parent.name, path.stem) == (group, name) and path.parent.parent in folders:
                folders = folders[folders.index(path.parent.parent) + 1 :]
        file = option_file(group, name, folders)
        if file is None:
            self._report(choice, self._absent(choice, open_))
            return None
        if is_strange() and file.parent.parent not in shared_folders() and not is_inside(file, file.parent.parent):
            message = f"{shown(file, self.folder)} is a link to another folder, which {NO_CODE} or --no-code refuses"
            self._report(choice, message)
            return None
        if not open_ and file.parent.parent != packaged():
            self._say_hidden(group, name, file)
        return self._read(file, open_)

    def _read(self, file: Path, open_: tuple[Path, ...]) -> Value | None:
        try:
            root = read(file, shown(file, self.folder)).root
        except RecipeError as error:
            self.diagnostics += error.diagnostics
            return None
        before = len(self.diagnostics)
        choices = [choice for choice in choices_of(root, self.diagnostics, file.parent.name) if choice.option]
        below = [self.option(choice, (*open_, file)) for choice in choices]
        if None in below or len(self.diagnostics) > before:
            return None
        parts = tuple(part for part in (*below, root) if part is not None)
        return self.merge(parts) if len(parts) > 1 else root

    def _absent(self, choice: Choice, open_: tuple[Path, ...]) -> str:
        """Return the message for an option without a file, or with the files of all folders in use."""
        group, name = choice.group, str(choice.option)
        known = self.names()
        if group not in known:
            return f"no group {group}; {nearest(group, known)}"
        if name in known[group] and open_:
            chain = " -> ".join(shown(path, self.folder) for path in (*open_, open_[0]))
            return f"options extend each other in a circle: {chain}"
        return f"no option {name} in {group}; {nearest(name, known[group])}"

    def _say_hidden(self, group: str, name: str, file: Path) -> None:
        rest = self.folders[self.folders.index(file.parent.parent) + 1 :]
        hidden = option_file(group, name, rest)
        if hidden is not None:
            ours = "the packaged option" if hidden.parent.parent == packaged() else str(hidden)
            self.notes.append(f"{group}: {name} is {shown(file, self.folder)}, which hides {ours}")

    def _report(self, choice: Choice, message: str) -> None:
        problem = Diagnostic(choice.mark, choice.shown, message)
        if problem not in self.diagnostics:
            self.diagnostics.append(problem)


def choices_of(root: Value, diagnostics: list[Diagnostic], group: str = "") -> Iterator[Choice]:
    """Yield the entries in the list ``defaults`` of a recipe, or of an option of ``group``; report wrong entries."""
    given = root.items.get("defaults")
    if given is None:
        return
    if not isinstance(given.data, list):
        form = "options of this group, such as `[small]`" if group else "`group: option`"
        diagnostics.append(Diagnostic(given.mark, "defaults", f"must be a list of {form}, not {kind(given)}"))
        return
    lines: dict[tuple[str, str], int] = {}
    for entry in given.data:
        pair = _pair(entry, group)
        if pair is None:
            diagnostics.append(Diagnostic(entry.mark, entry.name, _INNER if group else _FORM))
            continue
        name, option = pair
        again = (name, str(option.data) if group else "")
        if again in lines:
            message = f"given twice, first in line {lines[again]}"
            diagnostics.append(Diagnostic(entry.mark, f"defaults.{name}", message))
            continue
        lines[again] = entry.mark.line
        yield Choice(name, None if option.data is None else str(option.data), option.mark, f"{name}: {option.data}")


def _pair(entry: Value, group: str) -> tuple[str, Value] | None:
    """Return group and option of an entry in ``defaults``, or None if it has another form."""
    pair = list(entry.items.items()) if isinstance(entry.data, dict) else []
    if len(pair) == 1 and not isinstance(pair[0][1].data, dict | list):
        return str(pair[0][0]), pair[0][1]
    if group and isinstance(entry.data, str):
        return group, entry
    return None
