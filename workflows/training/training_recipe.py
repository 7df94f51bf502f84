"""What a training asks of a recipe: steps that exist, a scene of stated size, and float64 where it is wanted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from neusee.workflows.graph.diagnostics import nearest
from neusee.workflows.graph.recipe_graph import Recipe, Step


def in_precision(recipe: Recipe, dtype: torch.dtype) -> Recipe:
    """Return the recipe with steps in float64 if ``dtype`` is float64: steps with a choice of precision are double."""
    if dtype != torch.float64:
        return recipe
    steps = {name: _precise(step) if "precision" in step.params else step for name, step in recipe.steps.items()}
    return replace(recipe, steps=steps)


def _precise(step: Step) -> Step:
    return replace(step, params={**step.params, "precision": "double"})


def require_steps(recipe: Recipe, block: str, names: Sequence[str]) -> None:
    """Raise ValueError unless the recipe has all steps ``names``, which the settings block ``block`` names."""
    for name in names:
        if name not in recipe.steps:
            raise ValueError(f"{block}: the recipe has no step {name}; {nearest(name, recipe.steps)}")


def frame_of(recipe: Recipe, scene: str) -> tuple[int, int]:
    """Return the sides of the scene in pixels (y, x); raise ValueError if the step ``scene`` does not state them."""
    shape = recipe.steps[scene].params.get("shape")
    if shape is None:
        raise ValueError(f"train: the step {scene} has no shape: set {scene}.shape in pixels, such as [96, 96]")
    return shape[0], shape[1]
