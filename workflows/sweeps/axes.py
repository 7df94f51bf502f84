"""Axes of a sweep, such as ``a=1,2,3`` and ranges, and the combinations of their values."""

from __future__ import annotations

import difflib
import itertools
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal, localcontext
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from neusee.workflows.graph.errors import Diagnostic, Location, RecipeError
from neusee.workflows.graph.final_values import flow
from neusee.workflows.recipe.text.overrides import Override, overrides_of, read_override

# --- value ranges ---------------------------------------------------------------------------------

# Lists and ranges that are written as text, such as ``1,2,3`` and ``linspace(450 nm, 650 nm, 5)``.
#
# Commas in quotes or brackets do not separate values, so that ``[1, 2]`` is one value. The numbers
# of a range are computed exactly: ``range(0, 1, 0.1)`` contains 0.3, not 0.30000000000000004.


MOST = 100_000  #: largest number of values of an axis, and of points of a sweep

_QUOTED = r"""(?:^|(?<=[\s,:(\[{]))(?:"(?:[^"\\]|\\.)*"|'(?:[^']|'')*')"""
_TOKEN = re.compile(rf"{_QUOTED}|.", re.DOTALL)
_PAIRS = {"(": ")", "[": "]", "{": "}"}
_CALL = re.compile(r"\s*([A-Za-z]\w*)\s*\((.*)\)\s*", re.DOTALL)
_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\d\s.].*)?")
_EXACT = 10**15  #: whole numbers below this are written without a decimal point


def split(text: str) -> list[str]:
    """Split a text at commas outside of quotes and brackets; raise `ValueError` for an unclosed
    bracket.
    """
    pieces, closing_brackets = [""], list[str]()
    for token in _TOKEN.findall(text):
        if token == "," and not closing_brackets:
            pieces.append("")
            continue
        pieces[-1] += token
        if token in _PAIRS:
            closing_brackets.append(_PAIRS[token])
        elif closing_brackets and token == closing_brackets[-1]:
            closing_brackets.pop()
    if closing_brackets:
        raise ValueError(f"a bracket is not closed: {closing_brackets[-1]} is missing")
    return pieces


def values_of(text: str) -> list[str]:
    """Return the values of a list or range as YAML texts; raise `ValueError` for a
    malformed text.
    """
    pieces = split(text)
    if len(pieces) > 1 and not all(piece.strip() for piece in pieces):
        raise ValueError("a value is missing before or after a comma")
    values = []
    for piece in pieces:
        values += _spanned(piece)
    return values


def spans(text: str) -> bool:
    """Return True if the text is a range, such as ``range(4)``."""
    return _function(text) is not None


def _spanned(text: str) -> list[str]:
    """Return the values of a range such as ``range(4)``; any other text is its own single value."""
    function = _function(text)
    if function is None:
        return [text.strip()]
    name, arguments = function
    try:
        return _FUNCTIONS[name](
            [piece.strip() for piece in split(arguments)] if arguments.strip() else []
        )
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def _function(text: str) -> tuple[str, str] | None:
    """Return name and arguments of a range such as ``range(4)``; None if the text is not a range.

    Raises `ValueError` if the name is misspelt.
    """
    match = _CALL.fullmatch(text)
    if match is None or match[1] in _FUNCTIONS:
        # None if there is no match
        return match and (match[1], match[2])
    similar_names = difflib.get_close_matches(match[1].lower(), _FUNCTIONS, 1, 0.7)
    if similar_names:
        raise ValueError(f"there is no range function {match[1]}; did you mean {similar_names[0]}?")
    return None


def _range(arguments: list[str]) -> list[str]:
    """Return the values of ``range(start, stop, step)``, as Python's range but with a unit."""
    if not 1 <= len(arguments) <= 3:
        raise ValueError("write range(stop), range(start, stop) or range(start, stop, step)")
    numbers, unit = _numbers(arguments)
    start, stop = (Fraction(0), numbers[0]) if len(numbers) == 1 else (numbers[0], numbers[1])
    step = numbers[2] if len(numbers) == 3 else Fraction(1)
    if step == 0:
        raise ValueError("the step of a range must not be 0")
    count = _count(math.ceil((stop - start) / step))
    return [_written(start + i * step, unit) for i in range(count)]


