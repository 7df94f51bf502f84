"""CSV files of damage thresholds of a user: one law a row, and a header that names quantity and unit of each column."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple, cast

from neusee.nodes.input_files import csv_rows
from neusee.nodes.laser._damage_laws import KINDS, DamageLaw, Kind, Quantity
from neusee.nodes.spectra._table_files import Column, place

_LENGTHS = {"nm": 1e-9, "um": 1e-6, "µm": 1e-6, "mm": 1e-3, "m": 1.0}
_TIMES = {"ns": 1e-9, "us": 1e-6, "µs": 1e-6, "ms": 1e-3, "s": 1.0}
_IRRADIANCES = {"W/m2": 1.0, "W/cm2": 1e4, "kW/cm2": 1e7, "MW/cm2": 1e10}
_FLUENCES = {"J/m2": 1.0, "mJ/cm2": 10.0, "J/cm2": 1e4}
_NONE: dict[str, float] = {"": 1.0, "1": 1.0}
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
    "factor": _NONE,
    "median factor": _NONE,
    "spot": _LENGTHS,
}
_OPTIONAL = ("factor", "median factor", "spot")
_FORM = (
    "write a header such as device,damage,wavelength from (nm),wavelength to (nm),duration from (s),duration to (s),"
    "threshold (kW/cm2),factor,median factor,spot (um),source"
)


class _Cell(NamedTuple):
    """A cell of a row, with its place in the file."""

    text: str
    where: str
    column: Column


def read_damage_laws(file: Path) -> tuple[DamageLaw, ...]:
    """Read laws of damage from a CSV file with one law a row.

    Columns, in any order: device; damage (point, line, cross, destruction or frame); wavelength from and to; duration
    from and to; threshold, in W/cm2 or kW/cm2 for continuous light and in J/cm2 or mJ/cm2 for a pulse, of the median
    device; factor, the geometric standard deviation from device to device; median factor, that of the median; spot, the
    1/e2 diameter with which the threshold was measured; source. The last four but the source may be empty. A file with
    both kinds of light has two columns of thresholds, of which each row fills one.

    Raises ValueError, with line and column, for a column or a unit that is missing or unknown, for a cell that is not a
    positive number, for a range whose end is before its start, and for a factor without a median factor.
    """
    if file.suffix.lower() in (".yaml", ".yml", ".json", ".xlsx"):
        raise ValueError(f"{file.name} is no CSV file: thresholds are read from a table with one law a row; {_FORM}")
    rows = list(csv_rows(file))
    if len(rows) < 2:
        raise ValueError(f"{file.name} has no laws of damage below a header: {_FORM}")
    columns = [_heading(file, rows[0][0], index, cell) for index, cell in enumerate(rows[0][1])]
    missing = [name for name in _UNITS if name not in _OPTIONAL and name not in {c.quantity for c in columns}]
    if missing:
        raise ValueError(f"{file.name}: no column {missing[0]}: {_FORM}")
    laws = []
    for line, cells in rows[1:]:
        if len(cells) != len(columns):
            text = f"{len(cells)} columns in place of {len(columns)}, the number of headings"
            raise ValueError(f"{file.name}:{line}: {text}: write one cell for each heading")
        both = enumerate(zip(columns, cells, strict=True))
        laws.append(_law([_Cell(cell.strip(), place(file, line, i, column), column) for i, (column, cell) in both]))
    return tuple(laws)


def _heading(file: Path, line: int, index: int, cell: str) -> Column:
    """Return the quantity and the unit of a heading; raise ValueError for one that is not known."""
    quantity, _, unit = cell.strip().removesuffix(")").partition("(")
    column = Column(quantity.strip().casefold(), unit.strip())
    if column.quantity not in _UNITS:
        raise ValueError(f"{file.name}:{line}, column {index + 1}: no quantity {quantity.strip()!r}: {_FORM}")
    units = _UNITS[column.quantity]
    if units and column.unit not in units:
        what = f"has the unit {column.unit}" if column.unit else "has no unit"
        known = ", ".join(f"({unit})" for unit in units if unit.isascii())
        raise ValueError(f"{place(file, line, index, column)} {what}: write one of {known}")
    return column


def _law(cells: list[_Cell]) -> DamageLaw:
    """Return the law of one row."""
    values = {cell.column.quantity: _value(cell) for cell in cells if cell.column.quantity != "threshold"}
    given = [cell for cell in cells if cell.column.quantity == "threshold" and cell.text]
    if len(given) != 1:
        where = next(cell.where for cell in cells if cell.column.quantity == "threshold")
        text = f"{len(given)} thresholds in this row"
        raise ValueError(f"{where}: {text}: give one, an irradiance for continuous light or a fluence for a pulse")
    by_name = {cell.column.quantity: cell for cell in cells}
    for name in ("wavelength", "duration"):
        if values[f"{name} to"] < values[f"{name} from"]:
            raise ValueError(f"{by_name[f'{name} to'].where}: the range ends before it starts: swap the two {name}s")
    if (values.get("factor") is None) != (values.get("median factor") is None):
        cell = by_name.get("factor") or by_name["median factor"]
        text = "one of factor and median factor is given: a probability needs both, so give both or neither"
        raise ValueError(f"{cell.where}: {text}")
    quantity: Quantity = "irradiance" if given[0].column.unit in _IRRADIANCES else "fluence"
    return DamageLaw(
        cast(str, values["device"]),
        cast(Kind, values["damage"]),
        quantity,
        cast(float, _value(given[0])),
        values.get("factor"),
        values.get("median factor"),
        (values["wavelength from"], values["wavelength to"]),
        (values["duration from"], values["duration to"]),
        values.get("spot"),
        cast(str, values["source"]),
    )


def _value(cell: _Cell) -> Any:
    """Return the text of a cell, its number in SI units, or None for an empty cell of an optional column."""
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
        text = "a factor of one standard deviation, such as 2, is above 1; leave the cell empty if it is not known"
        raise ValueError(f"{cell.where}: {cell.text}: {text}")
    return number * units[cell.column.unit]


def _text(cell: _Cell) -> str:
    """Return the text of a cell; raise ValueError for an empty cell and for a kind of damage that is not known."""
    if not cell.text:
        fix = "say where the threshold is from" if cell.column.quantity == "source" else "fill it in"
        raise ValueError(f"{cell.where}: the cell is empty: {fix}")
    if cell.column.quantity == "damage" and cell.text not in KINDS:
        raise ValueError(f"{cell.where}: no kind of damage {cell.text!r}: write one of {', '.join(KINDS)}")
    return cell.text
