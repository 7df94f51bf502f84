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
from neusee.workflows.recipe.text.defaults_list import (
    Choice,
    Extended,
    Option,
    OwnValues,
    choice,
    entries_of,
)
from neusee.workflows.recipe.text.hydra_habits import advice_on_recipe
from neusee.workflows.recipe.text.overrides import Override, apply, read_override
from neusee.workflows.recipe.text.yaml_values import Document, Value, Where, read

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
_MOST_FILES_DEEP = 50  #: longest chain of recipes that extend each other
_SUFFIXES = (".yaml", ".yml")


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


def search_folders(recipe: Path, extended: Iterable[Path], folder: Path) -> tuple[Path, ...]:
    """Return the folders in which the groups of a recipe are searched: beside it, beside the
    recipes that it extends, and those of all recipes. Beside a packaged recipe is ``folder``.
    """
    beside = folder if recipe.parent == packaged() else recipe.parent
    below = [file.parent for file in extended if file.parent != packaged()]
    return tuple(dict.fromkeys((beside, *below, *shared_folders())))


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
    merge: Callable[[tuple[Value, ...], Location], Value]
    diagnostics: list[Diagnostic] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)  #: on options that hide others of the same name

    def names(self) -> dict[str, list[str]]:
        """Return the names of the options of each group."""
        return groups_of(*self.folders)

    def values(self, choice: Choice, open_: tuple[Path, ...] = ()) -> list[Value | None]:
        """Return the values of each option of a choice; None stands for a mistake."""
        values: list[Value | None] = []
        for option in choice.options:
            file = self._file(option, open_)
            if file is None and option.is_optional:
                note = f"{option.group}: {option.name} is optional, and there is no such option"
                self.notes.append(note)
            elif file is None:
                self._report(option, self._absent(option, open_))
                values.append(None)
            else:
                values.append(self._option(option, file, open_))
        return values

    def _file(self, option: Option, open_: tuple[Path, ...]) -> Path | None:
        """Return the file of an option; one that extends its own name extends that of the next
        folder.

        ``open_``: the files of options that are being read.
        """
        folders = self.folders
        for path in open_:
            same = (path.parent.name, path.stem) == (option.group, option.name)
            if same and path.parent.parent in folders:
                folders = folders[folders.index(path.parent.parent) + 1 :]
        return option_file(option.group, option.name, folders)

    def _option(self, option: Option, file: Path, open_: tuple[Path, ...]) -> Value | None:
        """Return the values in the file of an option with those of the options that it extends, or
        None for a mistake.
        """
        above = file.parent.parent
        if is_strange() and above not in shared_folders() and not is_inside(file, above):
            self._report(option, _is_link(file, self.folder))
            return None
        if not open_ and above != packaged():
            self._say_hidden(option.group, option.name, file)
        return self._read(file, open_)

    def _read(self, file: Path, open_: tuple[Path, ...]) -> Value | None:
        try:
            root = read(file, shown(file, self.folder)).root
        except RecipeError as error:
            self.diagnostics += error.diagnostics
            return None
        before = len(self.diagnostics)
        levels: list[Value | None] = []
        for entry in entries_of(root, self.diagnostics, file.parent.name):
            if isinstance(entry, Choice):
                levels += self.values(entry, (*open_, file))
            else:
                levels.append(root)
        if len(self.diagnostics) > before:
            return None
        parts = tuple(level for level in levels if level is not None)
        return self.merge(parts, root.mark) if len(parts) > 1 else root

    def _absent(self, option: Option, open_: tuple[Path, ...]) -> str:
        """Return the message for an option without a file, or with the files of all folders in
        use.
        """
        options = self.names()
        if option.group not in options:
            return f"no group {option.group}; {nearest(option.group, options)}"
        names = options[option.group]
        if option.name in names and open_:
            chain = " -> ".join(shown(path, self.folder) for path in (*open_, open_[0]))
            return f"options extend each other in a circle: {chain}"
        if "," in option.name:
            return (
                f"no option {option.name} in {option.group}: several options are a list,"
                f" [{option.name}], and several runs are `neusee sweep`"
            )
        return f"no option {option.name} in {option.group}; {nearest(option.name, names)}"

    def _say_hidden(self, group: str, name: str, file: Path) -> None:
        later_folders = self.folders[self.folders.index(file.parent.parent) + 1 :]
        hidden = option_file(group, name, later_folders)
        if hidden is not None:
            ours = "the packaged option" if hidden.parent.parent == packaged() else str(hidden)
            self.notes.append(f"{group}: {name} is {shown(file, self.folder)}, which hides {ours}")

    def _report(self, option: Option, message: str) -> None:
        problem = Diagnostic(option.mark, option.shown, message)
        if problem not in self.diagnostics:
            self.diagnostics.append(problem)


