"""Composition of a recipe from options of its groups, its own file and the arguments."""

from __future__ import annotations

import functools
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.resources import files
from pathlib import Path

from neusee.workflows.graph.diagnostics import Diagnostic, Location, RecipeError, nearest
from neusee.workflows.recipe.text.overrides import Override, apply, read_override
from neusee.workflows.recipe.text.yaml_values import Value, Where, kind, read

# --- no code --------------------------------------------------------------------------------------

# The switch ``--no-code``, with which a recipe is read as that of a stranger.


#: any text but an empty one refuses recipes that name code, or files that are not in their folder
NO_CODE_VARIABLE = "NEUSEE_NO_CODE"


def is_strange() -> bool:
    """Return True if recipes count as those of strangers."""
    return bool(os.environ.get(NO_CODE_VARIABLE))


def is_inside(path: str | os.PathLike[str], folder: str | os.PathLike[str]) -> bool:
    """Return True if a path leads to something in a folder, whatever links are on the way."""
    return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))


# --- option groups --------------------------------------------------------------------------------

# Groups of a recipe, such as ``sensor``: where the files of their options are, and options that
# extend others.
#
# A group is a folder, and each YAML file in it is an option. Folders are searched in order: beside
# the recipe, those of the variable ``NEUSEE_RECIPES``, the folder of the user, the packaged
# recipes.


NAME = re.compile(r"[\w-]+")
RECIPES_VARIABLE = "NEUSEE_RECIPES"  #: folders with recipes and groups, separated as in ``PATH``
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
    """Return the folder of the user for recipes and groups, as his system places the
    configuration of programs.
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
    named = (
        Path(name).expanduser().absolute()
        for name in os.environ.get(RECIPES_VARIABLE, "").split(os.pathsep)
        if name
    )
    return tuple(dict.fromkeys((*named, user_folder(), packaged())))


def search_folders(recipe: Path, folder: Path) -> tuple[Path, ...]:
    """Return the folders in which the groups of a recipe are searched; beside a packaged recipe
    is ``folder``.
    """
    beside = folder if recipe.parent == packaged() else recipe.parent
    return tuple(dict.fromkeys((beside, *shared_folders())))


def shown(path: Path, folder: Path) -> str:
    """Return the path of a file relative to the packaged recipes or to ``folder``, or else the
    full path.
    """
    for above in (packaged(), folder):
        if path.is_relative_to(above):
            return path.relative_to(above).as_posix()
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
    return next(
        (path for above in folders if (path := above / group / f"{option}.yaml").is_file()), None
    )


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
        """Return the values of an option with those of the options that it extends, or None for a
        mistake.

        ``open_``: the files of options that are being read. An option that extends its own name
        extends that of the next folder.
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
        if (
            is_strange()
            and file.parent.parent not in shared_folders()
            and not is_inside(file, file.parent.parent)
        ):
            message = (
                f"{shown(file, self.folder)} is a link to another folder, which "
                f"{NO_CODE_VARIABLE} or --no-code refuses"
            )
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
        choices = [
            choice
            for choice in choices_of(root, self.diagnostics, file.parent.name)
            if choice.option
        ]
        below = [self.option(choice, (*open_, file)) for choice in choices]
        if None in below or len(self.diagnostics) > before:
            return None
        parts = tuple(level for level in (*below, root) if level is not None)
        return self.merge(parts) if len(parts) > 1 else root

    def _absent(self, choice: Choice, open_: tuple[Path, ...]) -> str:
        """Return the message for an option without a file, or with the files of all folders in
        use.
        """
        group, name = choice.group, str(choice.option)
        options = self.names()
        if group not in options:
            return f"no group {group}; {nearest(group, options)}"
        if name in options[group] and open_:
            chain = " -> ".join(shown(path, self.folder) for path in (*open_, open_[0]))
            return f"options extend each other in a circle: {chain}"
        return f"no option {name} in {group}; {nearest(name, options[group])}"

    def _say_hidden(self, group: str, name: str, file: Path) -> None:
        later_folders = self.folders[self.folders.index(file.parent.parent) + 1 :]
        hidden = option_file(group, name, later_folders)
        if hidden is not None:
            ours = "the packaged option" if hidden.parent.parent == packaged() else str(hidden)
            self.notes.append(f"{group}: {name} is {shown(file, self.folder)}, which hides {ours}")

    def _report(self, choice: Choice, message: str) -> None:
        problem = Diagnostic(choice.mark, choice.shown, message)
        if problem not in self.diagnostics:
            self.diagnostics.append(problem)


def choices_of(root: Value, diagnostics: list[Diagnostic], group: str = "") -> Iterator[Choice]:
    """Yield the entries in the list ``defaults`` of a recipe, or of an option of ``group``;
    report wrong entries.
    """
    block = root.items.get("defaults")
    if block is None:
        return
    if not isinstance(block.data, list):
        form = "options of this group, such as `[small]`" if group else "`group: option`"
        diagnostics.append(
            Diagnostic(block.mark, "defaults", f"must be a list of {form}, not {kind(block)}")
        )
        return
    lines: dict[tuple[str, str], int] = {}
    for entry in block.data:
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
        yield Choice(
            name,
            None if option.data is None else str(option.data),
            option.mark,
            f"{name}: {option.data}",
        )


