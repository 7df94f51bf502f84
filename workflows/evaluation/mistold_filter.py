"""Recipes whose restorer is told optics and laser with one error, while the camera stays as it is.

The steps that compute what the restorer knows are copied with another parameter; the copies have the prefix ``told_``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from neusee.workflows.evaluation.pipelines import BEAM
from neusee.workflows.graph.recipe_graph import Recipe, Step, dependents, needed
from neusee.workflows.graph.told_copies import FRAME, knowers, known, with_copies
from neusee.workflows.recipe.blocks.evaluate_block import Mismatch


def errors_of(recipe: Recipe, mismatch: Mismatch) -> dict[str, Mapping[str, Any]]:
    """Return the errors in what the restorer of a recipe is told: by text, what is added to which parameters.

    A parameter with None is removed: the input ``dirt`` of a pupil. The result is empty if the restorer knows nothing.
    """
    told = known(recipe, _readers(recipe))
    if not told:
        return {}
    pupils = [name for name in needed(recipe, told) if recipe.steps[name].node.path == "optics.pupil"]
    found: dict[str, Mapping[str, Any]] = {}
    direction, line = f"direction[{BEAM}]", f"line[{BEAM}]"
    glare = [name for name in needed(recipe, told) if direction in recipe.steps[name].sources]
    if mismatch.pixels and glare:
        lens = recipe.steps[glare[0]].params
        angle = mismatch.pixels * lens["pixel_pitch"] / lens["focal_length"]
        found[f"direction {mismatch.pixels:g} px off"] = {f"{direction}.angle": (angle, angle)}
    if mismatch.wavelength and glare and "wavelength" in recipe.steps[line].params:
        found[f"wavelength {mismatch.wavelength * 1e9:g} nm off"] = {f"{line}.wavelength": mismatch.wavelength}
    if mismatch.defocus and pupils:
        found[f"defocus {mismatch.defocus:g} waves off"] = dict.fromkeys(
            (f"{name}.defocus" for name in pupils), mismatch.defocus
        )
    dirty = [name for name in pupils if recipe.steps[name].wires.get("dirt") is not None]
    if mismatch.dirt and dirty:
        found["dirt not told"] = dict.fromkeys(f"{name}.dirt" for name in dirty)
    return found


def mistold(recipe: Recipe, error: Mapping[str, Any]) -> Recipe:
    """Return the recipe with a copy of each step that the error changes, from which alone the restorer knows."""
    added = {name: value for name, value in error.items() if name.rpartition(".")[0] in recipe.steps}
    changed = {name.rpartition(".")[0] for name in added}
    readers = _readers(recipe)
    copied = {
        name
        for name in dependents(recipe, changed) & set(needed(recipe, known(recipe, readers)))
        if not recipe.steps[name].node.random or name in changed  # another name would draw anew
    }
    return with_copies(recipe, readers, copied, lambda step: _changed(step, added))


def shifted(value: Any, by: Any) -> Any:
    """Return a parameter to which an error is added: a number, or the two angles of a direction."""
    return tuple(a + b for a, b in zip(value, by, strict=True)) if isinstance(by, tuple) else value + by


def _readers(recipe: Recipe) -> list[str]:
    """Return the steps that restore the picture of the mask and know optics or lasers."""
    return knowers(recipe, dependents(recipe, [FRAME])) if FRAME in recipe.steps else []


def _changed(step: Step, error: Mapping[str, Any]) -> Step:
    params, wires = dict(step.params), dict(step.wires)
    for full, by in error.items():
        name, _, param = full.rpartition(".")
        if name != step.name:
            continue
        if by is None:
            wires[param] = None
        elif params[param] is not None:  # a direction is drawn for each scene
            params[param] = shifted(params[param], by)
    return replace(step, params=params, wires=wires)
