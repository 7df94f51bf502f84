"""Passes over the bands: a step that is computed in parts has every bit of its result as if it were
computed whole.
"""

import pytest
import torch

import neusee
from neusee.nodes import Node
from neusee.nodes.optics import image, psf
from neusee.nodes.spectra import illuminate
from neusee.nodes.values import LowRankCube, Psf, Pupil
from neusee.workflows import RunError, Store, load
from neusee.workflows.engine.node_call import band_count, call, call_in_parts
from neusee.workflows.graph.errors import Location
from neusee.workflows.graph.recipe_graph import Step

LENS = {"focal_length": 0.11, "pixel_pitch": 2.9e-6, "shape": (32, 64)}
BANDS = 6


def rand(*shape, seed=0, dtype=torch.float32):
    return torch.rand(*shape, dtype=dtype, generator=torch.Generator().manual_seed(seed))


def light(seed=0, bands=BANDS):
    return rand(bands, 32, 64, seed=seed), Psf(
        rand(bands, 9, 9), torch.ones(bands, dtype=torch.float64)
    )


def pupil(bands=BANDS):
    waves = torch.linspace(400e-9, 700e-9, bands, dtype=torch.float64)
    flat = torch.ones(24, 24)
    return Pupil(
        flat,
        flat,
        0 * flat,
        0 * flat,
        0.46 + 0 * waves,
        waves,
        torch.tensor(2e-4, dtype=torch.float64),
    )


class Made:
    """A step by band, that counts what it computes."""

    def __init__(self, node, **params):
        self.step = Step("s", node, params, {}, Location("here.yaml"), {})
        self.computed = []

    def __call__(self, *inputs, parts=1):
        self.computed = []
        return call_in_parts(self.step, inputs, self.evaluate, parts)

    def evaluate(self, inputs):
        self.computed.append(band_count(self.step, inputs))
        return call(self.step, inputs, self.step.params, 0, "cpu")


def same(found, expected):
    found, expected = (x if isinstance(x, tuple) else (x,) for x in (found, expected))
    return all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


def test_a_result_of_several_tensors_is_computed_in_parts():
    made, at = Made(psf, **LENS, pixel="zoh"), pupil()
    value = made(at, None, parts=3)
    assert made.computed == [2, 2, 2]
    assert type(value) is Psf
    assert same(value, psf(at, **LENS, pixel="zoh"))


@pytest.mark.parametrize(
    ("parts", "computed"), [(2, [3, 3]), (4, [2, 2, 2]), (6, [1] * 6), (99, [1] * 6)]
)
@pytest.mark.parametrize("border", ["zero", "reflect"])
def test_in_parts_it_is_the_same_to_the_last_bit(parts, computed, border):
    made, inputs = Made(image, border=border), light()
    value = made(*inputs, parts=parts)
    assert made.computed == computed
    assert same(value, image(*inputs, border=border))
    assert value.is_contiguous()


def test_bands_that_are_not_the_first_axis_are_computed_in_parts():
    scene = rand(2, BANDS, 32, 64)
    made, kernel = Made(image), light()[1]
    for parts, computed in ((1, [BANDS]), (3, [2, 2, 2])):
        value = made(scene, kernel, parts=parts)
        assert made.computed == computed
        assert torch.equal(value, image(scene, kernel))


def test_a_node_without_bands_is_only_called():
    made = Made(Node(lambda light: light + 1))
    assert torch.equal(made(torch.ones(3, 4), parts=3), torch.full((3, 4), 2.0))


def test_a_scene_in_few_planes_has_no_band_to_compute_alone():
    mixed = LowRankCube(
        rand(2, 64, 64),
        rand(BANDS, 2, dtype=torch.float64),
        torch.zeros(3, BANDS, dtype=torch.float64),
    )
    power = rand(BANDS, dtype=torch.float64)
    step = Step("radiance", illuminate, {"times": "once"}, {}, Location("test"), {})
    found = call_in_parts(step, [mixed, power], lambda given: illuminate(*given), 3)
    torch.testing.assert_close(found.basis, mixed.basis * power[:, None])


def test_bands_that_differ_are_left_to_the_node_to_refuse():
    with pytest.raises(RunError, match="same `bands` step"):
        Made(illuminate)(rand(3, 4, 5), rand(4), parts=2)


def test_a_single_band_is_computed_whole():
    made = Made(image)
    made(*light(bands=1), parts=3)
    assert made.computed == [1]


CAMERA = """
outputs: [psf, image]
filters: {centres: [450 nm, 500 nm, 550 nm, 600 nm, 650 nm], widths: [20 nm, 20 nm, 10 nm, 20 nm, 20 nm]}
steps:
  bands: {node: spectra.filters, with: {centres: "${filters.centres}", widths: "${filters.widths}"}}
  light: {node: spectra.illuminant, from: bands, with: {kind: E}}
  scene: {node: scene.targets, with: {kind: siemens, shape: [32, 64]}}
  cube: {node: spectra.lift_mallett, from: {rgb: scene, bands: bands}}
  radiance: {node: spectra.illuminate, from: {reflectance: cube, illuminant: light}}
  index: {node: doe.material, from: bands}
  stop: {node: optics.stop, with: {samples: 32, pitch: 250 um, diameter: 8 mm}}
  height: {node: doe.axicon, from: stop, with: {waves: 1}}
  pupil: {node: optics.pupil, from: {height: height, index: index, bands: bands, stop: stop}}
  psf: {node: optics.psf, from: pupil, with: {focal_length: 0.1 m, pixel_pitch: 2.9 um, shape: [32, 32], pixel: zoh}}
  image: {node: optics.image, from: {radiance: radiance, psf: psf}}
"""


def test_one_filter_of_five_that_moves_gives_what_a_new_cache_gives(write, tmp_path):
    path = write(CAMERA)
    store = Store(tmp_path / "cache")
    moved = "filters.centres=[450 nm, 500 nm, 552 nm, 600 nm, 650 nm]"
    neusee.run(load(path), store=store)
    found = neusee.run(load(path, (moved,)), store=store)
    expected = neusee.run(load(path, (moved,)), store=Store(tmp_path / "other"))
    for name in ("psf", "image"):
        assert found.done[name].state == "run"
        assert same(found.values[name], expected.values[name])
        assert same(Store(store.root).get(found.keys[name]), expected.values[name])
