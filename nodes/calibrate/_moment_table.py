"""A node that reads a table with means and variances of frames from another program."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Literal

import torch

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.input_files import csv_rows, once_per_version
from neusee.nodes.units import DataFile
from neusee.nodes.values import Levels

_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_NUMBERS = {
    "photons": ">= 0",
    "exposure": "> 0",
    "pixels": ">= 1",
    "mean": "finite",
    "variance": ">= 0",
}


@node(rtol=0.0)
def table(
    *,
    file: DataFile,
    photons: str = "photons",
    exposure: str = "exposure_s",
    pixels: str = "pixels",
    mean: str = "mean",
    variance: str = "variance",
    drift: str | None = None,
    exposure_unit: Literal["s", "ms", "us", "ns"] = "s",
) -> Levels:
    """Read the means and variances of pairs of frames from a CSV file with named columns and a line
    per light level.

    ``drift`` names the column with the difference of the two means, for a table whose variance
    excludes that difference. Half the square of the difference is then added, because the variance
    of EMVA 1288 includes that part.

    Shapes: -> (level,), in the order of the file; no histograms.
    Units:  photons per pixel and exposure; exposure in `exposure_unit`; pixels of one frame; mean
            DN; variance DN2.
    Error:  exact.
    Raises: ParameterError before the run for a missing column, another separator than a comma, and
            a cell without a valid number.
    Source: EMVA Standard 1288, release 4.0 Linear, section 6.6 (variance of a pair of frames).
    """
    names = {
        "photons": photons,
        "exposure": exposure,
        "pixels": pixels,
        "mean": mean,
        "variance": variance,
    }
    rows = _rows(file, {**names, **({} if drift is None else {"drift": drift})})
    if not rows:
        raise ValueError(f"{file.name} has no line below the header: give one line per level")
    columns = {
        name: torch.tensor([row[name] for row in rows], dtype=torch.float64) for name in rows[0]
    }
    # half the squared difference of the means belongs to the variance of a pair
    total_variance = columns["variance"] + (
        columns["drift"].square() / 2 if drift is not None else 0.0
    )
    exposures, pixel_count = columns["exposure"] * _SECONDS[exposure_unit], columns["pixels"]
    no_cells = torch.zeros(0, dtype=torch.float64)
    return Levels(
        columns["photons"],
        exposures,
        # pixels of both frames; a pair has one degree of freedom a pixel
        2 * pixel_count,
        columns["mean"],
        total_variance,
        pixel_count,
        no_cells.long(),
        no_cells,
        no_cells,
    )


@table.preflight
def _(*, file: Path, exposure_unit: str = "s", **names: Any) -> list[str]:
    try:
        _, header = next(csv_rows(file), (0, list[str]()))
    except ValueError as error:
        raise ParameterError("file", str(error)) from None
    for parameter, column in names.items():
        if column is not None and column not in header:
            raise ParameterError(
                parameter, f"{file.name} has no column {column!r}: name one of {', '.join(header)}"
            )
    if problem := _wrong_cell(
        file, *sorted((name, column) for name, column in names.items() if column is not None)
    ):
        raise ParameterError("file", problem)
    return []


@once_per_version
def _wrong_cell(file: Path, *columns: tuple[str, str]) -> str:
    """Return a message for the first cell of a table that is not a valid number, else an empty
    text.
    """
    try:
        rows = _rows(file, dict(columns))
    except ValueError as error:
        return str(error)
    return "" if rows else f"{file.name} has no line below the header: give one line per level"


@table.check
def _(result: Levels, **params: Any) -> list[Check]:
    dark = int((result.photons == 0).sum())
    return [Check(f"{len(result.mean)} levels, {dark} dark", dark > 0)]


def _rows(file: Path, columns: dict[str, str]) -> list[dict[str, float]]:
    """Read the lines of a table as numbers by name; ``columns`` has the heading of each name.
    Raises ValueError, with line and column, for a cell that is no valid number.
    """
    rows = csv_rows(file)
    _, header = next(rows, (0, list[str]()))
    cells_of_line = ((line, dict(zip(header, row, strict=False))) for line, row in rows)
    return [
        {n: _number(row.get(c), n, f"{file.name}:{line}: column {c}") for n, c in columns.items()}
        for line, row in cells_of_line
    ]


def _number(text: str | None, name: str, where: str) -> float:
    """Return the number in the cell of a column ``name``; raise ValueError, with the place
    ``where``, for a text that is no valid number of it.
    """
    condition = _NUMBERS.get(name, "finite")
    try:
        number = float(text or "")
    except ValueError:
        number = math.nan
    fulfilled = {
        ">= 0": number >= 0,
        "> 0": number > 0,
        ">= 1": number >= 1 and number.is_integer(),
    }
    if not math.isfinite(number) or not fulfilled.get(condition, True):
        kind = "whole number" if name == "pixels" else "number"
        raise ValueError(f"{where}: {text!r} is not valid for {name}: write a {kind}, {condition}")
    return number
