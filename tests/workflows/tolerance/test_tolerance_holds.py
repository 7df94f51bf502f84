"""Whatever the recipe and its tolerance: a run is finite, keeps its energy, and is as near the full one as it says."""

import importlib.util
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from neusee.workflows.engine.runner import run
from neusee.workflows.store.result_store import Store
from neusee.workflows.tolerance.error_norm import error_of

SPEC = importlib.util.spec_from_file_location("random_recipes", Path(__file__).parents[1] / "random_recipes.py")
random_recipes = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(random_recipes)


def compared(seed, tmp_path):
    """A drawn recipe as it is run, and in full."""
    recipe, _ = random_recipes.draw(seed)
    store = Store(tmp_path)
    result = run(recipe, store)
    held = [name for name in result.proof.held if name in recipe.steps]
    return recipe, result, run(replace(recipe, exact=True), store, dict.fromkeys([*recipe.outputs, *held]))


def unrounded(value, reference):
    """Without differences of one number, which any error can make, however small."""
    return reference + (value - reference).sign() * ((value - reference).abs() - 1).clamp_min(0)


def holds(recipe, result, full):
    """Raises where a value is not finite, light appears from nowhere, or an error is beyond its bound."""
    for name in recipe.outputs:
        assert bool(torch.isfinite(result[name]).all()), name
    for name in full.values.keys() & result.proof.held.keys():
        value = unrounded(result[name], full[name]) if name.startswith("raw") else result[name]
        assert error_of(value, full[name]) <= max(result.proof.held[name], 1e-6), name
    assert result.proof.worst <= recipe.tolerance
    for arm in ("plain", "mask"):
        assert error_of(result[f"raw[{arm}]"], full[f"raw[{arm}]"]) <= recipe.tolerance
        assert float(result[f"bsr[{arm}]"].max()) <= 1.0 + 1e-6


@pytest.mark.parametrize("seed", [13, 20])
def test_a_random_recipe_is_within_its_tolerance(seed, tmp_path):
    holds(*compared(seed, tmp_path))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(16))
def test_more_random_recipes_are_within_their_tolerance(seed, tmp_path):
    holds(*compared(seed, tmp_path))
