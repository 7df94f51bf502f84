"""Numbers of a run: the expected numbers of the recipe, the result table, and the rows of the metrics file."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping
from typing import Any

from torch import Tensor

from neusee.nodes.spectra import mean_wavelength
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.report.contents import BANDS, LINES, TABLE

Value = Callable[[str], Any]  #: a function that returns the value of a step and reads the store only when called
_COLUMNS = ("peak/I_sat", "LSR", "BSR", "PSNR (dB)", "SSIM", "saturated px")
_DESIGN = 550e-9  #: m, wavelength of the LSR in the result table for a recipe without a laser
_SMALL = 4096  #: elements, at most, of a result whose numbers become rows


def expected(recipe: Recipe, value: Value) -> list[dict[str, Any]]:
    """Return every expected number of the recipe with the number that the run found."""
    rows = []
    for e in recipe.expect:
        found: Any = value(e.step)
        for part in e.at:
            found = getattr(found, part) if isinstance(part, str) and not isinstance(found, dict) else found[part]
        number = float(found)
        ok = abs(number - e.value) <= e.rtol * abs(e.value)
        rows.append({"name": e.name, "step": e.step, "wanted": e.value, "found": number, "rtol": e.rtol, "ok": ok})
    return rows


def table(recipe: Recipe, keys: Mapping[str, str], value: Value) -> dict[str, Any]:
    """Return the result table: a row each for plain lens, mask and restored picture; no rows if all cells are empty."""
    band, where = _band(recipe, keys, value)
    rows = []
    for name, cells in TABLE.items():
        known = {column: value(step) for column, step in cells.items() if step in keys}
        rows.append({"name": name, "cells": _cells(known, band)})
    legend = [f"LSR at {where}; BSR is the mean over the bands."] if any(r["cells"][1] for r in rows) else []
    rows = rows if any(any(row["cells"]) for row in rows) else []
    return {"columns": list(_COLUMNS), "rows": rows, "legend": legend}


def _cells(known: Mapping[str, Any], band: int) -> list[str]:
    quality = known.get("quality")
    numbers = {
        "peak/I_sat": (_largest(known.get("peak/I_sat")), "{:.4g}"),
        "LSR": (_at(known.get("LSR"), band), "{:.3g}"),
        "BSR": (_mean(known.get("BSR")), "{:.3f}"),
        "PSNR (dB)": (_field(quality, "psnr"), "{:.2f}"),
        "SSIM": (_field(quality, "ssim"), "{:.3f}"),
        "saturated px": (_sum(known.get("saturated")), "{:,.0f}"),
    }
    return ["" if number is None else form.format(number) for number, form in (numbers[c] for c in _COLUMNS)]


def _band(recipe: Recipe, keys: Mapping[str, str], value: Value) -> tuple[int, str]:
    """Return the band of the scene that is nearest to the first laser, or to 550 nm if there is no laser."""
    if BANDS not in keys:
        return 0, "the first band"
    prefix = LINES.removesuffix("*]")
    lines = [name for name in recipe.steps if name.startswith(prefix) and name in keys]
    wanted = _DESIGN
    if lines:
        wanted = mean_wavelength(value(lines[0]))
    centres = value(BANDS).centres
    band = int((centres - wanted).abs().argmin())
    return band, f"{float(centres[band]) * 1e9:.0f} nm"


def metrics(recipe: Recipe, keys: Mapping[str, str], value: Value) -> list[list[Any]]:
    """Return a row (step, field, index, value) for each number of each small result of a metric."""
    return [row for name in metrics_of(recipe, keys) for row in numbers_of(name, value(name))]


def metrics_of(recipe: Recipe, among: Container[str]) -> list[str]:
    """Return the steps ``among`` those given that are metrics, in the order of the recipe."""
    return [name for name, step in recipe.steps.items() if name in among and step.node.path.startswith("metrics.")]


def numbers_of(step: str, found: Any) -> list[list[Any]]:
    """Return a row (step, field, index, value) for each number of a small result; none for a picture."""
    rows: list[list[Any]] = []
    for field, tensor in _fields(found):
        if tensor.numel() <= _SMALL and not tensor.is_complex():
            numbers = tensor.detach().double().flatten().tolist()
            rows += [[step, field, i if len(numbers) > 1 else "", n] for i, n in enumerate(numbers)]
    return rows


def _fields(found: Any) -> list[tuple[str, Tensor]]:
    if isinstance(found, Tensor):
        return [("", found)]
    if hasattr(found, "_asdict"):
        return [(k, v) for k, v in found._asdict().items() if isinstance(v, Tensor)]
    return []


def _tensor(found: Any) -> Tensor | None:
    fields = [] if found is None else _fields(found)
    return fields[0][1] if fields else None


def _largest(found: Any) -> float | None:
    tensor = _tensor(found)
    return None if tensor is None else float(tensor.max())


def _mean(found: Any) -> float | None:
    tensor = _tensor(found)
    return None if tensor is None else float(tensor.double().mean())


def _sum(found: Any) -> float | None:
    tensor = _tensor(found)
    return None if tensor is None else float(tensor.double().sum())


def _at(found: Any, band: int) -> float | None:
    tensor = _tensor(found)
    return None if tensor is None else float(tensor.flatten()[min(band, tensor.numel() - 1)])


def _field(found: Any, name: str) -> float | None:
    return None if found is None else float(getattr(found, name))
