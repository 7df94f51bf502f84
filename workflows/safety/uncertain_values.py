"""Random draws of the settings of an estimate that a recipe gives as distributions or by a posterior."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from neusee.workflows.graph.diagnostics import RecipeError
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.recipe.blocks.safety_block import Safety
from neusee.workflows.recipe.distributions.scalar import FloatArray


@dataclass(frozen=True)
class SettingDraws:
    """Draws of the uncertain settings of an estimate."""

    count: int
    values: Mapping[str, FloatArray]  #: (draw,) in SI by setting, such as ``laser.power``
    laws: Mapping[str, str]  #: distribution as written, by setting
    seed: int

    def column(self, name: str, nominal: float) -> FloatArray:
        """Return the nominal value of a setting and its draws (1 + draw,)."""
        rest = self.values.get(name, np.full(self.count, nominal))
        return np.concatenate([[nominal], rest])

    def normal(self, stream: int) -> FloatArray:
        """Return a standard normal number for each draw; another ``stream`` has independent numbers."""
        return np.random.default_rng([self.seed, 2, stream]).standard_normal(self.count)


def draw_settings(recipe: Recipe, safety: Safety) -> SettingDraws:
    """Return draws of each setting whose value in the recipe is a distribution or belongs to a posterior.

    Raises `RecipeError` for a distribution that has values which the recipe does not allow.
    """
    uncertain, count = recipe.uncertain, safety.settings.draws
    readers: dict[str, list[str]] = {}
    for setting, value in safety.values.items():
        readers.setdefault(value.name, []).append(setting)
    if uncertain is None:
        return SettingDraws(count, {}, {}, recipe.seed)
    names = [name for name in uncertain.names if name in readers]
    z = np.random.default_rng([recipe.seed, 1]).standard_normal((count, len(names)))
    laws = [name for name in names if name in uncertain.laws]
    drawn = {name: uncertain.laws[name].at(z[:, i]) for i, name in enumerate(laws)}
    if kept := names[len(laws) :]:
        assert uncertain.joint is not None
        drawn |= dict(zip(kept, uncertain.joint.only(kept).at(z[:, len(laws) :]).T, strict=True))
    _refuse_invalid(recipe, drawn)
    said = {setting: uncertain.said(name) for name in names for setting in readers[name]}
    return SettingDraws(count, {s: drawn[name] for name in names for s in readers[name]}, said, recipe.seed)


def _refuse_invalid(recipe: Recipe, drawn: Mapping[str, FloatArray]) -> None:
    """Raise `RecipeError` if the recipe does not allow the smallest or the largest draw of a value."""
    assert recipe.uncertain is not None
    for name, values in drawn.items():
        for value in (float(values.min()), float(values.max())):
            try:
                recipe.uncertain.at({name: value})
            except RecipeError as error:
                found = [replace(d, message=f"the value is drawn, but {d.message}") for d in error.diagnostics]
                raise RecipeError(found) from None
