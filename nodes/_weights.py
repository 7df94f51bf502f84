"""Weights of a network in a safetensors file, and whether they are this network's."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import torch
from torch import nn

from neusee.nodes import ParameterError

Net = TypeVar("Net", bound=nn.Module)


def empty(make: Callable[[], Net]) -> Net:
    """The network without memory, and without a draw from the global random stream."""
    with torch.device("meta"):
        return make()


def loaded(make: Callable[[], Net], weights: Path) -> Net:
    """The network with these weights, in single precision."""
    from safetensors.torch import load_file

    net = empty(make)
    net.load_state_dict(load_file(weights), assign=True)
    return net.float()


def same_layout(make: Callable[[], nn.Module], weights: Path, width: int) -> None:
    """Refuse a file unless its tensors have the names and shapes of this network's."""
    from safetensors import SafetensorError, safe_open

    wanted = {name: tuple(tensor.shape) for name, tensor in empty(make).state_dict().items()}
    try:
        with safe_open(weights, framework="pt") as tensors:
            found = {name: tuple(tensors.get_slice(name).get_shape()) for name in tensors.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise ParameterError("weights", f"{weights.name} is no safetensors file: {error}") from error
    odd = sorted(name for name in wanted | found if wanted.get(name) != found.get(name))
    if odd:
        name = odd[0]
        text = f"{weights.name}: {name} is {found.get(name)}, this network (width {width}) has {wanted.get(name)}"
        raise ParameterError("weights", text)
