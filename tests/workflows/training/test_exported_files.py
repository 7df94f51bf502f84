"""A training that exports its network: the graph has the best weights, and what cannot be
exported ends it early.
"""

import importlib.util

import pytest
import torch
from safetensors.torch import load_file

from neusee.nodes.restore import UNet
from neusee.workflows import RecipeError, load
from tests.workflows.training.test_warm_start import TINY, trained

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.slow
def test_the_exported_graph_is_the_trained_network(tmp_path):
    folder = trained(["train.export=[pt2]"], tmp_path)
    net = UNet(4).eval()
    net.load_state_dict(load_file(folder / "network.safetensors"))
    picture = torch.rand(1, 3, 32, 48, generator=torch.Generator().manual_seed(2))
    assert torch.equal(torch.export.load(folder / "network.pt2").module()(picture), net(picture))
    assert trained([], tmp_path) == folder, "an export changes no weight"


def test_what_cannot_be_exported_is_refused_before_the_training(tmp_path, monkeypatch):
    with pytest.raises(
        RecipeError,
        match=r"export: torch\.export and ONNX cannot represent the scan of the network fft_mamba",
    ):
        load("train_small", [*TINY, "train.network.kind=fft_mamba", "train.export=[onnx]"])
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "onnxscript" else found(name)
    )
    with pytest.raises(ValueError, match=r"train\.export: .*onnxscript must be installed"):
        trained(["train.export=[onnx]"], tmp_path)
    assert not list(tmp_path.rglob("losses.csv"))
