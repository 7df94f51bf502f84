"""Format of a stored value: a layout in JSON, and the tensors in one safetensors file.

The file is written from the memory of the tensors and read through a memory map, so that neither writing nor reading
makes a copy. Each tensor begins at a multiple of 64 bytes like a newly allocated tensor, so that a kernel uses the same
code path for a stored value and a computed value. The layout of a `Stacked` tensor names one band file for each slice.
"""

from __future__ import annotations

import base64
import importlib
import json
import math
import mmap
from collections.abc import Callable
from typing import IO, Any

import torch
import xxhash
from torch import Tensor

from neusee.workflows.store.band_files import Blobs, Stacked, bytes_of, dtype_of

_ALIGN = 64
_FILLER = "_"  #: first letter of the names of padding entries, which fill up to the next multiple of `_ALIGN`
_DTYPES = {
    torch.float64: "F64",
    torch.float32: "F32",
    torch.float16: "F16",
    torch.bfloat16: "BF16",
    torch.float8_e4m3fn: "F8_E4M3",
    torch.float8_e5m2: "F8_E5M2",
    torch.int64: "I64",
    torch.int32: "I32",
    torch.int16: "I16",
    torch.int8: "I8",
    torch.uint64: "U64",
    torch.uint32: "U32",
    torch.uint16: "U16",
    torch.uint8: "U8",
    torch.bool: "BOOL",
}
_NAMES = {name: dtype for dtype, name in _DTYPES.items()}


def each_tensor(change: Callable[[Tensor], Tensor], value: Any) -> Any:
    """Return ``value`` with the function ``change`` applied once to every distinct tensor in ``value``."""
    return _change(value, change, {})


def _change(item: Any, change: Callable[[Tensor], Tensor], done: dict[int, Tensor]) -> Any:
    """Return ``item`` with ``change`` applied to its tensors; ``done`` has the changed tensors by identity.

    A nested function would hold the tensors until garbage collection.
    """
    if isinstance(item, Tensor):
        if id(item) not in done:
            done[id(item)] = change(item)
        return done[id(item)]
    if isinstance(item, tuple):
        items = [_change(i, change, done) for i in item]
        return item._make(items) if hasattr(item, "_make") else tuple(items)
    if isinstance(item, list):
        return [_change(i, change, done) for i in item]
    return {k: _change(v, change, done) for k, v in item.items()} if isinstance(item, dict) else item


def tensors_in(value: Any) -> list[Tensor]:
    """Return the distinct tensors in ``value``."""
    tensors: list[Tensor] = []
    each_tensor(lambda t: tensors.append(t) or t, value)  # type: ignore[func-returns-value]
    return tensors


def settle(value: Any) -> Any:
    """Return ``value`` as if read from the store: contiguous tensors that hold no memory beyond their own elements."""
    return each_tensor(_settled, value)


def _settled(x: Tensor) -> Tensor:
    x = x.resolve_conj().resolve_neg().contiguous()
    try:
        spare = x.untyped_storage().nbytes() > x.nbytes
    except NotImplementedError:  # a tensor inside a transform of torch.func has no memory of its own
        spare = False
    return x.clone(memory_format=torch.contiguous_format) if spare else x


class _Listed:
    """List of the tensors of one file, in which tensors that share memory and shape appear once."""

    def __init__(self) -> None:
        self.tensors: list[Tensor] = []
        self._known: dict[tuple[Any, ...], int] = {}

    def add(self, x: Tensor) -> int:
        identity = (x.data_ptr() or id(x), x.dtype, x.shape, x.stride(), x.is_conj(), x.is_neg())
        if identity not in self._known:
            self._known[identity] = len(self.tensors)
            self.tensors.append(x.detach())
        return self._known[identity]


def pack(value: Any, blobs: Blobs | None = None) -> tuple[Any, list[Tensor]]:
    """Return the JSON layout of ``value`` and its tensors; write `Stacked` tensors to the folder ``blobs`` if given.

    Raises `TypeError` for a value that cannot be stored, and `OSError` if ``blobs`` cannot be written.
    """
    listed = _Listed()
    return _layout(value, listed, blobs), listed.tensors


def _layout(item: Any, listed: _Listed, blobs: Blobs | None) -> dict[str, Any]:
    if isinstance(item, Stacked):
        return _layout(item.tensor, listed, None) if blobs is None else _stack_layout(item, blobs)
    if isinstance(item, Tensor):
        return {"tensor": listed.add(item)}
    if isinstance(item, bytes):
        return {"bytes": listed.add(torch.frombuffer(bytearray(item), dtype=torch.uint8) if item else torch.empty(0))}
    if isinstance(item, tuple):
        return {"class": _class_path(item), "items": [_layout(i, listed, blobs) for i in item]}
    if isinstance(item, list):
        return {"list": [_layout(i, listed, blobs) for i in item]}
    if isinstance(item, dict) and all(isinstance(k, str) for k in item):
        return {"dict": {k: _layout(v, listed, blobs) for k, v in item.items()}}
    if item is None or isinstance(item, bool | int | float | str):
        return {"value": item}
    raise TypeError(f"a step must return tensors, numbers, strings, bytes or collections of these, not {type(item)}")


def _stack_layout(item: Stacked, blobs: Blobs) -> dict[str, Any]:
    written = blobs.write_all(item.names, item.tensor.unbind())
    kind = str(item.tensor.dtype).removeprefix("torch.")
    return {"stacked": {"names": item.names, "xxh3": written, "dtype": kind, "shape": list(item.tensor.shape)}}