def _pair(entry: Value, group: str) -> tuple[str, Value] | None:
    """Return group and option of an entry in ``defaults``, or None if it has another form."""
    pair = list(entry.items.items()) if isinstance(entry.data, dict) else []
    if len(pair) == 1 and not isinstance(pair[0][1].data, dict | list):
        return str(pair[0][0]), pair[0][1]
    if group and isinstance(entry.data, str):
        return group, entry
    return None


# --- named files ----------------------------------------------------------------------------------

# Files that a recipe names: with ``--no-code`` those in its own folder alone, so that it shows none
# of the reader.


def refuse_outside(path: Path, mark: Location) -> None:
    """Raise ValueError for a file that a recipe of a stranger names outside the folder of the YAML
    file.

    ``mark`` is the place of the path. An argument of the reader, and a file in the reader's own
    folders of recipes, may name any file.
    """
    if not is_strange() or _is_argument(mark):
        return
    folder = Path(mark.folder)
    if is_inside(path, folder) or any(folder.is_relative_to(own) for own in shared_folders()):
        return
    raise ValueError(
        f"is not in the folder of {Path(mark.file).name.partition(':')[0]}, and with "
        f"{NO_CODE_VARIABLE} or --no-code a recipe reads no other files: give the path as an "
        "argument, which may name any file"
    )


def _is_argument(mark: Location) -> bool:
    """Return True for a place on the command line; what a recipe passes on as one has the place
    in the recipe.
    """
    return not mark.line and ":" not in mark.file


# --- composition ----------------------------------------------------------------------------------

# Composition of a recipe from the options of its groups, its own file and the arguments, in this
# order.


@dataclass(frozen=True, slots=True)
class Composed:
    """A recipe composed from its files and the arguments of the user, with values that are not
    yet checked.
    """

    name: str
    title: str
    root: Value
    diagnostics: tuple[Diagnostic, ...]
    whole: bool = True  #: whether every named group could be read
    #: paths of the values in options that arguments replaced, each with the argument, such as
    #: ``scene=siemens``
    replaced: tuple[tuple[Where, str], ...] = ()
    notes: tuple[str, ...] = ()  #: on options that hide others of the same name

    def without(self, key: str) -> Composed:
        """Return the recipe without the block ``key``."""
        return replace(self, root=self.root.without(key))

    def with_problems(self, diagnostics: Iterable[Diagnostic]) -> Composed:
        """Return the recipe with ``diagnostics`` added to its diagnostics."""
        return replace(self, diagnostics=(*self.diagnostics, *diagnostics))


def locate(recipe: str | Path, folder: Path) -> Path:
    """Return the path of a recipe file from a name, such as that of a packaged recipe, or from a
    path to ``.yaml``.
    """
    if str(recipe).endswith((".yaml", ".yml")):
        path = folder / Path(recipe).expanduser()
        if path.exists() and not path.is_dir():
            return path
        similar_files = [
            str(p.relative_to(folder))
            for p in path.parent.glob("*.yaml")
            if p.is_relative_to(folder)
        ]
        raise RecipeError(
            [
                Diagnostic(
                    Location("recipe"),
                    str(recipe),
                    f"no such file; {nearest(str(recipe), similar_files)}",
                )
            ]
        )
    shared = shared_folders()
    if NAME.fullmatch(str(recipe)):
        for above in shared:
            if (path := above / f"{recipe}.yaml").is_file():
                return path
    names = [p.stem for above in shared for p in above.glob("*.yaml")]
    raise RecipeError(
        [
            Diagnostic(
                Location("recipe"), str(recipe), f"no such recipe; {nearest(str(recipe), names)}"
            )
        ]
    )


def compose(
    recipe: str | Path, arguments: Sequence[str | Override], folder: Path, first: int = 1
) -> Composed:
    """Return a recipe composed from its files and arguments; messages number the arguments from
    ``first``.
    """
    return Composer(recipe, folder).compose(arguments, first)


