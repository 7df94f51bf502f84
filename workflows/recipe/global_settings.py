"""Global settings of a recipe: outputs, seed, tolerance, and the numbers that a run is expected to give."""

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
ESTIMATES = "estimates"  #: key of a recipe, false if only proved errors may count towards the tolerance
_NUMBERS = {"seed": "must be a whole number of 0 or more", "tolerance": "must be a number of 0 or more"}


def seed_and_tolerance(root: Value, references: References, diagnostics: list[Diagnostic]) -> tuple[int, float]:
    """Return the random seed and the error tolerance of a recipe; each is 0 if the recipe does not set it."""
    numbers = dict.fromkeys(_NUMBERS, 0)
    for key in (key for key in _NUMBERS if key in root.items):
        value = references.resolve(root.items[key], Scope({}, key))
        if value.data is not BROKEN:
            numbers[key] = value.data
            if not _is_number(value.data, whole=key == "seed") or value.data < 0:
                diagnostics.append(Diagnostic(value.mark, f"{key} = {value.data}", _NUMBERS[key]))
    return numbers["seed"], numbers["tolerance"]


def estimates_of(root: Value, references: References, diagnostics: list[Diagnostic]) -> bool:
    """Return True if a run may use cheaper steps whose error is estimated and not proved, as by default."""
    if ESTIMATES not in root.items:
        return True
    value = references.resolve(root.items[ESTIMATES], Scope({}, ESTIMATES))
    if value.data is BROKEN or isinstance(value.data, bool):
        return bool(value.data)
    diagnostics.append(Diagnostic(value.mark, f"{ESTIMATES} = {value.plain}", "must be true or false"))
    return True


def outputs_of(root: Value, wiring: Wiring) -> tuple[str, ...]:
    """Return the names of all copies, such as ``psf[mask]``, of the steps in the recipe key ``outputs``."""
    given = root.items.get("outputs")
    if given is None or given.data in (None, "", [], {}):
        if given is not None or not get_close_matches("outputs", map(str, root.items)):  # else reported as unknown
            wiring.refuse(given or root, "outputs", "no output is requested: write outputs: [STEP, …]")
        return ()
    if isinstance(given.data, dict):
        wiring.refuse(given, "outputs", "must be a list of steps, not a mapping")
        return ()
    values = given.data if isinstance(given.data, list) else [given]
    resolved = [wiring.references.resolve(value, Scope({}, "outputs")) for value in values]
    names = (name for value in resolved if value.data is not BROKEN for name in wiring.outputs(value, value.name))
    return tuple(dict.fromkeys(names))


def expectations(root: Value, wiring: Wiring) -> tuple[Expectation, ...]:
    """Return the expected numbers in the key ``expect`` of a recipe."""
    given = root.items.get("expect")
    if given is None or given.data is None:
        return ()
    given = wiring.references.resolve(given, Scope({}, "expect"))
    if not isinstance(given.data, dict):
        wiring.refuse(given, "expect", f"must be a mapping of names, not {kind(given)}")
        return ()
    expected = (_expectation(str(name), value, wiring) for name, value in given.data.items())
    return tuple(e for e in expected if e is not None)


def _expectation(name: str, given: Value, wiring: Wiring) -> Expectation | None:
    before = len(wiring.diagnostics)
    values: dict[str, Value] = given.items if isinstance(given.data, dict) else {}
    unknown = {value: nearest(str(key), _EXPECTED) for key, value in values.items() if key not in _EXPECTED}
    wiring.diagnostics.extend(Diagnostic(v.key, v.name, f"unknown; {hint}") for v, hint in unknown.items())
    for key in ("step", "value", "rtol"):
        if key not in values and f"did you mean {key}?" not in unknown.values():
            message = f"needs {key}: {{step, value, rtol}} and perhaps at"
            wiring.diagnostics.append(Diagnostic(given.key, given.name, message))
    for key in ("value", "rtol"):
        number = values.get(key)
        if number and not (_is_number(number.data) and (key == "value" or number.data >= 0)):
            wiring.refuse(number, f"{number.name} = {number.plain}", "must be a number")
    steps = wiring.outputs(values["step"], values["step"].name) if "step" in values else ()
    if len(steps) > 1:
        wiring.refuse(values["step"], values["step"].name, f"must be one step, such as {steps[0]}")
    at = _indices(values["at"], wiring) if "at" in values else ()
    if len(wiring.diagnostics) > before or not steps:
        return None
    return Expectation(name, steps[0], at, float(values["value"].data), float(values["rtol"].data), given.key)


def _indices(given: Value, wiring: Wiring) -> tuple[int | str, ...]:
    at = given.plain if isinstance(given.data, list) else [given.plain]
    if not all(isinstance(part, int | str) and not isinstance(part, bool) for part in at):
        wiring.refuse(given, given.name, "must be a list of indices or names of fields")
    return tuple(at)


def _is_number(data: Any, whole: bool = False) -> bool:
    if isinstance(data, bool) or not isinstance(data, int if whole else int | float):
        return False
    return whole or math.isfinite(data)
