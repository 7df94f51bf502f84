"""The points of a sweep, in Hydra's manner: ``a=1,2,3`` and ``b='range(0, 10, 2)'``, their product or their pairs."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neusee.workflows.graph.diagnostics import Diagnostic, Location, RecipeError
from neusee.workflows.graph.final_values import flow
from neusee.workflows.recipe.text.overrides import Override, read_override
from neusee.workflows.recipe.text.python_overrides import overrides_of
from neusee.workflows.sweeps.value_ranges import MOST, spans, values_of


@dataclass(frozen=True, slots=True)
class Coordinate:
    """One value of an axis."""

    shown: str  #: as one would write it
    value: Any  #: as YAML reads it
    overrides: tuple[Override, ...]


@dataclass(frozen=True, slots=True)
class Axis:
    """A parameter, or a group, with the values that it takes."""

    name: str
    coordinates: tuple[Coordinate, ...]
    mark: Location


Argument = Override | Axis


@dataclass(frozen=True, slots=True)
class Point:
    """One combination of values; points count from 1 in the order in which the axes are written."""

    number: int
    place: tuple[int, ...]  #: index along every axis
    coordinates: tuple[Coordinate, ...]  #: one for each axis
    overrides: tuple[Override, ...]  #: every change of the recipe, in the order of the arguments
    axes: tuple[str, ...]  #: their names

    @property
    def shown(self) -> str:
        """``sensor.read_noise=5 e-, doe=axicon``."""
        return ", ".join(f"{name}={c.shown}" for name, c in zip(self.axes, self.coordinates, strict=True))


def read_words(words: Sequence[str | Override], folder: Path, first: int = 1) -> list[Argument]:
    """Arguments of the command line, counted from ``first``; a `RecipeError` has everything that is wrong with them."""
    found: list[Argument] = []
    diagnostics: list[Diagnostic] = []
    for number, word in enumerate(words, first):
        try:
            found.append(_read_word(word, Location(f"argument {number}", folder=str(folder))))
        except RecipeError as error:
            diagnostics += error.diagnostics
    if diagnostics:
        raise RecipeError(diagnostics)
    return found


def read_axes(axes: Mapping[str, str | Iterable[Any]], folder: Path) -> list[Argument]:
    """Axes as Python values: a list of values, or a text as the command line would have it."""
    found: list[Argument] = []
    diagnostics: list[Diagnostic] = []
    for name, values in axes.items():
        mark = Location(f"axis {name}", folder=str(folder))
        try:
            found.append(_read_axis(name, values, mark, folder))
        except RecipeError as error:
            diagnostics += error.diagnostics
    if diagnostics:
        raise RecipeError(diagnostics)
    return found


def points(arguments: Sequence[Argument], paired: bool = False) -> list[Point]:
    """Every combination of the axes' values, the last axis fastest; or, ``paired``, the first with the first, …"""
    axes = [argument for argument in arguments if isinstance(argument, Axis)]
    diagnostics = list(_wrong(axes, paired))
    if diagnostics:
        raise RecipeError(diagnostics)
    sizes = [range(len(axis.coordinates)) for axis in axes]
    places = zip(*sizes, strict=True) if paired else itertools.product(*sizes)
    return [_point(number, place, arguments, axes) for number, place in enumerate(places, 1)]


# --- arguments ------------------------------------------------------------------------------------------------------


def _read_word(word: str | Override, mark: Location) -> Argument:
    if isinstance(word, Override):
        return word
    name, _, text = word.partition("=")
    if "=" not in word or name.startswith("~"):
        return read_override(word, mark)
    try:
        values = values_of(text)
        one = len(values) == 1 and not spans(text)
    except ValueError as error:
        raise RecipeError([Diagnostic(mark, word, str(error))]) from None
    if one:
        return read_override(word, mark)
    if name.startswith("+"):
        fix = "an added value is the same at every point: quote a text with commas"
        raise RecipeError([Diagnostic(mark, word, fix)])
    return _axis(name, values, mark)


def _read_axis(name: str, values: str | Iterable[Any], mark: Location, folder: Path) -> Axis:
    if name.startswith(("+", "~")):
        raise RecipeError([Diagnostic(mark, name, "an axis changes a value that is there: leave out the sign")])
    if isinstance(values, str):
        try:
            return _axis(name, values_of(values), mark)
        except ValueError as error:
            raise RecipeError([Diagnostic(mark, f"{name}={values}", str(error))]) from None
    listed = values.tolist() if hasattr(values, "tolist") else values
    if isinstance(listed, Mapping) or not isinstance(listed, Iterable):
        raise RecipeError([Diagnostic(mark, name, f"give a list of values, not {type(values).__name__}")])
    found = tuple(_coordinate(name, value, folder) for value in listed)
    if not found:
        raise RecipeError([Diagnostic(mark, name, "has no values")])
    return Axis(name, found, mark)


def _coordinate(name: str, value: Any, folder: Path) -> Coordinate:
    changes = tuple(overrides_of({name: value}, folder))
    alone = changes[0].value if len(changes) == 1 and changes[0].path == tuple(name.split(".")) else None
    plain = value if alone is None else alone.plain
    return Coordinate(plain if isinstance(plain, str) else flow(plain), plain, changes)


def _axis(name: str, values: Sequence[str], mark: Location) -> Axis:
    diagnostics: list[Diagnostic] = []
    found: list[Coordinate] = []
    for text in values:
        try:
            change = read_override(f"{name}={text}", mark)
        except RecipeError as error:
            diagnostics += error.diagnostics
            continue
        assert change.value is not None
        plain = change.value.plain
        found.append(Coordinate(plain if isinstance(plain, str) else text, plain, (change,)))
    if diagnostics:
        raise RecipeError(diagnostics)
    return Axis(name, tuple(found), mark)


# --- combinations ---------------------------------------------------------------------------------------------------


def _wrong(axes: Sequence[Axis], paired: bool) -> Iterable[Diagnostic]:
    """What is wrong with the axes together."""
    if not axes:
        yield Diagnostic(Location("sweep"), "", "no axis: write a=1,2,3 or a='linspace(450 nm, 650 nm, 5)'")
    first: dict[str, Axis] = {}
    for axis in axes:
        if first.setdefault(axis.name, axis) is not axis:
            yield Diagnostic(axis.mark, axis.name, f"is an axis already ({first[axis.name].mark})")
        twice = [value for value, count in Counter(c.shown for c in axis.coordinates).items() if count > 1]
        if twice:
            yield Diagnostic(axis.mark, axis.name, f"{twice[0]} stands twice")
        there, here = len(axes[0].coordinates), len(axis.coordinates)
        if paired and there != here:
            told = f"has {here} values, and {axes[0].name} ({axes[0].mark}) has {there}"
            yield Diagnostic(axis.mark, axis.name, f"{told}: paired axes have equally many")
    count = 1 if paired else math.prod(len(axis.coordinates) for axis in axes)
    if count > MOST:
        yield Diagnostic(Location("sweep"), "", f"{count} points: at most {MOST}")


def _point(number: int, place: tuple[int, ...], arguments: Sequence[Argument], axes: Sequence[Axis]) -> Point:
    coordinates = tuple(axis.coordinates[i] for axis, i in zip(axes, place, strict=True))
    here = iter(coordinates)
    changes = [next(here).overrides if isinstance(a, Axis) else (a,) for a in arguments]
    names = tuple(axis.name for axis in axes)
    return Point(number, place, coordinates, tuple(change for group in changes for change in group), names)
