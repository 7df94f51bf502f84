"""Files of samples: columns of numbers in .csv, .txt, .npy and .npz files, with names and units from their headings."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from neusee.nodes.array_bytes import npy_needs, npz_needs
from neusee.nodes.input_size import head_of, lines_of, refuse_other_than_file
from neusee.nodes.units import read_written
from neusee.workflows.recipe.distributions.shapes import FloatArray

Line = tuple[int, list[str]]  #: number and cells of a line of a table

_CELLS = 24.0  #: bytes in memory for each byte of a table: all cells as texts, and their numbers
FEWEST = 30  #: smallest number of samples that stand for a distribution
_HEADING = re.compile(r"\s*(.*?)\s*\[([^\[\]]*)\]\s*")  #: ``gain [DN/e-]``
_SUFFIXES = (".csv", ".txt", ".npy", ".npz")


def read_columns(path: Path) -> dict[str, FloatArray]:
    """Return the columns of a table of samples by heading; a column without a heading is named "".

    A .csv or .txt file without headings, and a .npy file, must have one column.
    Raises ValueError for a file that is not a table of numbers.
    """
    suffix = path.suffix.lower()
    if suffix not in _SUFFIXES:
        raise ValueError(f"{path.name} is not a table of samples: give a file in .csv, .txt, .npy or .npz")
    refuse_other_than_file(path)
    if not path.is_file():
        raise ValueError(f"there is no file {path}")
    try:
        if suffix == ".npz":
            return _arrays(path)
        if suffix == ".npy":
            npy_needs(path, 1.0, 8.0)
            return {"": _one_column(path, np.load(path, allow_pickle=False))}
        return _text_columns(path)
    except (OSError, EOFError, BadZipFile, UnicodeDecodeError) as error:
        raise ValueError(f"{path.name} cannot be read: {error}") from None


def _arrays(path: Path) -> dict[str, FloatArray]:
    if head_of(path, 2) != b"PK":
        raise ValueError(f"{path.name} cannot be read: the file does not have the format .npz")
    npz_needs(path, 1.0, 8.0)
    with np.load(path, allow_pickle=False) as arrays:
        return {name: np.asarray(arrays[name], np.float64).reshape(-1) for name in arrays}


def _one_column(path: Path, array: FloatArray) -> FloatArray:
    if array.ndim != 1 or array.dtype.kind not in "fiu":
        raise ValueError(f"{path.name} must contain one row of real numbers, not {array.dtype} of shape {array.shape}")
    return np.asarray(array, np.float64)


def _text_columns(path: Path) -> dict[str, FloatArray]:
    lines = csv.reader(lines_of(path, _CELLS))
    rows = [(n, row) for n, row in enumerate(lines, 1) if any(cell.strip() for cell in row)]
    if not rows:
        raise ValueError(f"{path.name} is empty")
    headings, rows = _take_headings(path, rows)
    for line, row in rows:
        _refuse_line(path, line, row, len(headings))
    numbers = np.array([row for _, row in rows], np.float64).reshape(-1, len(headings))
    return {name: numbers[:, i] for i, name in enumerate(headings)}


def _take_headings(path: Path, rows: list[Line]) -> tuple[list[str], list[Line]]:
    """Return the headings of a table and the lines below; a table of one column may have no heading."""
    headings = [cell.strip() for cell in rows[0][1]]
    if not all(map(_is_number, headings)):
        return headings, rows[1:]
    if len(headings) > 1:
        raise ValueError(f"the first line of {path.name} must have a heading for each of its columns")
    return [""], rows


def _refuse_line(path: Path, line: int, row: Sequence[str], count: int) -> None:
    """Raise ValueError for a line that does not have ``count`` numbers."""
    if len(row) != count:
        raise ValueError(f"line {line} of {path.name} must have {count} values like the first line")
    for cell in row:
        if not _is_number(cell):
            raise ValueError(f"line {line} of {path.name} must contain numbers, not {cell.strip()!r}")


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def with_units(columns: Mapping[str, FloatArray]) -> tuple[dict[str, FloatArray], dict[str, str]]:
    """Return the columns by name in SI units, and their units by name, from headings such as ``exposure [ms]``.

    Values in ``e-/DN`` stay as they are, with this unit. A unit that no recipe has, such as that of a dark current
    ``e- in 1 s``, stays as text. Raises ValueError for a name that stands twice.
    """
    values: dict[str, FloatArray] = {}
    units: dict[str, str] = {}
    for heading, column in columns.items():
        match = _HEADING.fullmatch(heading)
        name = match[1] if match else heading
        if name in values:
            raise ValueError(f"two columns have the name {name}")
        values[name] = column
        if match:
            scale, units[name] = si_unit(match[2].strip())
            values[name] = column * scale
    return values, units


def si_unit(unit: str) -> tuple[float, str]:
    """Return the factor from a unit to SI and the SI unit; ``e-/DN`` and unknown units stay, with the factor 1."""
    try:
        scale, si, reciprocal = read_written(f"1 {unit}".strip())
    except ValueError:
        return 1.0, unit
    return scale, unit if reciprocal else si


def require_samples(samples: FloatArray, name: str) -> None:
    """Raise ValueError for samples that do not stand for a distribution: too few, not finite, or all equal."""
    if not np.isfinite(samples).all():
        row = int(np.argmin(np.isfinite(samples))) + 1
        raise ValueError(f"sample {row} of {name} is {samples[row - 1]}: remove this sample")
    if len(samples) < FEWEST:
        raise ValueError(f"{name} has {len(samples)} samples, which are too few: give {FEWEST} or more")
    if np.ptp(samples) == 0:
        raise ValueError(f"all samples of {name} are equal: write the value itself")