def _linspace(arguments: list[str]) -> list[str]:
    """Return equally spaced values, including both ends."""
    (start, stop), unit, count = _ends(arguments, "linspace(450 nm, 650 nm, 5)")
    # a single value needs no step
    step = (stop - start) / max(count - 1, 1)
    return [_written(start + i * step, unit) for i in range(count)]


def _logspace(arguments: list[str]) -> list[str]:
    """Return values in a geometric series, including both ends exactly."""
    (start, stop), unit, count = _ends(arguments, "logspace(1e2, 1e6, 5)")
    if start <= 0 or stop <= 0:
        raise ValueError("the first and the last value of a logarithmic range must be positive")
    # 50 digits, so that the values are correct to the last digit of a float
    with localcontext(prec=50):
        first_value, last_value = (
            Decimal(x.numerator) / Decimal(x.denominator) for x in (start, stop)
        )
        log_ratio = (last_value / first_value).ln() / max(count - 1, 1)
        values = [Fraction(first_value * (log_ratio * i).exp()) for i in range(count)]
    ends = [start, *values[1:-1], stop][:count]
    return [_written(x, unit) for x in ends]


_FUNCTIONS = {"range": _range, "linspace": _linspace, "logspace": _logspace}


def _ends(arguments: list[str], example: str) -> tuple[list[Fraction], str, int]:
    """Return first and last value of a range, their common unit, and the number of values."""
    if len(arguments) != 3:
        raise ValueError(
            f"write the first value, the last value and the number of values: {example}"
        )
    numbers, unit = _numbers(arguments[:2])
    if not re.fullmatch(r"\+?\d{1,9}", arguments[2]):
        raise ValueError(
            "the number of values must be a whole number of at least 1, not"
            f" {arguments[2] or 'nothing'}"
        )
    return numbers, unit, _count(int(arguments[2]))


def _count(count: int) -> int:
    """Return a valid number of values of an axis; raise `ValueError` for any other number."""
    if count < 1:
        raise ValueError(
            "the range is empty: change its first value, its last value or the number of values"
        )
    if count > MOST:
        raise ValueError(
            f"the range has {count if count < _EXACT else 'too many'} values: an axis has at most"
            f" {MOST}"
        )
    return count


def _numbers(texts: list[str]) -> tuple[list[Fraction], str]:
    """Return the numbers in ``texts`` as exact fractions, and their common unit."""
    pairs = [_number(text) for text in texts]
    units = list(dict.fromkeys(unit for _, unit in pairs))
    if len(units) > 1:
        unit_names = ", ".join(unit or "none" for unit in units)
        raise ValueError(f"write all numbers in the same unit instead of {unit_names}")
    return [number for number, _ in pairs], units[0]


def _number(text: str) -> tuple[Fraction, str]:
    """Return a number as an exact fraction, and its unit."""
    match = _NUMBER.fullmatch(text)
    if match is None or not math.isfinite(float(match[1])):
        raise ValueError(f"{text or 'nothing'} is not a number")
    # exact: 0.1 is 1/10, not the nearest float
    return Fraction(repr(float(match[1]))), (match[2] or "").strip()


def _written(number: Fraction, unit: str) -> str:
    """Return a number with its unit as in the notation of the user."""
    value = float(number)
    is_whole = value.is_integer() and abs(value) < _EXACT
    return f"{int(value) if is_whole else value!r} {unit}".strip()


# --- axes -----------------------------------------------------------------------------------------

# Axes of a parameter sweep, in Hydra notation such as ``a=1,2,3``, and the combinations of their
# values.


@dataclass(frozen=True, slots=True)
class Coordinate:
    """One value on an axis of a sweep, with the recipe changes that set it."""

    shown: str  #: the value in the notation of the user
    value: Any  #: the value as parsed by YAML
    overrides: tuple[Override, ...]


