"""CSV files with a user's damage thresholds, and the fit of laws to the user's damage tests."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from neusee.nodes.input_files import csv_rows
from neusee.nodes.laser._damage_laws import KINDS, DamageLaw, Kind, Quantity
from neusee.nodes.spectra._table_files import Column, place

# --- hit and miss ---------------------------------------------------------------------------------

# A damage threshold from damage tests: the number of shots at each level, and how many caused
# damage.
#
# The probability of damage, Phi((ln level - ln median) / ln factor), is fitted by maximum
# likelihood (probit regression). If the levels with and without damage hardly overlap, the data
# give a bracket but no spread.


_MOST_ROUNDS = 200  #: largest number of iterations of Fisher scoring
_CLOSE_PARAMETERS = 1e-10  #: relative change of the parameters at which the fit ends
_LEAST_PROBABILITY = 1e-12  #: probabilities are kept at least this far from 0 and 1

Numbers = NDArray[np.float64]


@dataclass(frozen=True)
class Shots:
    """Shots at one level."""

    level: float  #: W/m2 or J/m2
    count: int
    damaged: int


@dataclass(frozen=True)
class FittedThreshold:
    """A threshold fitted to shots: a law with spread, or only a bracket."""

    median: float  #: in the unit of the levels
    #: geometric standard deviation of the threshold; None where the data do not show it
    factor: float | None
    #: geometric standard deviation of the median; None where the data do not show it
    median_factor: float | None
    low: float | None = None  #: highest level without any damage; None for a law with spread
    #: lowest level at which every shot caused damage; None for a law with spread
    high: float | None = None


def fit_shots(shots: Sequence[Shots]) -> FittedThreshold:
    """Return the damage threshold fitted to shots at several levels, with its spread and the
    uncertainty of its median.

    The uncertainty of the median is that of the Fisher information. Where at most one level has
    both damaged and undamaged shots and the others are in order, the threshold is between the
    highest level without any damage and the lowest level at which every shot damaged, and no spread
    is stated.

    Raises ValueError for shots at fewer than two levels, without any or with only damage, and for
    damage that gets rarer with the level.
    Source: ISO 21254-2 (damage probability over level); McCullagh, Nelder, Generalized Linear
            Models, ch. 2.5.
    """
    levels = np.array([shot.level for shot in shots])
    count = np.array([shot.count for shot in shots], np.float64)
    damaged = np.array([shot.damaged for shot in shots], np.float64)
    if len(np.unique(levels)) < 2:
        raise ValueError("the shots have one level: a threshold needs several levels")
    if not damaged.any():
        raise ValueError(
            "no shot was damaged: the threshold is above all levels, so add higher levels"
        )
    if (damaged == count).all():
        raise ValueError(
            "every shot was damaged: the threshold is below all levels, so add lower levels"
        )
    if levels[damaged < count].max() <= levels[damaged > 0].min():
        return _separated(levels, count, damaged)
    return _probit(np.log(levels), count, damaged)


def _separated(levels: Numbers, count: Numbers, damaged: Numbers) -> FittedThreshold:
    """Return the bracket if the levels with and without damage do not overlap; raise ValueError
    where one of its ends is missing.
    """
    undamaged_levels, damaged_levels = levels[damaged == 0], levels[damaged == count]
    if not undamaged_levels.size:
        raise ValueError("no level is without damage: add lower levels")
    if not damaged_levels.size:
        raise ValueError(
            "no level damaged with every shot: add higher levels, or more shots at each level"
        )
    highest_undamaged, lowest_damaged = float(undamaged_levels.max()), float(damaged_levels.min())
    # the geometric middle of the bracket
    return FittedThreshold(
        math.sqrt(highest_undamaged * lowest_damaged), None, None, highest_undamaged, lowest_damaged
    )


def _probit(logs: Numbers, count: Numbers, damaged: Numbers) -> FittedThreshold:
    """Return the maximum-likelihood threshold of a lognormal law; ``logs`` are the logarithms of
    the levels, ``count`` and ``damaged`` the numbers of shots and of shots with damage.

    The share of damaged shots is Phi(intercept + slope (ln level - centre)). Raises ValueError for
    damage that gets rarer with the level.
    """
    from scipy.special import ndtr, ndtri

    centre = float(logs.mean())
    design = np.stack([np.ones_like(logs), logs - centre], 1)
    # adding half a shot keeps the probits finite at levels with no or only damage
    start_probits = ndtri((damaged + 0.5) / (count + 1))
    coefficients, *_ = np.linalg.lstsq(
        design * np.sqrt(count)[:, None], start_probits * np.sqrt(count), rcond=None
    )
    information = np.eye(2)
    # Fisher scoring: coefficients += information^-1 score
    for _ in range(_MOST_ROUNDS):
        probits = design @ coefficients
        damaged_share = np.clip(ndtr(probits), _LEAST_PROBABILITY, 1 - _LEAST_PROBABILITY)
        normal_density = np.exp(-(probits**2) / 2) / math.sqrt(2 * math.pi)
        weights = count * normal_density**2 / (damaged_share * (1 - damaged_share))
        information = design.T @ (design * weights[:, None])
        score = design.T @ (
            normal_density
            * (damaged - count * damaged_share)
            / (damaged_share * (1 - damaged_share))
        )
        change = np.linalg.solve(information, score)
        coefficients = coefficients + change
        if np.abs(change).max() < _CLOSE_PARAMETERS * (1 + np.abs(coefficients).max()):
            break
    intercept, slope = float(coefficients[0]), float(coefficients[1])
    if not (math.isfinite(slope) and slope > 0):
        raise ValueError(
            "damage gets rarer with the level: no threshold can be fitted to these shots"
        )
    covariance = np.linalg.inv(information)
    # ln median = centre - intercept / slope: its gradient by intercept and slope
    gradient = np.array([-1 / slope, intercept / slope**2])
    deviation = math.sqrt(float(gradient @ covariance @ gradient))
    return FittedThreshold(
        # median, factor and median factor: the probability is 1/2 at the median, and the standard
        # deviation of ln threshold is 1 / slope
        math.exp(centre - intercept / slope),
        math.exp(1 / slope),
        math.exp(deviation),
    )


# --- damage table ---------------------------------------------------------------------------------

# CSV files with a user's damage thresholds: each row has a law, or the shots at one level, to which
# a law is fitted.
#
# The header names quantity and unit of each column.


_LENGTHS = {"nm": 1e-9, "um": 1e-6, "µm": 1e-6, "mm": 1e-3, "m": 1.0}
_TIMES = {"fs": 1e-15, "ps": 1e-12, "ns": 1e-9, "us": 1e-6, "µs": 1e-6, "ms": 1e-3, "s": 1.0}
_IRRADIANCES = {"W/m2": 1.0, "W/cm2": 1e4, "kW/cm2": 1e7, "MW/cm2": 1e10}
_FLUENCES = {"J/m2": 1.0, "mJ/cm2": 10.0, "J/cm2": 1e4}
_PLAIN_NUMBERS: dict[str, float] = {"": 1.0, "1": 1.0}
#: the units of each quantity that a heading may name; a quantity without units is a text
_UNITS: dict[str, dict[str, float]] = {
    "device": {},
    "damage": {},
    "source": {},
    "wavelength from": _LENGTHS,
    "wavelength to": _LENGTHS,
    "duration from": _TIMES,
    "duration to": _TIMES,
    "threshold": _IRRADIANCES | _FLUENCES,
    "low": _IRRADIANCES | _FLUENCES,
    "high": _IRRADIANCES | _FLUENCES,
    "level": _IRRADIANCES | _FLUENCES,
    "shots": _PLAIN_NUMBERS,
    "damaged": _PLAIN_NUMBERS,
    "factor": _PLAIN_NUMBERS,
    "median factor": _PLAIN_NUMBERS,
    "spot": _LENGTHS,
}
_OPTIONAL = ("low", "high", "factor", "median factor", "spot")
_COUNTS = ("shots", "damaged")
_LAW_COLUMNS = tuple(
    name for name in _UNITS if name not in ("threshold", "level", *_COUNTS, *_OPTIONAL)
)
_TABLE_FORM = (
    "write a header such as device,damage,wavelength from (nm),wavelength to (nm),duration from"
    " (s),duration to (s),threshold (kW/cm2),low (kW/cm2),high (kW/cm2),factor,median factor,spot"
    " (um),source, or with level (J/cm2),shots,damaged in place of the threshold and its factors"
)


class _Cell(NamedTuple):
    """A cell of a row, with its place in the file."""

    text: str
    where: str
    column: Column


def read_damage_laws(file: Path) -> tuple[DamageLaw, ...]:
    """Read laws of damage from a CSV file with one law a row, or with the shots at one level a row.

    Columns, in any order: device; damage (point, line, cross, destruction or frame); wavelength
    from and to; duration from and to; threshold, in W/cm2 or kW/cm2 for continuous light and in
    J/cm2 or mJ/cm2 for a pulse, of the median device; low and high, the ends of a bracket around a
    threshold without data of devices; factor, the geometric standard deviation from device to
    device; median factor, that of the median; spot, the 1/e2 diameter with which the threshold was
    measured; source. Low, high, the factors and the spot may be empty or left out. A file with both
    kinds of light has two columns of thresholds, of which each row fills one.

    A table of shots has the columns level, shots and damaged in place of the threshold and its
    factors. Rows that agree in all other columns are one test, and `fit_shots` makes one law of
    each test.

    Raises ValueError, with line and column, for a column or a unit that is missing or unknown, for
    a cell that is not a positive number, for a range whose end is before its start, for a factor
    without a median factor, for a bracket that does not hold its threshold, for more damage than
    shots, and for shots that show no threshold.
    """
    if file.suffix.lower() in (".yaml", ".yml", ".json", ".xlsx"):
        raise ValueError(
            f"{file.name} is no CSV file: thresholds are read from a table with one law a row;"
            f" {_TABLE_FORM}"
        )
    rows = list(csv_rows(file))
    if len(rows) < 2:
        raise ValueError(f"{file.name} has no laws of damage below a header: {_TABLE_FORM}")
    columns = [_heading(file, rows[0][0], index, cell) for index, cell in enumerate(rows[0][1])]
    quantities = {column.quantity for column in columns}
    has_shots = bool(quantities & {"level", *_COUNTS})
    _refuse_columns(file, quantities, has_shots)
    table = [_cells(file, columns, line, cells) for line, cells in rows[1:]]
    return _fitted_laws(table) if has_shots else tuple(map(_law, table))


def _refuse_columns(file: Path, names: set[str], has_shots: bool) -> None:
    """Raise ValueError for a missing column, and for a table with both thresholds and shots."""
    required_columns = (
        (*_LAW_COLUMNS, "level", *_COUNTS) if has_shots else (*_LAW_COLUMNS, "threshold")
    )
    missing_columns = [name for name in required_columns if name not in names]
    if missing_columns:
        raise ValueError(f"{file.name}: no column {missing_columns[0]}: {_TABLE_FORM}")
    excluded = sorted(names & {"threshold", "low", "high", "factor", "median factor"})
    if has_shots and excluded:
        raise ValueError(
            f"{file.name}: the column {excluded[0]} beside shots: the threshold is fitted to the"
            " shots"
        )


def _cells(file: Path, columns: list[Column], line: int, cells: list[str]) -> list[_Cell]:
    """Return the cells of a row with their places in the file; raise ValueError unless the row has
    one cell for each heading.
    """
    if len(cells) != len(columns):
        text = f"{len(cells)} columns in place of {len(columns)}, the number of headings"
        raise ValueError(f"{file.name}:{line}: {text}: write one cell for each heading")
    numbered_cells = enumerate(zip(columns, cells, strict=True))
    return [
        _Cell(cell.strip(), place(file, line, index, column), column)
        for index, (column, cell) in numbered_cells
    ]


def _heading(file: Path, line: int, index: int, cell: str) -> Column:
    """Return the quantity and the unit of a heading; raise ValueError for an unknown one."""
    # `wavelength from (nm)`: quantity before the parenthesis, unit inside it
    quantity, _, unit = cell.strip().removesuffix(")").partition("(")
    column = Column(quantity.strip().casefold(), unit.strip())
    if column.quantity not in _UNITS:
        raise ValueError(
            f"{file.name}:{line}, column {index + 1}: no quantity {quantity.strip()!r}:"
            f" {_TABLE_FORM}"
        )
    units = _UNITS[column.quantity]
    if units and column.unit not in units:
        fault = f"has the unit {column.unit}" if column.unit else "has no unit"
        unit_names = ", ".join(f"({unit})" for unit in units if unit.isascii())
        raise ValueError(f"{place(file, line, index, column)} {fault}: write one of {unit_names}")
    return column


def _law(cells: list[_Cell]) -> DamageLaw:
    """Return the law of damage in a row: median threshold, with the spread of devices or the
    bracket if the row states one.

    Raises ValueError for only one of factor and median factor, and for the mistakes that `_values`,
    `_filled_cell` and `_bracket` refuse.
    """
    values = _values(cells, "threshold")
    threshold = _filled_cell(cells, "threshold")
    cell_of = {cell.column.quantity: cell for cell in cells}
    if (values.get("factor") is None) != (values.get("median factor") is None):
        cell = cell_of.get("factor") or cell_of["median factor"]
        text = (
            "one of factor and median factor is given: a probability needs both, so give both or"
            " neither"
        )
        raise ValueError(f"{cell.where}: {text}")
    bracket_low, bracket_high = _bracket(cell_of, values, threshold)
    return DamageLaw(
        **_law_arguments(values),
        quantity=_quantity(threshold),
        median=cast(float, _value(threshold)),
        factor=values.get("factor"),
        median_factor=values.get("median factor"),
        low=bracket_low,
        high=bracket_high,
    )


def _bracket(
    cells: dict[str, _Cell], values: dict[str, Any], threshold: _Cell
) -> tuple[float | None, float | None]:
    """Return the lower and the upper end of the bracket of a row in SI units, or None twice if the
    row has none.

    Raises ValueError for one end alone, for a bracket beside a factor, for ends in another quantity
    than the threshold, and for ends that do not hold the threshold.
    """
    low, high = values.get("low"), values.get("high")
    if low is None and high is None:
        return None, None
    # the cell of a stated end, for the error message
    end = cells["high"] if low is None else cells["low"]
    if low is None or high is None:
        raise ValueError(
            f"{end.where}: one end of a bracket is given: give low and high, or neither"
        )
    if values.get("factor") is not None:
        raise ValueError(
            f"{end.where}: a bracket beside a factor: give the bracket or the spread of devices"
        )
    if {_quantity(cells[name]) for name in ("low", "high")} != {_quantity(threshold)}:
        raise ValueError(
            f"{end.where}: the bracket has another quantity than the threshold of this row"
        )
    if not low <= cast(float, _value(threshold)) <= high:
        raise ValueError(
            f"{end.where}: the bracket does not hold the threshold: give low <= threshold <= high"
        )
    return low, high


def _values(cells: list[_Cell], *but: str) -> dict[str, Any]:
    """Return the values of a row by quantity, except for the quantities in ``but``.

    Numbers are in SI units; an empty cell of an optional column has None. Raises ValueError for a
    range of wavelengths or durations whose end is before its start.
    """
    values = {
        cell.column.quantity: _value(cell) for cell in cells if cell.column.quantity not in but
    }
    cell_of = {cell.column.quantity: cell for cell in cells}
    for name in ("wavelength", "duration"):
        if values[f"{name} to"] < values[f"{name} from"]:
            raise ValueError(
                f"{cell_of[f'{name} to'].where}: the range ends before it starts: swap the two"
                f" {name}s"
            )
    return values


def _filled_cell(cells: list[_Cell], name: str) -> _Cell:
    """Return the only filled cell of a row among the columns of a quantity (thresholds may have a
    column in W/cm2 and one in J/cm2).

    Raises ValueError for no such cell and for several.
    """
    cells_of_quantity = [cell for cell in cells if cell.column.quantity == name]
    filled_cells = [cell for cell in cells_of_quantity if cell.text]
    if len(filled_cells) != 1:
        where = cells_of_quantity[0].where
        text = f"{len(filled_cells)} {name}s in this row"
        raise ValueError(
            f"{where}: {text}: give one, an irradiance for continuous light or a fluence for a"
            " pulse"
        )
    return filled_cells[0]


def _quantity(cell: _Cell) -> Quantity:
    """Return "irradiance" or "fluence" for a threshold or a level, by its unit."""
    return "irradiance" if cell.column.unit in _IRRADIANCES else "fluence"


def _law_arguments(values: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments of `DamageLaw` other than threshold and spread, from the values of a
    row.
    """
    return {
        "device": values["device"],
        "damage": cast(Kind, values["damage"]),
        "wavelengths": (values["wavelength from"], values["wavelength to"]),
        "durations": (values["duration from"], values["duration to"]),
        "spot": values.get("spot"),
        "source": values["source"],
    }


