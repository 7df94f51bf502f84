"""Files of network weights in safetensors format, and the check that a file fits a network."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from neusee.nodes import ParameterError
from neusee.nodes.file_headers import safetensors_need
from neusee.nodes.input_files import once_per_version

Net = TypeVar("Net", bound=nn.Module)
#: metadata key of a network's options, which the tensors alone may not show
OPTIONS = "neusee.options"


def empty(make: Callable[[], Net]) -> Net:
    """Build a network on the meta device, which needs no memory for tensors and no random
    numbers.
    """
    with torch.device("meta"):
        return make()


def loaded(make: Callable[[], Net], weights: Path) -> Net:
    """Return a network in single precision, with weights from a file."""
    from safetensors.torch import load_file

    safetensors_need(weights, parameter="weights")
    net = empty(make)
    net.load_state_dict(load_file(weights), assign=True)
    return net.float()


def file_metadata(net: nn.Module) -> dict[str, str]:
    """Return the metadata for a network's weights file: its ``options`` as JSON; empty if it has
    none.
    """
    options = getattr(net, "options", None)
    return {} if options is None else {OPTIONS: json.dumps(options, sort_keys=True)}


def same_layout(make: Callable[[], nn.Module], weights: Path, width: int) -> None:
    """Raise ParameterError unless a weights file fits a network in names, shapes and options, and
    all values are finite.
    """
    net = empty(make)
    fits(net, weights, f"this network (width {width})", getattr(net, "options", {}))


def fits(net: nn.Module, weights: Path, called: str, options: Mapping[str, Any]) -> None:
    """Raise ParameterError unless a weights file fits a module, which messages name ``called``.

    ``options`` are the options of the network; those in the metadata of the file must agree with
    them.
    """
    from safetensors import SafetensorError, safe_open

    safetensors_need(weights, parameter="weights")
    shapes = {name: tuple(tensor.shape) for name, tensor in net.state_dict().items()}
    try:
        with safe_open(weights, framework="pt") as tensors:
            stored = {name: tuple(tensors.get_slice(name).get_shape()) for name in tensors.keys()}  # noqa: SIM118
            stored_options = (tensors.metadata() or {}).get(OPTIONS)
    except SafetensorError as error:
        raise ParameterError(
            "weights", f"{weights.name} is not a safetensors file: {error}"
        ) from error
    if stored_options is not None:
        _refuse_other_options(_stored_options(stored_options, weights), options, weights)
    for name in sorted(shapes | stored):
        if shapes.get(name) != stored.get(name):
            text = f"{weights.name}: {name} is {stored.get(name)}, {called} has {shapes.get(name)}"
            raise ParameterError("weights", text)
    if problem := _not_finite(weights):
        raise ParameterError("weights", problem)


@once_per_version
def _not_finite(weights: Path) -> str:
    """Return an error message for the first tensor of a weights file with values that are not
    finite, else an empty text.
    """
    from safetensors import safe_open

    safetensors_need(weights, parameter="weights")
    with safe_open(weights, framework="pt") as tensors:
        wrong = (wrong_weights(weights, name, tensors.get_tensor(name)) for name in tensors.keys())  # noqa: SIM118
        return next(filter(None, wrong), "")


def wrong_weights(weights: Path, name: str, tensor: Tensor) -> str:
    """Return an error message for a tensor of network weights with values that are not finite, else
    an empty text.
    """
    count = int((~torch.isfinite(tensor)).sum())
    fix = "train the network again, or give an earlier file"
    if not count:
        return ""
    return (
        f"{weights.name}: {name} holds {count} values that are not finite (NaN or infinity): {fix}"
    )


def _stored_options(text: str, weights: Path) -> Mapping[str, Any]:
    """Return the options in the metadata text of a file; raise ParameterError for an invalid
    text.
    """
    try:
        options = json.loads(text)
    except ValueError:
        options = None
    if not isinstance(options, dict):
        raise ParameterError(
            "weights", f"{weights.name} has damaged options ({text[:40]!r}): copy the file again"
        )
    return options


def _refuse_other_options(
    trained: Mapping[str, Any], options: Mapping[str, Any], weights: Path
) -> None:
    """Raise ParameterError if the options in a weights file differ from those of the network.

    Names and shapes of the tensors may agree nevertheless, and the network would compute other
    results.
    """
    for name in options:
        if name in trained and trained[name] != options[name]:
            text = (
                f"{weights.name} was trained with {name}: {_as_written(trained[name])}, and this"
                f" network has {name}: "
            )
            fix = {
                "class": "name that class",
                "parameters": f"write parameters: {_as_written(trained[name])}",
            }.get(name, "train the network again")
            raise ParameterError("weights", f"{text}{_as_written(options[name])}; {fix}")


def _as_written(value: object) -> str:
    """Return an option as a recipe writes it."""
    return value if isinstance(value, str) else json.dumps(value, sort_keys=True)
