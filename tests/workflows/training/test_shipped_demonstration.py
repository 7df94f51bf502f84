"""What ships trained: it is small, it fits its recipes, and on first light's photograph it helps the filter."""

from pathlib import Path

import pytest

from neusee.workflows import Store, load

SAMPLES = Path(__file__).parents[3] / "recipes" / "samples"


def test_all_data_that_ships_is_less_than_a_megabyte():
    assert sum(path.stat().st_size for path in SAMPLES.rglob("*") if path.is_file()) < 1_000_000


def test_what_ships_fits_its_recipes():
    recipe = load("demonstration")  # refuses a relief of another grid, and weights of another network
    assert recipe.steps["height"].params["file"].name == "demonstration_mask.png"
    assert recipe.steps["restored"].params["weights"].name == "demonstration_network.safetensors"
    assert {"restored", "wiener", "wiener_quality"} <= set(recipe.outputs)


@pytest.mark.slow
def test_the_network_restores_better_than_the_filter_behind_a_mask_that_suppresses(tmp_path):
    """On a photograph that it never saw, with the recipe's own laser."""
    found = load("demonstration").run(
        Store(tmp_path), outputs=["restored_quality", "wiener_quality", "developed_quality[mask]", "lsr[mask]"]
    )
    restored, wiener = found["restored_quality"], found["wiener_quality"]
    assert float(restored.l1) < float(wiener.l1) < float(found["developed_quality[mask]"].l1)
    assert float(restored.psnr) > float(wiener.psnr)
    assert float(found["lsr[mask]"].mean()) < 0.0103  # of a half-ring of 20 waves
