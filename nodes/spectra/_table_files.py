"""CSV tables of a user: wavelengths in the first column, and a header that names quantity and unit
of each column.

A header is such as ``wavelength (nm),QE (%)``. Lines that begin with ``#`` are comments, such as
the source.
"""

import math
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from neusee.nodes import ParameterError
from neusee.nodes.input_files import csv_rows
from neusee.nodes.spectra._cie_tables import Table

Numbers = NDArray[np.float64]

LENGTHS = {"nm": 1e-9, "um": 1e-6, "µm": 1e-6, "μm": 1e-6, "m": 1.0}
_SHORTEST_WAVELENGTH, _LONGEST_WAVELENGTH = (
    100e-9,
    20e-6,
)  #: m, range of wavelengths in a recipe
_HEADING = re.compile(r"(?P<quantity>[^(\[]*?)\s*(?:[(\[](?P<unit>.*)[)\]])?")


class Column(NamedTuple):
    """The heading of a column of a table, such as ``QE (%)``."""

    quantity: str  #: "QE"
    unit: str  #: "%", or "" where the header has none

    @property
    def heading(self) -> str:
        """Return the heading as the header of a file writes it."""
        return f"{self.quantity} ({self.unit})" if self.unit else self.quantity


class Rows(NamedTuple):
    """The numbers of a CSV file below its header."""

    columns: tuple[Column, ...]
    lines: tuple[int, ...]  #: number of the line of each row
    values: Numbers  #: (row, column), all finite


class Curves(NamedTuple):
    """The curves of a CSV file over the wavelength, in the units of the file."""

    file: Path
    columns: tuple[Column, ...]  #: of the curves
    lines: tuple[int, ...]  #: number of the line of each row
    wavelengths: Numbers  #: (row,) m, rising
    values: Numbers  #: (curve, row)

    def table(self) -> Table:
        """Return the curves as a table that can be interpolated."""
        return Table(
            torch.from_numpy(self.wavelengths.copy()), torch.from_numpy(self.values.copy())
        )

    def place(self, curve: int, row: int) -> str:
        """Return the line and the column of a value, as messages name them."""
        return place(self.file, self.lines[row], curve + 1, self.columns[curve])

    def refuse(self, wrong: NDArray[np.bool_], why: Callable[[float], str]) -> None:
        """Raise ValueError for the first value (curve, row) that is ``wrong``; ``why`` is the
        message for a value.
        """
        if wrong.any():
            row, curve = (int(i) for i in np.argwhere(wrong.T)[0])
            raise ValueError(f"{self.place(curve, row)}: {why(float(self.values[curve, row]))}")


def place(file: Path, line: int, column: int, heading: Column) -> str:
    """Return a place in a table as text, such as ``qe.csv:5, column 2, QE (%)``; columns count
    from 0.
    """
    return f"{file.name}:{line}, column {column + 1}, {heading.heading}"


def table_rows(file: Path) -> Rows:
    """Read the headings and the numbers of a CSV file.

    Raises ValueError, with line and column, for a file without header, for lines of different
    length, and for a cell that is not a finite number.
    """
    rows = list(csv_rows(file))
    if not rows:
        raise ValueError(f"{file.name} has no columns of numbers below a header")
    (first_line, header), body = rows[0], rows[1:]
    _refuse_only_numbers(file, first_line, header)
    columns = tuple(_column(cell) for cell in header)
    if not body or len(columns) < 2:
        raise ValueError(f"{file.name} has no columns of numbers below a header")
    for line, row in body:
        _refuse_other_length(file, line, row, len(columns))
    numbers = [
        [_number(file, line, i, columns[i], cell) for i, cell in enumerate(row)]
        for line, row in body
    ]
    return Rows(columns, tuple(line for line, _ in body), np.array(numbers, np.float64))


def _refuse_only_numbers(file: Path, line: int, header: Sequence[str]) -> None:
    """Raise ValueError for a first row of numbers in place of a header."""
    if all(_is_number(cell) for cell in header):
        raise ValueError(
            f"{file.name}:{line}: the first row holds numbers: begin with a header, such as"
            " wavelength (nm),QE (%)"
        )


def _refuse_other_length(file: Path, line: int, row: Sequence[str], length: int) -> None:
    """Raise ValueError for a row whose length differs from the number of headings."""
    if len(row) != length:
        count = f"{len(row)} column{'s' * (len(row) != 1)} in place of {length}"
        raise ValueError(
            f"{file.name}:{line}: {count}, the number of headings: write one number for each"
            " heading"
        )


