"""Files of a trained network for other programs: a graph of `torch.export` (.pt2) or of ONNX (.onnx)."""

import importlib.util
import os
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from neusee.nodes import ParameterError
from neusee.nodes.restore._networks._own_network import OwnNetwork
from neusee.nodes.restore._networks._restorer import Flat, Restorer

SUFFIXES = (".pt2", ".onnx")
_NEEDED = ("onnx", "onnxscript")
_LARGEST = 4096  #: pixels along a side
_LEAST = 32


class _Graph(nn.Module):
    """A restoring network for pictures whose sides are multiples of its own, without the padding for other sizes."""

    def __init__(self, net: Restorer) -> None:
        super().__init__()
        self.net = net

    def forward(self, picture: Tensor) -> Tensor:
        if isinstance(self.net, OwnNetwork):
            own: Tensor = self.net.inner(picture)
            return own
        assert isinstance(self.net, Flat)
        return picture + self.net.change(picture)


def require_exportable(net: Restorer, suffix: str) -> None:
    """Raise ParameterError for a network or a kind of file that `export_network` cannot write."""
    if suffix not in SUFFIXES:
        raise ParameterError("export", f"a network is exported to {' or '.join(SUFFIXES)}, not to {suffix}")
    if not isinstance(net, Flat | OwnNetwork):
        text = "the selective scan of fft_mamba is a kernel that no exported graph holds: train kind: nafnet or unet"
        raise ParameterError("export", text)
    missing = [name for name in _NEEDED if suffix == ".onnx" and importlib.util.find_spec(name) is None]
    if missing:
        text = f'{" and ".join(missing)} must be installed for .onnx: pip install "neusee[onnx]", or export to .pt2'
        raise ParameterError("export", text)


def export_network(net: Restorer, file: Path) -> None:
    """Write a restoring network with its weights as a graph that other programs run, by the suffix of the file.

    The graph takes a picture (1, 3, y, x) in float32, linear sRGB, and returns the restored picture. Its sides are
    multiples of `multiple` from 32 (or one multiple) to 4096 pixels; the program that runs the graph pads its pictures.
    The file appears by an atomic rename.

    Raises: ParameterError as `require_exportable`, and for a class whose operators the format does not have.
    """
    require_exportable(net, file.suffix)
    graph, step = _Graph(net).eval(), net.multiple
    count = -(-2 * _LEAST // step)
    example = torch.rand(1, 3, count * step, (count + 1) * step, generator=torch.Generator().manual_seed(0))
    low, high = -(-_LEAST // step), _LARGEST // step
    y, x = (torch.export.Dim(name, min=low, max=high) for name in ("rows", "columns"))
    sides = ({2: step * y, 3: step * x},)
    part = file.with_name(f".{os.getpid()}.{file.name}")
    try:
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of packages about their own future
            _write(graph, example, sides, part)
        part.replace(file)
    except Exception as error:
        said = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
        raise ParameterError("export", f"the network cannot be written as {file.suffix} ({said})") from error
    finally:
        part.unlink(missing_ok=True)


def _write(graph: nn.Module, example: Tensor, sides: Any, file: Path) -> None:
    program = torch.export.export(graph, (example,), dynamic_shapes=sides)
    if file.suffix == ".pt2":
        torch.export.save(program, file)
    else:
        torch.onnx.export(program, input_names=["picture"], output_names=["restored"], dynamo=True, verbose=False,
                          external_data=False, f=file)  # fmt: skip
