"""Recipes of the points of a sweep, each kept as its differences from the recipe of the first point."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from typing import Any

from neusee.workflows.graph.final_values import Config
from neusee.workflows.graph.recipe_graph import Recipe


@dataclass(frozen=True, slots=True)
class Same:
    """The newest step and value of each name that was equal to that of the first recipe, though another object."""

    steps: dict[str, Any] = field(default_factory=dict)
    values: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class KeptRecipe:
    """A checked recipe in little memory: the steps, values and fields that differ from those of another recipe."""

    first: Recipe
    steps: Mapping[str, Any]
    values: Mapping[str, Any]
    others: Mapping[str, Any]  #: by field of `Recipe`

    @classmethod
    def of(cls, recipe: Recipe, first: Recipe, same: Same | None = None) -> KeptRecipe:
        """Keep ``recipe`` beside ``first``, with which it shares what is equal in both.

        ``same`` is given to each call for one ``first``: values found equal are not compared again.
        """
        same = same or Same()
        others = {
            f.name: value for f in fields(Recipe) if (value := getattr(recipe, f.name)) is not getattr(first, f.name)
        }
        steps = _changed(recipe.steps, first.steps, same.steps)
        values = _changed(recipe.config.settings, first.config.settings, same.values)
        if steps is not None:
            others.pop("steps", None)
        if values is not None:
            others.pop("config", None)
        return cls(first, steps or {}, values or {}, others)

    @property
    def recipe(self) -> Recipe:
        """Return the recipe, equal to the one that was kept."""
        same = self.first
        steps, values = {**same.steps, **self.steps}, {**same.config.settings, **self.values}
        return replace(same, **{"steps": steps, "config": Config(values), **self.others})


def _changed(mapping: Mapping[str, Any], first: Mapping[str, Any], same: dict[str, Any]) -> dict[str, Any] | None:
    """Return the entries of a mapping that are not equal to those of ``first``, or None if the keys differ.

    The entries ``same`` are known to be equal, and those found equal are added.
    """
    if list(mapping) != list(first):
        return None
    changed = {}
    for key, value in mapping.items():
        if value is first[key] or (key in same and value is same[key]):
            continue
        if _equal(value, first[key]):
            same[key] = value
        else:
            changed[key] = value
    return changed


def _equal(one: Any, other: Any) -> bool:
    """Return True for equal values that are also written alike, unlike 0.0 and -0.0, or 1, 1.0 and True."""
    with suppress(Exception):  # values such as arrays, whose comparison has no single answer
        return bool(one == other) and repr(one) == repr(other)
    return False