def _fitted_laws(table: list[list[_Cell]]) -> tuple[DamageLaw, ...]:
    """Return one law for each damage test in a table of shots; rows that differ only in level,
    shots and damaged belong to one test.
    """
    rows_of_test: dict[tuple[Any, ...], list[list[_Cell]]] = {}
    for cells in table:
        law_arguments = _law_arguments(_values(cells, "level", *_COUNTS))
        test_key = (*law_arguments.values(), _quantity(_filled_cell(cells, "level")))
        rows_of_test.setdefault(test_key, []).append(cells)
    return tuple(_fitted_law(rows) for rows in rows_of_test.values())


def _fitted_law(rows: list[list[_Cell]]) -> DamageLaw:
    """Return the law fitted to the shots of one test; raise ValueError, which names the first row,
    if they determine no threshold.
    """
    first_level = _filled_cell(rows[0], "level")
    try:
        fitted = fit_shots([_shots(cells) for cells in rows])
    except _AtCell as error:
        raise ValueError(str(error)) from None
    except ValueError as error:
        raise ValueError(f"{first_level.where}: {error}") from None
    return DamageLaw(
        # all rows of a test agree in these values
        **_law_arguments(_values(rows[0], "level", *_COUNTS)),
        quantity=_quantity(first_level),
        median=fitted.median,
        factor=fitted.factor,
        median_factor=fitted.median_factor,
        low=fitted.low,
        high=fitted.high,
    )