def _is_link(file: Path, folder: Path) -> str:
    return (
        f"{shown(file, folder)} is a link to another folder, which {NO_CODE_VARIABLE} or --no-code"
        " refuses"
    )


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
    groups: tuple[str, ...] = ()  #: names of the groups of which it has an option
    own_blocks: frozenset[str] = frozenset()  #: blocks that the recipes write, beside the options
    extended: tuple[Path, ...] = ()  #: files of the recipes that it extends, at any depth

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
    shared = shared_folders()
    if str(recipe).endswith(_SUFFIXES):
        path = folder / Path(recipe).expanduser()
        if path.exists() and not path.is_dir():
            return path
        message = f"no such file; {_similar_file(str(recipe), path, folder)}"
    else:
        named = next(_files_named(str(recipe), shared), None)
        if named is not None:
            return named
        message = f"no such recipe; {nearest(str(recipe), _names_in(shared))}"
    raise RecipeError([Diagnostic(Location("recipe"), str(recipe), message)])


def _files_named(name: str, folders: Iterable[Path]) -> Iterator[Path]:
    """Yield the files of the recipes with a name, in the order of the folders."""
    if NAME.fullmatch(name):
        paths = (folder / f"{name}.yaml" for folder in folders)
        yield from (path for path in paths if path.is_file())


def _names_in(folders: Iterable[Path]) -> list[str]:
    names: list[str] = []
    for folder in folders:
        names += [path.stem for path in folder.glob("*.yaml")]
    return names


