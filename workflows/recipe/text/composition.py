"""Composition of a recipe from the options of its groups, its own file and the arguments, in this order."""

from __future__ import annotations

import functools
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path

from neusee.workflows.graph.diagnostics import Diagnostic, Location, RecipeError, nearest
from neusee.workflows.recipe.text.overrides import Override, apply, read_override
from neusee.workflows.recipe.text.yaml_values import Value, Where, kind, read

_NAME = re.compile(r"[\w-]+")


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

    def without(self, key: str) -> Composed:
        """Return the recipe without the block ``key``."""
        return replace(self, root=self.root.without(key))

    def with_problems(self, diagnostics: Iterable[Diagnostic]) -> Composed:
        """Return the recipe with ``diagnostics`` added to its diagnostics."""
        return replace(self, diagnostics=(*self.diagnostics, *diagnostics))


@dataclass(frozen=True, slots=True)
class Choice:
    """Entry of ``defaults`` in a recipe: a group and its option, or None for no option."""

    group: str
    option: str | None
    mark: Location
    shown: str  #: the entry as the user wrote it, for a message


@functools.cache
def packaged() -> Path:
    """Return the folder of the recipes that are installed with neusee."""
    return Path(str(files("neusee.recipes")))


def locate(recipe: str | Path, folder: Path) -> Path:
    """Return the path of a recipe file from the name of a packaged recipe or from a path that ends in ``.yaml``."""
    if str(recipe).endswith((".yaml", ".yml")):
        path = folder / Path(recipe).expanduser()
        if path.is_file():
            return path
        there = [str(p.relative_to(folder)) for p in path.parent.glob("*.yaml") if p.is_relative_to(folder)]
        raise RecipeError([Diagnostic(Location("recipe"), str(recipe), f"no such file; {nearest(str(recipe), there)}")])
    path = packaged() / f"{recipe}.yaml"
    if _NAME.fullmatch(str(recipe)) and path.is_file():
        return path
    names = [p.stem for p in packaged().glob("*.yaml")]
    raise RecipeError([Diagnostic(Location("recipe"), str(recipe), f"no such recipe; {nearest(str(recipe), names)}")])


def compose(recipe: str | Path, arguments: Sequence[str | Override], folder: Path, first: int = 1) -> Composed:
    """Return a recipe composed from its files and arguments; messages number the arguments from ``first``."""
    path = locate(recipe, folder)
    document = read(path, shown(path, folder))
    diagnostics: list[Diagnostic] = []
    overrides: list[Override] = []
    for number, argument in enumerate(arguments, first):
        mark = Location(f"argument {number}", folder=str(folder))
        try:
            overrides.append(argument if isinstance(argument, Override) else read_override(argument, mark))
        except RecipeError as error:
            diagnostics += error.diagnostics
    choices, rest = _choose(document.root, overrides, path.parent, diagnostics)
    options = [_option(choice, path.parent, folder, diagnostics) for choice in choices if choice.option is not None]
    root = _merged((*(option for option in options if option is not None), document.root))
    for override in rest:
        root = apply(root, override, diagnostics, [choice.group for choice in choices])
    replaced = tuple(_replaced(document.root, choices, path.parent, folder))
    return Composed(path.stem, document.title, root, tuple(diagnostics), None not in options, replaced)


def shown(path: Path, folder: Path) -> str:
    """Return the path of a file relative to the packaged recipes or to ``folder``, or else the full path."""
    for above in (packaged(), folder):
        if path.is_relative_to(above):
            return path.relative_to(above).as_posix()
    return str(path)


def merge(below: Value, above: Value) -> Value:
    """Merge the recipe value ``above`` into the recipe value ``below``, and return the result.

    Mappings are merged key by key; a list, a scalar or a step with ``node`` replaces the value in ``below``.
    """
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


def groups_of(*folders: Path) -> dict[str, list[str]]:
    """Return the names of the options of each group; a group is a folder of YAML files in one of ``folders``."""
    options: dict[str, set[str]] = {}
    for folder in folders:
        for path in folder.glob("*/*.yaml"):
            options.setdefault(path.parent.name, set()).add(path.stem)
    return {group: sorted(options[group]) for group in sorted(options)}


