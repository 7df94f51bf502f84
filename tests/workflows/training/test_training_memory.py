"""What one iteration of learning holds in memory: one picture's graph, a few numbers for each
pixel and band.
"""

import importlib.util
from pathlib import Path

import pytest

from neusee.nodes.scene import Photographs
from neusee.workflows import Store, load
from neusee.workflows.training.training_iteration import Learner
from neusee.workflows.training.training_pictures import PictureSource, TrainingStream

SPEC = importlib.util.spec_from_file_location(
    "live_bytes", Path(__file__).parents[2] / "live_bytes.py"
)
live_bytes = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(live_bytes)
SIDE, NET = 96, 32

pytestmark = pytest.mark.usefixtures("one_thread")


def peak(folder, bands, batch):
    """The most bytes that live at once in the second iteration of stage 1, beside what lives
    between iterations.
    """
    shapes = [
        f"{name}=[{SIDE}, {SIDE}]" for name in ("scene.shape", "sensor.shape", "optics.window")
    ]
    small = [
        "optics.samples=101",
        "optics.pitch=79.98 um",
        f"optics.bands={bands}",
        "doe.grid=16",
        f"train.size=[{NET}, {NET}]",
    ]
    nets = ["train.network.kind=unet", "train.network.width=2", "train.critics.width=2"]
    recipe = load("train", [*shapes, *small, *nets, f"train.stages.1.batch={batch}"])
    photographs = Photographs((recipe.steps["scene"].params["file"],))
    with live_bytes.LiveBytes() as live:
        learner = Learner(recipe, recipe.training, "cpu")
        samples = TrainingStream(recipe, recipe.training, PictureSource(photographs, Store(folder)))
        learner.begin(recipe.training.stages[1], True)
        learner.iterate(samples, 1, 0)
        live.again()
        before = live.now
        learner.iterate(samples, 1, 1)
        return live.peak - before


@pytest.mark.slow
def test_a_picture_more_costs_its_estimate_and_a_band_more_a_few_numbers_a_pixel(tmp_path):
    """111 and 21 bytes were found; 733 where the fields of each picture live on, 2285 where its
    whole graph does.
    """
    usual = peak(tmp_path, 5, 1)
    assert (peak(tmp_path, 5, 3) - usual) / 2 / NET**2 < 200
    assert (peak(tmp_path, 21, 1) - usual) / 16 / SIDE**2 < 24
