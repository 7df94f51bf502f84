"""Shapes before a run, and what a run then gives."""

from dataclasses import replace

import pytest
import torch

from neusee.nodes import node
from neusee.nodes.values import Bands
from neusee.workflows.engine.cost_model import measured_size, shipped, sizes_of
from neusee.workflows.engine.runner import run
from neusee.workflows.engine.wanted_steps import steps_of, wanted
from neusee.workflows.graph.recipe_graph import needed
from neusee.workflows.graph.step_shapes import bytes_of, form_of, forms_of
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.result_store import Store
from neusee.workflows.tolerance.cheaper_steps import with_substitutions

#: changes of a recipe to two small sizes, none of them square
SIZES = {
    "small": [
        "scene.shape=[40,48]",
        "sensor.shape=[32,24]",
        "optics.samples=60",
        "optics.pitch=120 um",
        "optics.window=[36,44]",
        "optics.bands=7",
    ],
    "larger": [
        "scene.shape=[72,60]",
        "sensor.shape=[56,48]",
        "optics.samples=90",
        "optics.pitch=80 um",
        "optics.window=[65,64]",
        "optics.bands=9",
    ],
}
#: every recipe of the camera whose sizes may be changed freely: the others read maps and networks
#: of one size, and the grey scene of `axicon` needs one plane of the three that are predicted,
#: which its values alone tell
CAMERA = (
    "dirty_windshield",
    "five_half_rings",
    "half_ring",
    "hdr_night",
    "laser_free",
    "paper_table1",
)
LEARNT = ("train_small", "train")


def told(value):
    """Shape and type of each tensor of a value or of a form."""
    if isinstance(value, torch.Tensor):
        return tuple(value.shape), value.dtype
    if hasattr(value, "_asdict"):
        return type(value).__name__, {name: told(item) for name, item in value._asdict().items()}
    return None if value is None else [told(item) for item in value]


def compare(recipe, outputs, store):
    """Every step of a run has the shape, the type, the bytes and the size that were predicted."""
    recipe = with_substitutions(recipe, outputs)
    order = needed(recipe, outputs)
    forms, sizes = forms_of(recipe, order), sizes_of(recipe, order)
    result = run(recipe, store, outputs)
    assert result.recipe.tolerance_scale == 1.0, "the steps that were predicted are those that ran"
    for name in result.done:
        value, step = result.value(name), recipe.steps[name]
        assert told(forms[name]) == told(value), f"{name} ({step.node.path})"
        assert bytes_of(forms[name]) == bytes_of(value) == sizes[name].result
        assert sizes[name].known
        wires = (step.wires.get(i) for i in step.node.inputs)
        inputs = [
            w and (result.value(w) if isinstance(w, str) else [result.value(n) for n in w])
            for w in wires
        ]
        assert measured_size(step.node, inputs, step.params, value) == list(sizes[name][:4]), name


@pytest.mark.slow
def test_the_shapes_of_the_first_recipe_are_those_of_its_run(tmp_path):
    recipe = load("first_light", SIZES["small"])
    compare(recipe, ("raw[mask]", "lsr[mask]", "bsr[mask]", "truth", "peak[mask]"), Store(tmp_path))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["first_light", "dirty_windshield", "hdr_night", "laser_free"])
def test_the_shapes_of_a_recipe_are_those_of_its_run(name, tmp_path):
    """The other recipes of the camera have no nodes that these lack."""
    # the values of a night ask for a second attempt
    changes = [*SIZES["small"], "tolerance=0" if name == "hdr_night" else "seed=7"]
    recipe = load(name, changes)
    compare(recipe, wanted(recipe), Store(tmp_path))


@pytest.mark.slow
def test_the_shapes_of_every_step_in_full_are_those_of_its_run(tmp_path):
    recipe = load("first_light", [*SIZES["larger"], "tolerance=0"])
    compare(recipe, (*wanted(recipe), "radiance", "image[mask]"), Store(tmp_path))


@pytest.mark.slow
def test_the_shapes_of_a_learnt_mask_are_those_of_its_run(tmp_path):
    recipe = load("train_small", ["scene.shape=[96, 80]", "sensor.shape=[48,48]"])
    compare(recipe, ("height", "psf[mask]", "truth"), Store(tmp_path))


