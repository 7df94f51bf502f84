"""Overrides of a recipe by Python values: ``sensor={"read_noise": "20 e-"}`` means ``sensor.read_noise=20 e-``.

A mapping changes only the values that it names, but an empty mapping or a step with ``node`` replaces the whole value.
A string is not read as YAML.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from neusee.workflows.graph.diagnostics import Diagnostic, Location, RecipeError
from neusee.workflows.graph.final_values import flow
from neusee.workflows.recipe.text.overrides import Override, read_override
from neusee.workflows.recipe.text.yaml_values import Value, Where, dotted

_ALLOWED = "give a number, a string, True or False, None, a list or a mapping"
_LONGEST = 40  #: largest number of characters of a value in a message


def overrides_of(values: Mapping[str, Any], folder: Path) -> list[Override]:
    """Return the overrides that keyword arguments contain; raise one `RecipeError` for all invalid values."""
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


def _read(key: str, given: Any, mark: Location) -> Iterator[Override]:
    """Yield the overrides that one keyword argument contains: one override for each value in a mapping."""
    if key.startswith("~") and given is not None:
        raise RecipeError([Diagnostic(mark, key, f"~ removes a value and cannot set one: write {{{key!r}: None}}")])
    try:
        named = read_override(key if key.startswith("~") else f"{key}=null", mark)
    except RecipeError as error:
        raise RecipeError([Diagnostic(mark, key, p.message) for p in error.diagnostics]) from None
    if named.sign:
        yield named if named.sign == "~" else _override(named, named.path, given)
        return
    stack = [(named.path, given)]
    while stack:
        path, value = stack.pop()
        if isinstance(value, Mapping) and value and not _whole_step(path, value):
            stack += [((*path, str(_key(name, mark, path))), below) for name, below in reversed(list(value.items()))]
        else:
            yield _override(named, path, value)


def _whole_step(path: tuple[str, ...], value: Mapping[Any, Any]) -> bool:
    return len(path) == 2 and path[0] == "steps" and "node" in value


def _override(named: Override, path: tuple[str, ...], given: Any) -> Override:
    name = ".".join(path)
    mark = named.mark if path == named.path else replace(named.mark, file=f"argument {name}")
    value = _value(given, mark, path)
    shown = flow(value.plain)
    shown = shown if len(shown) <= _LONGEST else shown[: _LONGEST - 1] + "…"
    return Override(f"{named.sign}{name}={shown}", named.sign, path, value, mark)


def _value(given: Any, mark: Location, path: Where) -> Value:
    """Return a recipe `Value` with the data of a Python value and the location of the argument that contains it."""
    if isinstance(given, Mapping):
        data = {_key(key, mark, path): _value(item, mark, (*path, str(key))) for key, item in given.items()}
        return Value(data, mark, mark, path)
    if isinstance(given, list | tuple | range):
        return Value([_value(item, mark, (*path, i)) for i, item in enumerate(given)], mark, mark, path)
    if isinstance(given, os.PathLike):
        return Value(os.fspath(given), mark, mark, path)
    if given is None or isinstance(given, bool | int | float | str):
        return Value(given, mark, mark, path)
    listed = given.tolist() if hasattr(given, "tolist") else given  # a number or an array of numpy or torch
    if not isinstance(listed, bool | int | float | str | list):
        message = f"a recipe cannot contain a value of type {type(given).__name__}: {_ALLOWED}"
        raise RecipeError([Diagnostic(mark, dotted(path), message)])
    return _value(listed, mark, path)


def _key(key: Any, mark: Location, path: Where) -> str | int:
    if isinstance(key, str | int) and not isinstance(key, bool) and key != "":
        return key
    raise RecipeError([Diagnostic(mark, dotted(path), f"a mapping's key must be a name or an integer, not {key!r}")])
