"""Selection of the expected numbers of a recipe that remain valid after the user's changes."""

from __future__ import annotations

from dataclasses import replace

from neusee.workflows.graph.recipe_graph import Recipe, needed


def unaffected_expectations(recipe: Recipe, written: Recipe | None) -> Recipe:
    """Return a recipe without the expected numbers that are affected by the user's changes to ``written``.

    None for ``written`` means that the recipe is not valid without the changes, so that the changes affect everything.
    """
    same: set[str] = set()
    for name in needed(recipe, recipe.steps) if written else ():
        if written and same.issuperset(recipe.steps[name].sources) and _alike(recipe, written, name):
            same.add(name)
    lost = [e for e in recipe.expect if (written is None or e in written.expect) and e.step not in same]
    if not lost:
        return recipe
    note = f"not compared, because your changes affect these numbers: {', '.join(e.name for e in lost)}"
    kept = tuple(e for e in recipe.expect if e not in lost)
    return replace(recipe, expect=kept, notes=(*recipe.notes, note))


def _alike(recipe: Recipe, written: Recipe, name: str) -> bool:
    one, other = recipe.steps[name], written.steps.get(name)
    if other is None or (one.node.random and recipe.seed != written.seed):
        return False
    return (one.node, one.params, one.wires) == (other.node, other.params, other.wires)
