"""A recipe and the recipes that it extends: the entries of its list ``defaults``, and the values of
all as one list of layers, in which a later layer overrides an earlier one.

A layer has the options of a group, or the values that a file itself writes.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from neusee.workflows.graph.errors import Diagnostic, Location, RecipeError, nearest
from neusee.workflows.recipe.text.other_spellings import (
    advice_on_group,
    advice_on_option,
    advice_on_recipe,
)
from neusee.workflows.recipe.text.recipe_files import (
    NO_CODE_VARIABLE,
    SUFFIXES,
    files_named,
    groups_of,
    hiding_notes,
    is_inside,
    is_strange,
    names_in,
    shared_folders,
    shown,
    similar_file,
)
from neusee.workflows.recipe.text.yaml_values import Document, Value, kind, read

# --- the list `defaults` of a recipe or an option -------------------------------------------------

SELF = "_self_"  #: entry for the values that the file itself writes
_OPTIONAL = "optional "
_FORM = (
    "must be one `group: option`, such as `doe: axicon`, or the name of a recipe, such as"
    " `first_light`"
)
_INNER = "must be an option of this group, such as `- small`, or one `group: option`"
_NAMES = "must be the name of an option, a list of names, or null"


@dataclass(frozen=True, slots=True)
class Option:
    """One option of a group that a recipe or an argument names."""

    group: str
    name: str
    mark: Location
    shown: str  #: the choice as the user wrote it, for a message
    is_optional: bool = False  #: whether a missing option is no mistake


@dataclass(frozen=True, slots=True)
class Choice:
    """Entry ``group: option``: the options of a group, of which a later one overrides an earlier
    one; none for null.
    """

    group: str
    options: tuple[Option, ...]
    mark: Location
    shown: str  #: as the user wrote it
    is_optional: bool = False

    @property
    def names(self) -> list[str]:
        return [option.name for option in self.options]


@dataclass(frozen=True, slots=True)
class Extended:
    """Entry that names another recipe, by its name or by the path of its file."""

    name: str
    mark: Location


@dataclass(frozen=True, slots=True)
class OwnValues:
    """Entry ``_self_``: the position of the file's own values among the entries."""

    mark: Location


Entry = Choice | Extended | OwnValues


def entries_of(root: Value, diagnostics: list[Diagnostic], group: str = "") -> list[Entry]:
    """Return the entries in the list ``defaults`` of a recipe, or of an option of ``group``, and
    report wrong entries.

    Without ``_self_`` the values of the file itself come last, as in Hydra 1.1 and later.
    """
    block = root.items.get("defaults")
    entries = [] if block is None else _listed(block, diagnostics, group)
    if not any(isinstance(entry, OwnValues) for entry in entries):
        entries.append(OwnValues(root.mark))
    return entries


def choice(
    group: str, values: Sequence[Value], mark: Location, shown: str, is_optional: bool = False
) -> Choice:
    """Return the choice of the options in ``values``; null adds no option."""
    options = tuple(
        Option(group, str(value.data), value.mark, shown, is_optional)
        for value in values
        if value.data is not None
    )
    return Choice(group, options, mark, shown, is_optional)


def _listed(block: Value, diagnostics: list[Diagnostic], group: str) -> list[Entry]:
    """Return the entries of a list ``defaults``; report wrong and repeated ones."""
    if not isinstance(block.data, list):
        expected_form = "options of this group, such as `[small]`" if group else "`group: option`"
        message = f"must be a list of {expected_form}, not {kind(block)}"
        diagnostics.append(Diagnostic(block.mark, "defaults", message))
        return []
    entries: list[Entry] = []
    first_lines: dict[tuple[str, str], int] = {}
    for value in block.data:
        entry = _entry(value, group)
        if isinstance(entry, Diagnostic):
            diagnostics.append(entry)
            continue
        name, identity = _identity(entry, group)
        if identity in first_lines:
            message = f"given twice, first in line {first_lines[identity]}"
            diagnostics.append(Diagnostic(value.mark, f"defaults.{name}", message))
            continue
        first_lines[identity] = value.mark.line
        entries.append(entry)
    return entries


def _identity(entry: Entry, group: str) -> tuple[str, tuple[str, str]]:
    """Return the name of an entry for a message, and the identity by which repeated entries are
    found.
    """
    if isinstance(entry, OwnValues):
        return SELF, (SELF, "")
    if isinstance(entry, Extended):
        return entry.name, ("", entry.name)
    # an option may extend several options of a group, in entries of their own
    return entry.group, (entry.group, str(entry.names) if group else "")


