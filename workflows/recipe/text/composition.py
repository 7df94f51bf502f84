"""Composition of a recipe from the options of its groups, its own file and the arguments, in this order."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from neusee.workflows.graph.diagnostics import Diagnostic, Location, RecipeError, nearest
from neusee.workflows.recipe.text.option_groups import (
    NAME,
    Choice,
    Groups,
    choices_of,
    packaged,
    search_folders,
    shared_folders,
    shown,
)
from neusee.workflows.recipe.text.overrides import Override, apply, read_override
from neusee.workflows.recipe.text.yaml_values import Value, Where, read


@dataclass(frozen=True, slots=True)
class Composed:
    """A recipe composed from its files and the arguments of the user, with values that are not yet checked."""

    name: str
    title: str
    root: Value
    diagnostics: tuple[Diagnostic, ...]
    whole: bool = True  #: whether every named group could be read
    #: paths of the values in options that arguments replaced, each with the argument, such as ``scene=siemens``
    replaced: tuple[tuple[Where, str], ...] = ()
    notes: tuple[str, ...] = ()  #: on options that hide others of the same name

    def without(self, key: str) -> Composed:
        """Return the recipe without the block ``key``."""
        return replace(self, root=self.root.without(key))

    def with_problems(self, diagnostics: Iterable[Diagnostic]) -> Composed:
        """Return the recipe with ``diagnostics`` added to its diagnostics."""
        return replace(self, diagnostics=(*self.diagnostics, *diagnostics))


def locate(recipe: str | Path, folder: Path) -> Path:
    """Return the path of a recipe file from a name, such as that of a packaged recipe, or from a path to ``.yaml``."""
    if str(recipe).endswith((".yaml", ".yml")):
        path = folder / Path(recipe).expanduser()
        if path.exists() and not path.is_dir():
            return path
        there = [str(p.relative_to(folder)) for p in path.parent.glob("*.yaml") if p.is_relative_to(folder)]
        raise RecipeError([Diagnostic(Location("recipe"), str(recipe), f"no such file; {nearest(str(recipe), there)}")])
    shared = shared_folders()
    if NAME.fullmatch(str(recipe)):
        for above in shared:
            if (path := above / f"{recipe}.yaml").is_file():
                return path
    names = [p.stem for above in shared for p in above.glob("*.yaml")]
    raise RecipeError([Diagnostic(Location("recipe"), str(recipe), f"no such recipe; {nearest(str(recipe), names)}")])


def compose(recipe: str | Path, arguments: Sequence[str | Override], folder: Path, first: int = 1) -> Composed:
    """Return a recipe composed from its files and arguments; messages number the arguments from ``first``."""
    return Composer(recipe, folder).compose(arguments, first)


class Composer:
    """A recipe that is composed with several lists of arguments, such as the points of a sweep; a file is read once."""

    def __init__(self, recipe: str | Path, folder: Path) -> None:
        self._path, self._folder = locate(recipe, folder), folder
        self._document = read(self._path, shown(self._path, folder))
        self._hides = _hiding(self._path, recipe)
        self._known: dict[tuple[Choice, ...], Composed] = {}  # before the arguments that set single values

    def compose(self, arguments: Sequence[str | Override], first: int = 1) -> Composed:
        """Return the recipe with arguments; messages number the arguments from ``first``."""
        diagnostics: list[Diagnostic] = []
        overrides: list[Override] = []
        for number, argument in enumerate(arguments, first):
            mark = Location(f"argument {number}", folder=str(self._folder))
            try:
                overrides.append(argument if isinstance(argument, Override) else read_override(argument, mark))
            except RecipeError as error:
                diagnostics += error.diagnostics
        choices, rest = _choose(self._document.root, overrides, self._groups(diagnostics))
        chosen = tuple(choices)
        if chosen not in self._known:
            self._known[chosen] = self._with_options(chosen)
        below = self._known[chosen]
        root, diagnostics = below.root, [*diagnostics, *below.diagnostics]
        for override in rest:
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
        told, notes = tuple(groups.diagnostics), (*self._hides, *groups.notes)
        return Composed(self._path.stem, document.title, root, told, None not in options, replaced, notes)


def _hiding(path: Path, recipe: str | Path) -> list[str]:
    """Return a note if the name of a recipe means a file of the user, which hides a packaged recipe."""
    hides = path.parent != packaged() and path.stem == str(recipe) and (packaged() / path.name).is_file()
    return [f"{recipe} is {path}, which hides the packaged recipe"] if hides else []


def merge(below: Value, above: Value) -> Value:
    """Merge the recipe value ``above`` into the recipe value ``below``, and return the result.

    Mappings are merged key by key; a list, a scalar or a step with ``node`` replaces the value in ``below``. The lists
    ``nodes`` are joined, because each file names the code of its own steps.
    """
    if above.path == ("nodes",) and isinstance(below.data, list) and isinstance(above.data, list):
        joined = [*below.data, *above.data]
        return replace(above, data=[replace(part, path=("nodes", i)) for i, part in enumerate(joined)])
    if not isinstance(below.data, dict) or not isinstance(above.data, dict) or _new_step(above):
        return above
    data = dict(below.data)
    for key, value in above.data.items():
        data[key] = merge(data[key], value) if key in data else value
    return replace(below, data=data)


@functools.lru_cache(maxsize=16)
def _merged(parts: tuple[Value, ...]) -> Value:
    """Merge the options of the groups and the recipe in order; return the cached object if the parts are the same."""
    mark = parts[-1].mark
    return functools.reduce(merge, (part.without("defaults") for part in parts), Value({}, mark, mark, ()))


def _new_step(value: Value) -> bool:
    return len(value.path) == 2 and value.path[0] == "steps" and "node" in value.items


# --- groups ---------------------------------------------------------------------------------------------------------


def _choose(root: Value, overrides: list[Override], groups: Groups) -> tuple[list[Choice], list[Override]]:
    """Return the option of each group after overrides such as ``laser=six``, and the overrides of single values."""
    choices = {choice.group: choice for choice in choices_of(root, groups.diagnostics)}
    names, rest = functools.cache(groups.names), []
    for o in overrides:
        group, data = o.path[0], o.value.data if o.value else None
        values = len(o.path) > 1 or isinstance(data, dict | list)
        if values or (group not in choices and (group in root.items or group not in names())):
            rest.append(o)
        elif message := _group_fault(o, choices):
            groups.diagnostics.append(Diagnostic(o.mark, o.text, message))
        elif o.sign == "~":
            del choices[group]
        else:
            choices[group] = Choice(group, None if data is None else str(data), o.mark, o.text)
    return list(choices.values()), rest


def _replaced(root: Value, choices: Iterable[Choice], groups: Groups) -> Iterator[tuple[Where, str]]:
    """Yield the path of each value in an option that the recipe names and an argument replaces or removes."""
    chosen = {choice.group: choice for choice in choices}
    silent = replace(groups, diagnostics=[], notes=[])
    for written in choices_of(root, []):
        now = chosen.get(written.group)
        if written.option is None or (now and now.option == written.option):
            continue
        option = silent.option(written)
        shown = now.shown if now else f"~{written.group}"
        yield from ((leaf.path, shown) for leaf in (option.leaves() if option else ()))


def _group_fault(o: Override, choices: Mapping[str, Choice]) -> str:
    group = o.path[0]
    if group in choices:
        return f"{group} is already set to {choices[group].option}: remove the +" if o.sign == "+" else ""
    if o.sign == "~":
        return f"is not a group of this recipe; {nearest(group, choices)}"
    return "" if o.sign else f"this recipe has no group {group}; to add the group, write +{o.text}"
