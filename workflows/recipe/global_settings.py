"""Global settings of a recipe: outputs, seed, tolerance and expected numbers."""

from __future__ import annotations

import math
from difflib import get_close_matches
from typing import Any

from neusee.workflows.graph.diagnostics import Diagnostic, nearest
from neusee.workflows.graph.recipe_graph import Expectation
from neusee.workflows.recipe.text.references import BROKEN, References, Scope
from neusee.workflows.recipe.text.yaml_values import Value, kind
from neusee.workflows.recipe.wiring import Wiring

_EXPECTED = ("step", "at", "value", "rtol")


def seed_and_tolerance(root: Value, references: References, diagnostics: list[Diagnostic]) -> tuple[int, float]:
    """Return seed and tolerance; 0 where the recipe does not set them."""
    seed = tolerance = 0
    given = {
        key: references.resolve(root.items[key], Scope({}, key)) for key in ("seed", "tolerance") if key in root.items
    }
    if "seed" in given and given["seed"].data is not BROKEN:
        seed = given["seed"].data
        if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
            diagnostics.append(Diagnostic(given["seed"].mark, f"seed = {seed}", "must be a whole number of 0 or more"))
    if "tolerance" in given and given["tolerance"].data is not BROKEN:
        tolerance = given["tolerance"].data
        if not _is_number(tolerance) or tolerance < 0:
            diagnostics.append(
                Diagnostic(given["tolerance"].mark, f"tolerance = {tolerance}", "must be a number of 0 or more")
            )
    return seed, tolerance


def outputs_of(root: Value, wiring: Wiring) -> tuple[str, ...]:
    """Return the copies of the steps that ``outputs`` names."""
    given = root.items.get("outputs")
    if given is None or given.data in (None, "", [], {}):
        mark = root.mark if given is None else given.mark
        if given is None and get_close_matches("outputs", map(str, root.items)):
            return ()  # misspelt, and reported as unknown
        wiring.diagnostics.append(Diagnostic(mark, "outputs", "no output is requested: write outputs: [STEP, …]"))
        return ()
    if isinstance(given.data, dict):
        wiring.diagnostics.append(Diagnostic(given.mark, "outputs", "must be a list of steps, not a mapping"))
        return ()
    values = given.data if isinstance(given.data, list) else [given]
    resolved = [wiring.references.resolve(value, Scope({}, "outputs")) for value in values]
    found = [name for value in resolved if value.data is not BROKEN for name in wiring.outputs(value, value.name)]
    return tuple(dict.fromkeys(found))


def expectations(root: Value, wiring: Wiring) -> tuple[Expectation, ...]:
    """Return the numbers that a recipe promises."""
    given = root.items.get("expect")
    if given is None or given.data is None:
        return ()
    given = wiring.references.resolve(given, Scope({}, "expect"))
    if not isinstance(given.data, dict):
        wiring.diagnostics.append(Diagnostic(given.mark, "expect", f"must be a mapping of names, not {kind(given)}"))
        return ()
    found = [_expectation(str(name), value, wiring) for name, value in given.data.items()]
    return tuple(e for e in found if e is not None)


def _expectation(name: str, given: Value, wiring: Wiring) -> Expectation | None:
    before = len(wiring.diagnostics)
    said: dict[str, Value] = given.items if isinstance(given.data, dict) else {}
    for key, value in said.items():
        if key not in _EXPECTED:
            wiring.diagnostics.append(Diagnostic(value.key, value.name, f"unknown; {nearest(str(key), _EXPECTED)}"))
    meant = {nearest(str(key), _EXPECTED) for key in said if key not in _EXPECTED}
    for key in ("step", "value", "rtol"):
        if key not in said and f"did you mean {key}?" not in meant:
            wiring.diagnostics.append(
                Diagnostic(given.key, given.name, f"needs {key}: {{step, value, rtol}} and perhaps at")
            )
    for key in ("value", "rtol"):
        if key in said and not (_is_number(said[key].data) and (key == "value" or said[key].data >= 0)):
            wiring.diagnostics.append(
                Diagnostic(said[key].mark, f"{said[key].name} = {said[key].plain}", "must be a number")
            )
    steps = wiring.outputs(said["step"], said["step"].name) if "step" in said else ()
    if len(steps) > 1:
        message = f"must be one step, such as {steps[0]}"
        wiring.diagnostics.append(Diagnostic(said["step"].mark, said["step"].name, message))
    at = _place(said.get("at"), wiring.diagnostics)
    if len(wiring.diagnostics) > before or not steps:
        return None
    return Expectation(name, steps[0], at, float(said["value"].data), float(said["rtol"].data), given.key)


def _place(given: Value | None, diagnostics: list[Diagnostic]) -> tuple[int | str, ...]:
    """Return indices, or the names of fields."""
    if given is None:
        return ()
    at = given.plain if isinstance(given.data, list) else [given.plain]
    if not all(isinstance(part, int | str) and not isinstance(part, bool) for part in at):
        diagnostics.append(Diagnostic(given.mark, given.name, "must be a list of indices or names of fields"))
    return tuple(at)


def _is_number(data: Any) -> bool:
    return isinstance(data, int | float) and not isinstance(data, bool) and math.isfinite(data)
