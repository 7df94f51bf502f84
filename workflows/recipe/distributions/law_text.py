"""Text of a probability distribution in a recipe, such as normal(10.5 e-, 0.5 e-)."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from neusee.nodes.units import read_any, read_written
from neusee.workflows.graph.errors import Diagnostic, Location, nearest
from neusee.workflows.recipe.distributions.joint_distribution import (
    read_columns,
    require_samples,
    si_unit,
    with_units,
)
from neusee.workflows.recipe.distributions.shapes import (
    Beta,
    Discrete,
    Law,
    LogNormal,
    LogUniform,
    Moved,
    Normal,
    Shape,
    Triangular,
    Uniform,
)
from neusee.workflows.recipe.text.recipe_files import refuse_outside
from neusee.workflows.recipe.text.yaml_values import Value

# --- law text -------------------------------------------------------------------------------------

# Text of a probability distribution in place of a value of a recipe, such as ``normal(10.5 e-, 0.5
# e-)``.
#
# A distribution of samples names a file, whose path is relative to the folder of the recipe.


#: each kind of distribution with its form and the meaning of its arguments
KINDS = {
    "normal": ("normal(10.5 e-, 0.5 e-)", "mean and standard deviation"),
    "lognormal": ("lognormal(0.37, 1.02)", "median, and the factor of one standard deviation"),
    "uniform": ("uniform(1 um, 2 um)", "least and largest value"),
    "loguniform": ("loguniform(1, 1e6)", "least and largest value, uniform in the logarithm"),
    "triangular": ("triangular(9 e-, 10 e-, 12 e-)", "least, most probable and largest value"),
    "beta": (
        "beta(2, 5, 0 e-, 20 e-)",
        "two shape parameters, then the least and the largest value, which may be omitted",
    ),
    "truncated": (
        "truncated(normal(2 e-, 1 e-), 0 e-, inf)",
        "a distribution, its lower bound or -inf, and its upper bound or inf",
    ),
    "discrete": (
        "discrete(10 e- weight 0.2, 12 e- weight 0.8)",
        "values with weights that sum to 1; without weights all values are equally probable",
    ),
    "empirical": (
        "empirical(noise.csv, column read_noise, unit e-)",
        "samples in a file, its column, and their unit; the file may give the column and the unit",
    ),
}
_NAMES = "|".join(KINDS)
_BEGIN = re.compile(rf"\s*({_NAMES})\(")
_CALL = re.compile(rf"({_NAMES})\((.*)\)", re.DOTALL)
_WEIGHTED = re.compile(r"(.*\S)\s+weight\s+(\S+)", re.DOTALL)
_OPTION = re.compile(r"(column|unit)\s+(.*)", re.DOTALL)
_INFINITE = {"inf": math.inf, "-inf": -math.inf, "+inf": math.inf}
_SUM = 1e-6  #: largest difference of a sum of weights from 1


@dataclass(frozen=True)
class _Numbers:
    """Numbers of a distribution in SI, with their unit."""

    values: tuple[float, ...]
    unit: str
    reciprocal: bool


def is_law(text: Any) -> bool:
    """Return True if a recipe value is a text that begins with the name of a distribution, such
    as ``normal(``.
    """
    return isinstance(text, str) and _BEGIN.match(text) is not None


def read_law(text: str, folder: Path = Path(), mark: Location | None = None) -> Law:
    """Return the probability distribution in a text; raise ValueError with the correct form for an
    invalid text.

    ``folder`` is the folder of the recipe, to which the path of a file of samples is relative.
    ``mark`` is the place of the text.
    """
    text = text.strip()
    match = _CALL.fullmatch(text)
    if match is None or not _is_closed(match[2]):
        raise ValueError(
            "the text is not a complete distribution: write kind(…, …), in quotes inside [ ] or { }"
        )
    kind, arguments = match[1], _arguments(match[2])
    if not all(arguments):
        raise ValueError(_form(kind))
    if kind == "truncated":
        return _truncated(text, arguments, folder, mark)
    if kind == "empirical":
        return _empirical(text, arguments, folder, mark)
    return _READERS[kind](kind, text, arguments)


def _form(kind: str) -> str:
    """Return the error message for an incorrect distribution, with the correct form."""
    form, meaning = KINDS[kind]
    return f"the distribution {kind} needs {meaning}: write {form}"


def _is_closed(text: str) -> bool:
    """Return True if each parenthesis in a text has its partner; the text inside the outer
    parentheses of ``normal(1, 2) + normal(3, 4)`` does not.
    """
    depth = 0
    for sign in text:
        # how many parentheses are open
        depth += (sign == "(") - (sign == ")")
        if depth < 0:
            return False
    return depth == 0


def _arguments(text: str) -> list[str]:
    """Return the arguments in a text, which is split at the commas outside quotes and
    parentheses.
    """
    # a quote ends at the sign with which it began
    arguments, depth, quote = [""], 0, ""
    for sign in text:
        if quote or sign in "\"'":
            quote = "" if sign == quote else quote or sign
        depth += (sign == "(") - (sign == ")")
        if sign == "," and not depth and not quote:
            arguments.append("")
        else:
            arguments[-1] += sign
    return [argument.strip() for argument in arguments]


def _numbers(arguments: Sequence[str]) -> _Numbers:
    """Return arguments as numbers in SI; raise ValueError unless all have the same unit."""
    written_numbers = [read_written(argument) for argument in arguments]
    _, unit, reciprocal = written_numbers[0]
    for argument, (_, other_unit, other_reciprocal) in zip(arguments, written_numbers, strict=True):
        if (other_unit, other_reciprocal) != (unit, reciprocal):
            raise ValueError(f"{arguments[0]} and {argument} must have the same unit")
    return _Numbers(tuple(number for number, _, _ in written_numbers), unit, reciprocal)


def _plain(argument: str, meaning: str) -> float:
    """Return an argument as a number; raise ValueError for one with a unit."""
    number, unit, _ = read_written(argument)
    if unit:
        raise ValueError(f"{meaning} is a number without a unit, such as 1.1, not {argument}")
    return number


def _law(kind: str, text: str, shape: Shape, numbers: _Numbers) -> Law:
    """Return a distribution from its shape, with the unit of its numbers."""
    return Law(kind, text, shape, numbers.unit, numbers.reciprocal)


def _pair(kind: str, text: str, arguments: Sequence[str]) -> Law:
    """Return a normal, uniform or loguniform distribution."""
    if len(arguments) != 2:
        raise ValueError(_form(kind))
    numbers = _numbers(arguments)
    first_number, second_number = numbers.values
    if kind == "normal":
        if not second_number > 0:
            raise ValueError("the standard deviation must be greater than 0")
        return _law(kind, text, Normal(first_number, second_number), numbers)
    if not first_number < second_number:
        raise ValueError("the first value must be smaller than the second")
    if kind == "uniform":
        return _law(kind, text, Uniform(first_number, second_number), numbers)
    if not first_number > 0:
        raise ValueError("the least value must be greater than 0")
    return _law(kind, text, LogUniform(first_number, second_number), numbers)


def _lognormal(kind: str, text: str, arguments: Sequence[str]) -> Law:
    """Return a lognormal distribution from its median and the factor of one standard deviation."""
    if len(arguments) != 2:
        raise ValueError(_form(kind))
    numbers = _numbers(arguments[:1])
    median, factor = numbers.values[0], _plain(arguments[1], "the factor of one standard deviation")
    if not (median > 0 and factor > 1):
        raise ValueError("the median must be greater than 0, and the factor greater than 1")
    return _law(kind, text, LogNormal(median, factor), numbers)


def _triangular(kind: str, text: str, arguments: Sequence[str]) -> Law:
    """Return a triangular distribution from its least, most probable and largest value."""
    if len(arguments) != 3:
        raise ValueError(_form(kind))
    numbers = _numbers(arguments)
    least, mode, largest = numbers.values
    if not (least <= mode <= largest and least < largest):
        raise ValueError(
            "the least, the most probable and the largest value must stand in this order"
        )
    return _law(kind, text, Triangular(least, mode, largest), numbers)


def _beta(kind: str, text: str, arguments: Sequence[str]) -> Law:
    """Return a beta distribution.

    Its arguments are two shape parameters, and perhaps the least and the largest value.
    """
    if len(arguments) not in (2, 4):
        raise ValueError(_form(kind))
    a, b = (_plain(argument, "a shape parameter") for argument in arguments[:2])
    if not (a > 0 and b > 0):
        raise ValueError("the shape parameters of a beta distribution must be greater than 0")
    if len(arguments) == 2:
        return _law(kind, text, Beta(a, b), _Numbers((), "", False))
    numbers = _numbers(arguments[2:])
    least, largest = numbers.values
    if not least < largest:
        raise ValueError("the least value must be smaller than the largest")
    return _law(kind, text, Beta(a, b, least, largest), numbers)


def _discrete(kind: str, text: str, arguments: Sequence[str]) -> Law:
    """Return a discrete distribution from values, each perhaps followed by its weight."""
    matches = [_WEIGHTED.fullmatch(argument) for argument in arguments]
    numbers = _numbers(
        [
            match[1] if match else argument
            for match, argument in zip(matches, arguments, strict=True)
        ]
    )
    if len(set(numbers.values)) < len(arguments) or len(arguments) < 2:
        raise ValueError("a discrete distribution needs two or more different values")
    weights = _weights([match[2] for match in matches if match], len(arguments))
    return _law(kind, text, Discrete.of(np.array(numbers.values), np.array(weights)), numbers)


def _weights(written: Sequence[str], count: int) -> list[float]:
    """Return the weights of ``count`` values; they are equal if none is written."""
    if not written:
        return [1.0 / count] * count
    if len(written) < count:
        raise ValueError("write a weight for every value, or for none: " + KINDS["discrete"][0])
    weights = [_plain(weight, "a weight") for weight in written]
    if not min(weights) > 0:
        raise ValueError("every weight must be greater than 0: remove the values of weight 0")
    if abs(math.fsum(weights) - 1.0) > _SUM:
        raise ValueError(f"the weights sum to {math.fsum(weights):.6g}, not to 1")
    return weights


def _truncated(text: str, arguments: Sequence[str], folder: Path, mark: Location | None) -> Law:
    """Return a distribution with bounds; a bound of infinity has no unit."""
    if len(arguments) != 3 or not is_law(arguments[0]):
        raise ValueError(_form("truncated"))
    law = read_law(arguments[0], folder, mark)
    if law.kind == "truncated":
        raise ValueError(
            "a truncated distribution cannot be truncated again: write one distribution with both"
            " bounds"
        )
    lower_bound, upper_bound = (_bound(argument, law) for argument in arguments[1:])
    if math.isinf(lower_bound) and math.isinf(upper_bound):
        raise ValueError("a truncated distribution needs a bound: " + KINDS["truncated"][0])
    return replace(
        law, kind="truncated", text=text, shape=law.shape.truncated(lower_bound, upper_bound)
    )


def _bound(argument: str, law: Law) -> float:
    """Return a bound of a distribution in SI, or infinity."""
    if argument in _INFINITE:
        return _INFINITE[argument]
    number, unit, reciprocal = read_written(argument)
    if (unit, reciprocal) != (law.unit, law.reciprocal):
        raise ValueError(f"{argument} and {law.text} must have the same unit")
    return number


def _empirical(text: str, arguments: Sequence[str], folder: Path, mark: Location | None) -> Law:
    """Return the distribution of the samples in a file, each with the same probability."""
    options = _options_of(arguments[1:])
    path = folder / Path(arguments[0].strip("\"'")).expanduser()
    if mark is not None:
        refuse_outside(path, mark)
    columns, units = with_units(read_columns(path))
    name = _column(path, list(columns), options.get("column"))
    samples, unit = columns[name], units.get(name, "")
    if "unit" in options:
        if unit:
            raise ValueError(f"{path.name} gives the unit {unit} of {name}: remove the unit here")
        scale, unit = _unit(options["unit"])
        samples = samples * scale
    # e-/DN is allowed; for any other unit that recipes do not use, `_unit` raises
    reciprocal = unit == "e-/DN"
    if unit and not reciprocal:
        _unit(unit)
    place = f"{path.name}, column {name}" if name else path.name
    require_samples(samples, place)
    shape = Discrete.of(samples, np.full(len(samples), 1.0 / len(samples)))
    unit_of_law = "DN/e-" if reciprocal else unit
    return Law(
        kind="empirical",
        text=text,
        shape=shape,
        unit=unit_of_law,
        reciprocal=reciprocal,
        file=path,
        written_path=arguments[0],
    )


def _options_of(arguments: Sequence[str]) -> dict[str, str]:
    """Return the values of the options ``column`` and ``unit`` of samples in a file."""
    options: dict[str, str] = {}
    for argument in arguments:
        match = _OPTION.fullmatch(argument)
        if match is None or match[1] in options:
            raise ValueError(_form("empirical"))
        options[match[1]] = match[2].strip().strip("\"'")
    return options


def _column(path: Path, names: Sequence[str], name: str | None) -> str:
    """Return the name of the column to read: the one that is written, or that of the only column.

    Raise ValueError if it is not clear which.
    """
    if name is None and len(names) == 1:
        return names[0]
    if name is None:
        raise ValueError(
            f"{path.name} has the columns {', '.join(names)}: write empirical({path.name}, column"
            " NAME)"
        )
    if name not in names:
        raise ValueError(f"{path.name} has no column {name}; {nearest(name, names)}")
    return name


def _unit(unit: str) -> tuple[float, str]:
    """Return the factor of a unit and its SI unit; raise ValueError for a unit that no value of
    a recipe has.
    """
    read_written(f"1 {unit}")
    return si_unit(unit)


_READERS: dict[str, Callable[[str, str, Sequence[str]], Law]] = {
    "normal": _pair,
    "uniform": _pair,
    "loguniform": _pair,
    "lognormal": _lognormal,
    "triangular": _triangular,
    "beta": _beta,
    "discrete": _discrete,
}


# --- mismatch laws --------------------------------------------------------------------------------

# Distributions of the difference between a camera and its recipe: a training draws the differences,
# and the restorer does not know them.
#
# A ``lognormal`` or ``loguniform`` law multiplies the value of the recipe; any other law, or a
# single value, is added to it.


#: standard deviation in place of 0, relative to the value of the recipe
_NARROW = 1e-3
_NARROWEST = 1e-9  #: standard deviation in place of 0, in SI, if the value of the recipe is 0
ANGLE = "angle"  #: key of the direction of a laser, whose y and x differ independently


@dataclass(frozen=True)
class Difference:
    """Distribution of the difference between a value of the camera and that of the recipe."""

    law: Law
    own: float  #: value of the recipe, in SI
    mark: Location

    def of(self, value: float, drawn: float) -> float:
        """Return the true value of the camera from the value of the recipe and a draw."""
        return value * drawn if self.law.multiplies else value + drawn

    @property
    def truth(self) -> Law:
        """Return the distribution of the true value; a single value becomes a narrow normal
        distribution.
        """
        shape: Shape = self.law.shape
        if isinstance(shape, Normal) and not shape.sd:
            shape = Normal(shape.mean, abs(self.own) * _NARROW or _NARROWEST)
        if self.law.multiplies:
            return replace(self.law, shape=Moved(shape, factor=self.own))
        return replace(self.law, shape=Moved(shape, offset=self.own))


def read_mismatch(
    block: Value, root: Value, diagnostics: list[Diagnostic]
) -> dict[str, Difference]:
    """Return the differences that ``train.mismatch`` states, by the path of the value in the
    recipe ``root``.
    """
    differences = {}
    for path, leaf in _laws(block):
        try:
            differences[path] = _difference(path, leaf, root)
        except ValueError as error:
            diagnostics.append(Diagnostic(leaf.mark, f"{block.name}.{path}", str(error)))
    return differences


def _laws(block: Value, above: str = "") -> Iterator[tuple[str, Value]]:
    """Yield each single value below a mapping with its dotted path.

    `above` is the path of the mapping itself, with a dot at its end.
    """
    for key, value in block.items.items():
        if isinstance(value.data, dict):
            yield from _laws(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", value


def _difference(path: str, leaf: Value, root: Value) -> Difference:
    """Return the distribution of the difference between the true value and the recipe's value at a
    path.

    Lognormal and loguniform distributions are factors; all others are added.
    """
    value_in_recipe = root.below(path.split("."))
    if value_in_recipe is None:
        raise ValueError(
            f"the recipe has no value {path};"
            f" {nearest(path, [recipe_value.name for recipe_value in root.leaves()])}"
        )
    value, unit = _own(path, value_in_recipe)
    law = (
        read_law(leaf.data, Path(leaf.mark.folder), leaf.mark)
        if is_law(leaf.data)
        else _single(leaf)
    )
    if law.reciprocal:
        raise ValueError(
            "a distribution in e-/DN cannot be added to a gain: write a factor, such as"
            f" lognormal(1, …), not {law.text}"
        )
    if law.multiplies:
        _refuse_factor(law, path, value)
    elif law.unit != unit:
        raise ValueError(
            f"{law.text} is added to {path}, whose unit is {unit or 'none'}, not"
            f" {law.unit or 'none'}"
        )
    return Difference(replace(law, unit=unit), value, leaf.mark)


def _refuse_factor(law: Law, path: str, value: float) -> None:
    """Raise ValueError for a factor with a unit, and for a value of 0, which no factor changes."""
    if law.unit:
        raise ValueError(
            f"{law.kind} multiplies {path}: write the distribution without the unit {law.unit}"
        )
    if not value:
        raise ValueError(
            f"{path} is 0, and 0 times {law.text} is always 0: write normal(…, …) or uniform(…, …)"
        )


def _own(path: str, own: Value) -> tuple[float, str]:
    """Return the value of the recipe and its unit; a direction counts as 0 rad, because it may
    be drawn.
    """
    if path.rpartition(".")[2] == ANGLE:
        return 0.0, "rad"
    if own.data is None:
        raise ValueError(f"{path} is null, so no distribution can vary it: write a value first")
    return read_any(own.plain)


def _single(leaf: Value) -> Law:
    """Return a difference that is a single value as a normal distribution without width."""
    value, unit = read_any(leaf.plain)
    return Law("normal", str(leaf.data), Normal(value, 0.0), unit)
