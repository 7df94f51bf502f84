"""Call of the node of a step on its device, as a whole or band by band."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from math import ceil
from typing import Any

import torch
import xxhash
from torch import Tensor

from neusee.nodes import Check, Node
from neusee.nodes.values import BAND_FIELDS, band_names
from neusee.workflows.graph.errors import RunError
from neusee.workflows.graph.recipe_graph import Step
from neusee.workflows.keys.cache_key import device_kind, digest, plain, stream_seed, written
from neusee.workflows.store.band_files import Blobs, Damaged, Stacked, bytes_of
from neusee.workflows.store.serialization import (
    each_tensor,
    forget_attributes,
    pack,
    settle,
    tensors_in,
)
from neusee.workflows.store.serialization import fits as fits_type

# --- node call ------------------------------------------------------------------------------------

# Call of the node of a step, on the device of the step and with its random stream.


def call(
    step: Step, inputs: Sequence[Any], params: Mapping[str, Any], seed: int, device: str
) -> Any:
    """Call the node of a step and return its result with gradients, in the memory layout that
    stored results have.
    """
    moved_inputs = [to_device(value, device) for value in inputs]
    rng = (
        {"rng": torch.Generator(device).manual_seed(stream_seed(seed, step.name))}
        if step.node.random
        else {}
    )
    tensors = tensors_in(moved_inputs)
    # torch counts the changes in place of each tensor
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
    # as the annotation says
    if not fits_type(value, annotated_type):  # stored, such a value would count as damaged
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


# --- band results ---------------------------------------------------------------------------------

# Results stored by wavelength band: if one of 31 bands has changed, only this band is computed and
# written.
#
# A node that declares its bands computes each band to the same bits whatever the other bands are.
# Each band therefore has its own key, a digest of this band of the inputs and of everything else
# that determines the band. The store keeps the band of the result as a blob with this key as name.
# Hashing the inputs is cheap, because every input is read only once.


LEAST = 1 << 22  #: bytes; a smaller result is kept as one tensor
_ALIGN = 64  #: bytes; a kernel may take another path at another alignment
_TRIES = 3  #: attempts that may find damaged bands before all bands are computed

Evaluate = Callable[[Sequence[Any]], Any]  #: a function from the inputs of a step to its result


def call_by_band(
    step: Step, inputs: Sequence[Any], evaluate: Evaluate, code: str, blobs: Blobs, parts: int = 1
) -> Any:
    """Return the result of ``step``; compute only the wavelength bands that the store ``blobs``
    does not contain.

    ``code`` is the digest of the code of the node. More passes over the bands, ``parts``, need less
    memory. Tensors that can be stored by band are returned as `Stacked`, which `plain_of` converts
    to plain tensors.
    """
    count = band_count(step, inputs)
    if count < 2:
        return evaluate(inputs)
    keys = band_keys(step, inputs, code)
    fields = range(_fields(step))
    for _ in range(_TRIES):
        missing_bands = [
            i for i, key in enumerate(keys) if not all(blobs.has(f"{key}.{n}") for n in fields)
        ]
        # nothing to reuse: the whole result in one call
        if len(missing_bands) == count and parts == 1:
            break
        try:
            return _gathered(
                step, inputs, evaluate, keys, missing_bands, ceil(count / parts), blobs
            )
        except Damaged:  # the next attempt finds the damaged band missing
            continue
    # bands were damaged again and again, or nothing is stored: all in one call
    return _stacked(step, evaluate(inputs), keys)


def plain_of(value: Any) -> Any:
    """Return ``value`` with every `Stacked` tensor (stored by band) replaced by an ordinary
    PyTorch tensor.
    """
    if isinstance(value, Stacked):
        return value.tensor
    return value._make(map(plain_of, value)) if type(value) in BAND_FIELDS else value


def _is_cut_by_band(value: Any) -> bool:
    return isinstance(value, Tensor) or type(value) in BAND_FIELDS


def band_count(step: Step, inputs: Sequence[Any]) -> int:
    """Return the number of bands that a step computes independently of each other; 0 if the step
    has no such bands.
    """
    names_and_inputs = zip(step.node.inputs, inputs, strict=False)
    axes = [(_axis(step, name, value), value) for name, value in names_and_inputs]
    axes_and_inputs = [(axis, value) for axis, value in axes if axis is not None]
    # of each banded input
    if not all(_is_cut_by_band(value) for _, value in axes_and_inputs):
        return 0  # a low-rank cube has no slice of one band
    counts = set[int]()
    for axis, value in axes_and_inputs:
        counts.update(x.shape[axis] for x in band_tensors(value) if _has(x, axis))
    # inputs that disagree have no common bands
    return counts.pop() if len(counts) == 1 else 0


def bands_in(node: Node, inputs: Sequence[Any]) -> int:
    """Return the number of bands that a node computes one by one, from inputs that may have no
    values; at least 1.
    """
    for name, value in zip(node.inputs, inputs, strict=False):
        axis = node.bands.get(name) if node.bands else None
        if axis is not None and _is_cut_by_band(value):
            return max((x.shape[axis] for x in band_tensors(value) if _has(x, axis)), default=1)
    return 1


def band_keys(step: Step, inputs: Sequence[Any], code: str) -> list[str]:
    """Return the cache key of each wavelength band: a digest of node, code, parameters and this
    band of the inputs.
    """
    params = {name: plain(value) for name, value in step.params.items()}
    shared_parts: list[Any] = [
        "band",
        step.node.path,
        code,
        params,
        *([text_of_step] if (text_of_step := written(step)) else []),
    ]
    band_digests: list[list[str]] = []
    for name, value in zip(step.node.inputs, inputs, strict=False):
        axis = _axis(step, name, value)
        # what does not belong to a single band decides about all bands
        shared_parts.append([name, axis, content(value if axis is None else _without_bands(value))])
        if axis is not None:
            band_digests += [
                [_hashed(band) for band in x.unbind(axis)] for x in band_tensors(value)
            ]
    # one digest of each input belongs to one band
    return [digest(shared_parts, list(band)) for band in zip(*band_digests, strict=True)]


def content(value: Any) -> list[Any]:
    """Return a JSON value that identifies a result: its layout, and type, shape and digest of
    each tensor.
    """
    layout, tensors = pack(value)
    return [layout, [_hashed(x) for x in tensors]]


def _hashed(x: Tensor) -> str:
    return f"{x.dtype} {tuple(x.shape)} {xxhash.xxh3_128_hexdigest(bytes_of(x))}"


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


def _without_bands(value: Any) -> Any:
    """Return what of a value does not belong to single bands: None for a tensor."""
    return (
        None
        if isinstance(value, Tensor)
        else value._replace(**dict.fromkeys(BAND_FIELDS[type(value)]))
    )


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
    # adjacent bands
    if which == list(range(which[0], which[0] + len(which))):
        view = x.narrow(axis, which[0], len(which))
        if view.is_contiguous() and view.data_ptr() % _ALIGN == 0:
            return view
    return x.index_select(axis, torch.tensor(which, device=x.device))


def _fields(step: Step) -> int:
    """Return the number of tensors in the result of a step."""
    kind = step.node.hints["return"]
    return len(kind._fields) if kind in BAND_FIELDS else 1


def _rebuilt(step: Step, items: list[Any]) -> Any:
    """Return the result of a step from its tensors: a named tuple, or the tensor alone."""
    kind = step.node.hints["return"]
    return kind._make(items) if kind in BAND_FIELDS else items[0]


def _stacked(step: Step, value: Any, keys: list[str]) -> Any:
    """Return a large result as `Stacked` tensors with a key for each band, and any other result
    unchanged.
    """
    tensors = band_tensors(value)
    is_band_first = all(x.shape[0] == len(keys) and _leads(step, x) for x in tensors)
    if not is_band_first or sum(x.nbytes for x in tensors) < LEAST:
        return value
    items = [Stacked(x, tuple(f"{key}.{n}" for key in keys)) for n, x in enumerate(tensors)]
    return _rebuilt(step, items)


def _leads(step: Step, x: Tensor) -> bool:
    """Return True if the bands are the first axis of a tensor, so that each band is contiguous
    in memory.
    """
    assert step.node.bands is not None
    return _has(x, step.node.bands["return"]) and step.node.bands["return"] % x.dim() == 0


def _gathered(
    step: Step,
    inputs: Sequence[Any],
    evaluate: Evaluate,
    keys: list[str],
    missing: list[int],
    size: int,
    blobs: Blobs,
) -> Any:
    """Compute missing bands of a result in groups of ``size`` bands, and assemble all bands.

    Raises `Damaged` if a stored band is damaged.
    """
    assert step.node.bands is not None
    axis = step.node.bands["return"]
    # one for each tensor of the result
    stacks = [_Stack(axis, [f"{key}.{n}" for key in keys], blobs) for n in range(_fields(step))]
    # groups of `size` bands, for less memory
    for start in range(0, len(missing), size):
        band_indices = missing[start : start + size]
        for stack, x in zip(
            stacks, band_tensors(evaluate(taken(step, inputs, band_indices))), strict=True
        ):
            stack.add(band_indices, x)
    return _rebuilt(step, [stack.whole() for stack in stacks])


class _Stack:
    """A tensor that is assembled from bands; computed bands go to the store, or to memory if
    writing fails.
    """

    def __init__(self, axis: int, names: list[str], blobs: Blobs) -> None:
        self.axis, self.names, self.blobs = axis, names, blobs
        self.held: Tensor | None = None
        self.inside: set[int] = set()  # indices of the bands in memory

    def add(self, which: list[int], x: Tensor) -> None:
        """Add the computed wavelength bands ``x`` with the indices ``which`` to the tensor."""
        axis = self.axis % x.dim()
        slices = x.unbind(axis)
        # only then a band is contiguous, and can be a file
        if axis == 0:
            with suppress(OSError):
                self.blobs.write_all([self.names[i] for i in which], slices)
                return
        if self.held is None:
            # the whole tensor in memory, where no file could be written
            self.held = x.new_empty(*x.shape[:axis], len(self.names), *x.shape[axis + 1 :])
        for i, band in zip(which, slices, strict=True):
            self.held.select(axis, i).copy_(band)
        self.inside.update(which)

    def whole(self) -> Tensor | Stacked:
        """Return all wavelength bands as one tensor; raise `Damaged` if a stored band is
        damaged.
        """
        first_blob = self.blobs.about(self.names[0]) if self.held is None else None
        if first_blob is not None:
            shape = (len(self.names), *first_blob.shape)
            return Stacked(self.blobs.read(self.names, shape, first_blob.dtype), tuple(self.names))
        assert self.held is not None
        # bands that were in the store before
        for i in set(range(len(self.names))) - self.inside:
            band = self.held.select(self.axis, i)
            band.copy_(self.blobs.read([self.names[i]], (1, *band.shape), band.dtype)[0])
        return self.held