class _AtCell(ValueError):
    """A mistake in one cell, which the message names."""


def _shots(cells: list[_Cell]) -> Shots:
    """Return the shots of one row; raise `_AtCell` if more shots are damaged than fired."""
    cell_of = {cell.column.quantity: cell for cell in cells}
    count, damaged = (_count(cell_of[name]) for name in _COUNTS)
    if not count > 0 or damaged > count:
        raise _AtCell(
            f"{cell_of['damaged'].where}: {damaged} damaged of {count} shots: give at most as many"
            " as shots"
        )
    return Shots(cast(float, _value(_filled_cell(cells, "level"))), count, damaged)


def _count(cell: _Cell) -> int:
    """Return the whole number (0 or more) in a cell; raise `_AtCell` for other text."""
    if not (cell.text.isascii() and cell.text.isdigit()):
        raise _AtCell(f"{cell.where}: {cell.text!r} is no whole number of shots")
    return int(cell.text)


def _value(cell: _Cell) -> Any:
    """Return the text of a cell, its number in SI units, or None for an empty cell of an
    optional column.
    """
    name, units = cell.column.quantity, _UNITS[cell.column.quantity]
    if not cell.text and name in _OPTIONAL:
        return None
    if not units:
        return _text(cell)
    try:
        number = float(cell.text)
    except ValueError:
        raise ValueError(f"{cell.where}: {cell.text!r} is not a number") from None
    if not (math.isfinite(number) and number > 0):
        raise ValueError(f"{cell.where}: {cell.text} is not a finite number above 0")
    if name.endswith("factor") and number <= 1:
        text = (
            "a factor of one standard deviation, such as 2, is above 1; leave the cell empty if it"
            " is not known"
        )
        raise ValueError(f"{cell.where}: {cell.text}: {text}")
    return number * units[cell.column.unit]


def _text(cell: _Cell) -> str:
    """Return the text of a cell; raise ValueError for an empty cell and for a kind of damage
    that is not known.
    """
    if not cell.text:
        fix = (
            "say where the threshold is from" if cell.column.quantity == "source" else "fill it in"
        )
        raise ValueError(f"{cell.where}: the cell is empty: {fix}")
    if cell.column.quantity == "damage" and cell.text not in KINDS:
        raise ValueError(
            f"{cell.where}: no kind of damage {cell.text!r}: write one of {', '.join(KINDS)}"
        )
    return cell.text
