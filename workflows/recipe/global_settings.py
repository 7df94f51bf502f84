"""Global settings of a recipe: outputs, seed, tolerance, exports, expected numbers."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from difflib import get_close_matches
from typing import Any

from neusee.workflows.graph.errors import Diagnostic, nearest
from neusee.workflows.graph.recipe_graph import Expectation, Recipe, needed
from neusee.workflows.recipe.steps import Wiring
from neusee.workflows.recipe.text.references import BROKEN, References, Scope
from neusee.workflows.recipe.text.yaml_values import Value, kind

# --- expected numbers -----------------------------------------------------------------------------

# Selection of the expected numbers of a recipe that remain valid after the user's changes.


def unaffected_expectations(recipe: Recipe, written: Recipe | None) -> Recipe:
    """Return a recipe without the expected numbers that are affected by the user's changes to
    ``written``.

    None for ``written`` means that the recipe is not valid without the changes, so that the changes
    affect everything.
    """
    unchanged = _unchanged_steps(recipe, written) if written else set[str]()
    affected = [
        expected
        for expected in recipe.expect
        if (written is None or expected in written.expect) and expected.step not in unchanged
    ]
    if not affected:
        return recipe
    note = (
        "not compared, because your changes affect these numbers:"
        f" {', '.join(expected.name for expected in affected)}"
    )
    comparable = tuple(expected for expected in recipe.expect if expected not in affected)
    return replace(recipe, expect=comparable, notes=(*recipe.notes, note))


def _unchanged_steps(recipe: Recipe, written: Recipe) -> set[str]:
    """Return the names of the steps that are the same in two recipes, with all steps on which they
    depend.
    """
    unchanged: set[str] = set()
    for name in needed(recipe, recipe.steps):
        if unchanged.issuperset(recipe.steps[name].sources) and _alike(recipe, written, name):
            unchanged.add(name)
    return unchanged


def _alike(recipe: Recipe, written: Recipe, name: str) -> bool:
    """Return True if a step is the same in both recipes, apart from the steps that it reads."""
    step, written_step = recipe.steps[name], written.steps.get(name)
    if written_step is None or (step.node.random and recipe.seed != written.seed):
        return False
    return (step.node, step.params, step.wires) == (
        written_step.node,
        written_step.params,
        written_step.wires,
    )


# --- exported files -------------------------------------------------------------------------------

# Data files that a run writes: the key ``exports`` of a recipe, with the names of the files.


KEY, ALL, NONE, HALF = "exports", "all", "none", "@half"
#: files in the folder ``data`` of a run; `report.contents` describes each of them
NAMES = (
    "radiance.exr",
    "psf_plain.exr",
    "psf_mask.exr",
    "raw_plain.png",
    "raw_mask.png",
    "raw_plain.exr",
    "raw_mask.exr",
    "restored.exr",
    "restored.png",
    "restored_spread.exr",
    "invented.png",
    "outputs.safetensors",
)


def exports_of(root: Value, wiring: Wiring) -> dict[str, bool] | None:
    """Return the names of the data files that a run writes, with True for half floats; None for
    all files.
    """
    block = root.items.get(KEY)
    if block is None:
        return None
    values = block.data if isinstance(block.data, list) else [block]
    words = [wiring.references.resolve(value, Scope({}, KEY)) for value in values]
    if not isinstance(block.data, list) and words[0].data in (None, ALL, NONE):
        return {} if words[0].data == NONE else None
    return dict(_named(words, wiring))


def _named(words: list[Value], wiring: Wiring) -> Iterator[tuple[str, bool]]:
    """Yield each file name of the list with True for half floats; report unknown names."""
    for word in words:
        name = str(word.data).removesuffix(HALF)
        is_half = str(word.data) != name
        if word.data is BROKEN:
            continue
        if name not in NAMES:
            text = (
                f"no file of a run; {nearest(name, NAMES)}: write {ALL}, {NONE} or a list of names"
            )
            wiring.refuse(word, f"{KEY} = {word.data}", text)
        elif is_half and not name.endswith(".exr"):
            wiring.refuse(word, f"{KEY} = {word.data}", "only an .exr file can have half floats")
        else:
            yield name, is_half


# --- global settings ------------------------------------------------------------------------------

# Global settings of a recipe: outputs, seed, tolerance, and the numbers that a run is expected to
# give.


_EXPECTED = ("step", "at", "value", "rtol")
#: key of a recipe, false if only proved errors may count towards the tolerance
ESTIMATES = "estimates"
_NUMBERS = {
    "seed": "must be a whole number of 0 or more",
    "tolerance": "must be a number of 0 or more",
}


def seed_and_tolerance(
    root: Value, references: References, diagnostics: list[Diagnostic]
) -> tuple[int, float]:
    """Return the random seed and the error tolerance of a recipe; each is 0 if the recipe does
    not set it.
    """
    numbers = dict.fromkeys(_NUMBERS, 0)
    for key in (key for key in _NUMBERS if key in root.items):
        value = references.resolve(root.items[key], Scope({}, key))
        if value.data is not BROKEN:
            numbers[key] = value.data
            if not _is_number(value.data, is_integer=key == "seed") or value.data < 0:
                diagnostics.append(Diagnostic(value.mark, f"{key} = {value.data}", _NUMBERS[key]))
    return numbers["seed"], numbers["tolerance"]


def estimates_of(root: Value, references: References, diagnostics: list[Diagnostic]) -> bool:
    """Return True if a run may use cheaper steps whose error is estimated and not proved, as by
    default.
    """
    if ESTIMATES not in root.items:
        return True
    value = references.resolve(root.items[ESTIMATES], Scope({}, ESTIMATES))
    if value.data is BROKEN or isinstance(value.data, bool):
        return bool(value.data)
    diagnostics.append(
        Diagnostic(value.mark, f"{ESTIMATES} = {value.plain}", "must be true or false")
    )
    return True


def outputs_of(root: Value, wiring: Wiring) -> tuple[str, ...]:
    """Return the names of all copies, such as ``psf[mask]``, of the steps in the recipe key
    ``outputs``.
    """
    values = _requested(root, wiring)
    resolved = [wiring.references.resolve(value, Scope({}, "outputs")) for value in values]
    names: list[str] = []
    for value in resolved:
        if value.data is not BROKEN:
            names += wiring.outputs(value, value.name)
    return tuple(dict.fromkeys(names))


def _requested(root: Value, wiring: Wiring) -> list[Value]:
    """Return the values in the recipe key ``outputs``; report a recipe that requests no output."""
    block = root.items.get("outputs")
    if block is None or block.data in (None, "", [], {}):
        # a misspelt key is reported as unknown instead
        if block is not None or not get_close_matches("outputs", map(str, root.items)):
            message = "no output is requested: write outputs: [STEP, …]"
            wiring.refuse(block or root, "outputs", message)
        return []
    if isinstance(block.data, dict):
        wiring.refuse(block, "outputs", "must be a list of steps, not a mapping")
        return []
    return block.data if isinstance(block.data, list) else [block]


def expectations(root: Value, wiring: Wiring) -> tuple[Expectation, ...]:
    """Return the expected numbers in the key ``expect`` of a recipe."""
    block = root.items.get("expect")
    if block is None or block.data is None:
        return ()
    block = wiring.references.resolve(block, Scope({}, "expect"))
    if not isinstance(block.data, dict):
        wiring.refuse(block, "expect", f"must be a mapping of names, not {kind(block)}")
        return ()
    expected = (_expectation(str(name), value, wiring) for name, value in block.data.items())
    return tuple(e for e in expected if e is not None)


def _expectation(name: str, block: Value, wiring: Wiring) -> Expectation | None:
    """Return one expected number of the key ``expect``; None with diagnostics for a mistake."""
    earlier_mistakes = len(wiring.diagnostics)
    values: dict[str, Value] = block.items if isinstance(block.data, dict) else {}
    _refuse_keys(block, values, wiring)
    _refuse_numbers(values, wiring)
    steps = wiring.outputs(values["step"], values["step"].name) if "step" in values else ()
    if len(steps) > 1:
        wiring.refuse(values["step"], values["step"].name, f"must be one step, such as {steps[0]}")
    indices = _indices(values["at"], wiring) if "at" in values else ()
    if len(wiring.diagnostics) > earlier_mistakes or not steps:
        return None
    return Expectation(
        name, steps[0], indices, float(values["value"].data), float(values["rtol"].data), block.key
    )


def _refuse_keys(block: Value, values: Mapping[str, Value], wiring: Wiring) -> None:
    """Report the unknown and the missing keys of an expected number."""
    unknown = {
        value: nearest(str(key), _EXPECTED) for key, value in values.items() if key not in _EXPECTED
    }
    wiring.diagnostics.extend(
        Diagnostic(v.key, v.name, f"unknown; {hint}") for v, hint in unknown.items()
    )
    for key in ("step", "value", "rtol"):
        if key not in values and f"did you mean {key}?" not in unknown.values():
            message = (
                f"needs {key}: write {{step, value, rtol}}, and `at` if the result has several"
                " numbers"
            )
            wiring.diagnostics.append(Diagnostic(block.key, block.name, message))


def _refuse_numbers(values: Mapping[str, Value], wiring: Wiring) -> None:
    """Report a value or a relative tolerance that is no number."""
    for key in ("value", "rtol"):
        number = values.get(key)
        if number and not (_is_number(number.data) and (key == "value" or number.data >= 0)):
            wiring.refuse(number, f"{number.name} = {number.plain}", "must be a number")


def _indices(value: Value, wiring: Wiring) -> tuple[int | str, ...]:
    """Return the indices or field names that select one number of a result; report other values."""
    indices = value.plain if isinstance(value.data, list) else [value.plain]
    if not all(isinstance(index, int | str) and not isinstance(index, bool) for index in indices):
        wiring.refuse(value, value.name, "must be a list of indices or names of fields")
    return tuple(indices)


def _is_number(data: Any, is_integer: bool = False) -> bool:
    if isinstance(data, bool) or not isinstance(data, int if is_integer else int | float):
        return False
    return is_integer or math.isfinite(data)
