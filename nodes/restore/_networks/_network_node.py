"""The node that restores a picture with a network of the user: a class with weights, or a file of `torch.export`."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field
from torch import Tensor, nn

from neusee.nodes import ParameterError, node
from neusee.nodes.array_bytes import safetensors_need
from neusee.nodes.network_classes import Architecture, NetworkClass
from neusee.nodes.network_weights import fits
from neusee.nodes.restore._networks._exported_network import EXPORTED, exported_network, read_sizes
from neusee.nodes.restore._networks._own_network import OwnNetwork, own_network, tried
from neusee.nodes.restore._networks._restorer import Tile, restored_by, restorer_checks
from neusee.nodes.units import Count, DataFile

Multiple = Annotated[Count, Field(le=1024)]  #: divisor of the sides of a picture, pixels
_PICKLED = (".pt", ".pth", ".ckpt", ".bin", ".pkl")


@node()
def network(
    picture: Tensor,
    *,
    architecture: NetworkClass | None = None,
    parameters: dict[str, Any] | None = None,
    weights: DataFile | None = None,
    multiple: Multiple | None = None,
    tile: Tile | None = None,
    reduce: Count = 1,
    detail: bool = False,
) -> Tensor:
    """Restore a colour picture with a network of your own.

    The network is a class of `torch.nn.Module`, built with ``parameters`` and the ``weights`` of a .safetensors file,
    or the whole content of a .pt2 file of `torch.export`. It takes a picture (1, 3, y, x) and returns the restored
    picture of the same shape. ``multiple``: the sides are padded by reflection to a multiple of this number, by default
    the attribute ``multiple`` of the class, or 1. ``tile``, ``reduce`` and ``detail`` as in `fft_mamba`.

    Shapes: picture (3, y, x) of any size -> (3, y, x).
    Units:  linear sRGB, as in the training of the weights.
    Error:  float32, 1e-5; of the restoration, the error that the training reached.
    Raises: ParameterError before the run without weights, where the class or the file fails on a small picture, or
            where the weights do not fit; ValueError for a picture that is not a colour picture or not finite, and for a
            result with other sizes or with values that are not finite.
    Source: the author of the network.
    """
    return restored_by(lambda: _ready(architecture, parameters, weights, multiple), picture, tile, reduce, detail)


def _ready(
    architecture: Architecture | type[nn.Module] | None,
    parameters: dict[str, Any] | None,
    weights: Path | None,
    multiple: int | None,
) -> OwnNetwork:
    """Return the network with its weights, in single precision."""
    file = _weights(weights)
    if file.suffix == EXPORTED:
        return exported_network(file, multiple)
    from safetensors.torch import load_file

    safetensors_need(file, parameter="weights")
    net = own_network(_class(architecture), parameters, multiple)
    net.inner.load_state_dict(load_file(file))
    net.float()
    return net


def _class(architecture: Architecture | type[nn.Module] | None) -> Architecture:
    if architecture is None:
        text = "name the class of the network, such as mynet.SmallUNet, or give weights: a .pt2 file of torch.export"
        raise ParameterError("architecture", text)
    return architecture if isinstance(architecture, Architecture) else Architecture(architecture.__name__, architecture)


def _weights(weights: Path | None) -> Path:
    if weights is None:
        text = "a network needs trained weights: train them by `neusee train`, and give the .safetensors file"
        raise ParameterError("weights", text)
    if weights.suffix in _PICKLED:
        text = f"{weights.name} is a pickle, which can run code when it is read: save the weights as .safetensors"
        raise ParameterError("weights", text)
    return weights


@network.preflight
def _(
    *,
    architecture: Architecture | None = None,
    parameters: dict[str, Any] | None = None,
    weights: Path | None = None,
    multiple: int | None = None,
    tile: int | None = None,
    reduce: int = 1,
    picture: Any = None,
    **others: Any,
) -> list[str]:
    """Raise ParameterError for a class, a file or sizes that do not work; return no warnings."""
    if weights is not None and weights.suffix == EXPORTED:
        for name, value in (("architecture", architecture), ("parameters", parameters or None)):
            if value is not None:
                raise ParameterError(name, f"{weights.name} of torch.export holds its own network: remove {name}")
        read_sizes(weights, multiple, _sizes(picture, tile, reduce))
        return [f"{weights.name} of torch.export holds the operations of a network, which this recipe runs"]
    named = _class(architecture)
    tried(named, parameters, multiple)
    file, net = _weights(weights), own_network(named, parameters, multiple)
    fits(net.inner, file, str(named), net.options)
    return []


def _sizes(picture: Any, tile: int | None, reduce: int) -> tuple[int, int] | None:
    """Return height and width of the pictures that the network receives, or None where they are not known."""
    if not isinstance(picture, Tensor) or picture.ndim != 3:
        return None
    y, x = (-(-n // reduce) for n in picture.shape[-2:])
    return (y, x) if tile is None or max(y, x) <= tile else (min(y, tile), min(x, tile))


network.check(restorer_checks)