#: with nodes whose results have a shape by their values
CALIBRATED = ["calibrate", "calibrate_camera", "train_lift"]


@pytest.mark.parametrize(
    "name", ["first_light", "demonstration", "six_lasers", *CAMERA, *LEARNT, *CALIBRATED]
)
def test_every_step_of_a_shipped_recipe_has_a_shape_and_a_measured_law(name):
    recipe = load(name, [])
    recipe = with_substitutions(recipe, wanted(recipe))
    sizes = sizes_of(recipe, steps_of(recipe))
    assert [step for step, size in sizes.items() if not size.known] == []
    assert {recipe.steps[step].node.path for step in sizes} - shipped().keys() == set()


@node()
def countless() -> Bands:
    raise AssertionError("no node runs before the run")


countless.shape(
    lambda: Bands(*(torch.empty(10**8, dtype=torch.float64, device="meta") for _ in Bands._fields))
)


def test_more_bands_than_memory_can_hold_have_a_size_at_once():
    """The check of a recipe refuses so many bands, so the parameters are changed after it; bands
    of the user's own.
    """
    recipe = load("first_light", ["optics.bands=3"])
    steps = {**recipe.steps, "bands": replace(recipe.steps["bands"], node=countless, params={})}
    sizes = sizes_of(
        replace(recipe, steps=steps),
        ["bands", "stop", "flat", "index", "pupil[plain]", "psf[plain]"],
    )
    assert sizes["psf[plain]"].result == 1e8 * (512 * 512 * 4 + 3 * 8)
    assert sizes["psf[plain]"].bands == 10**8


def test_a_result_beyond_every_address_is_infinite_and_no_error():
    recipe = load("first_light", [])
    scene = recipe.steps["scene"]
    steps = {"scene": replace(scene, params={**scene.params, "shape": (10**10, 10**10)})}
    assert sizes_of(replace(recipe, steps=steps), ["scene"])["scene"].result == float("inf")


@node()
def own(x: torch.Tensor, *, factor: float = 2.0) -> torch.Tensor:
    raise AssertionError("no node runs before the run")


def test_a_node_without_a_rule_has_no_shape_and_does_not_run():
    assert form_of(own, [torch.empty(3, device="meta")], {}) is None


def test_a_rule_that_fails_leaves_the_error_to_the_step():
    @node()
    def odd(x: torch.Tensor) -> torch.Tensor:
        return x

    odd.shape(lambda x: x.shape[7])
    assert form_of(odd, [torch.empty(3, device="meta")], {}) is None


def test_a_rule_that_does_not_need_an_unknown_input_tells_the_shape():
    """A mask of the user's own has no rule; the pupil function, and with it the check of the PSF
    window, is known.
    """
    from neusee.nodes.optics import pupil, stop
    from neusee.nodes.spectra import bands

    three, grid = bands(start=4e-7, stop=7e-7, count=3), stop(samples=8, pitch=1e-5, diameter=8e-5)
    form = form_of(pupil, [None, None, three, grid, None], {})
    assert told(form) == told(pupil(torch.zeros(8, 8), torch.ones(3).double(), three, grid))
    assert torch.equal(form.wavelengths, three.centres)
    assert form_of(pupil, [torch.zeros(8, 8), None, None, grid, None], {}) is None


def test_a_rule_knows_what_the_header_of_a_picture_says(tmp_path):
    """The picture is stored on its side, and the EXIF orientation turns it upright."""
    from PIL import Image

    from neusee.nodes.scene import photograph

    orientation = Image.Exif()
    orientation[0x0112] = 6
    Image.new("RGB", (40, 24)).save(tmp_path / "a.jpg", exif=orientation)
    params = {"file": tmp_path / "a.jpg", "shape": None}
    assert (
        told(form_of(photograph, [], params))
        == told(photograph(**params))
        == ((3, 40, 24), torch.float32)
    )


def test_the_direction_of_a_laser_is_known_with_its_values():
    from neusee.nodes.optics import direction

    assert form_of(direction, [], {"angle": (1e-3, 2e-3)}).tolist() == [1e-3, 2e-3]
    assert told(form_of(direction, [], {"angle": None})) == ((2,), torch.float64)
