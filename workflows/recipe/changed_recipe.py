"""Changes of a loaded recipe: its final values are written to a file, changed by overrides and checked again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.recipe.loading import load


def changed(recipe: Recipe, overrides: Sequence[str]) -> Recipe:
    """Return a loaded recipe with values changed by ``overrides``; raise `RecipeError` for an invalid value."""
    with TemporaryDirectory(prefix="neusee-") as folder:
        path = Path(folder) / "recipe.yaml"
        path.write_text(recipe.config.to_yaml(), encoding="utf-8")
        loaded = load(path, overrides)
    loaded = replace(loaded, name=recipe.name, title=recipe.title, seed=recipe.seed, outputs=recipe.outputs, expect=())
    return replace(
        loaded, tolerance=recipe.tolerance, exact=recipe.exact, estimates=recipe.estimates and loaded.estimates
    )
