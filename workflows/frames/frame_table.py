"""A table that names the exposure and the light of each file of frames."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from neusee.nodes.input_files import csv_rows
from neusee.nodes.units import read_any

_TIMES = {"exposure": 0.0, "exposure_s": 1.0, "exposure_ms": 1e-3, "exposure_us": 1e-6, "exposure_ns": 1e-9}
_FRACTION = re.compile(r"\s*(\d+)\s*[/⁄]\s*([1-9]\d*(?:\.\d+)?)\s*(s|sec)?\s*")  #: 1/200 s
_COLUMNS = "file, exposure (such as 10 ms) or exposure_ms, and photons or light"


class TableRow(NamedTuple):
    """A line of a table: a file and what is told of it; None for an empty cell or a column that is missing."""

    line: int
    file: Path
    exposure: float | None  #: s
    photons: float | None  #: per pixel and exposure
    light: float | None  #: relative


def find_table(folder: Path) -> Path | None:
    """Return the only CSV file of a folder with a column ``file``, or None; raise ValueError for several."""
    found = [path for path in sorted(folder.glob("*.csv")) if "file" in _header(path)]
    if len(found) > 1:
        raise ValueError(f"{folder} has {len(found)} tables of frames, {', '.join(p.name for p in found)}: keep one")
    return found[0] if found else None


def read_table(table: Path) -> list[TableRow]:
    """Return the lines of a table of frames; raise ValueError with all mistakes, each with its line."""
    found = list(_read(table))
    rows = [item for item in found if isinstance(item, TableRow)]
    if problems := [item for item in found if isinstance(item, str)]:
        raise ValueError("\n".join(problems))
    if not rows:
        raise ValueError(f"{table.name} has no line below its header: write one line for each file")
    return rows


def _header(table: Path) -> list[str]:
    try:
        return next(([cell.strip().lower() for cell in row] for _, row in csv_rows(table)), [])
    except ValueError:
        return []


def _read(table: Path) -> Iterator[TableRow | str]:
    lines = csv_rows(table)
    names = [cell.strip().lower() for cell in next(lines)[1]]
    time = next((name for name in names if name in _TIMES), None)
    if strange := [name for name in names if name not in (*_TIMES, "file", "photons", "light")]:
        yield f"{table.name}:1: column {strange[0]} is unknown: write {_COLUMNS}"
    for line, cells in lines:
        row = dict(zip(names, (cell.strip() for cell in cells), strict=False))
        file = table.parent / row.get("file", "")
        if not file.is_file():
            yield f"{table.name}:{line}: no such file: {row.get('file') or '(empty)'}"
            continue
        try:
            exposure = _exposure(row.get(time or "", ""), time or "")
            yield TableRow(line, file, exposure, _light(row, "photons"), _light(row, "light"))
        except ValueError as error:
            yield f"{table.name}:{line}: {error}"


def _exposure(text: str, column: str) -> float | None:
    if not text:
        return None
    scale = _TIMES[column]
    if fraction := _FRACTION.fullmatch(text):
        number, unit = float(fraction[1]) / float(fraction[2]), "s" if scale or fraction[3] else ""
        scale = 0.0 if fraction[3] else scale
    else:
        number, unit = (float(text), "s") if scale else read_any(text)
    if unit != "s" or not 0 < number < math.inf:
        raise ValueError(f"exposure {text}: write a time with a unit, such as 10 ms, or name the column exposure_ms")
    return number * (scale or 1.0)


def _light(row: dict[str, str], column: str) -> float | None:
    text = row.get(column, "")
    if not text:
        return None
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 <= number < math.inf:
        raise ValueError(f"{column} {text}: write a number of 0 or more")
    return number
