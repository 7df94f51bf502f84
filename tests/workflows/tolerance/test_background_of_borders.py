"""The background suppression ratio of a recipe: at most 1 whatever the border, and without a
cube of all bands.
"""

import pytest
import torch

from neusee.workflows import load
from neusee.workflows.engine.runner import run
from neusee.workflows.store.result_store import Store

SMALL = [
    "optics.samples=135",
    "optics.pitch=59.84 um",
    "optics.bands=5",
    "scene.shape=[96, 96]",
    "sensor.shape=[48, 48]",
    "~restore",
    "steps.restored_quality=null",
    "outputs=[bsr, raw]",
    "laser=none",
    "doe.waves=[4]",
    "doe.orientation=90 deg",
]


def shares(store, *changes):
    return run(load("half_ring", [*SMALL, *changes]), Store(store))


@pytest.mark.parametrize("window", [64, 128])
def test_a_passive_mask_keeps_at_most_all_light_whatever_the_border(window, tmp_path):
    """Behind a mask that moves light to one side, the reflected scene brought in more light than
    was lost.
    """
    found = {}
    for border in ("zero", "reflect"):
        result = shares(tmp_path, f"optics.border={border}", f"optics.window=[{window}, {window}]")
        assert float(result["bsr[mask]"].max()) <= 1
        assert float(result["bsr[plain]"].max()) <= 1
        assert result.done["bsr[mask]"].state in ("run", "cached")
        found[border] = torch.stack([result["bsr[mask]"], result["bsr[plain]"]])
    torch.testing.assert_close(found["zero"], found["reflect"], rtol=0, atol=0)
    exact = shares(tmp_path, f"optics.window=[{window}, {window}]", "tolerance=0")
    full = torch.stack([exact["bsr[mask]"], exact["bsr[plain]"]])
    torch.testing.assert_close(found["zero"], full, rtol=1e-5, atol=0)