class Composer:
    """A recipe that is composed with several lists of arguments, such as the points of a sweep;
    a file is read once.
    """

    def __init__(self, recipe: str | Path, folder: Path) -> None:
        self._path, self._folder = locate(recipe, folder), folder
        self._document = read(self._path, shown(self._path, folder))
        self._hides = _hiding(self._path, recipe)
        # before the arguments that set single values
        self._known: dict[tuple[Choice, ...], Composed] = {}

    def compose(self, arguments: Sequence[str | Override], first: int = 1) -> Composed:
        """Return the recipe with arguments; messages number the arguments from ``first``."""
        diagnostics: list[Diagnostic] = []
        overrides: list[Override] = []
        for number, argument in enumerate(arguments, first):
            mark = Location(f"argument {number}", folder=str(self._folder))
            try:
                overrides.append(
                    argument if isinstance(argument, Override) else read_override(argument, mark)
                )
            except RecipeError as error:
                diagnostics += error.diagnostics
        choices, values = _choose(self._document.root, overrides, self._groups(diagnostics))
        selection = tuple(choices)
        if selection not in self._known:
            self._known[selection] = self._with_options(selection)
        below = self._known[selection]
        root, diagnostics = below.root, [*diagnostics, *below.diagnostics]
        for override in values:
            root = apply(root, override, diagnostics, [choice.group for choice in choices])
        return replace(below, root=root, diagnostics=tuple(diagnostics))

    def _groups(self, diagnostics: list[Diagnostic]) -> Groups:
        return Groups(search_folders(self._path, self._folder), self._folder, _merged, diagnostics)

    def _with_options(self, choices: tuple[Choice, ...]) -> Composed:
        """Return the recipe with the chosen option of each group."""
        document, groups = self._document, self._groups([])
        options = [groups.option(choice) for choice in choices if choice.option is not None]
        root = _merged((*(option for option in options if option is not None), document.root))
        replaced = tuple(_replaced(document.root, choices, groups))
        diagnostics, notes = tuple(groups.diagnostics), (*self._hides, *groups.notes)
        return Composed(
            self._path.stem, document.title, root, diagnostics, None not in options, replaced, notes
        )


def _hiding(path: Path, recipe: str | Path) -> list[str]:
    """Return a note if the name of a recipe means a file of the user, which hides a packaged
    recipe.
    """
    hides = (
        path.parent != packaged()
        and path.stem == str(recipe)
        and (packaged() / path.name).is_file()
    )
    return [f"{recipe} is {path}, which hides the packaged recipe"] if hides else []


def merge(below: Value, above: Value) -> Value:
    """Merge the recipe value ``above`` into the recipe value ``below``, and return the result.

    Mappings are merged key by key; a list, a scalar or a step with ``node`` replaces the value in
    ``below``. The lists ``nodes`` are joined, because each file names the code of its own steps.
    """
    if above.path == ("nodes",) and isinstance(below.data, list) and isinstance(above.data, list):
        joined = [*below.data, *above.data]
        return replace(
            above, data=[replace(entry, path=("nodes", i)) for i, entry in enumerate(joined)]
        )
    if not isinstance(below.data, dict) or not isinstance(above.data, dict) or _new_step(above):
        return above
    data = dict(below.data)
    for key, value in above.data.items():
        data[key] = merge(data[key], value) if key in data else value
    return replace(below, data=data)


@functools.lru_cache(maxsize=16)
def _merged(parts: tuple[Value, ...]) -> Value:
    """Merge the options of the groups and the recipe in order; return the cached object if the
    parts are the same.
    """
    mark = parts[-1].mark
    return functools.reduce(
        merge, (level.without("defaults") for level in parts), Value({}, mark, mark, ())
    )


def _new_step(value: Value) -> bool:
    return len(value.path) == 2 and value.path[0] == "steps" and "node" in value.items


# --- groups ---------------------------------------------------------------------------------------


def _choose(
    root: Value, overrides: list[Override], groups: Groups
) -> tuple[list[Choice], list[Override]]:
    """Return the option of each group after overrides such as ``laser=six``, and the overrides
    of single values.
    """
    choices = {choice.group: choice for choice in choices_of(root, groups.diagnostics)}
    names, value_overrides = functools.cache(groups.names), []
    for o in overrides:
        group, data = o.path[0], o.value.data if o.value else None
        values = len(o.path) > 1 or isinstance(data, dict | list)
        if values or (group not in choices and (group in root.items or group not in names())):
            value_overrides.append(o)
        elif message := _group_fault(o, choices):
            groups.diagnostics.append(Diagnostic(o.mark, o.text, message))
        elif o.sign == "~":
            del choices[group]
        else:
            choices[group] = Choice(group, None if data is None else str(data), o.mark, o.text)
    return list(choices.values()), value_overrides


def _replaced(
    root: Value, choices: Iterable[Choice], groups: Groups
) -> Iterator[tuple[Where, str]]:
    """Yield the path of each value in an option that the recipe names and an argument replaces
    or removes.
    """
    final_choices = {choice.group: choice for choice in choices}
    silent = replace(groups, diagnostics=[], notes=[])
    for written in choices_of(root, []):
        now = final_choices.get(written.group)
        if written.option is None or (now and now.option == written.option):
            continue
        option = silent.option(written)
        shown = now.shown if now else f"~{written.group}"
        yield from ((leaf.path, shown) for leaf in (option.leaves() if option else ()))


def _group_fault(o: Override, choices: Mapping[str, Choice]) -> str:
    group = o.path[0]
    if group in choices:
        return (
            f"{group} is already set to {choices[group].option}: remove the +"
            if o.sign == "+"
            else ""
        )
    if o.sign == "~":
        return f"is not a group of this recipe; {nearest(group, choices)}"
    return "" if o.sign else f"this recipe has no group {group}; to add the group, write +{o.text}"
