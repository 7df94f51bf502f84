"""A recipe that is kept as its differences from another one comes back with its own values."""

import math
from dataclasses import replace

import pytest

from neusee.nodes import node
from neusee.workflows.graph.errors import Location
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.sweeps import sweep_points as kept_recipes
from neusee.workflows.sweeps.sweep_points import KeptRecipe


@node()
def shifted(*, by: float = 0.0):
    return by


def recipe(value):
    step = Step("a", shifted, {"by": value}, {}, Location("test.yaml", 1, 1), {})
    return Recipe("test", "", 7, 0.0, ("a",), {"a": step})


@pytest.mark.parametrize(
    ("first", "value"), [(0.0, -0.0), (1, 1.0), (1, True), (0.5, 0.25), (0.5, 0.5)]
)
def test_values_come_back_with_their_type_and_their_sign(first, value):
    back = KeptRecipe.of(replace(recipe(value), seed=8), recipe(first)).recipe
    found = back.steps["a"].params["by"]
    assert (type(found), found, math.copysign(1.0, found)) == (
        type(value),
        value,
        math.copysign(1.0, value),
    )
    assert back.seed == 8


def test_what_is_equal_is_shared():
    first = recipe(0.5)
    assert KeptRecipe.of(recipe(0.5), first).steps == {}
    assert KeptRecipe.of(recipe(0.5), first).recipe.steps["a"] is first.steps["a"]


def test_a_value_found_equal_is_compared_once(monkeypatch):
    compared = []
    equal = kept_recipes._equal
    monkeypatch.setattr(
        kept_recipes, "_equal", lambda one, other: compared.append(one) or equal(one, other)
    )
    first, again, other, same = recipe(0.5), recipe(0.5), recipe(-0.0), kept_recipes.Same()
    for each in (again, again, replace(again, seed=8), other, again):
        assert (
            KeptRecipe.of(each, first, same).recipe.steps["a"].params["by"]
            == each.steps["a"].params["by"]
        )
    assert compared == [again.steps["a"], other.steps["a"]]