def _entry(value: Value, group: str) -> Entry | Diagnostic:
    """Return an entry of ``defaults``, or the mistake in it."""
    if value.data == SELF:
        return OwnValues(value.mark)
    if isinstance(value.data, str):
        # in the file of an option a name alone is another option of its group
        if group:
            return _choice(group, value, f"{group}: {value.data}")
        return Extended(value.data, value.mark)
    pairs = list(value.items.items()) if isinstance(value.data, dict) else []
    if len(pairs) != 1 or isinstance(pairs[0][1].data, dict):
        return Diagnostic(value.mark, value.name, _INNER if group else _FORM)
    name, options = str(pairs[0][0]), pairs[0][1]
    entry_text = f"{name}: {_text(options)}"
    if advice := advice_on_group(name, _text(options)):
        return Diagnostic(value.mark, entry_text, advice)
    is_optional = name.startswith(_OPTIONAL)
    return _choice(name.removeprefix(_OPTIONAL).strip(), options, entry_text, is_optional)


def _choice(
    group: str, options: Value, shown: str, is_optional: bool = False
) -> Choice | Diagnostic:
    """Return the choice of the options that an entry lists, or the mistake in them."""
    is_list = isinstance(options.data, list)
    values = options.data if is_list else [options]
    names = set[str]()
    for value in values:
        if isinstance(value.data, dict | list) or (is_list and value.data is None):
            return Diagnostic(value.mark, shown, _NAMES)
        if advice := advice_on_option(str(value.data)):
            return Diagnostic(value.mark, shown, advice)
        if str(value.data) in names:
            return Diagnostic(value.mark, shown, f"{value.data} is given twice")
        names.add(str(value.data))
    return choice(group, values, options.mark, shown, is_optional)


def _text(options: Value) -> str:
    """Return the options of an entry as a user writes them."""
    if isinstance(options.data, list):
        return f"[{', '.join(_text(value) for value in options.data)}]"
    return "null" if options.data is None else str(options.data)


# --- recipes and the recipes that they extend -----------------------------------------------------

_MOST_FILES_DEEP = 50  #: longest chain of recipes that extend each other

Layer = Choice | Value


@dataclass(frozen=True, slots=True)
class Written:
    """A recipe as its files write it, before the arguments of the user."""

    root: Value  #: of its own file
    title: str
    layers: tuple[Layer, ...]
    replaced: tuple[Choice, ...]  #: choices of extended recipes that a later choice replaces
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
        return {layer.group: layer for layer in choices_in(self.layers)}

    @property
    def own_blocks(self) -> frozenset[str]:
        """Return the keys that the recipes write themselves, beside the options of their groups."""
        keys = set[str]()
        for layer in self.layers:
            if isinstance(layer, Value):
                keys.update(map(str, layer.items))
        return frozenset(keys - {"defaults"})

    def layers_with(self, choices: Iterable[Choice]) -> list[Layer]:
        """Return the layers with other choices: each replaces the former choice of its group, and a
        choice of a new group comes before the values of the recipe itself.
        """
        chosen_groups = {entry.group: entry for entry in choices}
        layers: list[Layer] = []
        for layer in self.layers:
            if isinstance(layer, Value):
                layers.append(layer)
            elif layer.group in chosen_groups:
                layers.append(chosen_groups.pop(layer.group))
        position = len(layers) - 1 if isinstance(layers[-1], Value) else len(layers)
        return [*layers[:position], *chosen_groups.values(), *layers[position:]]


