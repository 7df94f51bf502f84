"""Exported networks: the graph gives the picture of the module, at other sizes too, or the
export is refused.
"""

import importlib.util

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from neusee.nodes import ParameterError, restore
from neusee.nodes.own_modules import Architecture
from neusee.nodes.restore import FFTMamba, NAFNet, UNet, export_network, own_network, start_network

SIZES = ((64, 96), (48, 160))  #: multiples of 16


class Own(nn.Module):
    """A network of a user."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(3, 4, 3, padding=1), nn.BatchNorm2d(4), nn.ReLU(), nn.Conv2d(4, 3, 1)
        )

    def forward(self, picture):
        return picture + self.layers(picture)


class Inverse(nn.Module):
    """A network with an operator that ONNX does not have."""

    def __init__(self) -> None:
        super().__init__()
        self.matrix = nn.Parameter(torch.eye(3) * 2)

    def forward(self, picture):
        return torch.einsum("ij,njyx->niyx", torch.linalg.matrix_exp(self.matrix), picture)


def started(make):
    return start_network(make, torch.Generator().manual_seed(1)).eval()


def own(network):
    return own_network(Architecture(network.__name__, network), None, 1).eval()


def picture(y, x):
    return torch.rand(1, 3, y, x, generator=torch.Generator().manual_seed(y))


def onnx():
    for name in ("onnx", "onnxscript", "onnxruntime"):
        if importlib.util.find_spec(name) is None:
            pytest.skip(f'{name} is not installed: pip install -e ".[onnx]" onnxruntime')
    import onnxruntime

    return onnxruntime


@pytest.mark.slow
def test_a_graph_of_torch_gives_the_picture_of_the_module_and_of_its_weights(tmp_path):
    net, file, weights = (
        started(lambda: UNet(4)),
        tmp_path / "net.pt2",
        tmp_path / "net.safetensors",
    )
    export_network(net, file)
    save_file(net.state_dict(), weights)
    program = torch.export.load(file).module()
    for sizes in SIZES:
        assert torch.equal(program(picture(*sizes)), net(picture(*sizes)))
    one = picture(50, 70)[0]  # no multiple of 8: both pad it
    found, expected = (
        restore.network(one, weights=file),
        restore.unet(one, weights=weights, width=4),
    )
    assert float((found - expected).abs().max()) <= 1e-6
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


@pytest.mark.slow
@pytest.mark.parametrize(
    "make", [lambda: UNet(4), lambda: NAFNet(4), None], ids=["unet", "nafnet", "own"]
)
def test_a_graph_of_onnx_gives_the_picture_of_the_module(tmp_path, make):
    runtime = onnx()
    net = started(make) if make else own(Own)
    export_network(net, tmp_path / "net.onnx")
    session = runtime.InferenceSession(
        str(tmp_path / "net.onnx"), providers=["CPUExecutionProvider"]
    )
    for sizes in SIZES:
        (found,) = session.run(None, {"picture": picture(*sizes).numpy()})
        assert np.abs(found - net(picture(*sizes)).detach().numpy()).max() <= 2e-6


def test_what_no_graph_holds_is_refused(tmp_path):
    with pytest.raises(
        ParameterError, match=r"scan of fft_mamba is a kernel .* train kind: nafnet or unet"
    ):
        export_network(FFTMamba(4), tmp_path / "net.pt2")
    with pytest.raises(ParameterError, match=r"exported to \.pt2 or \.onnx, not to \.pth"):
        export_network(UNet(4), tmp_path / "net.pth")


def test_onnx_that_is_not_installed_is_said(tmp_path, monkeypatch):
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name.startswith("onnx") else found(name)
    )
    with pytest.raises(
        ParameterError,
        match=r'onnx and onnxscript must be installed .* pip install "neusee\[onnx\]"',
    ):
        export_network(UNet(4), tmp_path / "net.onnx")


@pytest.mark.slow
def test_an_operator_that_onnx_does_not_have_is_said(tmp_path):
    onnx()
    with pytest.raises(ParameterError, match=r"the network cannot be written as \.onnx"):
        export_network(own(Inverse), tmp_path / "net.onnx")
    assert list(tmp_path.iterdir()) == []
