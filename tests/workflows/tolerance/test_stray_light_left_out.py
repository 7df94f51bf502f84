"""Stray light in a recipe: every PSF has it, and a tolerance omits it only where the scene does
not need it.
"""

import pytest

from neusee.workflows.engine.runner import run
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.result_store import Store

SMALL = [
    "optics.samples=64",
    "optics.pitch=126.2 um",
    "optics.bands=3",
    "optics.window=[48, 48]",
    "scene.shape=[48, 48]",
    "sensor.shape=[40, 40]",
    "scene=edge",
]
LENS = "stray_light.surfaces.lens"


def small(*changes, flare="stray_light"):
    return load("plain_lens", [f"flare={flare}", *SMALL, *changes])


@pytest.fixture
def states(tmp_path):
    def states(*changes, outputs=("lsr[plain]", "spot[plain,green]")):
        done = run(small(*changes), Store(tmp_path), outputs)
        return {name: record.state for name, record in done.done.items()}

    return states


def test_the_group_puts_the_psf_of_the_camera_behind_stray_light():
    with_veil, without = small().steps, small(flare="clean").steps
    for name in ("psf[plain]", "psf[mask]", "laser_psf[plain,green]"):
        lens = with_veil[f"lens_{name}"]
        assert (lens.node, dict(lens.wires), lens.params) == (
            without[name].node,
            dict(without[name].wires),
            without[name].params,
        )
        assert with_veil[name].node.path == "flare.stray_light"
        assert with_veil[name].wires["psf"] == f"lens_{name}"
    for reader in ("image[mask]", "spot[mask,green]", "lsr[plain]", "deconvolved"):
        assert with_veil[reader].wires["psf"] == without[reader].wires["psf"]


def test_dirt_ghosts_and_stray_light_together():
    nodes = {step.node.path for step in small(flare="dirty_stray_light").steps.values()}
    assert nodes >= {"flare.dirt", "flare.ghosts", "flare.stray_light"}


def test_faint_scatter_is_left_out_of_a_scene_and_never_of_a_laser(states):
    found = states(f"{LENS}.b0=1e-3")
    assert found["psf[plain]"] == "left out"
    assert found["laser_psf[plain,green]"] == "run"


def test_scatter_that_a_scene_needs_is_computed(states):
    assert states()["psf[plain]"] == "run"
    assert states(f"{LENS}.b0=1e-3", "stray_light.strength=1e9")["psf[plain]"] == "run"
    assert states(f"{LENS}.b0=1e-3", "tolerance=0")["psf[plain]"] == "run"


def test_a_lens_without_scatter_is_no_step_at_all(states):
    found = states(f"{LENS}.b0=0", "tolerance=0")
    assert {found["psf[plain]"], found["laser_psf[plain,green]"]} == {"left out"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (f"{LENS}.b0=-1", "must be greater than or equal to 0"),
        (f"{LENS}.l=0", "must be greater than 0"),
        (f"{LENS}.s=1", "must be less than or equal to 0"),
        (f"{LENS}.radius=3", "needs a unit"),
        (
            f"{LENS}.b0=1e4",
            "surface lens scatters 113 of the light at 550 nm, and the limit is below 1",
        ),
        (f"{LENS}.radius=2 um", "this surface lies on the sensor; choose a larger radius"),
        ("stray_light.scaling=rough", "'none' or 'roughness'"),
    ],
)
def test_mistakes_are_located(change, message):
    from neusee.workflows.graph.errors import RecipeError

    with pytest.raises(RecipeError) as error:
        small(change)
    assert message in str(error.value)
    assert "stray_light" in str(error.value)