class Extension:
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
        """Return the layers of the recipe in the last file of ``open_``; each of these files
        extends the next one.
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
        """Add a choice to the layers, in place of the choice of the same group in an extended
        recipe.
        """
        for position, layer in enumerate(layers):
            if isinstance(layer, Choice) and layer.group == entry.group:
                if entry.is_optional:
                    correct_form = entry.shown.removeprefix("optional ")
                    message = f"replaces {layer.shown} ({layer.mark}): write `{correct_form}`"
                    self._refuse(entry.mark, entry.shown, message)
                    return
                self.replaced.append(layer)
                layers[position] = entry
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
        try:
            is_path = entry.name.endswith(SUFFIXES)
            file = self._file_at_path(entry) if is_path else self._file_of_name(entry, open_)
            self._refuse_again(file, entry, open_)
            _refuse_strange(file, entry)
        except ValueError as error:
            self._refuse(entry.mark, entry.name, str(error))
            return None
        return file

    def _file_at_path(self, entry: Extended) -> Path:
        """Return the file at a path; raise ValueError if there is none."""
        folder = Path(entry.mark.folder)
        path = Path(os.path.abspath(folder / Path(entry.name).expanduser()))
        if path.exists() and not path.is_dir():
            return path
        raise ValueError(f"no such file; {similar_file(entry.name, path, folder)}")

    def _file_of_name(self, entry: Extended, open_: tuple[Path, ...]) -> Path:
        """Return the file of a recipe by its name, in the folder of the file that names it or in a
        shared folder; raise ValueError if there is none.

        A recipe that extends its own name extends the recipe of this name in the next folder.
        """
        folders = tuple(dict.fromkeys((open_[-1].parent, *shared_folders())))
        later_folders = folders
        for path in open_:
            if path.stem == entry.name and path.parent in later_folders:
                later_folders = later_folders[later_folders.index(path.parent) + 1 :]
        file = next(files_named(entry.name, later_folders), None)
        if file is not None:
            self.notes += hiding_notes(file, entry.name)
            return file
        circular = next(files_named(entry.name, folders), None)
        if circular is not None:
            raise ValueError(self._circle((*open_, circular)))
        raise ValueError(_absent(entry.name, folders))

    def _refuse_again(self, file: Path, entry: Extended, open_: tuple[Path, ...]) -> None:
        """Raise ValueError for a file that is being read, or was read already."""
        real_path = os.path.realpath(file)
        if any(os.path.realpath(path) == real_path for path in open_):
            raise ValueError(self._circle((*open_, file)))
        # two entries for one recipe would merge it twice
        if file in self.extended:
            raise ValueError(f"is extended already, by {self.extended[file]}: remove this entry")
        if len(open_) > _MOST_FILES_DEEP:
            raise ValueError(
                f"more than {_MOST_FILES_DEEP} recipes extend each other: write them as one"
            )

    def _circle(self, files: Sequence[Path]) -> str:
        """Return the message for recipes that extend each other in a circle."""
        circle = " -> ".join(shown(path, self.folder) for path in files)
        return f"recipes extend each other in a circle: {circle}"

    def _refuse(self, mark: Location, name: str, message: str) -> None:
        self.diagnostics.append(Diagnostic(mark, name, message))


def _absent(name: str, folders: tuple[Path, ...]) -> str:
    """Return the message for a recipe that is in none of the folders."""
    groups = groups_of(*folders)
    if advice := advice_on_recipe(name, groups):
        return advice
    if name in groups:
        return f"is a group: write `{name}: OPTION`; {nearest('', groups[name])}"
    return f"no such recipe; {nearest(name, names_in(folders))}"


def _refuse_strange(file: Path, entry: Extended) -> None:
    """Raise ValueError for a file outside the folder of the untrusted recipe that extends it."""
    shared, folder = shared_folders(), Path(entry.mark.folder)
    is_own = file.parent in shared or any(
        folder.is_relative_to(shared_folder) for shared_folder in shared
    )
    if is_strange() and not is_own and not is_inside(file, folder):
        raise ValueError(
            f"is not in the folder of {Path(entry.mark.file).name}, which {NO_CODE_VARIABLE} or"
            " --no-code refuses"
        )


def _chosen_before(entry: Extended, layers: Sequence[Layer], before: Sequence[Layer]) -> str:
    """Return the advice on groups from which both an extended recipe and an earlier entry choose an
    option, or an empty text.
    """
    groups = {layer.group for layer in choices_in(layers)}
    earlier = [layer for layer in choices_in(before) if layer.group in groups]
    of_same_file = [layer for layer in earlier if layer.mark.file == entry.mark.file]
    if of_same_file:
        return (
            f"contains the group {of_same_file[0].group} too: write `{of_same_file[0].shown}`"
            f" after {entry.name}"
        )
    if not earlier:
        return ""
    names = ", ".join(layer.group for layer in earlier[:6])
    further = f" and {len(earlier) - 6} more" if len(earlier) > 6 else ""
    return (
        f"contains the groups of an earlier recipe ({names}{further}): extend only one of the two"
        " recipes"
    )


def choices_in(layers: Iterable[Layer]) -> list[Choice]:
    return [layer for layer in layers if isinstance(layer, Choice)]
