"""Call of the node of a step on its device, as a whole or in passes over its bands."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import ceil
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import Check, Node
from neusee.nodes.values import BAND_FIELDS, band_names
from neusee.workflows.graph.errors import RunError
from neusee.workflows.graph.recipe_graph import Step
from neusee.workflows.keys.cache_key import device_kind, stream_seed
from neusee.workflows.store.serialization import (
    each_tensor,
    forget_attributes,
    settle,
    tensors_in,
)
from neusee.workflows.store.serialization import fits as fits_type

# --- node call ------------------------------------------------------------------------------------

# Call of the node of a step, on the step's device and with its random stream.


def call(
    step: Step, inputs: Sequence[Any], params: Mapping[str, Any], seed: int, device: str
) -> Any:
    """Call the node of a step and return its result with gradients, in the memory layout of stored
    results.
    """
    moved_inputs = [to_device(value, device) for value in inputs]
    rng = (
        {"rng": torch.Generator(device).manual_seed(stream_seed(seed, step.name))}
        if step.node.random
        else {}
    )
    tensors = tensors_in(moved_inputs)
    # torch counts the in-place changes of each tensor
    versions_before = [x._version for x in tensors]
    try:
        value = settle(step.node(*moved_inputs, **params, **rng))
    except Exception as error:
        raise RunError(step, inputs, error) from error
    if versions_before != [x._version for x in tensors]:
        raise RunError(
            step,
            inputs,
            ValueError("the node changed its input in place: let the node clone the input"),
        )
    for x in tensors:
        forget_attributes(x)
    annotated_type = step.node.hints.get("return", Any)
    # the value must have the annotated type
    if not fits_type(value, annotated_type):  # once stored, such a value would count as damaged
        type_name = getattr(annotated_type, "__name__", annotated_type)
        text = (
            f"the node returned a value of the type {type(value).__name__}, but its annotation says"
            f" {type_name}"
        )
        raise RunError(step, inputs, TypeError(text))
    return value


def examine(step: Step, value: Any, inputs: Sequence[Any]) -> tuple[Check, ...]:
    """Run the checks of a node on its result and return the outcomes; a check that raises an
    error counts as failed.
    """
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
    fitting = [
        device_name for device_name in devices if fits(device_name, device_kind(device_name), hint)
    ] or list(devices)
    return tuple(
        device_name
        for device_name in fitting
        if not step.node.random or device_kind(device_name) == device_kind(fitting[0])
    )


def fits(device: str, kind: str, hint: str) -> bool:
    """Return True if the device hint of a step, such as ``cpu``, ``gpu`` or ``cuda:1``, allows
    ``device``.
    """
    if hint in ("any", ""):
        return True
    return kind != "cpu" if hint == "gpu" else hint in (kind, device)


def to_device(value: Any, device: str) -> Any:
    return each_tensor(lambda x: x.to(device), value)


# --- passes over the bands ------------------------------------------------------------------------

# A node that declares its bands computes each band to the same bits whatever the other bands are.
# A step that does not fit into the memory as a whole is therefore computed in several passes over
# its bands.


_ALIGN = 64  #: alignment (bytes): a kernel may compute differently at another alignment

Evaluate = Callable[[Sequence[Any]], Any]  #: a function from the inputs of a step to its result


def call_in_parts(step: Step, inputs: Sequence[Any], evaluate: Evaluate, parts: int) -> Any:
    """Return the result of ``step``, computed in ``parts`` passes over its bands, or in one call if
    its bands depend on each other.
    """
    count = band_count(step, inputs)
    if count < 2:
        return evaluate(inputs)
    assert step.node.bands is not None
    axis = step.node.bands["return"]
    bands_at_once = ceil(count / parts)
    whole_tensors: list[Tensor] = []
    for start in range(0, count, bands_at_once):
        indices = list(range(start, min(start + bands_at_once, count)))
        result = evaluate(taken(step, inputs, indices))
        part_tensors = band_tensors(result)
        if not whole_tensors:
            whole_tensors = [_room_for(x, axis, count) for x in part_tensors]
        for whole_tensor, part_tensor in zip(whole_tensors, part_tensors, strict=True):
            whole_tensor.narrow(axis, start, len(indices)).copy_(part_tensor)
    return with_band_tensors(result, whole_tensors)


def _room_for(x: Tensor, axis: int, count: int) -> Tensor:
    """Return an empty tensor like ``x``, but with ``count`` bands along the axis."""
    shape = list(x.shape)
    shape[axis] = count
    return x.new_empty(shape)


def _is_cut_by_band(value: Any) -> bool:
    return isinstance(value, Tensor) or type(value) in BAND_FIELDS


def band_count(step: Step, inputs: Sequence[Any]) -> int:
    """Return the number of bands that a step computes independently of each other; 0 if the step
    has no such bands.
    """
    names_and_inputs = zip(step.node.inputs, inputs, strict=False)
    axes = [(_axis(step, name, value), value) for name, value in names_and_inputs]
    axes_and_inputs = [(axis, value) for axis, value in axes if axis is not None]
    # every input with bands must be a tensor or have tensors by band
    if not all(_is_cut_by_band(value) for _, value in axes_and_inputs):
        return 0  # a low-rank cube cannot be cut by band
    counts = set[int]()
    for axis, value in axes_and_inputs:
        counts.update(x.shape[axis] for x in band_tensors(value) if _has(x, axis))
    # inputs with different numbers of bands have no common bands
    return counts.pop() if len(counts) == 1 else 0


def bands_in(node: Node, inputs: Sequence[Any]) -> int:
    """Return the number of bands that a node computes one by one, at least 1; the inputs may be
    forms without values.
    """
    for name, value in zip(node.inputs, inputs, strict=False):
        axis = node.bands.get(name) if node.bands else None
        if axis is not None and _is_cut_by_band(value):
            return max((x.shape[axis] for x in band_tensors(value) if _has(x, axis)), default=1)
    return 1


def _axis(step: Step, name: str, value: Any) -> int | None:
    """Return the axis of the bands of an input, or None for an absent input or one without
    bands.
    """
    return None if value is None or step.node.bands is None else step.node.bands.get(name)


def band_tensors(value: Any) -> list[Tensor]:
    """Return the tensors of a result that have an axis of wavelength bands."""
    if isinstance(value, Tensor):
        return [value]
    return [getattr(value, name) for name in band_names(value)]


def with_band_tensors(value: Any, tensors: Sequence[Tensor]) -> Any:
    """Return ``value`` with ``tensors`` in place of its tensors that have an axis of wavelength
    bands.
    """
    if isinstance(value, Tensor):
        return tensors[0]
    return value._replace(**dict(zip(band_names(value), tensors, strict=True)))


def _has(x: Tensor, axis: int) -> bool:
    """Return True if a tensor has the axis."""
    return -x.dim() <= axis < x.dim()


def taken(step: Step, inputs: Sequence[Any], which: list[int]) -> list[Any]:
    """Return the inputs of a step, reduced to the wavelength bands with the indices ``which``."""
    reduced = list(inputs)
    for i, (name, value) in enumerate(zip(step.node.inputs, inputs, strict=False)):
        axis = _axis(step, name, value)
        if axis is not None:
            reduced[i] = with_band_tensors(
                value, [_slices(x, axis, which) for x in band_tensors(value)]
            )
    return reduced


def _slices(x: Tensor, axis: int, which: list[int]) -> Tensor:
    """Return the bands of a tensor with the indices ``which``, as a view if the memory layout
    allows.
    """
    # adjacent bands allow a view
    if which == list(range(which[0], which[0] + len(which))):
        view = x.narrow(axis, which[0], len(which))
        if view.is_contiguous() and view.data_ptr() % _ALIGN == 0:
            return view
    return x.index_select(axis, torch.tensor(which, device=x.device))
