"""A recipe with other values: its final values as a file, the changes over them, and all of it checked again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.recipe.loading import load


def changed(recipe: Recipe, overrides: Sequence[str]) -> Recipe:
    """Return ``recipe`` with other values, checked again; raise `RecipeError` where a value cannot be used."""
    with TemporaryDirectory(prefix="neusee-") as folder:
        path = Path(folder) / "recipe.yaml"
        path.write_text(recipe.config.to_yaml(), encoding="utf-8")
        found = load(path, overrides)
    found = replace(found, name=recipe.name, title=recipe.title, seed=recipe.seed, outputs=recipe.outputs, expect=())
    return replace(found, tolerance=recipe.tolerance, exact=recipe.exact)
