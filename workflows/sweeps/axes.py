"""Axes of a parameter sweep, written as in Hydra such as ``a=1,2,3``, and the combinations of their values."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from neusee.workflows.graph.diagnostics import Diagnostic, Location, RecipeError
from neusee.workflows.graph.final_values import flow
from neusee.workflows.recipe.text.overrides import Override, read_override
from neusee.workflows.recipe.text.python_overrides import overrides_of
from neusee.workflows.sweeps.value_ranges import MOST, spans, values_of


@dataclass(frozen=True, slots=True)
class Coordinate:
    """One value on an axis of a sweep, with the changes of the recipe that set this value."""

    shown: str  #: the value as a user writes it
    value: Any  #: the value as YAML reads it
    overrides: tuple[Override, ...]


@dataclass(frozen=True, slots=True)
class Axis:
    """An axis of a sweep: a parameter or a group of a recipe, with the list of values for the sweep."""

    name: str
    coordinates: tuple[Coordinate, ...]
    mark: Location


Argument = Override | Axis
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class Point:
    """A point of a sweep: one combination of values, with one value from each axis."""

    number: int  #: counts from 1, where the last axis varies fastest
    place: tuple[int, ...]  #: index of the value on each axis
    coordinates: tuple[Coordinate, ...]  #: one for each axis
    overrides: tuple[Override, ...]  #: every change of the recipe, in the order of the arguments
    axes: tuple[str, ...]  #: the names of the axes

    @property
    def shown(self) -> str:
        """Return the point of a sweep as text, such as ``sensor.read_noise=5 e-, doe=axicon``."""
        return ", ".join(f"{name}={c.shown}" for name, c in zip(self.axes, self.coordinates, strict=True))


def read_words(words: Sequence[str | Override], folder: Path, first: int = 1) -> list[Argument]:
    """Read the axes of a sweep and the fixed changes of its recipe from command-line arguments.

    Raises `RecipeError` with the mistakes of all arguments.

    Messages number the arguments from ``first``.
    """
    return _every(partial(_read_word, word, number, folder) for number, word in enumerate(words, first))


def read_axes(axes: Mapping[str, str | Iterable[Any]], folder: Path) -> list[Argument]:
    """Read the axes of a sweep, whose values are either Python lists or texts in the notation of the command line."""
    return _every(partial(_read_axis, name, values, folder) for name, values in axes.items())


def points(arguments: Sequence[Argument], paired: bool = False) -> list[Point]:
    """Return the points of a sweep: all combinations of values, or, if ``paired``, the n-th values of all axes.

    The last axis varies fastest.
    """
    axes = [argument for argument in arguments if isinstance(argument, Axis)]
    diagnostics = list(_wrong(axes, paired))
    if diagnostics:
        raise RecipeError(diagnostics)
    sizes = [range(len(axis.coordinates)) for axis in axes]
    places = zip(*sizes, strict=True) if paired else itertools.product(*sizes)
    return [_point(number, place, arguments, axes) for number, place in enumerate(places, 1)]


# --- arguments ------------------------------------------------------------------------------------------------------


def _every(readers: Iterable[Callable[[], _T]]) -> list[_T]:
    """Call each function and return the results; raise one `RecipeError` that lists the mistakes from all calls."""
    results: list[_T] = []
    diagnostics: list[Diagnostic] = []
    for read in readers:
        try:
            results.append(read())
        except RecipeError as error:
            diagnostics += error.diagnostics
    if diagnostics:
        raise RecipeError(diagnostics)
    return results


def _read_word(word: str | Override, number: int, folder: Path) -> Argument:
    if isinstance(word, Override):
        return word
    mark = Location(f"argument {number}", folder=str(folder))
    name, _, text = word.partition("=")
    if "=" not in word or name.startswith("~"):
        return read_override(word, mark)
    values = _values(text, word, mark)
    if len(values) == 1 and not spans(text):
        return read_override(word, mark)
    if name.startswith("+"):
        fix = "+ adds a value that is the same at every point: put a text with commas in quotes"
        raise RecipeError([Diagnostic(mark, word, fix)])
    return _axis(name, values, mark)


def _read_axis(name: str, values: str | Iterable[Any], folder: Path) -> Axis:
    mark = Location(f"axis {name}", folder=str(folder))
    if name.startswith(("+", "~")):
        raise RecipeError([Diagnostic(mark, name, "write the name of an axis without + or ~")])
    if isinstance(values, str):
        return _axis(name, _values(values, f"{name}={values}", mark), mark)
    listed = values.tolist() if hasattr(values, "tolist") else values
    if isinstance(listed, Mapping) or not isinstance(listed, Iterable):
        raise RecipeError([Diagnostic(mark, name, f"give the axis a list of values, not {type(values).__name__}")])
    coordinates = tuple(_coordinate(name, value, folder) for value in listed)
    if not coordinates:
        raise RecipeError([Diagnostic(mark, name, "the axis has an empty list of values: give at least one value")])
    return Axis(name, coordinates, mark)


def _values(text: str, path: str, mark: Location) -> list[str]:
    try:
        return values_of(text)
    except ValueError as error:
        raise RecipeError([Diagnostic(mark, path, str(error))]) from None


def _coordinate(name: str, value: Any, folder: Path) -> Coordinate:
    changes = tuple(overrides_of({name: value}, folder))
    alone = changes[0].value if len(changes) == 1 and changes[0].path == tuple(name.split(".")) else None
    plain = value if alone is None else alone.plain
    return Coordinate(plain if isinstance(plain, str) else flow(plain), plain, changes)


def _axis(name: str, values: Sequence[str], mark: Location) -> Axis:
    coordinates = []
    for text, change in zip(values, _every(partial(read_override, f"{name}={v}", mark) for v in values), strict=True):
        assert change.value is not None
        plain = change.value.plain
        coordinates.append(Coordinate(plain if isinstance(plain, str) else text, plain, (change,)))
    return Axis(name, tuple(coordinates), mark)


# --- combinations ---------------------------------------------------------------------------------------------------


def _wrong(axes: Sequence[Axis], paired: bool) -> Iterable[Diagnostic]:
    """Yield the mistakes in the axes of a sweep, such as a repeated name, a repeated value or too many points."""
    if not axes:
        yield Diagnostic(Location("sweep"), "", "the sweep has no axis: write a=1,2 or a='linspace(450 nm, 650 nm, 5)'")
    first: dict[str, Axis] = {}
    for axis in axes:
        if first.setdefault(axis.name, axis) is not axis:
            yield Diagnostic(axis.mark, axis.name, f"axis {axis.name} is also in {first[axis.name].mark}: remove one")
        twice = [value for value, count in Counter(c.shown for c in axis.coordinates).items() if count > 1]
        if twice:
            yield Diagnostic(axis.mark, axis.name, f"the value {twice[0]} appears twice on the axis: remove one")
        there, here = len(axes[0].coordinates), len(axis.coordinates)
        if paired and there != here:
            text = f"has {here} values, and {axes[0].name} ({axes[0].mark}) has {there}"
            yield Diagnostic(axis.mark, axis.name, f"{text}: give paired axes the same number of values")
    product = 1 if paired else math.prod(len(axis.coordinates) for axis in axes)
    if product > MOST:
        yield Diagnostic(Location("sweep"), "", f"a sweep of {product} points is too long: at most {MOST} points")


def _point(number: int, place: tuple[int, ...], arguments: Sequence[Argument], axes: Sequence[Axis]) -> Point:
    coordinates = tuple(axis.coordinates[i] for axis, i in zip(axes, place, strict=True))
    here = iter(coordinates)
    changes = (next(here).overrides if isinstance(a, Axis) else (a,) for a in arguments)
    names = tuple(axis.name for axis in axes)
    return Point(number, place, coordinates, tuple(itertools.chain.from_iterable(changes)), names)
