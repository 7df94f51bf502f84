"""The Python side: changes as Python values, runs from several threads, arrays out, and what a notebook shows."""

from __future__ import annotations

from pathlib import Path

import numpy
import pytest
import torch

from neusee.workflows import RecipeError, load

CAMERA = """\
# A camera of toys.
sensor: {gain: 0.5, read_noise: 10 e-, bits: 12}
optics: {window: [8, 8], device: cpu}
lasers:
  green: {wavelength: 532 nm, strength: 1e3}
  red: {wavelength: 638 nm, strength: 2e3}
seed: 7
steps:
  height: {node: toy.height}
  pupil: {node: toy.pupil, from: height, with: {pitch: 3.74 um}}
  psf:
    node: toy.psf
    each: lasers
    from: pupil
    with: {shape: "${optics.window}", wavelength: "${item.wavelength}"}
    device: ${optics.device}
  spot: {node: toy.spot, each: lasers, from: psf, with: {strength: "${item.strength}"}}
  sum: {node: toy.gather, from: {photons: height, lasers: spot, ghosts: null}}
  raw:
    node: toy.digitize
    from: sum
    with: {gain: "${sensor.gain}", sigma: "${sensor.read_noise}", bits: "${sensor.bits}"}
outputs: [raw]
"""


@pytest.fixture
def given(toy, write, tmp_path):
    """Load the camera of toys with changes as Python values."""
    return lambda *overrides, **values: load(write(CAMERA), overrides, tmp_path, **values)


@pytest.fixture
def refused(given):
    """What changes are refused with: one line each."""

    def refused(**values):
        with pytest.raises(RecipeError) as caught:
            given(**values)
        return [" | ".join(filter(None, (str(p.mark), p.path, p.message))) for p in caught.value.problems]

    return refused


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"sensor": {"read_noise": "20 e-"}}, ["sensor.read_noise=20 e-"]),
        ({"sensor.read_noise": "20 e-"}, ["sensor.read_noise=20 e-"]),
        ({"sensor": {"bits": 10, "gain": 0.25}}, ["sensor.bits=10", "sensor.gain=0.25"]),
        ({"lasers": {"green": {"strength": 1e4}}}, ["lasers.green.strength=1e4"]),
        ({"lasers.green": {"strength": 1e4}}, ["lasers.green.strength=1e4"]),
        ({"lasers": {}}, ["lasers={}"]),
        ({"optics": {"window": (16, 4)}}, ["optics.window=[16, 4]"]),
        ({"optics.window.0": 2}, ["optics.window.0=2"]),
        ({"seed": 3, "outputs": ["sum"], "tolerance": 0}, ["seed=3", "outputs=[sum]", "tolerance=0"]),
        ({"~lasers.red": None}, ["~lasers.red"]),
        (
            {"+lasers.blue": {"wavelength": "450 nm", "strength": 5}},
            ["+lasers.blue={wavelength: 450 nm, strength: 5}"],
        ),
        ({"steps": {"psf": {"with": {"shape": [2, 2]}}}}, ["steps.psf.with.shape=[2, 2]", "~optics.window"]),
        ({"steps": {"height": {"node": "toy.height", "with": {"samples": 8}}}}, ["steps.height.with.samples=8"]),
        ({"steps": {"raw": {"device": "cuda:1"}}}, ["steps.raw.device=cuda:1"]),
    ],
)
def test_python_values_are_what_the_command_line_says(given, values, words):
    if "~optics.window" in words:
        values = values | {"~optics.window": None}
    one, other = given(**values), given(*words)
    assert (one.seed, one.tolerance, one.outputs) == (other.seed, other.tolerance, other.outputs)
    assert list(one.steps) == list(other.steps)
    for name, step in one.steps.items():
        same = other.steps[name]
        assert (step.node, step.params, step.wires, step.device) == (same.node, same.params, same.wires, same.device)


def test_positional_changes_come_first_and_keywords_win(given):
    recipe = given("sensor.bits=10", "sensor.gain=2", sensor={"bits": 8})
    assert (recipe.steps["raw"].params["bits"], recipe.steps["raw"].params["gain"]) == (8, 2)
    assert recipe.config["sensor.bits"].source == "argument sensor.bits"
    assert recipe.config["sensor.gain"].source == "argument 2"


