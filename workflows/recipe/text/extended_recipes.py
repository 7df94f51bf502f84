"""A recipe with those that it extends, as one list of layers; a later layer wins.

A layer has the options of a group, or the values that a file itself writes.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from neusee.workflows.graph.diagnostics import Diagnostic, Location, RecipeError, nearest
from neusee.workflows.recipe.text.defaults_list import Choice, Extended, OwnValues, entries_of
from neusee.workflows.recipe.text.hydra_habits import advice_on_recipe
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
from neusee.workflows.recipe.text.yaml_values import Document, Value, read

_MOST_FILES_DEEP = 50  #: longest chain of recipes that extend each other

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
        for position, layer in enumerate(layers):
            if isinstance(layer, Choice) and layer.group == entry.group:
                if entry.is_optional:
                    correct_form = entry.shown.removeprefix("optional ")
                    message = (
                        f"takes the place of {layer.shown} ({layer.mark}): write `{correct_form}`"
                    )
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
        """Return the file of a recipe by its name: beside the file that names it, or where the
        recipes of all are; raise ValueError if there is none.

        A recipe that extends its own name extends that of the next folder.
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
    """Raise ValueError for a file outside of the folder of a stranger's recipe that extends it."""
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
    """Return what to do about groups of which an extended recipe has an option, and an earlier
    entry too; or an empty text.
    """
    groups = {layer.group for layer in choices_in(layers)}
    earlier = [layer for layer in choices_in(before) if layer.group in groups]
    of_same_file = [layer for layer in earlier if layer.mark.file == entry.mark.file]
    if of_same_file:
        return (
            f"has the group {of_same_file[0].group} too: write `{of_same_file[0].shown}`"
            f" after {entry.name}"
        )
    if not earlier:
        return ""
    names = ", ".join(layer.group for layer in earlier[:6])
    further = f" and {len(earlier) - 6} more" if len(earlier) > 6 else ""
    return f"has the groups of an earlier recipe ({names}{further}): extend only one of the two"


def choices_in(layers: Iterable[Layer]) -> list[Choice]:
    return [layer for layer in layers if isinstance(layer, Choice)]