def curves(file: Path, units: Sequence[str] | None, assumed: str = "", fewest: int = 2) -> Curves:
    """Read the curves of a CSV file over the wavelength, whose unit is in the first heading.

    ``units`` are the units that the other columns may have, None for any. A file without any unit
    has wavelengths in the unit ``assumed``; without such a unit, units are necessary. ``fewest`` is
    the least number of rows.

    Raises ValueError where `table_rows` does, for a unit that is missing or unknown, and for
    wavelengths that do not rise or lie outside 100 nm to 20 um.
    """
    rows = table_rows(file)
    first_column, *others = rows.columns
    without_units = assumed and not any(column.unit for column in rows.columns)
    unit = assumed if without_units else first_column.unit
    if unit not in LENGTHS:
        _refuse_first_column(file, first_column)
    if units is not None and not without_units:
        for number, column in enumerate(others, 1):
            _refuse_unit(file, number, column, units)
    nm = rows.values[:, 0] * (LENGTHS[unit] / 1e-9)
    if len(nm) < fewest:
        raise ValueError(f"{file.name} holds one wavelength: at least two wavelengths are needed")
    for problem in _wavelength_problems(file, rows.lines, nm):
        raise ValueError(problem)
    return Curves(
        file,
        tuple(others),
        rows.lines,
        rows.values[:, 0] * LENGTHS[unit],
        rows.values[:, 1:].T.copy(),
    )


def table_error(parameter: str, form: str, error: Exception) -> ParameterError:
    """Return the error for a parameter whose file is not a valid table; ``form`` describes the
    required table.
    """
    return ParameterError(parameter, f"{error}; {form}")


def _column(cell: str) -> Column:
    """Return the quantity and the unit that a cell of a header names."""
    match = _HEADING.fullmatch(cell.strip())
    if match is None:
        return Column(cell.strip(), "")
    return Column(match["quantity"].strip(), (match["unit"] or "").strip())


def _is_number(cell: str) -> bool:
    """Return True for a cell that is a number, with point and exponent as in other tables."""
    try:
        float(cell)
    except ValueError:
        return False
    return "_" not in cell  # Python reads 1_0 as 10


def _number(file: Path, line: int, index: int, column: Column, cell: str) -> float:
    """Return the finite number in a cell; raise ValueError with line and column for another
    text.
    """
    place_text = f" (column {index + 1}, {column.heading})"
    if not _is_number(cell):
        raise ValueError(f"{file.name}:{line}: {cell.strip()!r} is not a number{place_text}")
    if not math.isfinite(float(cell)):
        raise ValueError(f"{file.name}:{line}: {cell.strip()} is NaN or infinite{place_text}")
    return float(cell)


def _refuse_first_column(file: Path, first: Column) -> None:
    """Raise ValueError for a first column without wavelengths in a known unit."""
    unit_names = ", ".join(unit for unit in LENGTHS if unit.isascii())
    if not first.unit:
        fix = f"write the unit in brackets, such as {first.quantity or 'wavelength'} (nm)"
        raise ValueError(f"{file.name}: the first column, {first.quantity}, has no unit: {fix}")
    fix = f"write wavelength (nm) there, or another of {unit_names}"
    raise ValueError(f"{file.name}: the first column, {first.heading}, has no wavelengths: {fix}")


def _refuse_unit(file: Path, number: int, column: Column, units: Sequence[str]) -> None:
    """Raise ValueError for a column whose unit is none of ``units``; columns count from 0."""
    if column.unit not in units:
        fault = f"has the unit {column.unit}" if column.unit else "has no unit"
        fix = f"write one of {', '.join(f'({unit})' for unit in units)}"
        raise ValueError(f"{file.name}: column {number + 1}, {column.quantity}, {fault}: {fix}")


def _wavelength_problems(file: Path, lines: Sequence[int], nm: Numbers) -> Iterator[str]:
    """Yield a message for each error in the wavelengths (nm) of a file."""
    for line, previous, here in zip(lines[1:], nm, nm[1:], strict=False):
        if here == previous:
            yield (
                f"{file.name}:{line}: {here:g} nm stands there again: keep one row for each"
                " wavelength"
            )
        elif here < previous:
            yield (
                f"{file.name}:{line}: {here:g} nm follows {previous:g} nm: list the wavelengths in"
                " rising order"
            )
    for line, here in zip(lines, nm, strict=True):
        if not _SHORTEST_WAVELENGTH <= here * 1e-9 <= _LONGEST_WAVELENGTH:
            fix = (
                "check the unit in the header, such as wavelength (um), and give wavelengths from"
                " 100 nm to 20 um"
            )
            yield f"{file.name}:{line}: the wavelength {here:g} is no light when read in nm: {fix}"
