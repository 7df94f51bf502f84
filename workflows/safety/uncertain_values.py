"""Random draws of the settings of an estimate that a recipe gives as distributions or by a posterior."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.recipe.blocks.safety_block import Safety
from neusee.workflows.recipe.distributions.allowed_range import NEGLIGIBLE, within_allowed
from neusee.workflows.recipe.distributions.nominal_values import Uncertain
from neusee.workflows.recipe.distributions.shapes import FloatArray
from neusee.workflows.recipe.distributions.uncertain_inputs import only_values

_ROWS = 3  #: stream of random numbers that selects rows of a table of samples


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

    A negligible part of a distribution outside the values that the recipe allows is cut off, and its text says so.
    Raises `RecipeError` for a distribution with more outside.
    """
    uncertain, count = recipe.uncertain, safety.settings.draws
    if uncertain is None:
        return SettingDraws(count, {}, {}, recipe.seed)
    paths = {setting: value.name for setting, value in safety.values.items() if value.name in uncertain.names}
    allowed, notes = within_allowed(only_values(uncertain, paths.values()), NEGLIGIBLE)
    drawn = _draws(allowed, count, recipe.seed)
    texts = {path: uncertain.said(path) for path in drawn}
    texts |= {path: f"{texts[path]} ({note})" for path, note in notes.items()}
    order = sorted(paths, key=lambda setting: list(drawn).index(paths[setting]))
    values = {setting: drawn[paths[setting]] for setting in order}
    return SettingDraws(count, values, {setting: texts[paths[setting]] for setting in order}, recipe.seed)


def _draws(uncertain: Uncertain, count: int, seed: int) -> dict[str, FloatArray]:
    """Return ``count`` draws of each uncertain value; those of a table of samples are whole rows of the table."""
    z = np.random.default_rng([seed, 1]).standard_normal((count, len(uncertain.names)))
    drawn = {name: law.at(z[:, i]) for i, (name, law) in enumerate(uncertain.laws.items())}
    joint = uncertain.joint
    if joint is None:
        return drawn
    if joint.draws is None:
        rows = joint.at(z[:, len(drawn) :])
    else:
        rows = joint.draws[np.random.default_rng([seed, _ROWS]).integers(0, len(joint.draws), count)]
    return drawn | dict(zip(joint.names, rows.T, strict=True))
