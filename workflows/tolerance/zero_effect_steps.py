"""Removal of steps with zero effect, such as a laser without power, ghosts without energy or a clean window.

Such steps are found from parameters alone, before the run: a step whose node bounds its result by 0
(`Node.zero_bound`) is removed from the inputs to which it would add nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from neusee.nodes import TensorStats
from neusee.workflows.graph.recipe_graph import Recipe, Step, Substitution, Wire

_DARK = TensorStats((), "float32", 0.0, 0.0, 0.0, 0, True)  #: statistics of a result that is 0 everywhere


class _Unknown:
    """Statistics of a step that has not run yet: reading any attribute raises `LookupError`."""

    def __getattr__(self, name: str) -> Any:
        raise LookupError(name)


UNKNOWN = _Unknown()


def without_nothing(recipe: Recipe, order: Iterable[str]) -> Recipe:
    """Disconnect steps whose result must be 0 and return the recipe; ``order`` lists each step after its inputs."""
    dark: dict[str, None] = {}
    changed: dict[str, Step] = {}
    for name in order:
        step = recipe.steps[name]
        if _nothing(step, dark):
            dark[name] = None
        elif step.node.additive_inputs and not dark.keys().isdisjoint(step.sources):
            changed[name] = replace(step, wires=without(step, dark))
    if not changed:
        return recipe
    known = {substitution.step for substitution in recipe.substitutions}
    why = "its parameters make its result 0"
    new = tuple(Substitution(name, "", 0.0, why) for name in dark if name not in known)
    steps, whole = {**recipe.steps, **changed}, recipe.unsubstituted or recipe
    return replace(recipe, steps=steps, substitutions=(*recipe.substitutions, *new), unsubstituted=whole)


def _nothing(step: Step, dark: Mapping[str, None]) -> bool:
    """Return True if the result of a step must be 0 when the results of the steps in ``dark`` are 0."""
    if step.node.hooks.zero_bound is None:
        return False
    inputs = [_known(step.wires.get(name), dark) for name in step.node.inputs]
    try:
        return float(step.node.hooks.zero_bound(*inputs, **step.params)) == 0.0
    except LookupError:
        return False


def _known(wire: Wire, dark: Mapping[str, None]) -> Any:
    if wire is None:
        return None
    if isinstance(wire, str):
        return _DARK if wire in dark else UNKNOWN
    return [_known(name, dark) for name in wire]


def without(step: Step, dark: Mapping[str, None]) -> dict[str, Wire]:
    """Return the inputs of a step without the inputs from the steps ``dark``, whose results are 0.

    The other inputs of the same group are removed, too.
    """
    wires = dict(step.wires)
    for group in step.node.additive_inputs:
        wire = wires.get(group[0])
        if isinstance(wire, str) and wire in dark:
            wires |= dict.fromkeys(group)
        elif isinstance(wire, tuple):
            kept = [i for i, name in enumerate(wire) if name not in dark]
            for name in group:
                listed = wires.get(name)
                wires[name] = tuple(listed[i] for i in kept) if isinstance(listed, tuple) else listed
    return wires
