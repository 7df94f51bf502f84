"""Composition of a recipe from options of its groups, its own file and the arguments."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from neusee.workflows.graph.errors import Diagnostic, Location, RecipeError, nearest
from neusee.workflows.recipe.text.extended_recipes import (
    Choice,
    Extension,
    Option,
    Written,
    choice,
    entries_of,
)
from neusee.workflows.recipe.text.overrides import Override, apply, read_override
from neusee.workflows.recipe.text.recipe_files import (
    NO_CODE_VARIABLE,
    groups_of,
    hiding_notes,
    is_inside,
    is_strange,
    locate,
    option_file,
    packaged,
    search_folders,
    shared_folders,
    shown,
)
from neusee.workflows.recipe.text.yaml_values import Value, Where, read

# --- option groups --------------------------------------------------------------------------------

# Groups of a recipe, such as ``sensor``, and options that extend others.


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
                note = (
                    f"{option.group}: there is no option {option.name}; the entry is optional, so"
                    " it is ignored"
                )
                self.notes.append(note)
            elif file is None:
                self._report(option, self._absent(option, open_))
                values.append(None)
            else:
                values.append(self._option(option, file, open_))
        return values

    def _file(self, option: Option, open_: tuple[Path, ...]) -> Path | None:
        """Return the file of an option; an option that extends its own name extends the option of
        this name in the next folder.

        ``open_``: the files of options that are being read.
        """
        folders = self.folders
        for path in open_:
            is_same = (path.parent.name, path.stem) == (option.group, option.name)
            if is_same and path.parent.parent in folders:
                folders = folders[folders.index(path.parent.parent) + 1 :]
        return option_file(option.group, option.name, folders)

    def _option(self, option: Option, file: Path, open_: tuple[Path, ...]) -> Value | None:
        """Return the values in the file of an option with those of the options that it extends, or
        None for a mistake.
        """
        # the file of an option is FOLDER/GROUP/NAME.yaml
        groups_folder = file.parent.parent
        if (
            is_strange()
            and groups_folder not in shared_folders()
            and not is_inside(file, groups_folder)
        ):
            self._report(option, _is_link(file, self.folder))
            return None
        if not open_ and groups_folder != packaged():
            self._say_hidden(option.group, option.name, file)
        return self._read(file, open_)

    def _read(self, file: Path, open_: tuple[Path, ...]) -> Value | None:
        """Return the values in the file of an option, with those of the options that it extends.

        A mistake is reported and gives None.
        """
        try:
            root = read(file, shown(file, self.folder)).root
        except RecipeError as error:
            self.diagnostics += error.diagnostics
            return None
        earlier_mistakes = len(self.diagnostics)
        levels: list[Value | None] = []
        for entry in entries_of(root, self.diagnostics, file.parent.name):
            if isinstance(entry, Choice):
                levels += self.values(entry, (*open_, file))
            else:
                levels.append(root)
        if len(self.diagnostics) > earlier_mistakes:
            return None
        values = tuple(level for level in levels if level is not None)
        return self.merge(values, root.mark) if len(values) > 1 else root

    def _absent(self, option: Option, open_: tuple[Path, ...]) -> str:
        """Return the message for an option that no folder has, or whose files are all being read
        already.
        """
        options = self.names()
        if option.group not in options:
            return f"no group {option.group}; {nearest(option.group, options)}"
        names = options[option.group]
        if option.name in names and open_:
            circle = " -> ".join(shown(path, self.folder) for path in (*open_, open_[0]))
            return f"options extend each other in a circle: {circle}"
        if "," in option.name:
            return (
                f"there is no option {option.name} in {option.group}: write several options of"
                f" one run as a list, [{option.name}], and use `neusee sweep` for several runs"
            )
        return f"no option {option.name} in {option.group}; {nearest(option.name, names)}"

    def _say_hidden(self, group: str, name: str, file: Path) -> None:
        """Note that an option hides one of the same name in a later folder."""
        later_folders = self.folders[self.folders.index(file.parent.parent) + 1 :]
        hidden = option_file(group, name, later_folders)
        if hidden is not None:
            hidden_text = (
                "the packaged option" if hidden.parent.parent == packaged() else str(hidden)
            )
            self.notes.append(
                f"{group}: {name} is {shown(file, self.folder)}, which hides {hidden_text}"
            )

    def _report(self, option: Option, message: str) -> None:
        """Add a diagnostic, unless the same one is there already."""
        problem = Diagnostic(option.mark, option.shown, message)
        if problem not in self.diagnostics:
            self.diagnostics.append(problem)


def _is_link(file: Path, folder: Path) -> str:
    """Return the message for an option whose file is a link to another folder."""
    return (
        f"{shown(file, folder)} is a link to another folder, which {NO_CODE_VARIABLE} or --no-code"
        " refuses"
    )


# --- composition ----------------------------------------------------------------------------------

# Composition of a recipe from the options of its groups, the files of the recipe and of those that
# it extends, and the arguments, in this order.


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
    groups: tuple[str, ...] = ()  #: names of the groups from which it takes an option
    own_blocks: frozenset[str] = frozenset()  #: blocks that the files of the recipes write
    extended: tuple[Path, ...] = ()  #: files of the recipes that it extends, at any depth

    def without(self, key: str) -> Composed:
        """Return the recipe without the block ``key``."""
        return replace(self, root=self.root.without(key))

    def with_problems(self, diagnostics: Iterable[Diagnostic]) -> Composed:
        """Return the recipe with ``diagnostics`` added to its diagnostics."""
        return replace(self, diagnostics=(*self.diagnostics, *diagnostics))


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
        self._written = Extension(folder).written(self._path, document)
        self._hides = hiding_notes(self._path, recipe)
        # by the chosen options, before the arguments that set single values
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
        # without an extended recipe, the values that arguments change may be missing
        if not self._written.is_complete:
            overrides = []
        choices, values = _choose(self._written, overrides, self._groups(diagnostics))
        # points of a sweep with the same options share the composed recipe
        if choices not in self._known:
            self._known[choices] = self._with_options(choices)
        with_options = self._known[choices]
        root, diagnostics = with_options.root, [*diagnostics, *with_options.diagnostics]
        for override in values:
            root = apply(root, override, diagnostics, with_options.groups)
        return replace(with_options, root=root, diagnostics=tuple(diagnostics))

    def _groups(self, diagnostics: list[Diagnostic]) -> Groups:
        """Return the groups of the recipe; mistakes in their options go to `diagnostics`."""
        folders = search_folders(self._path, self._written.extended, self._folder)
        return Groups(folders, self._folder, _merged, diagnostics)

    def _with_options(self, choices: tuple[Choice, ...]) -> Composed:
        """Return the recipe with the chosen option of each group."""
        written, groups = self._written, self._groups([])
        layer_values: list[Value | None] = []
        for layer in written.layers_with(choices):
            layer_values += groups.values(layer) if isinstance(layer, Choice) else [layer]
        values = tuple(level for level in layer_values if level is not None)
        replaced = tuple(_replaced(written, choices, groups))
        return Composed(
            name=self._path.stem,
            title=written.title,
            root=_merged(values, written.root.mark),
            diagnostics=(*written.diagnostics, *groups.diagnostics),
            whole=written.is_complete and None not in layer_values,
            replaced=replaced,
            notes=(*self._hides, *written.notes, *groups.notes),
            groups=tuple(entry.group for entry in choices),
            own_blocks=written.own_blocks,
            extended=written.extended,
        )


def merge(below: Value, above: Value) -> Value:
    """Merge the recipe value ``above`` into the recipe value ``below``, and return the result.

    Mappings are merged key by key; a list, a scalar or a step with ``node`` replaces the value in
    ``below``. The lists ``nodes`` are joined, because each file names the code of its own steps.
    """
    if above.path == ("nodes",) and isinstance(below.data, list) and isinstance(above.data, list):
        entries = [*below.data, *above.data]
        return replace(
            above, data=[replace(entry, path=("nodes", i)) for i, entry in enumerate(entries)]
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
    """Return True for a step with a node, which replaces a step of the same name as a whole."""
    return len(value.path) == 2 and value.path[0] == "steps" and "node" in value.items


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
        # a name that is no group, or is a block of values that the recipe writes itself
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
    """Yield the path of each value in the options of a recipe that an argument, or an extending
    recipe, replaces or removes, with the text of the new choice.
    """
    final_choices = {entry.group: entry for entry in choices}
    silent_groups = replace(groups, diagnostics=[], notes=[])
    for former_choice in (*written.replaced, *written.choices.values()):
        present_choice = final_choices.get(former_choice.group)
        if present_choice and present_choice.names == former_choice.names:
            continue
        text = present_choice.shown if present_choice else f"~{former_choice.group}"
        for option in silent_groups.values(former_choice):
            yield from ((leaf.path, text) for leaf in (option.leaves() if option else ()))


def _group_fault(o: Override, choices: Mapping[str, Choice]) -> str:
    """Return what is wrong with an override of a group, or an empty text.

    A ``+`` adds a group that is not there, a ``~`` removes one that is there.
    """
    group = o.path[0]
    if group in choices:
        names = choices[group].names or ["null"]
        shown_names = names[0] if len(names) == 1 else f"[{', '.join(names)}]"
        return f"{group} is already set to {shown_names}: remove the +" if o.sign == "+" else ""
    if o.sign == "~":
        return f"is not a group of this recipe; {nearest(group, choices)}"
    return "" if o.sign else f"this recipe has no group {group}; to add the group, write +{o.text}"