def _similar_file(name: str, path: Path, folder: Path) -> str:
    """Return a hint with the recipe files in the folder of a ``path`` that does not exist."""
    similar = path.parent.glob("*.yaml")
    return nearest(name, [str(p.relative_to(folder)) for p in similar if p.is_relative_to(folder)])


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
        document = read(self._path, shown(self._path, folder))
        self._written = _Extension(folder).written(self._path, document)
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
        if not self._written.is_complete:  # what lacks a recipe lacks what arguments change
            overrides = []
        choices, values = _choose(self._written, overrides, self._groups(diagnostics))
        if choices not in self._known:
            self._known[choices] = self._with_options(choices)
        below = self._known[choices]
        root, diagnostics = below.root, [*diagnostics, *below.diagnostics]
        for override in values:
            root = apply(root, override, diagnostics, below.groups)
        return replace(below, root=root, diagnostics=tuple(diagnostics))

    def _groups(self, diagnostics: list[Diagnostic]) -> Groups:
        folders = search_folders(self._path, self._written.extended, self._folder)
        return Groups(folders, self._folder, _merged, diagnostics)

    def _with_options(self, choices: tuple[Choice, ...]) -> Composed:
        """Return the recipe with the chosen option of each group."""
        written, groups = self._written, self._groups([])
        levels: list[Value | None] = []
        for layer in written.layers_with(choices):
            levels += groups.values(layer) if isinstance(layer, Choice) else [layer]
        parts = tuple(level for level in levels if level is not None)
        replaced = tuple(_replaced(written, choices, groups))
        return Composed(
            name=self._path.stem,
            title=written.title,
            root=_merged(parts, written.root.mark),
            diagnostics=(*written.diagnostics, *groups.diagnostics),
            whole=written.is_complete and None not in levels,
            replaced=replaced,
            notes=(*self._hides, *written.notes, *groups.notes),
            groups=tuple(entry.group for entry in choices),
            own_blocks=written.own_blocks,
            extended=written.extended,
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
def _merged(parts: tuple[Value, ...], mark: Location) -> Value:
    """Merge the options of the groups and the recipes in order; return the cached object if the
    parts are the same. ``mark`` is the place of the recipe.
    """
    return functools.reduce(
        merge, (level.without("defaults") for level in parts), Value({}, mark, mark, ())
    )


def _new_step(value: Value) -> bool:
    return len(value.path) == 2 and value.path[0] == "steps" and "node" in value.items


# --- extended recipes -----------------------------------------------------------------------------

# A recipe with those that it extends, as one list of layers: the options of a group, or the values
# that a file itself writes. A later layer wins.


Layer = Choice | Value


@dataclass(frozen=True, slots=True)
class Written:
    """A recipe as its files write it, before the arguments of the user."""

    root: Value  #: of its own file
    title: str
    layers: tuple[Layer, ...]
    replaced: tuple[Choice, ...]  #: choices of extended recipes in whose place is another one
    extended: tuple[Path, ...]  #: files of the recipes that it extends, at any depth
    diagnostics: tuple[Diagnostic, ...]
    notes: tuple[str, ...]

    @property
    def is_complete(self) -> bool:
        """Return True if every entry of ``defaults`` could be read."""
        return not self.diagnostics

    @property
    def choices(self) -> dict[str, Choice]:
        """Return the choice of each group."""
        return {layer.group: layer for layer in _choices_in(self.layers)}

    @property
    def own_blocks(self) -> frozenset[str]:
        """Return the keys that the recipes write themselves, beside the options of their groups."""
        keys = set[str]()
        for layer in self.layers:
            if isinstance(layer, Value):
                keys.update(map(str, layer.items))
        return frozenset(keys - {"defaults"})

    def layers_with(self, choices: Iterable[Choice]) -> list[Layer]:
        """Return the layers with other choices: each in the place of the former one of its group,
        and a new one before the values of the recipe itself.
        """
        chosen_groups = {entry.group: entry for entry in choices}
        layers: list[Layer] = []
        for layer in self.layers:
            if isinstance(layer, Value):
                layers.append(layer)
            elif layer.group in chosen_groups:
                layers.append(chosen_groups.pop(layer.group))
        place = len(layers) - 1 if isinstance(layers[-1], Value) else len(layers)
        return [*layers[:place], *chosen_groups.values(), *layers[place:]]


class _Extension:
    """Reader of a recipe with the recipes that it extends, and of the mistakes in them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder  # to which paths in messages are relative
        self.diagnostics: list[Diagnostic] = []
        self.notes: list[str] = []
        self.replaced: list[Choice] = []
        self.extended: dict[Path, Location] = {}  # each file, with the entry that names it

    def written(self, path: Path, document: Document) -> Written:
        """Return the recipe in a file, with the layers of those that it extends."""
        layers = self._layers(document.root, (path,))
        return Written(
            root=document.root,
            title=document.title,
            layers=tuple(layers),
            replaced=tuple(self.replaced),
            extended=tuple(self.extended),
            diagnostics=tuple(self.diagnostics),
            notes=tuple(self.notes),
        )

    def _layers(self, root: Value, open_: tuple[Path, ...]) -> list[Layer]:
        """Return the layers of the recipe in the last file of ``open_``, which extend each other in
        this order.
        """
        layers: list[Layer] = []
        for entry in entries_of(root, self.diagnostics):
            if isinstance(entry, OwnValues):
                layers.append(root)
            elif isinstance(entry, Choice):
                self._add_choice(entry, layers)
            else:
                layers += self._layers_of(entry, open_, layers)
        return layers

    def _add_choice(self, entry: Choice, layers: list[Layer]) -> None:
        """Add a choice to the layers, in the place of that which an extended recipe has."""
        for place, layer in enumerate(layers):
            if isinstance(layer, Choice) and layer.group == entry.group:
                if entry.is_optional:
                    fix = entry.shown.removeprefix("optional ")
                    message = f"takes the place of {layer.shown} ({layer.mark}): write `{fix}`"
                    self._refuse(entry.mark, entry.shown, message)
                    return
                self.replaced.append(layer)
                layers[place] = entry
                return
        layers.append(entry)

    def _layers_of(
        self, entry: Extended, open_: tuple[Path, ...], before: Sequence[Layer]
    ) -> list[Layer]:
        """Return the layers of an extended recipe; ``before`` are those of earlier entries."""
        file = self._file(entry, open_)
        if file is None:
            return []
        self.extended[file] = entry.mark
        try:
            root = read(file, shown(file, self.folder)).root
        except RecipeError as error:
            self.diagnostics += error.diagnostics
            return []
        layers = self._layers(root, (*open_, file))
        if message := _chosen_before(entry, layers, before):
            self._refuse(entry.mark, entry.name, message)
        return layers

    def _file(self, entry: Extended, open_: tuple[Path, ...]) -> Path | None:
        """Return the file of an extended recipe, or None after a report of the mistake."""
        found = (
            self._file_at_path(entry)
            if entry.name.endswith(_SUFFIXES)
            else self._file_of_name(entry, open_)
        )
        message = found if isinstance(found, str) else self._refusal(found, entry, open_)
        if message:
            self._refuse(entry.mark, entry.name, message)
            return None
        assert isinstance(found, Path)
        return found

    def _file_at_path(self, entry: Extended) -> Path | str:
        folder = Path(entry.mark.folder)
        path = Path(os.path.abspath(folder / Path(entry.name).expanduser()))
        if path.exists() and not path.is_dir():
            return path
        return f"no such file; {_similar_file(entry.name, path, folder)}"

    def _file_of_name(self, entry: Extended, open_: tuple[Path, ...]) -> Path | str:
        """Return the file of a recipe by its name, or a message: beside the file that names it, and
        then where every recipe is found.

        A recipe that extends its own name extends that of the next folder.
        """
        folders = tuple(dict.fromkeys((open_[-1].parent, *shared_folders())))
        later_folders = folders
        for path in open_:
            if path.stem == entry.name and path.parent in later_folders:
                later_folders = later_folders[later_folders.index(path.parent) + 1 :]
        file = next(_files_named(entry.name, later_folders), None)
        if file is not None:
            self.notes += _hiding(file, entry.name)
            return file
        circular = next(_files_named(entry.name, folders), None)
        if circular is not None:
            return self._circle((*open_, circular))
        groups = groups_of(*folders)
        if advice := advice_on_recipe(entry.name, groups):
            return advice
        if entry.name in groups:
            return f"is a group: write `{entry.name}: OPTION`; {nearest('', groups[entry.name])}"
        return f"no such recipe; {nearest(entry.name, _names_in(folders))}"

    def _refusal(self, file: Path, entry: Extended, open_: tuple[Path, ...]) -> str:
        """Return why a file is not read as an extended recipe, or an empty text."""
        real = os.path.realpath(file)
        if any(os.path.realpath(path) == real for path in open_):
            return self._circle((*open_, file))
        if file in self.extended:
            return f"is extended already, by {self.extended[file]}: remove this entry"
        if len(open_) > _MOST_FILES_DEEP:
            return f"more than {_MOST_FILES_DEEP} recipes extend each other: write them as one"
        shared = shared_folders()
        folder = Path(entry.mark.folder)
        is_own = file.parent in shared or any(folder.is_relative_to(own) for own in shared)
        if is_strange() and not is_own and not is_inside(file, folder):
            return (
                f"is not in the folder of {Path(entry.mark.file).name}, which {NO_CODE_VARIABLE} or"
                " --no-code refuses"
            )
        return ""

    def _circle(self, files: Sequence[Path]) -> str:
        chain = " -> ".join(shown(path, self.folder) for path in files)
        return f"recipes extend each other in a circle: {chain}"

    def _refuse(self, mark: Location, name: str, message: str) -> None:
        self.diagnostics.append(Diagnostic(mark, name, message))


def _chosen_before(entry: Extended, layers: Sequence[Layer], before: Sequence[Layer]) -> str:
    """Return what to do about groups of which an extended recipe has an option, and an earlier
    entry too; or an empty text.
    """
    groups = {layer.group for layer in _choices_in(layers)}
    earlier = [layer for layer in _choices_in(before) if layer.group in groups]
    ours = [layer for layer in earlier if layer.mark.file == entry.mark.file]
    if ours:
        return f"has the group {ours[0].group} too: write `{ours[0].shown}` after {entry.name}"
    if not earlier:
        return ""
    names = ", ".join(layer.group for layer in earlier[:6])
    more = f" and {len(earlier) - 6} more" if len(earlier) > 6 else ""
    return f"has the groups of an earlier recipe ({names}{more}): extend only one of the two"


def _choices_in(layers: Iterable[Layer]) -> list[Choice]:
    return [layer for layer in layers if isinstance(layer, Choice)]


# --- groups ---------------------------------------------------------------------------------------


def _choose(
    written: Written, overrides: list[Override], groups: Groups
) -> tuple[tuple[Choice, ...], list[Override]]:
    """Return the options of each group after overrides such as ``laser=six``, and the overrides
    of single values.
    """
    choices = written.choices
    names, value_overrides = functools.cache(groups.names), []
    for override in overrides:
        group = override.path[0]
        is_other = group not in choices and (group in written.own_blocks or group not in names())
        if is_other or not _names_options(override):
            value_overrides.append(override)
        elif message := _group_fault(override, choices):
            groups.diagnostics.append(Diagnostic(override.mark, override.text, message))
        elif override.value is None:
            del choices[group]
        else:
            listed = override.value.data
            values = listed if isinstance(listed, list) else [override.value]
            choices[group] = choice(group, values, override.mark, override.text)
    return tuple(choices.values()), value_overrides


def _names_options(override: Override) -> bool:
    """Return True if the value of an override can be an option of a group, or a list of options."""
    data = override.value.data if override.value else None
    if len(override.path) > 1 or isinstance(data, dict):
        return False
    return not isinstance(data, list) or all(isinstance(value.data, str) for value in data)


def _replaced(
    written: Written, choices: Iterable[Choice], groups: Groups
) -> Iterator[tuple[Where, str]]:
    """Yield the path of each value in an option that a recipe names and an argument, or a recipe
    that extends it, replaces or removes.
    """
    final_choices = {entry.group: entry for entry in choices}
    silent = replace(groups, diagnostics=[], notes=[])
    for former in (*written.replaced, *written.choices.values()):
        now = final_choices.get(former.group)
        if now and now.names == former.names:
            continue
        text = now.shown if now else f"~{former.group}"
        for option in silent.values(former):
            yield from ((leaf.path, text) for leaf in (option.leaves() if option else ()))


def _group_fault(o: Override, choices: Mapping[str, Choice]) -> str:
    group = o.path[0]
    if group in choices:
        names = choices[group].names or ["null"]
        shown_names = names[0] if len(names) == 1 else f"[{', '.join(names)}]"
        return f"{group} is already set to {shown_names}: remove the +" if o.sign == "+" else ""
    if o.sign == "~":
        return f"is not a group of this recipe; {nearest(group, choices)}"
    return "" if o.sign else f"this recipe has no group {group}; to add the group, write +{o.text}"