def _choose(
    root: Value, overrides: list[Override], beside: Path, diagnostics: list[Diagnostic]
) -> tuple[list[Choice], list[Override]]:
    """Return the option of each group after overrides such as ``laser=six``, and the overrides of single values."""
    choices = {choice.group: choice for choice in _defaults(root, diagnostics)}
    groups = groups_of(beside, packaged())
    rest = []
    for o in overrides:
        group, data = o.path[0], o.value.data if o.value else None
        of_values = group not in choices and (group in root.items or group not in groups)
        if len(o.path) > 1 or isinstance(data, dict | list) or of_values:
            rest.append(o)
        elif message := _group_fault(o, choices):
            diagnostics.append(Diagnostic(o.mark, o.text, message))
        elif o.sign == "~":
            del choices[group]
        else:
            choices[group] = Choice(group, None if data is None else str(data), o.mark, o.text)
    return list(choices.values()), rest


def _replaced(root: Value, choices: Iterable[Choice], beside: Path, folder: Path) -> Iterator[tuple[Where, str]]:
    """Yield the path of each value in an option that the recipe names and an argument replaces or removes."""
    chosen = {choice.group: choice for choice in choices}
    for written in _defaults(root, []):
        now = chosen.get(written.group)
        if written.option is None or (now and now.option == written.option):
            continue
        option = _option(written, beside, folder, [])
        shown = now.shown if now else f"~{written.group}"
        yield from ((leaf.path, shown) for leaf in (option.leaves() if option else ()))


def _group_fault(o: Override, choices: Mapping[str, Choice]) -> str:
    group = o.path[0]
    if group in choices:
        return f"{group} is already set to {choices[group].option}: remove the +" if o.sign == "+" else ""
    if o.sign == "~":
        return f"is not a group of this recipe; {nearest(group, choices)}"
    return "" if o.sign else f"this recipe has no group {group}; to add the group, write +{o.text}"


def _defaults(root: Value, diagnostics: list[Diagnostic]) -> Iterator[Choice]:
    """Yield the entries in the list ``defaults`` of a recipe; report the entries that cannot be read."""
    given = root.items.get("defaults")
    if given is None:
        return
    if not isinstance(given.data, list):
        diagnostics.append(Diagnostic(given.mark, "defaults", f"must be a list of `group: option`, not {kind(given)}"))
        return
    lines: dict[str, int] = {}
    for entry in given.data:
        pair = list(entry.items.items()) if isinstance(entry.data, dict) else []
        if len(pair) != 1 or isinstance(pair[0][1].data, dict | list):
            diagnostics.append(Diagnostic(entry.mark, entry.name, "must be one `group: option`, such as `doe: axicon`"))
            continue
        group, option = str(pair[0][0]), pair[0][1]
        if group in lines:
            message = f"given twice, first in line {lines[group]}"
            diagnostics.append(Diagnostic(entry.mark, f"defaults.{group}", message))
            continue
        lines[group] = entry.mark.line
        yield Choice(group, None if option.data is None else str(option.data), option.mark, f"{group}: {option.data}")


def _option(choice: Choice, beside: Path, folder: Path, diagnostics: list[Diagnostic]) -> Value | None:
    """Return the values of an option of a group; a file beside the recipe takes precedence over a packaged file."""
    names = (choice.group, str(choice.option))
    for above in dict.fromkeys((beside, packaged())):
        path = above / choice.group / f"{names[1]}.yaml"
        if all(map(_NAME.fullmatch, names)) and path.is_file():
            return _read_option(path, folder, diagnostics)
    groups = groups_of(packaged(), beside)
    if choice.group in groups:
        message = f"no option {choice.option} in {choice.group}; {nearest(names[1], groups[choice.group])}"
    else:
        message = f"no group {choice.group}; {nearest(choice.group, groups)}"
    diagnostics.append(Diagnostic(choice.mark, choice.shown, message))
    return None


def _read_option(path: Path, folder: Path, diagnostics: list[Diagnostic]) -> Value | None:
    try:
        root = read(path, shown(path, folder)).root
    except RecipeError as error:
        diagnostics += error.diagnostics
        return None
    if "defaults" in root.items:
        message = "belongs in a recipe: an option of a group cannot name other groups"
        diagnostics.append(Diagnostic(root.items["defaults"].key, "defaults", message))
    return root
