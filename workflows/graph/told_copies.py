"""Copies of the steps from which a restorer knows optics and laser, so that a camera may differ from what is believed.

The camera keeps its steps. The copies have the prefix ``told_``, and the restorer reads these in place of the camera's.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import replace

from neusee.workflows.graph.recipe_graph import Recipe, Step, Wire

TOLD = "told_"  #: prefix of the copies
KNOWLEDGE = ("psf", "glare", "nearby")  #: inputs of a restorer that say what the optics and the laser are
FRAME = "raw[mask]"  #: step of the frame behind the mask, before which the camera is and after which the user


def knowers(recipe: Recipe, steps: Iterable[str]) -> list[str]:
    """Return those of the steps that read what optics or lasers are."""
    return [name for name in steps if any(recipe.steps[name].wires.get(key) for key in KNOWLEDGE)]


def known(recipe: Recipe, readers: Iterable[str]) -> list[str]:
    """Return the steps whose results tell the steps ``readers`` what optics and lasers are."""
    wires = (recipe.steps[name].wires.get(key) for name in readers for key in KNOWLEDGE)
    return [name for wire in wires for name in ((wire,) if isinstance(wire, str) else wire or ())]


def with_copies(
    recipe: Recipe, readers: Iterable[str], copied: Collection[str], change: Callable[[Step], Step]
) -> Recipe:
    """Return the recipe with changed copies of the steps ``copied``, from which alone the ``readers`` know."""
    steps = dict(recipe.steps)
    for name in copied:
        step = change(recipe.steps[name])
        wires = {key: _told(wire, copied) for key, wire in step.wires.items()}
        steps[TOLD + name] = replace(step, name=TOLD + name, wires=wires)
    for name in readers:
        step = recipe.steps[name]
        wires = {key: _told(wire, copied) if key in KNOWLEDGE else wire for key, wire in step.wires.items()}
        steps[name] = replace(step, wires=wires)
    return replace(recipe, steps=steps)


def _told(wire: Wire, copied: Collection[str]) -> Wire:
    if isinstance(wire, str):
        return TOLD + wire if wire in copied else wire
    return None if wire is None else tuple(TOLD + name if name in copied else name for name in wire)
