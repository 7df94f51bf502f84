"""A training that begins with the weights of another: the same weights at first, and no
resumption.
"""

import json
import re

import pytest
import torch
from safetensors.torch import load_file, save_file

from neusee.nodes.restore import UNet, start_network
from neusee.workflows import RecipeError, Store, load
from neusee.workflows.training.resumable_loop import TrainingSession
from neusee.workflows.training.run_training import train

TINY = [
    "optics.samples=48", "optics.pitch=168.27 um", "optics.bands=3", "optics.window=[32, 32]", "scene.shape=[32, 32]",
    "sensor.shape=[24, 24]", "doe=flat", "train.learn=null", "train.network.kind=unet", "train.network.width=4",
    "train.critics.width=4", "train.stages.2.iterations=2", "train.stages.2.adversarial=0", "train.keep=1",
    "train.average=0",
]  # fmt: skip

pytestmark = pytest.mark.usefixtures("one_thread")


def trained(words, folder, lines=None, watch=None):
    said = (lines if lines is not None else []).append
    return train(
        load("train_small", [*TINY, *words]),
        TrainingSession(Store(folder / "store"), folder / "runs", said, watch=watch),
        (2,),
    )


@pytest.fixture
def weights(tmp_path):
    net = start_network(lambda: UNet(4), torch.Generator().manual_seed(11))
    file = tmp_path / "earlier" / "network.safetensors"
    file.parent.mkdir()
    save_file(net.state_dict(), file)
    return file


@pytest.mark.slow
def test_the_network_begins_with_the_given_weights_and_stays_there_at_no_rate(tmp_path, weights):
    lines, slow = [], ["train.rates.weights=1e-30", "train.rates.biases=1e-30"]
    found = trained([f"train.start={weights}", *slow], tmp_path, lines)
    assert f"begins with the weights of {weights}" in lines
    expected, made = load_file(weights), load_file(found / "network.safetensors")
    assert expected.keys() == made.keys()
    assert all(float((made[name] - x).abs().max()) < 1e-25 for name, x in expected.items()), (
        "zeros move by the rate"
    )
    assert json.loads((found / "training.json").read_text())["start"]["file"] == str(weights)
    assert trained([f"train.start={weights.parent}", *slow], tmp_path) == found, (
        "a folder means its weights"
    )
    assert trained(slow, tmp_path) != found


@pytest.mark.slow
def test_a_stopped_training_goes_on_and_does_not_begin_again(tmp_path, weights):
    def stopped(stage, done, found):
        if done == 2:
            raise KeyboardInterrupt

    words, lines = [f"train.start={weights}", "train.stages.2.iterations=3"], []
    with pytest.raises(KeyboardInterrupt):
        trained(words, tmp_path, watch=stopped)
    again = trained(words, tmp_path, lines)
    assert not any("begins with" in line for line in lines)
    assert any("continues in stage 2 after 1 iterations" in line for line in lines)
    whole = trained(words, tmp_path / "whole")
    assert (again / "network.safetensors").read_bytes() == (
        whole / "network.safetensors"
    ).read_bytes()
    weights.write_bytes(b"")
    save_file({"other": torch.zeros(1)}, weights)
    with pytest.raises(ValueError, match=r"train\.start   network\.safetensors: "):
        trained(words, tmp_path)


def test_weights_that_do_not_fit_are_refused_with_the_layer(tmp_path, weights):
    with pytest.raises(
        ValueError, match=r"train\.start   network\.safetensors: \w.* is \(.*\), the net"
    ):
        trained([f"train.start={weights}", "train.network.width=6"], tmp_path)
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(
        ValueError, match=re.escape(f"{empty}/network.safetensors is no file of weights")
    ):
        trained([f"train.start={empty}"], tmp_path)
    with pytest.raises(RecipeError, match="there is neither a file nor a folder"):
        load("train_small", [*TINY, "train.start=nowhere.safetensors"])
