"""What ships trained: it is small, it fits its recipes, and it restores better than the told
filter.
"""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import neusee
from neusee.nodes.scene import Photographs
from neusee.workflows import Store, load
from neusee.workflows.training.training_pictures import HELD_OUT, PictureSource
from tests.benchmarks.bench_informed import STEPS, Judged, judged_frame, words
from tests.nodes.restore.lasers import own_camera

SAMPLES = Path(__file__).parents[3] / "recipes" / "samples"
WEIGHTS = SAMPLES / "neusee_network.safetensors"


def test_all_data_that_ships_is_less_than_a_megabyte():
    assert sum(path.stat().st_size for path in SAMPLES.rglob("*") if path.is_file()) < 1_000_000


@pytest.mark.parametrize(
    ("recipe", "words"),
    [("demonstration", []), ("first_light", ["restore=neusee"])],
)
def test_the_weights_fit_the_recipes_that_name_them(recipe, words):
    filtered = load(recipe, words).steps["deconvolved"]  # refuses weights of another network
    assert filtered.node.path == "restore.informed"
    assert filtered.params["weights"].resolve() == WEIGHTS.resolve()


def test_the_demonstration_shows_the_network_beside_the_filter():
    recipe = load("demonstration")
    assert recipe.steps["height"].params["file"].name == "demonstration_mask.png"
    assert {"restored", "wiener", "wiener_quality"} <= set(recipe.outputs)


@pytest.mark.slow
def test_the_network_is_better_than_the_told_filter_and_no_worse_than_the_best_on_scenes_that_no_training_saw(
    tmp_path,
):
    """Drawn leaves, which no photograph shows; a lens and a laser not as the filter is told, and
    three masks.
    """
    scenes = [own_camera.picture("leaves", 224, np.random.default_rng(seed)) for seed in range(2)]
    for number, scene in enumerate(scenes):
        Image.fromarray((255 * scene ** (1 / 2.2)).round().astype(np.uint8)).save(
            tmp_path / f"{number}.png"
        )
    photographs = Photographs.under(tmp_path)
    file = tmp_path / "judged.yaml"
    file.write_text(
        (SAMPLES.parent / "train_informed.yaml").read_text().replace("samples/", f"{SAMPLES}/")
        + STEPS
    )
    over_told, over_best = [], []
    for mask in ("plain", "half_ring", "designed"):
        recipe = load(file, words(mask))
        source = PictureSource(photographs, Store(tmp_path / "cache"), held_out=photographs.paths)
        stream = Judged(recipe, recipe.training, source, frozen=recipe)
        for number, strength in enumerate((1e3, 1e5)):
            stream.strength = strength
            found, kept = stream({}, HELD_OUT, number)
            psnr = judged_frame(WEIGHTS, 12, kept)["psnr"]
            over_told.append(psnr - found["told"]["psnr"])
            over_best.append(psnr - found["uncertain"]["psnr"])
    assert np.mean(over_told) > 1.0, over_told
    assert np.mean(over_best) > -0.1, over_best
    assert min(over_best) > -0.5, over_best


@pytest.mark.slow
def test_the_demonstration_is_better_than_its_filter_behind_a_mask_that_suppresses(tmp_path):
    """Its photograph was one of the training; the filter is told the laser exactly, the network
    roughly.
    """
    found = neusee.run(
        load("demonstration"),
        store=Store(tmp_path),
        outputs=["restored_quality", "wiener_quality", "developed_quality[mask]", "lsr[mask]"],
    )
    restored, wiener = found["restored_quality"], found["wiener_quality"]
    assert float(restored.l1) < float(wiener.l1) < float(found["developed_quality[mask]"].l1)
    assert float(restored.psnr) > float(wiener.psnr)
    assert float(found["lsr[mask]"].mean()) < 0.0103  # of a half-ring of 20 waves
