"""A network class of the user in training: dropout and batch norm resume to the bit, and its
file is used as it is.
"""

import json
import os
import sys

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from neusee.workflows import RecipeError, Store, load, run
from neusee.workflows.evaluation.evaluation_points import EvaluationPoints, PointRequest
from neusee.workflows.evaluation.evaluation_scenes import scenes
from neusee.workflows.evaluation.pipelines import (
    CASES,
    EvaluationRefused,
    NamedRecipe,
    compose_pipelines,
    read_pipelines,
)
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.training.process_mesh import ALONE, Mesh
from neusee.workflows.training.resumable_loop import TrainingSession
from neusee.workflows.training.run_training import code_of_class, network_settings, train

TINY = [
    "optics.samples=64",
    "optics.pitch=126.2 um",
    "optics.bands=3",
    "optics.window=[48, 48]",
    "scene.shape=[48, 48]",
    "sensor.shape=[33, 36]",
]
SHORT = [
    "train.stages.2.iterations=3",
    "train.stages.2.batch=1",
    "train.critics.width=4",
    "train.keep=1",
]
NETWORK = '''\
"""A network."""

import torch
from torch import nn


class Small(nn.Module):
    """A network with dropout, batch norm and a buffer that no file holds."""

    multiple = 2

    def __init__(self, width=4):
        super().__init__()
        self.first, self.last = nn.Conv2d(3, width, 3, 2, 1), nn.ConvTranspose2d(width, 3, 2, 2)
        self.norm, self.drop = nn.BatchNorm2d(width), nn.Dropout(0.5)
        self.register_buffer("kernel", torch.full((3, 1, 1), 0.5), persistent=False)

    def forward(self, x):
        return x * self.kernel + self.last(self.drop(torch.relu(self.norm(self.first(x)))))


class Fixed(nn.Module):
    def forward(self, x):
        return 0.5 * x


class Single(nn.Conv2d):
    def __init__(self):
        super().__init__(3, 3, 1)

    def forward(self, x):
        return super().forward(x.float()).to(x.dtype) if self.training else super().forward(x.float())
'''
RECIPE = """\
# Mine.
nodes: [{name}.py]
defaults:
  [camera: neusee, scene: china, illuminant: daylight, lift: lmmse, laser: green, optics: small, sensor: small,
   doe: five_half_rings, flare: clean, restore: wiener, reading: coherent, train: recommended]
seed: 7
tolerance: 1e-3
outputs: [developed, truth, bsr, lsr, developed_quality, restored_quality]
train: {{learn: null, network: {{architecture: {name}.Small, parameters: {{width: 4}}}}}}
"""
OPTION = """\
# Mine.
nodes: [../{name}.py]
restore: {{weights: null, width: 4}}
steps:
  restored:
    node: restore.network
    from: "developed[mask]"
    with: {{architecture: {name}.Small, parameters: {{width: "${{restore.width}}"}}, weights: "${{restore.weights}}"}}
"""

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """Write a network, a recipe that trains it and an option that restores with it, under a name
    of the test.
    """
    name = f"own_{abs(hash(tmp_path)) % 10**9:09d}"
    (tmp_path / "restore").mkdir()
    (tmp_path / f"{name}.py").write_text(NETWORK)
    (tmp_path / "mine.yaml").write_text(RECIPE.format(name=name))
    (tmp_path / "restore" / "mine.yaml").write_text(OPTION.format(name=name))
    monkeypatch.setattr(sys, "path", list(sys.path))
    return name


def trained(tmp_path, out="runs", *words, watch=None):
    recipe = load("mine.yaml", [*TINY, *SHORT, *words], tmp_path)
    return train(
        recipe,
        TrainingSession(Store(tmp_path / "cache"), tmp_path / out, lambda line: None, watch=watch),
        (2,),
    )


class Stopped(Exception):
    pass


@pytest.mark.slow
def test_a_stopped_training_goes_on_to_the_same_weights_and_a_run_uses_them(mine, tmp_path):
    whole = trained(tmp_path)

    def stop(stage, done, losses):
        if done == 2:
            raise Stopped

    with pytest.raises(Stopped):
        trained(tmp_path, "stopped", watch=stop)
    again = trained(tmp_path, "stopped")
    assert again.name == whole.name
    assert (again / "network.safetensors").read_bytes() == (
        whole / "network.safetensors"
    ).read_bytes()

    weights = whole / "network.safetensors"
    state = load_file(weights)
    network = sys.modules[mine].Small(4)
    assert state.keys() == network.state_dict().keys()
    assert int(state["norm.num_batches_tracked"]) == 3
    with safe_open(weights, "pt") as file:
        about = json.loads(file.metadata()["neusee.options"])
    assert about == {"class": "Small", "parameters": {"width": 4}}
    words = [*TINY, "restore=mine", f"restore.weights={weights}", "outputs=[developed, restored]"]
    found = run(load("mine.yaml", words, tmp_path), Store(tmp_path / "cache"))
    network.load_state_dict(state)
    seen = torch.nn.functional.pad(found["developed[mask]"][None], (0, 0, 0, 1), "reflect")
    with torch.no_grad():
        assert torch.equal(found["restored"], network.eval()(seen)[0, :, :33])

    point = evaluated(tmp_path, weights)
    assert point["psnr"] != evaluated(tmp_path, other_weights(tmp_path, state))["psnr"]


