"""Account of the error by the number of spectral bands, which the tolerance of a run does not include."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.report.contents import SPECTRAL, spectral_steps


def spectral_error(recipe: Recipe, keys: Mapping[str, str], value: Callable[[str], Any]) -> dict[str, Any]:
    """Return the largest error by the number of bands, over channels, by what it is the error of; empty if unknown."""
    found: dict[str, float] = {}
    for name in spectral_steps(recipe):
        if name in keys:
            what = SPECTRAL[name.partition("[")[0]]
            found[what] = max(found.get(what, 0.0), float(value(name).max()))
    if not found:
        return {}
    larger = max(found.values()) > recipe.tolerance
    return {"errors": found, "larger": larger, "said": _said(found, recipe.tolerance, larger)}


def _said(found: Mapping[str, float], tolerance: float, larger: bool) -> str:
    """Return one sentence with the errors by the number of bands, and a warning if one exceeds the tolerance."""
    errors = ", ".join(f"{error:.1e} {what}" for what, error in found.items())
    beside = f"tolerance {tolerance:g}, which is relative to the bands of the recipe"
    if not larger:
        return f"bands    error by the number of bands: {errors}; {beside}"
    return f"bands    LOOK: error by the number of bands: {errors}, larger than the {beside}: set more bands"
