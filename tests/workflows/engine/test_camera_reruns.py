"""On the paper's camera, made small: a change reruns what follows from it, and nothing else."""

import pytest

from neusee.workflows import load
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.recipe_graph import needed
from neusee.workflows.store.result_store import Store

SMALL = [
    "optics.samples=128",
    "optics.pitch=60 um",
    "optics.window=[64, 64]",
    "optics.bands=5",
    "sensor.shape=[48, 48]",
    "scene.shape=[64, 64]",
    "restore=null",
    "steps.restored_quality=null",
    "outputs=[raw, lsr, bsr, developed_quality]",
]
SCENE = (
    "bands",
    "illuminant",
    "responses",
    "cube",
    "radiance",
    "index",
    "pupil",
    "psf",
    "image",
    "scene_photons",
)


class KeepsAll(Store):
    """A store in which everything pays, so that what may be read is read."""

    def write_seconds(self, size):
        return 0.0

    def read_seconds(self, size):
        return 0.0


def camera(*more):
    return load("first_light", [*SMALL, *more])


def after(recipe, first):
    """Steps that come after ``first``, and these."""
    found = set(first)
    for name in needed(recipe, recipe.outputs):
        if found & set(recipe.steps[name].sources):
            found.add(name)
    return found


@pytest.fixture
def cold(tmp_path):
    result = run(camera(), KeepsAll(tmp_path))
    assert sum(done.state == "run" for done in result.done.values()) > 30
    return result


def ran(recipe, store):
    return {
        name for name, done in run(recipe, KeepsAll(store.root)).done.items() if done.state == "run"
    }


def test_another_read_noise_reruns_the_sensor_from_there_on(cold):
    recipe = camera("sensor.read_noise=20 e-")
    reads = {n for n, s in recipe.steps.items() if n.startswith("read[") or n == "transfer"}
    found = ran(recipe, cold.store)
    assert {"read[plain]", "read[mask]", "raw[plain]", "raw[mask]"} <= found
    assert found <= after(recipe, reads)


def test_another_wavelength_of_the_laser_reruns_no_step_of_the_scene(cold):
    recipe = camera("lasers.green.wavelength=550 nm")
    found = ran(recipe, cold.store)
    assert {"line[green]", "laser_psf[mask,green]", "raw[mask]"} <= found
    assert not [name for name in found if name.partition("[")[0] in SCENE]


def test_going_back_finds_the_old_results(cold):
    run(camera("sensor.read_noise=20 e-"), KeepsAll(cold.store.root))
    assert ran(camera(), cold.store) == set()
