"""Weights of a network in a safetensors file, and the check that the weights fit the network."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import nn

from neusee.nodes import ParameterError

Net = TypeVar("Net", bound=nn.Module)
OPTIONS = "neusee.options"  #: metadata key of a network's options, which the tensors alone may not reveal


def empty(make: Callable[[], Net]) -> Net:
    """Build the network without memory for its tensors and without a draw from the global random stream."""
    with torch.device("meta"):
        return make()


def loaded(make: Callable[[], Net], weights: Path) -> Net:
    """Return the network with these weights, in single precision."""
    from safetensors.torch import load_file

    net = empty(make)
    net.load_state_dict(load_file(weights), assign=True)
    return net.float()


def file_metadata(net: nn.Module) -> dict[str, str]:
    """Return the metadata for a file of this network's weights: the ``options`` of the network, if any."""
    options = getattr(net, "options", None)
    return {} if options is None else {OPTIONS: json.dumps(options, sort_keys=True)}


def same_layout(make: Callable[[], nn.Module], weights: Path, width: int) -> None:
    """Raise ParameterError unless a file holds the names and shapes of this network's tensors, and its options."""
    from safetensors import SafetensorError, safe_open

    net = empty(make)
    wanted = {name: tuple(tensor.shape) for name, tensor in net.state_dict().items()}
    try:
        with safe_open(weights, framework="pt") as tensors:
            found = {name: tuple(tensors.get_slice(name).get_shape()) for name in tensors.keys()}  # noqa: SIM118
            said = (tensors.metadata() or {}).get(OPTIONS)
    except SafetensorError as error:
        raise ParameterError("weights", f"{weights.name} is not a safetensors file: {error}") from error
    if said is not None:
        _same_options(json.loads(said), getattr(net, "options", {}), weights)
    odd = sorted(name for name in wanted | found if wanted.get(name) != found.get(name))
    if odd:
        name = odd[0]
        text = f"{weights.name}: {name} is {found.get(name)}, this network (width {width}) has {wanted.get(name)}"
        raise ParameterError("weights", text)


def _same_options(learnt: Mapping[str, Any], options: Mapping[str, Any], weights: Path) -> None:
    """Raise ParameterError for other options, because tensors of the same names and shapes then act differently."""
    for name in options:
        if name in learnt and learnt[name] != options[name]:
            text = f"{weights.name} was trained with {name}: {_word(learnt[name])}, and this network has {name}: "
            raise ParameterError("weights", f"{text}{_word(options[name])}; write {name}: {_word(learnt[name])}")


def _word(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value)
