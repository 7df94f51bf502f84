"""CSV files of spectra: a header, wavelengths in nm in the first column, and one further column for each spectrum."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from neusee.nodes.input_files import csv_rows

Numbers = NDArray[np.float64]


def csv_spectra(file: Path) -> tuple[Numbers, Numbers]:
    """Read the wavelengths of a CSV file, in nm, and its spectra (spectrum, wavelength).

    Raises ValueError for lines of different length, for a cell that is not a number, and for a file without columns.
    """
    rows = [[_number(cell, file, line) for cell in row] for line, row in list(csv_rows(file))[1:]]
    if len({len(row) for row in rows}) > 1:
        raise ValueError("the lines have different numbers of cells")
    numbers = np.array(rows, np.float64)
    if numbers.ndim != 2 or numbers.shape[1] < 2:
        raise ValueError("the file has no columns of numbers below a header")
    return numbers[:, 0].copy(), numbers[:, 1:].T


def wrong_wavelengths(wavelengths: Numbers, values: Numbers) -> str:
    """Return the reason why numbers from a file cannot be wavelengths in nm and their spectra, or an empty text."""
    if not (np.isfinite(wavelengths).all() and np.isfinite(values).all()):
        return "some of its numbers are NaN or infinite"
    if len(wavelengths) < 2 or not (np.diff(wavelengths) > 0).all() or wavelengths[0] < 100:
        return "the file needs at least two wavelengths in nm, in rising order"
    return ""


def _number(cell: str, file: Path, line: int) -> float:
    try:
        return float(cell)
    except ValueError:
        raise ValueError(f"{file.name}:{line}: {cell!r} is not a number") from None