def test_numbers_of_numpy_and_torch_and_paths_are_values(given, write):
    recipe = given(sensor={"gain": numpy.float64(2), "bits": torch.tensor(8)}, optics={"window": numpy.array([2, 4])})
    assert {name: recipe.steps["raw"].params[name] for name in ("gain", "bits")} == {"gain": 2.0, "bits": 8}
    assert recipe.steps["psf[red]"].params["shape"] == (2, 4)
    picture = write("x", "picture.png")
    recipe = given(**{"+steps.photo": {"node": "toy.photograph", "with": {"file": Path("picture.png")}}})
    assert recipe.steps["photo"].params["file"] == picture


def test_groups_are_chosen_by_keyword():
    recipe = load("first_light", doe="axicon", sensor={"read_noise": "20 e-"}, lasers={"green": {"strength": 1e4}})
    assert recipe.steps["height"].node.path == "doe.axicon"
    assert recipe.steps["read[mask]"].params["sigma"] == 20
    assert recipe.steps["spot[mask,green]"].params["strength"] == 1e4
    assert any("not compared" in note for note in recipe.notes)


@pytest.mark.parametrize(
    ("values", "lines"),
    [
        (
            {"sensor": {"read_nois": "20 e-"}},
            ["argument sensor.read_nois | sensor.read_nois=20 e- | unknown; did you mean sensor.read_noise?"],
        ),
        (
            {"sensor": {"read_noise": 20, "bits": 0}},
            [
                "argument sensor.bits | sensor.bits = 0 | must be greater than or equal to 1",
                "argument sensor.read_noise | sensor.read_noise = 20 | needs a unit: write 20 e- (one of e-, ke-)",
            ],
        ),
        (
            {"sensor.bits": object(), "optics": {"window": {1.5: 2}}},
            [
                "argument optics | optics.window | a key is a name or a whole number, not 1.5",
                "argument sensor.bits | sensor.bits | a recipe holds no object: give a number, a text, "
                "True or False, None, a list or a mapping",
            ],
        ),
        (
            {"a b": 1},
            ["argument a b | a b | is no override: write path=value, +path=value, ~path or group=option"],
        ),
        (
            {"~sensor.bits": 3},
            [
                "argument ~sensor.bits | ~sensor.bits | "
                "~ takes a value away and gives none: write {'~sensor.bits': None}"
            ],
        ),
    ],
)
def test_a_mistake_says_which_keyword(refused, values, lines):
    assert refused(**values) == lines


# --- where a step asks to run -----------------------------------------------------------------------------------------


def test_a_step_says_where_it_wants_to_run(given):
    recipe = given(optics={"device": "cuda:1"}, steps={"raw": {"device": "gpu"}, "sum": {"device": "any"}})
    devices = {name: step.device for name, step in recipe.steps.items()}
    assert devices == {
        "height": "",
        "pupil": "",
        "psf[green]": "cuda:1",
        "psf[red]": "cuda:1",
        "spot[green]": "",
        "spot[red]": "",
        "sum": "",
        "raw": "gpu",
    }
    assert recipe.config["steps.raw.device"].value == "gpu"


def test_a_wrong_device_is_located(refused, toy):
    assert refused(**{"optics.device": "cuda1"}) == [
        "argument optics.device | optics.device = cuda1 | is no device: write any, cpu, gpu, cuda, cuda:1 or mps"
    ]
    assert refused(**{"steps.raw.device": 3}) == [
        "argument steps.raw.device | steps.raw.device = 3 | is no device: write any, cpu, gpu, cuda, cuda:1 or mps"
    ]
    toy.digitize.device = "cpu"
    assert refused(**{"steps.raw.device": "mps"}) == [
        "argument steps.raw.device | steps.raw.device = mps | toy.digitize computes on a CPU alone"
    ]
    toy.digitize.device = "gpu"
    assert refused(**{"steps.raw.device": "cpu"}) == [
        "argument steps.raw.device | steps.raw.device = cpu | toy.digitize computes on a GPU alone"
    ]


def test_without_lasers_their_device_is_not_unused(given):
    assert given(lasers={}).config["optics.device"].value == "cpu"
