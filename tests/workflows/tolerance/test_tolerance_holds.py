"""Whatever the recipe and its tolerance: a run is finite, keeps its energy, and is as near the
full one as it says.
"""

import importlib.util
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from neusee.workflows.engine.runner import run
from neusee.workflows.store.result_store import Store
from neusee.workflows.tolerance.error_norm import error_of

SPEC = importlib.util.spec_from_file_location(
    "random_recipes", Path(__file__).parents[1] / "random_recipes.py"
)
random_recipes = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(random_recipes)


def compared(seed, tmp_path):
    """A drawn recipe as it is run, and in full."""
    recipe, _ = random_recipes.draw(seed)
    store = Store(tmp_path)
    result = run(recipe, store)
    held = [name for name in result.proof.held if name in recipe.steps]
    return (
        recipe,
        result,
        run(replace(recipe, exact=True), store, dict.fromkeys([*recipe.outputs, *held])),
    )


def stated(result, full):
    """Raises where an error is larger than the run says, changes of digital numbers by rounding
    included.
    """
    for name in full.values.keys() & result.proof.held.keys():
        assert result.proof.held[name] <= result.proof.stated[name], name
        assert error_of(result[name], full[name]) <= max(result.proof.stated[name], 1e-6), name


def holds(recipe, result, full):
    """Raises where a value is not finite, light appears from nowhere, or an error is beyond its
    bound.
    """
    for name in recipe.outputs:
        assert bool(torch.isfinite(result[name]).all()), name
    stated(result, full)
    assert result.proof.worst <= recipe.tolerance
    for arm in ("plain", "mask"):
        assert error_of(result[f"raw[{arm}]"], full[f"raw[{arm}]"]) <= recipe.tolerance
        assert float(result[f"bsr[{arm}]"].max()) <= 1.0 + 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("seed", [13, 20])
def test_a_random_recipe_is_within_its_tolerance(seed, tmp_path):
    holds(*compared(seed, tmp_path))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(16))
def test_more_random_recipes_are_within_their_tolerance(seed, tmp_path):
    holds(*compared(seed, tmp_path))


@pytest.mark.parametrize(
    "seed", [68, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (40, 84))]
)
def test_numbers_that_rounding_changes_are_in_the_stated_error(seed, tmp_path):
    """One to 1700 of 120 000 numbers differed by one behind points: 1.1 to 9.4 times the error
    before rounding.

    Behind pixels that average over their area only those of seed 68 do.
    """
    recipe, store = random_recipes.draw_large(seed), Store(tmp_path)
    result, full = run(recipe, store), run(replace(recipe, exact=True), store)
    moved = any(
        error_of(result[name], full[name]) > bound for name, bound in result.proof.held.items()
    )
    assert moved == (seed == 68)
    stated(result, full)
    assert max(result.proof.stated.values()) < 4e-3  # and says more than "one number"