@dataclass(frozen=True, slots=True)
class Axis:
    """An axis of a sweep: a parameter or group of the recipe, with the list of its values."""

    name: str
    coordinates: tuple[Coordinate, ...]
    mark: Location


Argument = Override | Axis
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class Point:
    """A point of a sweep: a combination of one value from each axis."""

    number: int  #: number from 1; the last axis varies fastest
    place: tuple[int, ...]  #: index of the value on each axis
    coordinates: tuple[Coordinate, ...]  #: one for each axis
    overrides: tuple[Override, ...]  #: all changes of the recipe, in the order
    axes: tuple[str, ...]  #: the names of the axes

    @property
    def shown(self) -> str:
        """Return the point as text, such as ``sensor.read_noise=5 e-, doe=axicon``."""
        return ", ".join(
            f"{name}={coordinate.shown}"
            for name, coordinate in zip(self.axes, self.coordinates, strict=True)
        )


def read_words(words: Sequence[str | Override], folder: Path, first: int = 1) -> list[Argument]:
    """Parse the axes of a sweep and the fixed changes of its recipe from command-line arguments.

    Raises `RecipeError` with the errors of all arguments.

    Messages number the arguments from ``first``.
    """
    return _every(
        partial(_read_word, word, number, folder) for number, word in enumerate(words, first)
    )


def read_axes(axes: Mapping[str, str | Iterable[Any]], folder: Path) -> list[Argument]:
    """Parse the axes of a sweep; their values are Python lists or texts in command-line
    notation.
    """
    return _every(partial(_read_axis, name, values, folder) for name, values in axes.items())


def points(arguments: Sequence[Argument], paired: bool = False) -> list[Point]:
    """Return the points of a sweep: all combinations of values or, if ``paired``, the n-th values
    of all axes together.

    The last axis varies fastest.
    """
    axes = [argument for argument in arguments if isinstance(argument, Axis)]
    diagnostics = list(_wrong(axes, paired))
    if diagnostics:
        raise RecipeError(diagnostics)
    sizes = [range(len(axis.coordinates)) for axis in axes]
    index_tuples = zip(*sizes, strict=True) if paired else itertools.product(*sizes)
    return [
        _point(number, indices, arguments, axes) for number, indices in enumerate(index_tuples, 1)
    ]


# --- arguments ------------------------------------------------------------------------------------


def _every(readers: Iterable[Callable[[], _T]]) -> list[_T]:
    """Call each function and return the results; raise one `RecipeError` with the errors of all
    calls.
    """
    results: list[_T] = []
    diagnostics: list[Diagnostic] = []
    for read_argument in readers:
        try:
            results.append(read_argument())
        except RecipeError as error:
            diagnostics += error.diagnostics
    if diagnostics:
        raise RecipeError(diagnostics)
    return results


def _read_word(word: str | Override, number: int, folder: Path) -> Argument:
    """Parse one command-line argument: an axis if it has several values, else a change of the
    recipe.
    """
    if isinstance(word, Override):
        return word
    mark = Location(f"argument {number}", folder=str(folder))
    name, _, text = word.partition("=")
    # "~name" removes a value
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
    """Parse an axis from a list of values, or from a text in command-line notation."""
    mark = Location(f"axis {name}", folder=str(folder))
    if name.startswith(("+", "~")):
        raise RecipeError([Diagnostic(mark, name, "write the name of an axis without + or ~")])
    if isinstance(values, str):
        return _axis(name, _values(values, f"{name}={values}", mark), mark)
    # NumPy arrays have this method
    listed = values.tolist() if hasattr(values, "tolist") else values
    if isinstance(listed, Mapping) or not isinstance(listed, Iterable):
        raise RecipeError(
            [Diagnostic(mark, name, f"give the axis a list of values, not {type(values).__name__}")]
        )
    coordinates = tuple(_coordinate(name, value, folder) for value in listed)
    if not coordinates:
        raise RecipeError(
            [
                Diagnostic(
                    mark, name, "the axis has an empty list of values: give at least one value"
                )
            ]
        )
    return Axis(name, coordinates, mark)


