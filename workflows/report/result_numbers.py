"""Numbers of a run: the expected numbers of the recipe, the result table, and the rows of
``metrics.csv``.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping
from typing import Any

from torch import Tensor

from neusee.nodes.spectra import mean_wavelength
from neusee.workflows.engine.result_values import metrics_of, numbers_of, tensor_fields
from neusee.workflows.engine.wanted_steps import BANDS, LINES, TABLE, compared
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.report.figures.style import nearest

Value = Callable[[str], Any]  #: a function from the name of a step to the value of the step
#: Columns of the result table: the result in `TABLE`, its field, the number of this field and a
#: band, and the format
_COLUMNS: Mapping[str, tuple[str, str, Callable[[Tensor, int], Any], str]] = {
    "peak/I_sat": ("peak/I_sat", "", lambda x, band: x.max(), "{:.4g}"),
    "LSR": ("LSR", "", lambda x, band: x.flatten()[min(band, x.numel() - 1)], "{:.3g}"),
    "BSR": ("BSR", "", lambda x, band: x.double().mean(), "{:.3f}"),
    "outside": ("outside", "", lambda x, band: x.double().mean(), "{:.2%}"),
    "PSNR (dB)": ("quality", "psnr", lambda x, band: x, "{:.2f}"),
    "SSIM": ("quality", "ssim", lambda x, band: x, "{:.3f}"),
    "saturated px": ("saturated", "", lambda x, band: x.double().sum(), "{:,.0f}"),
}
_LEGEND = {
    "LSR": "LSR at {band}",
    "BSR": "BSR, the mean over the bands: the share of the scene's light that stays in the field",
    "outside": (
        "outside, the mean over the bands: the share of a point's light that falls outside the PSF"
        " window"
    ),
}
_DESIGN_WAVELENGTH = 550e-9  #: m, for the LSR in the result table of a recipe without a laser


def expected(recipe: Recipe, value: Value) -> list[dict[str, Any]]:
    """Compare the numbers that a recipe expects with the numbers from the run, and return one
    row for each.
    """
    rows = []
    for expected_number in compared(recipe)[0]:
        result: Any = value(expected_number.step)
        # a text is a field, or a key of a dictionary; a number is an index
        for key in expected_number.at:
            result = (
                getattr(result, key)
                if isinstance(key, str) and not isinstance(result, dict)
                else result[key]
            )
        number = float(result)
        is_within = abs(number - expected_number.value) <= expected_number.rtol * abs(
            expected_number.value
        )
        rows.append(
            {
                "name": expected_number.name,
                "step": expected_number.step,
                "wanted": expected_number.value,
                "found": number,
                "rtol": expected_number.rtol,
                "ok": is_within,
            }
        )
    return rows


def table(recipe: Recipe, keys: Mapping[str, str], value: Value) -> dict[str, Any]:
    """Return the table for plain lens, mask and restored picture, with the rows and columns that
    have numbers.
    """
    _, band_name = _band(recipe, keys, value)
    numbers_by_arm = arms(recipe, keys, value)
    columns = [
        column for column in _COLUMNS if any(column in cells for cells in numbers_by_arm.values())
    ]
    rows = [
        {"name": name, "cells": [_text(cells, c) for c in columns]}
        for name, cells in numbers_by_arm.items()
        if cells
    ]
    legend = [text.format(band=band_name) for column, text in _LEGEND.items() if column in columns]
    return {"columns": columns, "rows": rows, "legend": legend}


def arms(recipe: Recipe, keys: Mapping[str, str], value: Value) -> dict[str, dict[str, float]]:
    """Return the numbers of the plain lens, of the mask and of the restored picture, by column
    of the result table.
    """
    band, _ = _band(recipe, keys, value)
    numbers: dict[str, dict[str, float]] = {}
    for name, cells in TABLE.items():
        results = {column: value(step) for column, step in cells.items() if step in keys}
        numbers[name] = {}
        # (result in `TABLE`, field, function that gives the number, format)
        for column, (source, field, number, _) in _COLUMNS.items():
            result = _field(results.get(source), field)
            if result is not None:
                numbers[name][column] = float(number(result, band))
    return numbers


def lines_of(recipe: Recipe, keys: Container[str]) -> list[str]:
    """Return the steps among ``keys`` that give the spectral line of a laser whose strength is
    not 0.
    """
    strengths = {
        # line[green] has the strength of the laser green
        name: recipe.config.values.get(f"lasers.{name[5:-1]}.strength")
        for name in _lines(recipe, keys)
    }
    return [name for name, strength in strengths.items() if strength != 0]


def suppressed(recipe: Recipe, keys: Mapping[str, str], value: Value) -> dict[str, float]:
    """Return the LSR of the mask at the wavelength of each laser that shines, by wavelength in
    nm as text.
    """
    step = TABLE["with mask"]["LSR"]
    if step not in keys or BANDS not in keys:
        return {}
    lsr, centres = value(step).flatten(), value(BANDS).centres
    bands_of_lasers = (
        nearest(centres, mean_wavelength(value(line))) for line in lines_of(recipe, keys)
    )
    # an LSR of one band is that of every laser
    return {name: float(lsr[min(band, lsr.numel() - 1)]) for band, name in bands_of_lasers}


def _field(result: Any, field: str) -> Tensor | None:
    """Return the field ``field`` of a result, or its first field for an empty name, or None if
    the field is missing.
    """
    fields = {} if result is None else dict(tensor_fields(result))
    return fields.get(field) if field else next(iter(fields.values()), None)


def _text(cells: Mapping[str, float], column: str) -> str:
    """Return a number of the result table as text, or an empty text if the table has no number
    there.
    """
    # the format is the last entry
    return _COLUMNS[column][3].format(cells[column]) if column in cells else ""


def _band(recipe: Recipe, keys: Mapping[str, str], value: Value) -> tuple[int, str]:
    """Return index and name of the spectral band nearest to the first laser, or to 550 nm if
    there is no laser.
    """
    if BANDS not in keys:
        return 0, "the first band"
    lines = _lines(recipe, keys)
    wavelength = mean_wavelength(value(lines[0])) if lines else _DESIGN_WAVELENGTH
    bands = value(BANDS)
    band, name = nearest(bands.centres, wavelength)
    if abs(float(bands.centres[band]) - wavelength) > float(bands.widths[band]):
        name += f", the band nearest to the laser at {wavelength * 1e9:.0f} nm"
    return band, name


def _lines(recipe: Recipe, keys: Container[str]) -> list[str]:
    """Return the steps among ``keys`` that give the spectral line of a laser."""
    prefix = LINES.removesuffix("*]")
    return [name for name in recipe.steps if name.startswith(prefix) and name in keys]


def metrics(recipe: Recipe, keys: Mapping[str, str], value: Value) -> list[list[Any]]:
    """Return the rows (step, field, index, value) of ``metrics.csv``, one for each number that a
    metric gave.
    """
    rows: list[list[Any]] = []
    for name in metrics_of(recipe, keys):
        rows += numbers_of(name, value(name))
    return rows