def unpack(layout: Any, tensors: list[Tensor], blobs: Blobs | None = None, verify: bool = True) -> Any:
    """Return the value that `pack` turned into ``layout`` and ``tensors``; raise `ValueError` if a band is damaged."""
    ((kind, body),) = ((k, v) for k, v in layout.items() if k != "items")
    if kind == "tensor":
        return tensors[body]
    if kind == "stacked":
        if blobs is None:
            raise ValueError("the value has band files: give the folder of the band files as ``blobs``")
        return blobs.read(body["names"], body["shape"], dtype_of(body["dtype"]), verify, body["xxh3"])
    if kind == "bytes":
        return tensors[body].numpy().tobytes()
    if kind == "class":
        items = (unpack(i, tensors, blobs, verify) for i in layout["items"])
        return _class(body)(*items) if body else tuple(items)
    if kind == "list":
        return [unpack(i, tensors, blobs, verify) for i in body]
    return {k: unpack(v, tensors, blobs, verify) for k, v in body.items()} if kind == "dict" else body


def blobs_in(layout: Any) -> dict[str, str]:
    """Return the checksum (xxh3) of every band file that the layout of a value names, by the name of the band."""
    checksums: dict[str, str] = {}
    todo = [layout]
    while todo:
        item = todo.pop()
        if "stacked" in item:
            checksums |= zip(item["stacked"]["names"], item["stacked"]["xxh3"], strict=True)
        todo += item.get("items", item.get("list", item.get("dict", {}).values()))
    return checksums


def _class_path(item: tuple[Any, ...]) -> str:
    """Return the module and the name of the class of a named tuple, or an empty string for a plain tuple."""
    kind = type(item)
    if kind is tuple:
        return ""
    if not kind.__module__.startswith("neusee.nodes.") or not hasattr(item, "_fields"):
        raise TypeError(f"{kind.__module__}.{kind.__qualname__} cannot be stored: use a NamedTuple of neusee.nodes")
    return f"{kind.__module__}:{kind.__qualname__}"


def _class(path: str) -> Callable[..., Any]:
    module, _, name = path.partition(":")
    if not module.startswith("neusee.nodes."):
        raise ValueError(f"the stored class {path} is not a class of neusee.nodes")
    named_tuple: Callable[..., Any] = getattr(importlib.import_module(module), name)
    return named_tuple


def to_text(x: Tensor) -> list[Any]:
    """Return a small tensor as four JSON values: type, shape, True for a complex tensor, and the bytes as text."""
    return [*_kind(x), base64.b64encode(bytes_of(x)).decode()]


def from_text(kind: str, shape: list[int], is_complex: bool, text: str) -> Tensor:
    """Return the tensor that `to_text` turned into four JSON values."""
    return _tensor(bytearray(base64.b64decode(text)), 0, kind, shape, is_complex)


def write(file: IO[bytes], tensors: list[Tensor]) -> str:
    """Write tensors to a safetensors file; return the checksum (xxh3) of all bytes."""
    header: dict[str, Any] = {"__metadata__": {}}
    end = 0
    for i, x in enumerate(tensors):
        kind, shape, is_complex = _kind(x)
        header["__metadata__"][str(i)] = "complex" if is_complex else "real"
        header[str(i)] = {"dtype": kind, "shape": shape, "data_offsets": [end, end + x.nbytes]}
        end += x.nbytes
        if pad := -end % _ALIGN:
            header[f"{_FILLER}{i}"] = {"dtype": "U8", "shape": [pad], "data_offsets": [end, end + pad]}
            end += pad
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-(8 + len(text)) % _ALIGN)
    digest = xxhash.xxh3_128()
    for block in (len(text).to_bytes(8, "little"), text):
        file.write(block)
        digest.update(block)
    for x in tensors:
        for part in (bytes_of(x), bytes(-x.nbytes % _ALIGN)):
            file.write(part)
            digest.update(part)
    return digest.hexdigest()


def read(path: str, expected: str | None) -> list[Tensor]:
    """Map the tensors in a safetensors file into memory; compare the file with the checksum ``expected`` if given."""
    with open(path, "rb") as file:
        data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
    if expected is not None and xxhash.xxh3_128_hexdigest(data) != expected:
        raise ValueError("checksum mismatch: the stored bytes have changed since they were written")
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])
    tensors = []
    for i, name in sorted((int(n), n) for n in header if n.isdigit()):
        entry, is_complex = header[name], header["__metadata__"][str(i)] == "complex"
        tensors.append(_tensor(data, 8 + size + entry["data_offsets"][0], entry["dtype"], entry["shape"], is_complex))
    return tensors


def _kind(x: Tensor) -> tuple[str, list[int], bool]:
    real = torch.empty(0, dtype=x.dtype).real.dtype if x.is_complex() else x.dtype
    if real not in _DTYPES:
        raise TypeError(f"a tensor of {x.dtype} cannot be stored")
    return _DTYPES[real], [*x.shape, 2] if x.is_complex() else list(x.shape), x.is_complex()


def _tensor(data: Any, offset: int, kind: str, shape: list[int], is_complex: bool) -> Tensor:
    dtype, count = _NAMES[kind], math.prod(shape)
    flat = torch.frombuffer(data, dtype=dtype, count=count, offset=offset) if count else torch.empty(0, dtype=dtype)
    x = flat.reshape(shape)
    return torch.view_as_complex(x) if is_complex else x
