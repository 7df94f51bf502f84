"""Overrides of a recipe as arguments: ``a.b=1``, ``+a.b=1``, ``~a.b``."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

from neusee.workflows.graph.diagnostics import Diagnostic, Location, RecipeError
from neusee.workflows.recipe.text.renamed_keys import instead
from neusee.workflows.recipe.text.yaml_values import Value, parse

RESERVED = frozenset(
    {"steps", "seed", "tolerance", "outputs", "expect", "posterior"}
)  #: keys that are not parameter blocks

Trail = list[tuple[Value, str | int]]  #: values along a path, each with the key to the next one

_SYNTAX = re.compile(r"(?P<sign>[+~]?)(?P<path>[^\s=+~.]+(?:\.[^\s=.]+)*)(?:=(?P<value>.*))?", re.DOTALL)
_HELP = "is not an override: write path=value, +path=value, ~path or group=option"


@dataclass(frozen=True, slots=True)
class Override:
    """One parsed argument."""

    text: str
    sign: str  #: ``""`` changes a value, ``+`` adds one, ``~`` removes one
    path: tuple[str, ...]
    value: Value | None
    mark: Location

    @property
    def value_is_collection(self) -> bool:
        return self.value is not None and isinstance(self.value.data, dict | list)


def read_override(text: str, mark: Location) -> Override:
    """Read one argument; its value is YAML, so that ``20 e-`` stays a string."""
    match = _SYNTAX.fullmatch(text)
    if match is None:
        raise RecipeError([Diagnostic(mark, text, _HELP)])
    sign, path, value = match["sign"], tuple(match["path"].split(".")), match["value"]
    if sign == "~":
        if value is not None:
            raise RecipeError([Diagnostic(mark, text, f"~ removes a value and cannot set one: write ~{match['path']}")])
        return Override(text, sign, path, None, mark)
    if value is None:
        raise RecipeError([Diagnostic(mark, text, f"has no value: write {text}=VALUE")])
    if not value.strip():
        raise RecipeError([Diagnostic(mark, text, f"has no value: write {text}VALUE, or {text}null for none")])
    try:
        return Override(text, sign, path, parse(value, mark, path), mark)
    except RecipeError as error:
        raise RecipeError([Diagnostic(mark, text, p.message) for p in error.diagnostics]) from None


def apply(root: Value, override: Override, diagnostics: list[Diagnostic], groups: Iterable[str] = ()) -> Value:
    """Return ``root`` with one value changed, added or removed; a mistake leaves ``root`` unchanged."""
    trail, missing = _follow(root, override.path)
    fault = _fault(root, override, trail, missing, groups)
    if fault:
        diagnostics.append(Diagnostic(override.mark, override.text, fault))
        return root
    return _rebuild(trail, missing, override)


def _follow(root: Value, path: tuple[str, ...]) -> tuple[Trail, tuple[str, ...]]:
    """Return the values along ``path`` with the key to the next one, and the part of the path that does not exist."""
    trail: Trail = []
    here = root
    for n, part in enumerate(path):
        items = here.items
        key: str | int = int(part) if part not in items and part.isdecimal() and int(part) in items else part
        if key not in items:
            return [*trail, (here, part)], path[n:]
        trail.append((here, key))
        here = items[key]
    return trail, ()


def _fault(root: Value, o: Override, trail: Trail, missing: tuple[str, ...], groups: Iterable[str]) -> str | None:
    """Return the mistake of an override, or None."""
    here = trail[-1][0]
    if not missing:
        return "exists already: remove the + to change the value" if o.sign == "+" else None
    if isinstance(here.data, list):
        if o.sign == "+" and len(missing) == 1 and missing[0] == str(len(here.data)):
            return None
        return f"{here.name} has {len(here.data)} values: 0 to {len(here.data) - 1}"
    if o.sign == "+" or (o.sign == "" and _implied(root, o.path)):
        return None if isinstance(here.data, dict | None) else f"{here.name} is a single value, not a mapping"
    return instead(".".join(o.path)) or f"unknown; {_suggest(root, o.path, groups)}"


def _implied(root: Value, path: tuple[str, ...]) -> bool:
    """Return True if a path may be set without being written: a key of the recipe, or of one of its steps."""
    if path[0] != "steps":
        return path[0] in RESERVED and (len(path) == 1 or path[0] in ("expect", "posterior"))
    steps = root.items.get("steps")
    return len(path) > 2 and steps is not None and path[1] in steps.items


def _suggest(root: Value, path: tuple[str, ...], groups: Iterable[str]) -> str:
    """Return the nearest path that exists, because a new path is often a typo."""
    here, found = root, list[str]()
    for part in path:
        names = {str(key): value for key, value in here.items.items()}
        also = (*RESERVED, *groups) if here is root else ()
        close = difflib.get_close_matches(part, {*names, *also}, 1)
        if not close:
            break
        found += close
        here = names.get(close[0], Value(None, here.mark, here.key, ()))
    if len(found) == len(path):
        return f"did you mean {'.'.join(found)}?"
    same = {leaf.name for leaf in root.leaves() if leaf.path[0] not in RESERVED and _close(path[-1], leaf.path[-1])}
    if same:
        return f"did you mean {' or '.join(sorted(same)[:3])}?"
    return f"{here.name or 'the recipe'} has {', '.join(map(str, here.items)) or 'no such value'}"


def _close(name: str, other: str | int) -> bool:
    return bool(difflib.get_close_matches(name, [str(other)], 1, 0.75))


def _rebuild(trail: Trail, missing: tuple[str, ...], o: Override) -> Value:
    """Return the values along the trail with the change, rebuilt from the inside out."""
    made = _placed(trail, missing, o)
    for n in range(len(missing) - 1, 0, -1):
        assert made is not None
        made = Value({_key(missing[n]): made}, o.mark, o.mark, o.path[: len(o.path) - len(missing) + n])
    for here, key in reversed(trail):
        made = _with(here, _key(key) if missing and here is trail[-1][0] else key, made, o.mark)
    assert made is not None
    return made


def _placed(trail: Trail, missing: tuple[str, ...], o: Override) -> Value | None:
    """Return the value parsed for its final place: a digit string is a number as a key there, as in the file."""
    there = tuple(key for _, key in trail)
    where = (*there[:-1], *map(_key, missing)) if missing else there
    return o.value if o.value is None or where == o.path else parse(o.text.partition("=")[2], o.mark, where)


def _key(part: str | int) -> str | int:
    return int(part) if isinstance(part, str) and part.isdecimal() else part


def _with(here: Value, key: str | int, made: Value | None, mark: Location) -> Value:
    items = {k: v for k, v in here.items.items() if made is not None or k != key}
    if made is not None:
        items[key] = made
    if isinstance(here.data, list):
        return replace(here, data=[replace(v, path=(*here.path, i)) for i, v in enumerate(items.values())])
    return replace(here, data=items) if here.data is not None else Value(items, mark, here.key, here.path)


def arguments_in(value: Value) -> Iterator[Location]:
    """Yield the arguments that changed a part of a value."""
    for child in value.items.values():
        if not child.mark.line:
            yield child.mark
        yield from arguments_in(child)
