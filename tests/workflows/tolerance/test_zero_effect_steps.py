"""What is nothing by its parameters is not computed, and the result is what it was, to the last
bit.
"""

from dataclasses import replace

import pytest
import torch

from neusee.workflows import load
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.recipe_graph import needed
from neusee.workflows.store.result_store import Store
from neusee.workflows.tolerance.cheaper_steps import with_substitutions

SMALL = [
    "optics.samples=180",
    "optics.pitch=44.88 um",
    "optics.window=[48, 48]",
    "scene.shape=[64, 64]",
    "sensor.shape=[48, 48]",
    "optics.bands=5",
    "lasers.green.angle=[0.1 mrad, 0 mrad]",
    "~restore",
    "steps.restored_quality=null",
    "outputs=[raw, peak, lsr]",
]
CLEAN = [f"dirt.{name}=0" for name in ("dust", "scratches", "smudges")] + [
    "dirt.grease=0 waves",
    "dirt.dents=0 waves",
]
LASER = {
    "laser_psf",
    "laser_pupil",
    "laser_photons",
    "spot",
    "direction",
    "line",
    "laser_index",
    "laser_responses",
    "light",
    "wavefront",
}


def recipe(*changes, flare="dirty_windshield"):
    return load("first_light", [*SMALL, f"flare={flare}", *changes])


def asked(found):
    return {
        name.partition("[")[0]
        for name in needed(with_substitutions(found, found.outputs), found.outputs)
    }


CASES = [
    ((), set()),
    (("lasers.green.strength=0",), LASER | {"ghosts", "ghost_photons"}),
    (("ghosts.count=0",), {"ghosts", "ghost_photons"}),
    (("ghosts.energy=0",), {"ghosts", "ghost_photons"}),
    (CLEAN, {"dirt"}),
]


@pytest.mark.parametrize(
    ("changes", "gone"), CASES, ids=["all", "no light", "no ghosts", "no energy", "clean"]
)
def test_only_what_is_nothing_goes(changes, gone):
    everything = asked(recipe())
    assert everything >= LASER | {"ghosts", "ghost_photons", "dirt"}
    assert everything - asked(recipe(*changes)) == gone


def test_a_little_is_not_nothing():
    assert asked(recipe("lasers.green.strength=1e-30")) == asked(recipe())


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes", [("lasers.green.strength=0",), CLEAN, ("ghosts.count=0",)], ids=str
)
def test_the_result_is_the_same(changes, tmp_path):
    found = recipe("tolerance=0", *changes)
    spared = run(found, Store(tmp_path / "a"))
    full = run(replace(found, exact=True), Store(tmp_path / "b"))
    assert len(spared.done) < len(full.done)
    for name in found.outputs:
        one, other = spared[name], full[name]
        for a, b in zip(*(x if isinstance(x, tuple) else (x,) for x in (one, other)), strict=True):
            assert torch.equal(a, b), name
