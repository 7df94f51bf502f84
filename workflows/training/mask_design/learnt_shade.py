"""The shade in front of a mask during its design: what it lets through, and a stop that is learnt with the mask."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from neusee.nodes.values import Shade
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.recipe.blocks.mask_design_block import DesignError, MaskTraining
from neusee.workflows.store.result_store import Store


@dataclass(frozen=True)
class LearntShade:
    """The step of a shade, its result as the recipe has it, and that with the stop of the shade fully open."""

    step: str
    own: Shade
    wide: Shade
    learnt: bool

    @classmethod
    def of(cls, recipe: Recipe, settings: MaskTraining, store: Store | None, device: str) -> LearntShade | None:
        """Return the shade in the pupil of the mask, or None for a pupil without one.

        Raises: `DesignError` if a stop is to be learnt and the pupil has no shade of `doe.shade`.
        """
        pupil = recipe.steps[settings.psf].wires.get("pupil")
        name = recipe.steps[pupil].wires.get("shade") if isinstance(pupil, str) else None
        if not isinstance(name, str) or recipe.steps[name].node.path != "doe.shade":
            if settings.learn_stop:
                text = f"the pupil of {settings.psf} has no shade whose stop could be learnt: use doe=shaded"
                raise DesignError(f"learn_stop: {text}, or remove learn_stop")
            return None
        wide = run(stopped(recipe, name, 1.0), store, [name], device=device)[name]
        own = run(recipe, store, [name], device=device)[name]
        return cls(name, own, wide, settings.learn_stop)

    def behind(self, stop: Tensor | None) -> Shade:
        """Return the shade with the amplitude of a stop in place of its own stop, or as it is for None."""
        return self.own if stop is None else self.wide._replace(amplitude=self.wide.amplitude * stop)

    def passed(self, stop: Tensor | None) -> Tensor:
        """Return the share of the light that the shade lets through, away from its notches."""
        light = self.behind(stop).amplitude.double().square().sum()
        return light / torch.count_nonzero(self.wide.amplitude)


def stopped(recipe: Recipe, shade: str, diameter: float) -> Recipe:
    """Return the recipe with another diameter of the stop in a shade."""
    step = recipe.steps[shade]
    changed = replace(step, params={**step.params, "diameter": diameter})
    return replace(recipe, steps={**recipe.steps, shade: changed})