def _values(text: str, path: str, mark: Location) -> list[str]:
    """Return the values in a text; raise `RecipeError` if it is malformed."""
    try:
        return values_of(text)
    except ValueError as error:
        raise RecipeError([Diagnostic(mark, path, str(error))]) from None


def _coordinate(name: str, value: Any, folder: Path) -> Coordinate:
    """Return one value of an axis with the recipe changes that set it."""
    changes = tuple(overrides_of({name: value}, folder))
    # a mapping may change several values at once
    single_change = (
        changes[0].value
        if len(changes) == 1 and changes[0].path == tuple(name.split("."))
        else None
    )
    plain_value = value if single_change is None else single_change.plain
    return Coordinate(
        plain_value if isinstance(plain_value, str) else flow(plain_value), plain_value, changes
    )


def _axis(name: str, values: Sequence[str], mark: Location) -> Axis:
    """Return an axis from values that are texts."""
    coordinates = []
    for text, override in zip(
        values,
        _every(partial(read_override, f"{name}={value}", mark) for value in values),
        strict=True,
    ):
        assert override.value is not None
        plain_value = override.value.plain
        coordinates.append(
            Coordinate(
                plain_value if isinstance(plain_value, str) else text, plain_value, (override,)
            )
        )
    return Axis(name, tuple(coordinates), mark)


# --- combinations ---------------------------------------------------------------------------------


def _wrong(axes: Sequence[Axis], paired: bool) -> Iterable[Diagnostic]:
    """Yield the errors in the axes of a sweep, such as a repeated name, a repeated value or too
    many points.
    """
    if not axes:
        yield Diagnostic(
            Location("sweep"),
            "",
            "the sweep has no axis: write a=1,2 or a='linspace(450 nm, 650 nm, 5)'",
        )
    axis_of_name: dict[str, Axis] = {}
    for axis in axes:
        # this name occurred before
        if axis_of_name.setdefault(axis.name, axis) is not axis:
            yield Diagnostic(
                axis.mark,
                axis.name,
                f"axis {axis.name} is also in {axis_of_name[axis.name].mark}: remove one",
            )
        yield from _repeated(axis)
        if paired:
            yield from _unequal(axis, axes[0])
    point_count = 1 if paired else math.prod(len(axis.coordinates) for axis in axes)
    if point_count > MOST:
        yield Diagnostic(
            Location("sweep"),
            "",
            f"a sweep of {point_count} points is too long: at most {MOST} points",
        )


def _repeated(axis: Axis) -> Iterator[Diagnostic]:
    """Yield an error for the first repeated value of an axis."""
    counts = Counter(coordinate.shown for coordinate in axis.coordinates)
    repeated_values = [value for value, count in counts.items() if count > 1]
    if repeated_values:
        yield Diagnostic(
            axis.mark,
            axis.name,
            f"the value {repeated_values[0]} appears twice on the axis: remove one",
        )


def _unequal(axis: Axis, first: Axis) -> Iterator[Diagnostic]:
    """Yield an error if an axis of a paired sweep has another number of values than the
    first axis.
    """
    expected, count = len(first.coordinates), len(axis.coordinates)
    if expected != count:
        text = f"has {count} values, and {first.name} ({first.mark}) has {expected}"
        yield Diagnostic(
            axis.mark, axis.name, f"{text}: give paired axes the same number of values"
        )


def _point(
    number: int, place: tuple[int, ...], arguments: Sequence[Argument], axes: Sequence[Axis]
) -> Point:
    """Return one point: its number, its index on each axis, and all recipe changes in the order of
    the arguments.
    """
    coordinates = tuple(axis.coordinates[i] for axis, i in zip(axes, place, strict=True))
    next_coordinate = iter(coordinates)
    # axes among the arguments are in the order of ``axes``
    changes = (
        next(next_coordinate).overrides if isinstance(argument, Axis) else (argument,)
        for argument in arguments
    )
    names = tuple(axis.name for axis in axes)
    return Point(number, place, coordinates, tuple(itertools.chain.from_iterable(changes)), names)
