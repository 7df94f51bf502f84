"""Overrides of a recipe, by arguments such as a.b=1 and by values of Python."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from neusee.workflows.graph.errors import Diagnostic, Location, RecipeError, shortened
from neusee.workflows.graph.final_values import flow
from neusee.workflows.recipe.text.other_spellings import advice_on_argument, instead
from neusee.workflows.recipe.text.yaml_values import Value, Where, dotted, parse

# --- overrides ------------------------------------------------------------------------------------

# Overrides of a recipe by arguments: ``a.b=1`` changes a value, ``+a.b=1`` adds a value, ``~a.b``
# removes a value.


#: recipe keys that are not blocks of parameters
_OTHER_KEYS = {
    "steps",
    "seed",
    "tolerance",
    "estimates",
    "outputs",
    "exports",
    "expect",
    "posterior",
    "nodes",
}
RESERVED = frozenset(_OTHER_KEYS | {"safety", "traceability"})
#: keys below which an override may set a missing path
_OPEN = ("expect", "posterior", "safety", "traceability")

Trail = list[tuple[Value, str | int]]  #: values along a path, each with the key of the next value

_SYNTAX = re.compile(
    r"(?P<sign>[+~]?)(?P<path>[^\s=+~.]+(?:\.[^\s=.]+)*)(?:=(?P<value>.*))?", re.DOTALL
)
_HELP = "is not an override: write path=value, +path=value, ~path or group=option"


@dataclass(frozen=True, slots=True)
class Override:
    """An override of a recipe, parsed from one argument."""

    text: str
    sign: str  #: ``""`` changes a value, ``+`` adds a value, ``~`` removes a value
    path: tuple[str, ...]
    value: Value | None
    mark: Location


def read_override(text: str, mark: Location) -> Override:
    """Return the override in an argument such as ``a.b=1``; read its value as YAML: ``20 e-`` is
    a string.
    """
    match = _SYNTAX.fullmatch(text)
    if match is None:
        raise RecipeError([Diagnostic(mark, text, advice_on_argument(text, "") or _HELP)])
    sign, path, value = match["sign"], tuple(match["path"].split(".")), match["value"]
    if sign == "~":
        if value is not None:
            raise RecipeError(
                [
                    Diagnostic(
                        mark, text, f"~ removes a value and cannot set one: write ~{match['path']}"
                    )
                ]
            )
        return Override(text, sign, path, None, mark)
    if value is None:
        raise RecipeError(
            [Diagnostic(mark, text, f"the argument has no value: write {text}=VALUE")]
        )
    if not value.strip():
        raise RecipeError(
            [
                Diagnostic(
                    mark, text, f"the value is empty: write {text}VALUE, or {text}null for none"
                )
            ]
        )
    try:
        return Override(text, sign, path, parse(value, mark, path), mark)
    except RecipeError as error:
        raise RecipeError([Diagnostic(mark, text, p.message) for p in error.diagnostics]) from None


def apply(
    root: Value, override: Override, diagnostics: list[Diagnostic], groups: Iterable[str] = ()
) -> Value:
    """Return a recipe after an override; for a mistake, add a diagnostic and return the recipe
    unchanged.
    """
    trail, missing = _follow(root, override.path)
    fault = _fault(root, override, trail, missing, groups)
    if fault:
        diagnostics.append(Diagnostic(override.mark, override.text, fault))
        return root
    return _rebuild(trail, missing, override)


def _follow(root: Value, path: tuple[str, ...]) -> tuple[Trail, tuple[str, ...]]:
    """Return the recipe values along a path with their keys, and the part of the path that does
    not exist.
    """
    trail: Trail = []
    value = root
    for position, name in enumerate(path):
        items = value.items
        # the items of a mapping may have whole numbers as keys
        key: str | int = (
            int(name) if name not in items and name.isdecimal() and int(name) in items else name
        )
        if key not in items:
            return [*trail, (value, name)], path[position:]
        trail.append((value, key))
        value = items[key]
    return trail, ()


def _fault(
    root: Value, o: Override, trail: Trail, missing: tuple[str, ...], groups: Iterable[str]
) -> str | None:
    """Return the message for an invalid override of a recipe, or None for a valid override."""
    parent, is_added = trail[-1][0], o.sign == "+"
    if not missing:
        return "exists already: remove the + to change the value" if is_added else None
    if advice := advice_on_argument(o.text, ".".join(o.path)):
        return advice
    if isinstance(parent.data, list):
        return _index_fault(parent, missing, is_added)
    # a new value needs a mapping as its parent
    if is_added or (not o.sign and _implied(root, o.path)):
        is_open = isinstance(parent.data, dict | None)
        return None if is_open else f"{parent.name} is a single value, not a mapping"
    return instead(".".join(o.path)) or f"unknown; {_suggest(root, o.path, groups)}"


def _index_fault(values: Value, missing: tuple[str, ...], is_added: bool) -> str | None:
    """Return the message for an index that a list does not have, unless it adds the next value."""
    count = len(values.data)
    is_next = is_added and missing == (str(count),)
    return None if is_next else f"{values.name} has {count} values: 0 to {count - 1}"


def _implied(root: Value, path: tuple[str, ...]) -> bool:
    """Return True if an override may set a missing path without a ``+``, as for a global key or
    a key of a step.
    """
    if path[0] != "steps":
        return path[0] in RESERVED and (len(path) == 1 or path[0] in _OPEN)
    steps = root.items.get("steps")
    return len(path) > 2 and steps is not None and path[1] in steps.items


def _suggest(root: Value, path: tuple[str, ...], groups: Iterable[str]) -> str:
    """Return a hint with the most similar path in the recipe, because an unknown path is often a
    typing error.
    """
    last_value, similar = _followed_similar(root, path, groups)
    if len(similar) == len(path):
        return f"did you mean {'.'.join(similar)}?"
    if alike_paths := _paths_ending_alike(root, path[-1]):
        return f"did you mean {' or '.join(sorted(alike_paths)[:3])}?"
    return (
        f"{last_value.name or 'the recipe'} has"
        f" {', '.join(map(str, last_value.items)) or 'no such value'}"
    )


def _followed_similar(
    root: Value, path: tuple[str, ...], groups: Iterable[str]
) -> tuple[Value, list[str]]:
    """Follow a path by the most similar names in a recipe; return the value at its end, and these
    names.
    """
    value, similar = root, list[str]()
    for name in path:
        names = set(map(str, value.items))
        if value is root:
            names |= {*RESERVED, *groups}
        matches = difflib.get_close_matches(name, names, 1)
        if not matches:
            break
        similar += matches
        value = value.child(matches[0]) or Value(None, value.mark, value.key, ())
    return value, similar


def _paths_ending_alike(root: Value, name: str) -> set[str]:
    """Return the paths of the values in the blocks of a recipe whose last name is similar."""
    return {
        leaf.name
        for leaf in root.leaves()
        if _is_in_block(leaf) and difflib.get_close_matches(name, [str(leaf.path[-1])], 1, 0.75)
    }


def _is_in_block(leaf: Value) -> bool:
    return bool(leaf.path) and leaf.path[0] not in RESERVED


def _rebuild(trail: Trail, missing: tuple[str, ...], o: Override) -> Value:
    """Return the recipe after an override; each value along the path is rebuilt, from the
    innermost value outwards.
    """
    value = _parsed_again(trail, missing, o)
    # mappings that do not exist yet, from the inside outwards
    for position in range(len(missing) - 1, 0, -1):
        assert value is not None
        value = Value(
            {_key(missing[position]): value},
            o.mark,
            o.mark,
            o.path[: len(o.path) - len(missing) + position],
        )
    # then the values that exist, each with its new child
    for parent, key in reversed(trail):
        key = _key(key) if missing and parent is trail[-1][0] else key
        value = (
            Value({key: value}, o.mark, parent.key, parent.path)
            if parent.data is None
            else parent.replaced(key, value)
        )
    assert value is not None
    return value


def _parsed_again(trail: Trail, missing: tuple[str, ...], o: Override) -> Value | None:
    """Return the value of an override; parse the value again if the path of the override has
    integer keys.
    """
    keys = tuple(key for _, key in trail)
    path = (*keys[:-1], *map(_key, missing)) if missing else keys
    return (
        o.value
        if o.value is None or path == o.path
        else parse(o.text.partition("=")[2], o.mark, path)
    )


def _key(name: str | int) -> str | int:
    """Return a name of decimal digits as a whole number, and any other key as it is."""
    return int(name) if isinstance(name, str) and name.isdecimal() else name


def arguments_in(value: Value) -> Iterator[Location]:
    """Yield the location of each argument that changed a value within a list or a mapping of a
    recipe.
    """
    for child in value.items.values():
        if not child.mark.line:
            yield child.mark
        yield from arguments_in(child)


# --- python overrides -----------------------------------------------------------------------------

# Overrides of a recipe by Python values: ``sensor={"read_noise": "20 e-"}`` means
# ``sensor.read_noise=20 e-``.
#
# A mapping changes only the values that it names, but an empty mapping or a step with ``node``
# replaces the whole value. A string is not read as YAML.


_ALLOWED = "give a number, a string, True or False, None, a list or a mapping"
_MOST_CHARACTERS = 40  #: largest number of characters of a value in a message


def overrides_of(values: Mapping[str, Any], folder: Path) -> list[Override]:
    """Return the overrides that keyword arguments contain; raise one `RecipeError` for all
    invalid values.
    """
    overrides: list[Override] = []
    diagnostics: list[Diagnostic] = []
    for key, value in values.items():
        mark = Location(f"argument {key}", folder=str(folder))
        try:
            overrides += _read(key, value, mark)
        except RecipeError as error:
            diagnostics += error.diagnostics
    if diagnostics:
        raise RecipeError(diagnostics)
    return overrides


def _read(key: str, argument: Any, mark: Location) -> Iterator[Override]:
    """Yield the overrides that one keyword argument contains: one override for each value in a
    mapping.
    """
    override = _named(key, argument, mark)
    if override.sign:
        yield override if override.sign == "~" else _override(override, override.path, argument)
        return
    stack = [(override.path, argument)]
    while stack:
        path, value = stack.pop()
        if isinstance(value, Mapping) and value and not _whole_step(path, value):
            stack += [
                ((*path, str(_python_key(name, mark, path))), inner)
                for name, inner in reversed(list(value.items()))
            ]
        else:
            yield _override(override, path, value)


def _named(key: str, argument: Any, mark: Location) -> Override:
    """Return the override, sign and path, in the name of a keyword argument, without its value."""
    if key.startswith("~") and argument is not None:
        raise RecipeError(
            [
                Diagnostic(
                    mark, key, f"~ removes a value and cannot set one: write {{{key!r}: None}}"
                )
            ]
        )
    argument = key if key.startswith("~") else f"{key}=null"
    try:
        return read_override(argument, mark)
    except RecipeError as error:
        raise RecipeError([Diagnostic(mark, key, p.message) for p in error.diagnostics]) from None


def _whole_step(path: tuple[str, ...], value: Mapping[Any, Any]) -> bool:
    """Return True for a mapping that is a step with its node, which is set as a whole."""
    return len(path) == 2 and path[0] == "steps" and "node" in value


def _override(named: Override, path: tuple[str, ...], argument: Any) -> Override:
    """Return the override of one value at a path, with the argument shown as a text."""
    name = ".".join(path)
    mark = named.mark if path == named.path else replace(named.mark, file=f"argument {name}")
    value = _value(argument, mark, path)
    value_text = shortened(flow(value.plain), _MOST_CHARACTERS)
    return Override(f"{named.sign}{name}={value_text}", named.sign, path, value, mark)


def _value(argument: Any, mark: Location, path: Where) -> Value:
    """Return a recipe `Value` with the data of a Python value and the location of the argument
    that contains it.
    """
    if isinstance(argument, Mapping):
        data = {
            _python_key(key, mark, path): _value(item, mark, (*path, str(key)))
            for key, item in argument.items()
        }
        return Value(data, mark, mark, path)
    if isinstance(argument, list | tuple | range):
        return Value(
            [_value(item, mark, (*path, i)) for i, item in enumerate(argument)], mark, mark, path
        )
    if isinstance(argument, os.PathLike):
        return Value(os.fspath(argument), mark, mark, path)
    if argument is None or isinstance(argument, bool | int | float | str):
        return Value(argument, mark, mark, path)
    # a number or an array of numpy or torch
    plain = argument.tolist() if hasattr(argument, "tolist") else argument
    if not isinstance(plain, bool | int | float | str | list):
        message = f"a recipe cannot contain a value of type {type(argument).__name__}: {_ALLOWED}"
        raise RecipeError([Diagnostic(mark, dotted(path), message)])
    return _value(plain, mark, path)


def _python_key(key: Any, mark: Location, path: Where) -> str | int:
    """Return a key of a Python mapping; raise `RecipeError` unless it is a name or an integer."""
    if isinstance(key, str | int) and not isinstance(key, bool) and key != "":
        return key
    raise RecipeError(
        [
            Diagnostic(
                mark, dotted(path), f"a mapping's key must be a name or an integer, not {key!r}"
            )
        ]
    )
