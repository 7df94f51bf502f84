"""Results by band: if one band of a stack of 31 has changed, one band is computed and written.

A node that declares its bands computes each band to the same bits whatever the other bands are. A band therefore has a
key of its own: a digest of that band of the inputs and of everything else that determines the band. Its slice of the
result is a blob of that name. Hashing reads the inputs once at memory speed, where computing reads them many times.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from math import ceil
from typing import Any

import torch
import xxhash
from torch import Tensor

from neusee.nodes.values import BAND_FIELDS
from neusee.workflows.graph.recipe_graph import Step
from neusee.workflows.keys.cache_key import digest, plain
from neusee.workflows.store.band_files import Blobs, Damaged, Stacked, bytes_of
from neusee.workflows.store.serialization import pack

LEAST = 1 << 22  #: bytes of a result below which the result is kept as one tensor
_ALIGN = 64  #: bytes; a kernel may take another path at another alignment
_TRIES = 3  #: attempts that may find damaged bands before all bands are computed


def call_by_band(
    step: Step,
    inputs: Sequence[Any],
    evaluate: Callable[[Sequence[Any]], Any],
    code: str,
    blobs: Blobs,
    parts: int = 1,
) -> Any:
    """Return the result of ``step``; ``evaluate`` computes only the bands that ``blobs`` does not hold.

    ``code`` is the digest of the node's code. ``parts`` is the number of passes; more need less memory. Tensors of
    the result that can be stored by band are returned as `Stacked`; `plain_of` returns the value itself.
    """
    count = band_count(step, inputs)
    if count < 2:
        return evaluate(inputs)
    keys = band_keys(step, inputs, code)
    fields = range(_fields(step))
    for _ in range(_TRIES):
        missing = [i for i, key in enumerate(keys) if not all(blobs.has(f"{key}.{n}") for n in fields)]
        if len(missing) == count and parts == 1:
            break
        try:
            return _gathered(step, inputs, evaluate, keys, missing, ceil(count / parts), blobs)
        except Damaged:  # the next attempt finds the damaged band missing
            continue
    return _stacked(step, evaluate(inputs), keys)


def plain_of(value: Any) -> Any:
    """Return ``value`` with a plain tensor in place of every stack."""
    if isinstance(value, Stacked):
        return value.tensor
    return value._make(map(plain_of, value)) if type(value) in BAND_FIELDS else value


def band_count(step: Step, inputs: Sequence[Any]) -> int:
    """Return the number of bands that a step computes independently; 0 where its node or its inputs have none."""
    banded = list(_banded(step, inputs))
    if any(not isinstance(value, Tensor) and type(value) not in BAND_FIELDS for _, value in banded):
        return 0  # a low-rank cube has no slice of one band
    found = {x.shape[axis] for axis, value in banded for x in band_tensors(value) if _has(x, axis)}
    return found.pop() if len(found) == 1 else 0


def band_keys(step: Step, inputs: Sequence[Any], code: str) -> list[str]:
    """Return the key of each band: node, code, parameters, that band of the inputs and the whole other inputs."""
    params = {name: plain(value) for name, value in step.params.items()}
    same: list[Any] = ["band", step.node.path, code, params]
    each: list[list[str]] = []
    for name, value in zip(step.node.inputs, inputs, strict=False):
        axis = _axis(step, name, value)
        same.append([name, axis, content(value if axis is None else _without_bands(value))])
        if axis is not None:
            each += [[_hashed(part) for part in x.unbind(axis)] for x in band_tensors(value)]
    return [digest(same, list(band)) for band in zip(*each, strict=True)]


def content(value: Any) -> list[Any]:
    """Return the content of a value as JSON: its layout, and type, shape and xxh3 of each tensor."""
    layout, tensors = pack(value)
    return [layout, [_hashed(x) for x in tensors]]


def _hashed(x: Tensor) -> str:
    return f"{x.dtype} {tuple(x.shape)} {xxhash.xxh3_128_hexdigest(bytes_of(x))}"


def _axis(step: Step, name: str, value: Any) -> int | None:
    return None if value is None or step.node.bands is None else step.node.bands.get(name)


def _banded(step: Step, inputs: Sequence[Any]) -> Iterator[tuple[int, Any]]:
    for name, value in zip(step.node.inputs, inputs, strict=False):
        axis = _axis(step, name, value)
        if axis is not None:
            yield axis, value


def band_tensors(value: Any) -> list[Tensor]:
    """Return the tensors of a value that have bands."""
    if isinstance(value, Tensor):
        return [value]
    return [getattr(value, name) for name in BAND_FIELDS[type(value)]]


def with_band_tensors(value: Any, tensors: Sequence[Tensor]) -> Any:
    """Return ``value`` with other tensors in place of those that have bands."""
    if isinstance(value, Tensor):
        return tensors[0]
    return value._replace(**dict(zip(BAND_FIELDS[type(value)], tensors, strict=True)))


def _without_bands(value: Any) -> Any:
    return None if isinstance(value, Tensor) else value._replace(**dict.fromkeys(BAND_FIELDS[type(value)]))


def _has(x: Tensor, axis: int) -> bool:
    return -x.dim() <= axis < x.dim()


def taken(step: Step, inputs: Sequence[Any], which: list[int], of: Collection[str] | None = None) -> list[Any]:
    """Return the inputs with the bands ``which`` only; ``of`` names the inputs to slice (all banded inputs if None)."""
    found = list(inputs)
    for i, (name, value) in enumerate(zip(step.node.inputs, inputs, strict=False)):
        axis = _axis(step, name, value)
        if axis is None or (of is not None and name not in of):
            continue
        if isinstance(value, Tensor):
            found[i] = _slices(value, axis, which)
        else:
            fields = {name: _slices(getattr(value, name), axis, which) for name in BAND_FIELDS[type(value)]}
            found[i] = value._replace(**fields)
    return found


def _slices(x: Tensor, axis: int, which: list[int]) -> Tensor:
    """Return a view where it is laid out in memory like a new tensor, else a copy."""
    if which == list(range(which[0], which[0] + len(which))):
        part = x.narrow(axis, which[0], len(which))
        if part.is_contiguous() and part.data_ptr() % _ALIGN == 0:
            return part
    return x.index_select(axis, torch.tensor(which, device=x.device))


def _fields(step: Step) -> int:
    """Return the number of tensors in the result of a step."""
    kind = step.node.hints["return"]
    return len(kind._fields) if kind in BAND_FIELDS else 1


def _rebuilt(step: Step, items: list[Any]) -> Any:
    kind = step.node.hints["return"]
    return kind._make(items) if kind in BAND_FIELDS else items[0]


def _stacked(step: Step, value: Any, keys: list[str]) -> Any:
    """Return a result that was computed as a whole, with the names of its bands if the result is large."""
    tensors = band_tensors(value)
    leading = all(x.shape[0] == len(keys) and _leads(step, x) for x in tensors)
    if not leading or sum(x.nbytes for x in tensors) < LEAST:
        return value
    items = [Stacked(x, tuple(f"{key}.{n}" for key in keys)) for n, x in enumerate(tensors)]
    return _rebuilt(step, items)


def _leads(step: Step, x: Tensor) -> bool:
    """Return True if the bands are the first axis, because only such a stack lies in memory band by band."""
    assert step.node.bands is not None
    return _has(x, step.node.bands["return"]) and step.node.bands["return"] % x.dim() == 0


def _gathered(
    step: Step,
    inputs: Sequence[Any],
    evaluate: Callable[[Sequence[Any]], Any],
    keys: list[str],
    missing: list[int],
    size: int,
    blobs: Blobs,
) -> Any:
    """Compute the missing bands, ``size`` at a time, and assemble all bands; raise `Damaged` for a damaged band."""
    assert step.node.bands is not None
    axis = step.node.bands["return"]
    stacks = [_Stack(axis, [f"{key}.{n}" for key in keys], blobs) for n in range(_fields(step))]
    for start in range(0, len(missing), size):
        which = missing[start : start + size]
        for stack, x in zip(stacks, band_tensors(evaluate(taken(step, inputs, which))), strict=True):
            stack.add(which, x)
    return _rebuilt(step, [stack.whole() for stack in stacks])


class _Stack:
    """One tensor of an unfinished result: its bands go to the store, or to memory where the store cannot be written."""

    def __init__(self, axis: int, names: list[str], blobs: Blobs) -> None:
        self.axis, self.names, self.blobs = axis, names, blobs
        self.held: Tensor | None = None
        self.inside: set[int] = set()  # bands that are in memory

    def add(self, which: list[int], x: Tensor) -> None:
        """Add the bands ``which``."""
        axis = self.axis % x.dim()
        slices = x.unbind(axis)
        if axis == 0 and self._written(which, slices):
            return
        if self.held is None:
            self.held = x.new_empty(*x.shape[:axis], len(self.names), *x.shape[axis + 1 :])
        for i, part in zip(which, slices, strict=True):
            self.held.select(axis, i).copy_(part)
        self.inside.update(which)

    def whole(self) -> Tensor | Stacked:
        """Return all bands as one tensor; raise `Damaged` for a damaged band."""
        blob = self.blobs.about(self.names[0]) if self.held is None else None
        if blob is not None:
            shape = (len(self.names), *blob.shape)
            return Stacked(self.blobs.read(self.names, shape, blob.dtype), tuple(self.names))
        assert self.held is not None
        for i in set(range(len(self.names))) - self.inside:
            part = self.held.select(self.axis, i)
            part.copy_(self.blobs.read([self.names[i]], (1, *part.shape), part.dtype)[0])
        return self.held

    def _written(self, which: list[int], slices: Sequence[Tensor]) -> bool:
        try:
            self.blobs.write_all([self.names[i] for i in which], slices)
        except OSError:
            return False
        return True