def evaluated(tmp_path, weights):
    words = read_pipelines(f"flat+none, five_half_rings+mine@{weights}", tmp_path)
    _, pipeline = compose_pipelines(NamedRecipe("mine.yaml", TINY, tmp_path), words)
    assert pipeline.name == f"five_half_rings+mine@{weights.name}"
    store = Store(tmp_path / "cache")
    (scene,), _ = scenes(load("mine.yaml", TINY, tmp_path), store, None, 1, list(CASES))
    return EvaluationPoints(store, 16).point(pipeline, PointRequest(scene, 0.0))


def other_weights(tmp_path, state):
    save_file({**state, "last.bias": state["last.bias"] + 0.3}, tmp_path / "other.safetensors")
    return tmp_path / "other.safetensors"


def test_a_training_is_another_one_after_an_edit_of_the_class_and_in_the_same_folder_without(
    mine, tmp_path
):
    def identity():
        network = load("mine.yaml", [*TINY, *SHORT], tmp_path).training.network
        return network_settings(network), code_of_class(
            network.architecture, Code(tmp_path / "code.json")
        )

    first, code = identity()
    assert first == {"class": f"{mine}.Small", "parameters": {"width": 4}, "multiple": None}
    assert identity() == (first, code)
    file = tmp_path / f"{mine}.py"
    file.write_text(file.read_text().replace("x * self.kernel +", "x * self.kernel -"))
    os.utime(file, ns=(1, 1))
    del sys.modules[mine]
    assert identity()[1] != code


NET = "train.network"
MISTAKES = [
    (
        [f"{NET}.architecture={{0}}.Smal"],
        f"argument 11 | {NET}.architecture",
        "{0} has no network class Smal",
    ),
    (
        [f"{NET}.parameters={{{{depth: 3}}}}"],
        f"argument 11 | {NET}.parameters",
        "{0}.Small takes no argument depth",
    ),
    (
        [f"{NET}.width=8"],
        f"argument 11 | {NET}.width",
        "width is a setting of the networks of neusee: for your own class write parameters: {{width",
    ),
    ([f"{NET}.parameters=4"], f"argument 11 | {NET}.parameters", "must be a mapping"),
    (
        [f"{NET}.architecture={{0}}.Fixed", f"{NET}.parameters=null"],
        f"argument 11 | {NET}.architecture",
        "{0}.Fixed has no parameters, so training would change nothing",
    ),
    (
        [f"{NET}.architecture={{0}}.Single", f"{NET}.parameters=null", "train.precision=float64"],
        f"argument 11 | {NET}.architecture",
        (
            "{0}.Single fails for a picture 1 x 3 x 33 x 35: {0}.py:32: Input type (float) and bias"
            " type (double) should"
        ),
    ),
    ([f"+{NET}.multiple=0"], f"argument 11 | {NET}.multiple", "must be greater than or equal to 1"),
    (
        [f"{NET}.architecture=null"],
        f"mine.yaml:9:79 | {NET}.parameters",
        "is a setting for a network class of your own: add arch",
    ),
]


@pytest.mark.parametrize(("words", "place", "message"), MISTAKES)
def test_a_mistake_is_located_before_the_training(words, place, message, mine, tmp_path):
    with pytest.raises(RecipeError) as caught:
        load("mine.yaml", [*TINY, *SHORT, *(word.format(mine) for word in words)], tmp_path)
    (problem,) = caught.value.diagnostics
    assert f"{problem.mark} | {problem.path}".startswith(place)
    assert problem.message.startswith(message.format(mine))


def test_an_option_of_the_user_that_takes_no_file_is_refused(mine, tmp_path):
    option = tmp_path / "restore" / "bare.yaml"
    option.write_text(
        "# Bare.\nsteps: {restored: {node: restore.colour, from: {channels: signal, matrix:"
        " matrix}}}\n"
    )
    weights = tmp_path / "any.safetensors"
    weights.write_bytes(b"")
    with pytest.raises(EvaluationRefused, match="bare takes no file: remove @ and the file name"):
        compose_pipelines(
            NamedRecipe("mine.yaml", TINY, tmp_path),
            read_pipelines(f"flat+bare@{weights}", tmp_path),
        )


def test_an_option_in_a_shared_folder_is_found(mine, tmp_path, monkeypatch):
    monkeypatch.setenv("NEUSEE_RECIPES", str(tmp_path))
    network = torch.nn.Module()
    save_file(network.state_dict() | {"a": torch.zeros(1)}, tmp_path / "wrong.safetensors")
    (tmp_path / "away").mkdir()
    asked = read_pipelines(f"flat+mine@{tmp_path / 'wrong.safetensors'}", tmp_path / "away")
    with pytest.raises(
        EvaluationRefused, match=r"wrong.safetensors: a is \(1,\), own_.*Small has None"
    ):
        compose_pipelines(NamedRecipe("first_light", TINY, tmp_path / "away"), asked)


def test_all_processes_have_the_running_means_of_the_first(monkeypatch):
    net, sent = torch.nn.Sequential(torch.nn.Conv2d(3, 3, 1), torch.nn.BatchNorm2d(3)), []
    monkeypatch.setattr(
        torch.distributed, "broadcast", lambda buffer, source: sent.append((buffer, source))
    )
    ALONE.share_buffers(net)
    assert not sent
    Mesh(2, rank=1).share_buffers(net)
    assert [source for _, source in sent] == [0, 0, 0]
    assert all(x is y for (x, _), y in zip(sent, net.buffers(), strict=True))
