"""Call of the node of a step, on the device of the step and with its random stream."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from neusee.nodes import Check
from neusee.workflows.graph.recipe_graph import Step
from neusee.workflows.graph.run_error import RunError
from neusee.workflows.keys.cache_key import device_kind, stream_seed
from neusee.workflows.store.serialization import each_tensor, forget_attributes, settle, tensors_in
from neusee.workflows.store.stored_types import fits as fits_type


def call(step: Step, inputs: Sequence[Any], params: Mapping[str, Any], seed: int, device: str) -> Any:
    """Call the node of a step and return its result with gradients, in the memory layout that stored results have."""
    moved = [to_device(value, device) for value in inputs]
    rng = {"rng": torch.Generator(device).manual_seed(stream_seed(seed, step.name))} if step.node.random else {}
    tensors = tensors_in(moved)
    before = [x._version for x in tensors]
    try:
        value = settle(step.node(*moved, **params, **rng))
    except Exception as error:
        raise RunError(step, inputs, error) from error
    if before != [x._version for x in tensors]:
        raise RunError(step, inputs, ValueError("the node changed its input in place: let the node clone the input"))
    for x in tensors:
        forget_attributes(x)
    kind = step.node.hints.get("return", Any)
    if not fits_type(value, kind):  # stored, such a value would count as damaged
        name = getattr(kind, "__name__", kind)
        text = f"the node returned a value of the type {type(value).__name__}, but its annotation says {name}"
        raise RunError(step, inputs, TypeError(text))
    return value


def examine(step: Step, value: Any, inputs: Sequence[Any]) -> tuple[Check, ...]:
    """Run the checks of a node on its result and return the outcomes; a check that raises an error counts as failed."""
    if step.node.hooks.check is None:
        return ()
    try:
        return tuple(step.node.hooks.check(value, *inputs, **step.params))
    except Exception as error:
        return (Check(f"the check raised an error: {type(error).__name__}: {error}", False),)


def place(step: Step, device: str) -> str:
    """Return the preferred device of a step from a list of device names, separated by commas."""
    return places(step, device.split(","))[0]


def places(step: Step, devices: Sequence[str]) -> tuple[str, ...]:
    """Return the devices on which a step may run, the preferred device first.

    The hint of the recipe precedes the hint of the node. A random step stays on one kind of device,
    because its random stream and its key depend on the kind of device.
    """
    hint = step.device or step.node.device
    if hint == "cpu":
        return ("cpu",)
    allowed = [d for d in devices if fits(d, device_kind(d), hint)] or list(devices)
    return tuple(d for d in allowed if not step.node.random or device_kind(d) == device_kind(allowed[0]))


def fits(device: str, kind: str, hint: str) -> bool:
    """Return True if the device hint of a step, such as ``cpu``, ``gpu`` or ``cuda:1``, allows ``device``."""
    if hint in ("any", ""):
        return True
    return kind != "cpu" if hint == "gpu" else hint in (kind, device)


def to_device(value: Any, device: str) -> Any:
    return each_tensor(lambda x: x.to(device), value)
