"""Composition of a recipe from several files: its groups first, then its own text, then the arguments."""

from __future__ import annotations

import functools
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path

from neusee.workflows.graph.diagnostics import Diagnostic, Location, RecipeError, nearest
from neusee.workflows.recipe.text.overrides import Override, apply, read_override
from neusee.workflows.recipe.text.yaml_values import Value, kind, read

_NAME = re.compile(r"[\w-]+")
_MOST_KNOWN = 16
_known: dict[tuple[int, ...], tuple[tuple[Value, ...], Value]] = {}  #: ids of the parts -> the parts, merged


@dataclass(frozen=True, slots=True)
class Composed:
    """The final values of a recipe, read as YAML and not yet checked."""

    name: str
    title: str
    root: Value
    diagnostics: tuple[Diagnostic, ...]
    whole: bool = True  #: whether every named group could be read

    def without(self, key: str) -> Composed:
        """Return the recipe without one block, which is read separately."""
        return replace(self, root=replace(self.root, data={k: v for k, v in self.root.data.items() if k != key}))

    def with_problems(self, diagnostics: Iterable[Diagnostic]) -> Composed:
        """Return the recipe with further diagnostics."""
        return replace(self, diagnostics=(*self.diagnostics, *diagnostics))


@dataclass(frozen=True, slots=True)
class Choice:
    """An entry of ``defaults``: the option of a group, or no option."""

    group: str
    option: str | None
    mark: Location
    shown: str  #: the user's text, for a message


@functools.cache
def packaged() -> Path:
    """Return the folder of the recipes that are installed with the program."""
    return Path(str(files("neusee.recipes")))


def locate(recipe: str | Path, folder: Path) -> Path:
    """Return the file of a packaged recipe's name, or of a path that ends in ``.yaml``."""
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
    """Compose ``recipe``; ``arguments`` count from ``first``, and their paths are relative to ``folder``."""
    path = locate(recipe, folder)
    document = read(path, shown(path, folder))
    diagnostics: list[Diagnostic] = []
    overrides: list[Override] = []
    for number, given in enumerate(arguments, first):
        mark = Location(f"argument {number}", folder=str(folder))
        try:
            overrides.append(given if isinstance(given, Override) else read_override(given, mark))
        except RecipeError as error:
            diagnostics += error.diagnostics
    choices, rest = _choose(document.root, overrides, path.parent, diagnostics)
    options = [_option(choice, path.parent, folder, diagnostics) for choice in choices if choice.option is not None]
    root = _merged((*(option for option in options if option is not None), document.root))
    for override in rest:
        root = apply(root, override, diagnostics, [choice.group for choice in choices])
    return Composed(path.stem, document.title, root, tuple(diagnostics), None not in options)


def shown(path: Path, folder: Path) -> str:
    """Return a file's name as its user knows it: relative to the packaged recipes or the working folder, or in full."""
    for above in (packaged(), folder):
        if path.is_relative_to(above):
            return path.relative_to(above).as_posix()
    return str(path)


def merge(below: Value, above: Value) -> Value:
    """Merge ``above`` over ``below``: mappings by key, other values and steps with their own ``node`` as a whole."""
    if not isinstance(below.data, dict) or not isinstance(above.data, dict) or _new_step(above):
        return above
    data = dict(below.data)
    for key, value in above.data.items():
        data[key] = merge(data[key], value) if key in data else value
    return replace(below, data=data)


def _merged(parts: tuple[Value, ...]) -> Value:
    """Merge the groups' options and the recipe; equal parts give the identical value again."""
    name = tuple(map(id, parts))  # no other value takes an id while `_known` holds the parts
    found = _known.get(name)
    if found is None:
        root = Value({}, parts[-1].mark, parts[-1].mark, ())
        for part in parts:
            root = merge(root, _without_defaults(part))
        found = (parts, root)
        while len(_known) >= _MOST_KNOWN:
            _known.pop(next(iter(_known), name), None)
        _known[name] = found
    return found[1]


def _new_step(value: Value) -> bool:
    return len(value.path) == 2 and value.path[0] == "steps" and "node" in value.items


def _without_defaults(root: Value) -> Value:
    if "defaults" not in root.items:
        return root
    return replace(root, data={key: value for key, value in root.data.items() if key != "defaults"})


# --- groups ---------------------------------------------------------------------------------------------------------


def groups_of(*folders: Path) -> dict[str, list[str]]:
    """Return options by group: the folders of YAML files beside a recipe and among the packaged ones."""
    found: dict[str, set[str]] = {}
    for folder in folders:
        for path in folder.glob("*/*.yaml"):
            found.setdefault(path.parent.name, set()).add(path.stem)
    return {group: sorted(found[group]) for group in sorted(found)}


def _choose(
    root: Value, overrides: list[Override], beside: Path, diagnostics: list[Diagnostic]
) -> tuple[list[Choice], list[Override]]:
    """Return the defaults after ``group=option``, and the overrides of values."""
    choices = {choice.group: choice for choice in _defaults(root, diagnostics)}
    groups = groups_of(beside, packaged())
    rest = []
    for o in overrides:
        group = o.path[0]
        of_values = group not in choices and (group in root.items or group not in groups)
        if len(o.path) > 1 or o.value_is_collection or of_values:
            rest.append(o)
        elif o.sign == "+" and group in choices:
            diagnostics.append(
                Diagnostic(o.mark, o.text, f"{group} is already set to {choices[group].option}: remove the +")
            )
        elif o.sign == "" and group not in choices:
            diagnostics.append(
                Diagnostic(o.mark, o.text, f"this recipe has no group {group}; to add the group, write +{o.text}")
            )
        elif o.sign == "~" and group not in choices:
            diagnostics.append(Diagnostic(o.mark, o.text, f"is not a group of this recipe; {nearest(group, choices)}"))
        elif o.sign == "~":
            del choices[group]
        else:
            option = None if o.value is None or o.value.data is None else str(o.value.data)
            choices[group] = Choice(group, option, o.mark, o.text)
    return list(choices.values()), rest


def _defaults(root: Value, diagnostics: list[Diagnostic]) -> Iterator[Choice]:
    """Yield the entries of the ``defaults`` list that can be read."""
    given = root.items.get("defaults")
    if given is None:
        return
    if not isinstance(given.data, list):
        diagnostics.append(Diagnostic(given.mark, "defaults", f"must be a list of `group: option`, not {kind(given)}"))
        return
    seen: dict[str, Location] = {}
    for entry in given.data:
        pair = list(entry.items.items()) if isinstance(entry.data, dict) else []
        if len(pair) != 1 or isinstance(pair[0][1].data, dict | list):
            diagnostics.append(Diagnostic(entry.mark, entry.name, "must be one `group: option`, such as `doe: axicon`"))
            continue
        group, option = str(pair[0][0]), pair[0][1]
        if group in seen:
            diagnostics.append(
                Diagnostic(entry.mark, f"defaults.{group}", f"given twice, first in line {seen[group].line}")
            )
            continue
        seen[group] = entry.mark
        yield Choice(group, None if option.data is None else str(option.data), option.mark, f"{group}: {option.data}")


def _option(choice: Choice, beside: Path, folder: Path, diagnostics: list[Diagnostic]) -> Value | None:
    """Return the values of an option; the folder beside the recipe precedes the packaged one."""
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
    return _without_defaults(root)
