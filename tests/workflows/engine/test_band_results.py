"""Results by band: what has changed is computed and written, the rest is found, and every bit is
as if it were not.
"""

import os

import pytest
import torch

import neusee
from neusee.nodes import Node
from neusee.nodes.optics import image, psf
from neusee.nodes.spectra import illuminate
from neusee.nodes.values import LowRankCube, Psf, Pupil
from neusee.workflows import RunError, Store, load
from neusee.workflows.engine import node_call as band_results
from neusee.workflows.engine.node_call import call, call_by_band, plain_of
from neusee.workflows.graph.errors import Location
from neusee.workflows.graph.recipe_graph import Step, in_order
from neusee.workflows.store import serialization
from neusee.workflows.store.band_files import Blobs, Stacked
from neusee.workflows.store.metadata import checked_layout

LENS = {"focal_length": 0.11, "pixel_pitch": 2.9e-6, "shape": (32, 64)}
BANDS = 6


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Small results too are kept by band."""
    monkeypatch.setattr(band_results, "LEAST", 0)


@pytest.fixture
def blobs(tmp_path):
    return Blobs(tmp_path / "bands")


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


def changed(x, *which):
    x = x.clone()
    x[list(which)] *= 1.01
    return x


class Made:
    """A step by band, that counts what it computes."""

    def __init__(self, node, blobs, code="code", store=True, **params):
        self.step = Step("s", node, params, {}, Location("here.yaml"), {})
        self.blobs, self.code, self.store, self.computed = blobs, code, store, []

    def __call__(self, *inputs, parts=1):
        self.computed = []
        value = call_by_band(
            self.step, inputs, self.evaluate, self.code, Blobs(self.blobs.root), parts
        )
        if self.store:
            self.layout, self.tensors = serialization.pack(value, Blobs(self.blobs.root))
        return value

    def evaluate(self, inputs):
        self.computed.append(band_results.band_count(self.step, inputs))
        return call(self.step, inputs, self.step.params, 0, "cpu")


def files(blobs):
    return {path for path in blobs.root.glob("*/*") if path.is_file()}


def same(found, expected):
    found, expected = (x if isinstance(x, tuple) else (x,) for x in (plain_of(found), expected))
    return all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


def test_the_first_time_all_is_computed_at_once_and_kept_by_band(blobs):
    made, inputs = Made(image, blobs), light()
    value = made(*inputs)
    assert isinstance(value, Stacked)
    assert made.computed == [BANDS]
    assert same(value, image(*inputs))
    assert len(files(blobs)) == len(set(value.names)) == BANDS
    assert torch.equal(
        serialization.unpack(made.layout, made.tensors, Blobs(blobs.root)), image(*inputs)
    )


def test_of_one_changed_band_one_is_computed_and_written(blobs):
    made, (scene, kernel) = Made(image, blobs), light()
    made(scene, kernel)
    before = {path: path.stat().st_mtime_ns for path in files(blobs)}
    value = made(changed(scene, 2), kernel)
    assert made.computed == [1]
    assert same(value, image(changed(scene, 2), kernel))
    assert len(files(blobs) - before.keys()) == 1
    assert {path: path.stat().st_mtime_ns for path in before} == before
    made(scene, kernel)
    assert made.computed == []


def test_bands_of_a_named_tuple_are_told_apart_too(blobs):
    made, (scene, kernel) = Made(image, blobs), light()
    made(scene, kernel)
    other = kernel._replace(intensity=changed(kernel.intensity, 0, 5))
    assert same(made(scene, other), image(scene, other))
    assert made.computed == [2]


def test_a_result_of_several_tensors_is_kept_by_band(blobs):
    made, at = Made(psf, blobs, **LENS, pixel="zoh"), pupil()
    assert same(made(at, None), psf(at, **LENS, pixel="zoh"))
    assert len(files(blobs)) == len(Psf._fields) * BANDS
    other = at._replace(index=changed(at.index, 3))
    value = made(other, None)
    assert made.computed == [1]
    assert type(value) is Psf
    assert same(value, psf(other, **LENS, pixel="zoh"))


@pytest.mark.parametrize("which", [[4, 2], [0, 0, 5], [5, 4, 3, 2, 1, 0]])
def test_any_bands_in_any_order_are_found_again(blobs, which):
    made, (scene, kernel) = Made(image, blobs), light()
    made(scene, kernel)
    picked = scene[which], Psf(kernel.intensity[which], kernel.clear_peak[which])
    assert same(made(*picked), image(*picked))
    assert made.computed == []


def test_what_all_bands_share_changes_all_of_them(blobs):
    at = pupil()
    Made(psf, blobs, **LENS, pixel="zoh")(at, None)
    tilted = torch.tensor([1e-4, 0.0], dtype=torch.float64)
    for made, inputs in (
        (Made(psf, blobs, **LENS, pixel="zoh", code="other"), (at, None)),
        (Made(psf, blobs, **{**LENS, "shape": (64, 64)}, pixel="zoh"), (at, None)),
        (Made(psf, blobs, **LENS, pixel="zoh"), (at, tilted)),
        (Made(psf, blobs, **LENS, pixel="zoh"), (at._replace(height=at.height + 1e-7), None)),
    ):
        made(*inputs)
        assert made.computed == [BANDS]


@pytest.mark.parametrize(
    ("parts", "computed"), [(2, [3, 3]), (4, [2, 2, 2]), (6, [1] * 6), (99, [1] * 6)]
)
@pytest.mark.parametrize("border", ["zero", "reflect"])
def test_in_parts_it_is_the_same_to_the_last_bit(blobs, parts, computed, border):
    made, inputs = Made(image, blobs, border=border), light()
    value = made(*inputs, parts=parts)
    assert made.computed == computed
    assert isinstance(value, Stacked)
    assert same(value, image(*inputs, border=border))


def test_in_parts_only_what_is_missing_is_computed(blobs):
    made, (scene, kernel) = Made(image, blobs), light()
    made(scene, kernel)
    other = changed(scene, 1, 3, 4)
    assert same(made(other, kernel, parts=3), image(other, kernel))
    assert made.computed == [2, 1]


def damage(path):
    data = bytearray(path.read_bytes())
    data[100] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize("harm", [damage, os.unlink, lambda path: path.write_bytes(b"")])
def test_a_damaged_band_alone_is_computed_again(blobs, harm):
    made, (scene, kernel) = Made(image, blobs), light()
    names = made(scene, kernel).names
    harm(blobs.root / names[3][:2] / names[3])
    other = changed(scene, 0)
    assert same(made(other, kernel), image(other, kernel))
    assert sum(made.computed) == 2
    assert same(made(scene, kernel), image(scene, kernel))
    assert made.computed == []


def test_a_store_that_takes_nothing_costs_no_result(blobs, monkeypatch):
    made, (scene, kernel) = Made(image, blobs), light()
    made(scene, kernel)

    def refuse(self, name, x):
        raise OSError(28, "no space left on device")

    monkeypatch.setattr(Blobs, "write", refuse)
    other, made.store = changed(scene, 2, 5), False
    for parts in (1, 3):
        assert same(made(other, kernel, parts=parts), image(other, kernel))
        assert sum(made.computed) == 2
    assert same(
        Made(image, blobs, store=False, border="reflect")(scene, kernel, parts=3),
        image(scene, kernel, border="reflect"),
    )


def test_bands_that_are_not_the_first_axis_are_computed_in_parts_and_kept_whole(blobs):
    scene = rand(2, BANDS, 32, 64)
    made, kernel = Made(image, blobs, store=False), light()[1]
    for parts, computed in ((1, [BANDS]), (3, [2, 2, 2])):
        value = made(scene, kernel, parts=parts)
        assert made.computed == computed
        assert torch.equal(value, image(scene, kernel))
    assert files(blobs) == set()


def test_a_small_result_is_kept_whole(blobs, monkeypatch):
    monkeypatch.setattr(band_results, "LEAST", 1 << 20)
    value = Made(image, blobs)(*light())
    assert isinstance(value, torch.Tensor)
    assert files(blobs) == set()


def test_a_node_without_bands_is_only_called(blobs):
    made = Made(Node(lambda light: light + 1), blobs)
    assert torch.equal(made(torch.ones(3, 4)), torch.full((3, 4), 2.0))
    assert files(blobs) == set()


def test_a_scene_in_few_planes_has_no_band_to_compute_alone(blobs):
    mixed = LowRankCube(
        rand(2, 64, 64),
        rand(BANDS, 2, dtype=torch.float64),
        torch.zeros(3, BANDS, dtype=torch.float64),
    )
    power = rand(BANDS, dtype=torch.float64)
    step = Step("radiance", illuminate, {"times": "once"}, {}, Location("test"), {})
    found = call_by_band(step, [mixed, power], lambda given: illuminate(*given), "code", blobs)
    torch.testing.assert_close(found.basis, mixed.basis * power[:, None])
    assert not files(blobs)


def test_bands_that_differ_are_left_to_the_node_to_refuse(blobs):
    with pytest.raises(RunError, match="same `bands` step"):
        Made(illuminate, blobs)(rand(3, 4, 5), rand(4))


def test_a_single_band_is_computed_whole(blobs):
    value = Made(image, blobs)(*light(bands=1))
    assert isinstance(value, torch.Tensor)


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


def walk(recipe, blobs):
    """Every value of a recipe, and how many bands each step that has any computed."""
    values, computed = {}, {}
    for name in in_order({n: list(step.sources) for n, step in recipe.steps.items()}, recipe.steps):
        step = recipe.steps[name]
        made = Made(step.node, blobs, **step.params)
        values[name] = plain_of(
            made(*(values[step.wires[i]] if step.wires.get(i) else None for i in step.node.inputs))
        )
        if step.node.bands:
            computed[name] = sum(made.computed)
    return values, computed


def test_one_filter_of_five_that_moves_costs_one_fifth(write, blobs):
    path = write(CAMERA)
    assert walk(load(path), blobs)[1] == {"radiance": 5, "psf": 5, "image": 5}
    moved = "filters.centres=[450 nm, 500 nm, 552 nm, 600 nm, 650 nm]"
    values, computed = walk(load(path, (moved,)), blobs)
    assert computed["psf"] == computed["image"] == 1
    expected = walk(load(path, (moved,)), Blobs(blobs.root.parent / "other"))[0]
    assert torch.equal(values["image"], expected["image"])
    assert walk(load(path), blobs)[1] == {"radiance": 0, "psf": 0, "image": 0}


def test_a_run_shares_the_bands_that_stayed(write, tmp_path):
    path = write(CAMERA)
    store, moved = (
        Store(tmp_path / "cache"),
        "filters.centres=[450 nm, 500 nm, 552 nm, 600 nm, 650 nm]",
    )
    first, found = (
        neusee.run(load(path), store=store),
        neusee.run(load(path, (moved,)), store=store),
    )
    expected = neusee.run(load(path, (moved,)), store=Store(tmp_path / "other"))
    for name, written in (("psf", len(Psf._fields)), ("image", 1)):
        assert found.done[name].state == "run"
        before, after = (
            set(checked_layout(store.about(run.keys[name])["layout"])) for run in (first, found)
        )
        assert len(after) == 5 * written
        assert len(after - before) == written
        assert same(found.values[name], expected.values[name])
        assert same(Store(store.root).get(found.keys[name]), expected.values[name])


def test_a_damaged_band_of_a_stored_result_is_mended(write, tmp_path):
    recipe, root = load(write(CAMERA)), tmp_path / "cache"
    first = neusee.run(recipe, store=Store(root))
    for path in sorted(files(Store(root).blobs))[::4]:
        damage(path) if path.stat().st_size > 200 else path.unlink()
    with pytest.warns(UserWarning, match="counts as missing"):
        again = neusee.run(recipe, store=Store(root))
    assert all(same(again.values[name], first.values[name]) for name in first.values)
    assert all(
        done.state == "cached"
        for done in neusee.run(recipe, store=Store(root)).done.values()
        if done.state != "not needed"
    )
