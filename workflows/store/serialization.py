"""Format of a stored value: a layout in JSON, types by name, tensors in safetensors."""

from __future__ import annotations

import base64
import functools
import hashlib
import json
import math
import mmap
import os
import types
import typing
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import IO, Any, TypeGuard, get_args, get_origin, get_type_hints

import torch
import xxhash
from torch import Tensor

from neusee.nodes import Node, registered_nodes, values
from neusee.workflows.keys.sealed_files import may_change
from neusee.workflows.store.metadata import check_layout, is_count, is_shape
from neusee.workflows.store.shared_folder import open_now

# --- stored types ---------------------------------------------------------------------------------

# Registry of the named tuples that a stored value may contain, by their names in stored values.
#
# The registry contains the named tuples of `neusee.nodes.values`, and those in the annotations of
# the inputs and the result of each node that this process has defined or imported. A name in a
# stored value is only looked up here, so that no content of a store can import a module or choose a
# function. A recipe imports its nodes, and so also the types of their values.


NamedTupleType = type[tuple[Any, ...]]

_types: dict[str, NamedTupleType] = {}
_looked_at: dict[str, Node] = {}
_all_nodes: list[tuple[Node, ...]] = [()]  #: the registered nodes at the last update


class UnknownType(ValueError):
    """Error for a stored value that names a type outside the registry; the value counts as
    missing.
    """


def type_name(kind: type) -> str:
    """Return the name under which the registry has a named tuple: its module and its own name."""
    return f"{kind.__module__}:{kind.__qualname__}"


def stored_type(name: str) -> NamedTupleType:
    """Return the named tuple with the name ``name`` in the registry; raise `UnknownType` for any
    other name.
    """
    _update()
    if name not in _types:
        raise UnknownType(
            f"{name!r} is not the type of an input or a result of a node that this process knows"
        )
    return _types[name]


def is_registered(kind: type) -> bool:
    """Return True if values of the named tuple ``kind`` can be stored."""
    _update()
    return _types.get(type_name(kind)) is kind


def made(kind: NamedTupleType, items: list[Any]) -> Any:
    """Return a named tuple of the class ``kind`` with the fields ``items``, without running code of
    the class.

    Raises `ValueError` for a wrong number of fields, or for a field that does not fit its
    annotation.
    """
    names: tuple[str, ...] = kind._fields  # type: ignore[attr-defined]
    if len(items) != len(names):
        raise ValueError(f"{kind.__name__} has {len(names)} fields, not {len(items)}")
    hints = _hints(kind)
    for name, item in zip(names, items, strict=True):
        if not fits(item, hints.get(name, Any)):
            raise ValueError(f"the field {name} of {kind.__name__} cannot be {type(item).__name__}")
    return tuple.__new__(kind, items)


_PLAIN = (Tensor, bool, str, bytes, list, dict)  #: types that are checked with `isinstance`


def fits(value: Any, kind: Any) -> bool:
    """Return True if a value has the annotated type ``kind``; True also for a type that stored
    values cannot have.
    """
    origin, type_arguments = get_origin(kind), get_args(kind)
    if origin is typing.Annotated:
        # Annotated[type, notes]
        return fits(value, type_arguments[0])
    if origin in (typing.Union, types.UnionType):
        return any(fits(value, union_member) for union_member in type_arguments)
    if origin in (list, dict) or (origin is tuple and not hasattr(value, "_fields")):
        return isinstance(value, origin) and _items_fit(value, origin, type_arguments)
    # stored values have no other types with parameters
    return origin is not None or _fits_plain(value, kind)


def _fits_plain(value: Any, kind: Any) -> bool:
    """Return True if a value has the type ``kind`` without parameters; True also for a type that
    stored values cannot have.
    """
    if kind is None or kind is types.NoneType:
        return value is None
    # bool is a subclass of int in Python, but does not count as a number here
    if kind is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    if kind is int:
        return isinstance(value, int) and not isinstance(value, bool)
    if isinstance(kind, type) and (kind in _PLAIN or _is_named_tuple(kind)):
        return isinstance(value, kind)
    return True


def _items_fit(value: Any, origin: type, inner: tuple[Any, ...]) -> bool:
    """Return True if the items of a list, dict or tuple have the types ``inner`` in the brackets
    of the annotation.
    """
    if origin is dict:
        # dict[key type, value type]; keys are always texts
        return len(inner) != 2 or all(fits(item, inner[1]) for item in value.values())
    # list[type] or tuple[type, ...]
    if origin is list or inner[1:] == (...,):
        return not inner or all(fits(item, inner[0]) for item in value)
    return len(value) == len(inner) and all(map(fits, value, inner))


def _is_named_tuple(kind: Any) -> TypeGuard[NamedTupleType]:
    """Return True for the class of a named tuple."""
    return isinstance(kind, type) and issubclass(kind, tuple) and hasattr(kind, "_fields")


def _update() -> None:
    """Add the types of nodes that were defined or imported since the last call."""
    if not _types:
        for kind in vars(values).values():
            _add(kind)
    known_nodes = registered_nodes()
    if known_nodes == _all_nodes[0]:  # the same objects, as almost always
        return
    _all_nodes[0] = known_nodes
    for node in known_nodes:
        # a new node, or one that was defined again
        if _looked_at.get(name := f"{node.fn.__module__}:{node.fn.__name__}") is not node:
            _looked_at[name] = node
            for kind in _annotated(node):
                _add(kind)


def _annotated(node: Node) -> Iterator[Any]:
    """Yield the annotated types of the inputs and the result of a node."""
    try:
        hints = node.hints
    except Exception:  # an annotation may be any text; the check of a recipe reports it
        return
    yield from (hints.get(name) for name in (*node.inputs, "return"))


def _add(kind: Any) -> None:
    """Add a type and the types in its parts, if they are named tuples."""
    types_to_add, visited_ids = [kind], set[int]()
    while types_to_add:
        kind = types_to_add.pop()
        if id(kind) in visited_ids:
            continue
        visited_ids.add(id(kind))
        types_to_add += get_args(kind)
        if _is_named_tuple(kind):
            _types[type_name(kind)] = kind
            types_to_add += _hints(kind).values()


@functools.lru_cache(256)
def _hints(kind: type) -> dict[str, Any]:
    """Return the annotated types of the fields of a class; none if they cannot be read."""
    try:
        return get_type_hints(kind, include_extras=True)
    except Exception:  # an annotation may be any text
        return {}


# --- serialization --------------------------------------------------------------------------------

# Format of a stored value: a layout in JSON, and the tensors in one safetensors file.
#
# The file is written from the memory of the tensors and read through a memory map, so that neither
# writing nor reading makes a copy. Each tensor begins at a multiple of 64 bytes like a newly
# allocated tensor, so that a kernel uses the same code path for a stored value and a computed
# value.


_PIECE = 1 << 18  #: number of bytes of a file that are read at once
_ALIGN = 64
#: first letter of the names of padding entries, which fill up to the next multiple of `_ALIGN`
_FILLER = "_"
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
    """Return ``value`` with the function ``change`` applied once to every distinct tensor in
    ``value``.
    """
    return _change(value, change, {})


def _change(item: Any, change: Callable[[Tensor], Tensor], done: dict[int, Tensor]) -> Any:
    """Return ``item`` with ``change`` applied to its tensors; ``done`` has the changed tensors by
    identity.

    A nested function would hold the tensors until garbage collection.
    """
    if isinstance(item, Tensor):
        if id(item) not in done:
            done[id(item)] = change(item)
        return done[id(item)]
    if isinstance(item, tuple):
        changed_items = [_change(i, change, done) for i in item]
        return item._make(changed_items) if hasattr(item, "_make") else tuple(changed_items)
    if isinstance(item, list):
        return [_change(i, change, done) for i in item]
    return (
        {k: _change(v, change, done) for k, v in item.items()} if isinstance(item, dict) else item
    )


def tensors_in(value: Any) -> list[Tensor]:
    """Return the distinct tensors in ``value``."""
    tensors: list[Tensor] = []
    each_tensor(lambda t: tensors.append(t) or t, value)  # type: ignore[func-returns-value]
    return tensors


def settle(value: Any) -> Any:
    """Return ``value`` as if it were read from the store: with contiguous tensors that use no
    memory beyond their own elements.

    They have no added attributes and no user-defined class, and require a gradient only if
    gradients are being recorded.
    """
    return each_tensor(_settled, value)


def _settled(x: Tensor) -> Tensor:
    """Return a tensor of its own class, contiguous, with no memory beyond its elements."""
    x = _bare(x).resolve_conj().resolve_neg().contiguous()
    try:
        has_spare_memory = x.untyped_storage().nbytes() > x.nbytes
    except (
        NotImplementedError
    ):  # a tensor inside a transform of torch.func has no memory of its own
        has_spare_memory = False
    return x.clone(memory_format=torch.contiguous_format) if has_spare_memory else x


def forget_attributes(x: Tensor) -> None:
    """Delete the attributes that code has attached to a tensor: a step that reads it from the store
    would not see them either.
    """
    if type(x) is Tensor and vars(x):
        vars(x).clear()


def _bare(x: Tensor) -> Tensor:
    """Return a tensor without the properties that the store does not keep: gradient, attributes and
    user-defined class.
    """
    if x.requires_grad and not torch.is_grad_enabled():
        x = x.detach()
    kind = type(x)
    # a plain tensor may have added attributes; a class outside of torch is user-defined
    if vars(x) if kind is Tensor else kind.__module__.partition(".")[0] != "torch":
        with torch._C.DisableTorchFunctionSubclass():
            return x.as_subclass(Tensor)
    return x


class _Listed:
    """List of the tensors of one file, in which tensors that share memory and shape appear once."""

    def __init__(self) -> None:
        self.tensors: list[Tensor] = []
        self._known: dict[tuple[Any, ...], int] = {}

    def add(self, x: Tensor) -> int:
        # an empty tensor has no address
        identity = (x.data_ptr() or id(x), x.dtype, x.shape, x.stride(), x.is_conj(), x.is_neg())
        if identity not in self._known:
            self._known[identity] = len(self.tensors)
            self.tensors.append(x.detach())
        return self._known[identity]


def pack(value: Any) -> tuple[Any, list[Tensor]]:
    """Return the JSON layout of ``value`` and its tensors.

    Raises `TypeError` for a value that cannot be stored.
    """
    listed = _Listed()
    return _layout(value, listed), listed.tensors


def _layout(item: Any, listed: _Listed) -> dict[str, Any]:
    """Return the layout of a value, and add its tensors to ``listed``."""
    if isinstance(item, Tensor):
        return {"tensor": listed.add(item)}
    if isinstance(item, bytes):
        return {"bytes": listed.add(_tensor_of_bytes(item))}
    if isinstance(item, tuple | list | dict):
        return _collection_layout(item, listed)
    if item is None or isinstance(item, bool | int | float | str):
        return {"value": item}
    raise _cannot_be_stored(item)


def _cannot_be_stored(item: Any) -> TypeError:
    return TypeError(
        "a step must return tensors, numbers, strings, bytes or collections of these, not"
        f" {type(item)}"
    )


def _tensor_of_bytes(text: bytes) -> Tensor:
    """Return bytes as a tensor; separately for no bytes, since torch cannot read an empty
    buffer.
    """
    return torch.frombuffer(bytearray(text), dtype=torch.uint8) if text else torch.empty(0)


def _collection_layout(
    item: tuple[Any, ...] | list[Any] | dict[Any, Any], listed: _Listed
) -> dict[str, Any]:
    """Return the layout of a dict, list, tuple or named tuple."""
    if isinstance(item, dict):
        if not all(isinstance(key, str) for key in item):
            raise _cannot_be_stored(item)
        return {"dict": {key: _layout(value, listed) for key, value in item.items()}}
    items = [_layout(i, listed) for i in item]
    if isinstance(item, list):
        return {"list": items}
    return {"tuple": items} if type(item) is tuple else {"class": _class_name(item), "items": items}


def unpack(layout: Any, tensors: list[Tensor], typed: bool = True) -> Any:
    """Return the value that `pack` turned into ``layout`` and ``tensors``; ``typed=False`` gives
    plain tuples.

    Raises `UnknownType` for a named tuple that is not in the registry of `serialization`, and
    `ValueError` for a layout that `pack` did not write.
    """
    check_layout(layout)
    return _unpacked(layout, tensors, typed)


def _unpacked(layout: dict[str, Any], tensors: list[Tensor], typed: bool) -> Any:
    """Return the value of a layout; see `unpack`."""
    unpack_item = partial(_unpacked, tensors=tensors, typed=typed)
    if "class" in layout:
        items = list(map(unpack_item, layout["items"]))
        return made(stored_type(layout["class"]), items) if typed else tuple(items)
    # any other layout has one entry
    ((kind, body),) = layout.items()
    if kind in ("tensor", "bytes"):
        return _stored_tensor(kind, body, tensors)
    if kind in ("tuple", "list"):
        items = list(map(unpack_item, body))
        return tuple(items) if kind == "tuple" else items
    if kind == "dict":
        return dict(zip(body, map(unpack_item, body.values()), strict=True))
    return body


def _stored_tensor(kind: str, number: int, tensors: list[Tensor]) -> Tensor | bytes:
    """Return the tensor with a given number in the file, or the bytes that it contains."""
    if number >= len(tensors):
        raise ValueError(f"the value needs tensor {number}, but only {len(tensors)} are stored")
    return tensors[number] if kind == "tensor" else _bytes(tensors[number])


def bytes_of(x: Tensor) -> memoryview:
    """Return the bytes of a tensor, without a copy if the tensor is contiguous and on the CPU."""
    # torch may conjugate or negate a tensor by a flag alone, without new elements
    flat = x.detach().cpu().resolve_conj().resolve_neg().contiguous().reshape(-1)
    # a single element is contiguous whatever its stride, but cannot be viewed as bytes
    if flat.stride() != (1,):
        flat = flat.clone(memory_format=torch.contiguous_format)
    return flat.view(torch.uint8).numpy().data


def _bytes(x: Tensor) -> bytes:
    """Return the bytes that a tensor stores; see `_tensor_of_bytes`."""
    if x.dtype != torch.uint8 and x.numel():
        raise ValueError(f"bytes cannot be stored as a tensor of {x.dtype}")
    return x.numpy().tobytes()


def _class_name(item: tuple[Any, ...]) -> str:
    """Return the name of the class of a named tuple in the registry; raise `TypeError` for any
    other class.
    """
    kind = type(item)
    if not is_registered(kind):
        advice = (
            "annotate the node's result with it" if hasattr(item, "_fields") else "use a NamedTuple"
        )
        raise TypeError(f"{kind.__module__}.{kind.__qualname__} cannot be stored: {advice}")
    return type_name(kind)


def to_text(x: Tensor) -> list[Any]:
    """Return a small tensor as four JSON values: type, shape, True for a complex tensor, and the
    bytes as text.
    """
    return [*_kind(x), base64.b64encode(bytes_of(x)).decode()]


def from_text(kind: str, shape: list[int], is_complex: bool, text: str) -> Tensor:
    """Return the tensor that `to_text` turned into four JSON values."""
    raw_bytes = bytearray(base64.b64decode(text, validate=True))
    x = _tensor(raw_bytes, 0, kind, shape, is_complex)
    if x.nbytes != len(raw_bytes):
        raise ValueError(f"a tensor of {x.nbytes} bytes is stored as {len(raw_bytes)} bytes")
    return x


def write(file: IO[bytes], tensors: list[Tensor], also: Any = None) -> str:
    """Write tensors to a safetensors file; return the checksum (xxh3) of all bytes.

    ``also`` is a hash object of `hashlib` that receives the same bytes.
    """
    digest = xxhash.xxh3_128()
    for piece in _parts(tensors):
        file.write(piece)
        for hasher in (digest, also) if also is not None else (digest,):
            hasher.update(piece)
    return digest.hexdigest()


def _parts(tensors: list[Tensor]) -> Iterator[bytes | memoryview]:
    """Yield the bytes of a safetensors file: the length of the header, the header, and the
    padded tensors.
    """
    header: dict[str, Any] = {"__metadata__": {}}
    offset = 0
    for i, x in enumerate(tensors):
        type_name, shape, is_complex = _kind(x)
        header["__metadata__"][str(i)] = "complex" if is_complex else "real"
        header[str(i)] = {
            "dtype": type_name,
            "shape": shape,
            "data_offsets": [offset, offset + x.nbytes],
        }
        offset += x.nbytes
        # the next tensor is aligned
        if padding := -offset % _ALIGN:
            header[f"{_FILLER}{i}"] = {
                "dtype": "U8",
                "shape": [padding],
                "data_offsets": [offset, offset + padding],
            }
            offset += padding
    header_text = json.dumps(header, separators=(",", ":")).encode()
    # padded with spaces, so that the first tensor is aligned too; 8 bytes are the length
    header_text += b" " * (-(8 + len(header_text)) % _ALIGN)
    yield len(header_text).to_bytes(8, "little")
    yield header_text
    for x in tensors:
        yield bytes_of(x)
        yield bytes(-x.nbytes % _ALIGN)


def read(path: str, expected: str | None, sha256: str | None = None) -> list[Tensor]:
    """Map the tensors in a safetensors file into memory, or copy them if another user could change
    them.

    Compare the file with the checksum ``expected`` and the digest ``sha256`` if given. Raises
    `ValueError` for a file that differs, or that `write` did not write.
    """
    checksum_hasher = xxhash.xxh3_128() if expected is not None else None
    sha256_hasher = hashlib.sha256() if sha256 is not None else None
    with open(path, "rb", buffering=0, opener=open_now) as file:
        file_bytes = _mapped(
            file, [digest for digest in (checksum_hasher, sha256_hasher) if digest is not None]
        )
    if checksum_hasher is not None and checksum_hasher.hexdigest() != expected:
        raise ValueError("checksum mismatch: the stored bytes have changed since they were written")
    if sha256_hasher is not None and sha256_hasher.hexdigest() != sha256:
        raise ValueError("the stored bytes are not those that were signed")
    return _tensors_in(file_bytes)


def _mapped(file: IO[bytes], digests: Sequence[Any]) -> mmap.mmap:
    """Map a file into memory, or copy it if another user could change it; the ``digests`` are
    updated with its bytes.
    """
    if may_change(file.fileno()):
        data = _copied(file)
        for digest in digests:
            digest.update(data)
        return data
    # digests are computed by reading: if a device fails, a read raises an error, but access to a
    # memory map ends the process
    digests_of(file, *digests)
    return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)


def _tensors_in(data: mmap.mmap) -> list[Tensor]:
    """Return the tensors of a safetensors file; raise ValueError for a file that `write` did not
    write.
    """
    # 8 bytes with the length of the header, the header, the tensors
    first_byte = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:first_byte]) if first_byte <= len(data) else None
    if not isinstance(header, dict) or not isinstance(
        complex_or_real := header.get("__metadata__"), dict
    ):
        raise ValueError("the header of the file of tensors is missing or cut short")
    # names of tensors are numbers; names of padding entries are not
    numbers = sorted(int(name) for name in header if name.isdecimal())
    return [
        _entry(data, first_byte, header.get(str(i)), complex_or_real.get(str(i))) for i in numbers
    ]


def _copied(file: IO[bytes]) -> mmap.mmap:
    """Return the bytes of a file in memory of this process."""
    size = os.fstat(file.fileno()).st_size
    memory, bytes_read = mmap.mmap(-1, size), 0
    while bytes_read < size and (count := file.readinto(memoryview(memory)[bytes_read:])):  # type: ignore[attr-defined]
        bytes_read += count
    return memory


def digests_of(file: IO[bytes], *digests: Any) -> list[str]:
    """Return the digests of a file as texts, each of all its bytes, read piece by piece."""
    piece = memoryview(bytearray(_PIECE if digests else 0))
    while digests and (count := file.readinto(piece)):  # type: ignore[attr-defined]
        for digest in digests:
            digest.update(piece[:count])
    return [digest.hexdigest() for digest in digests]


def _entry(data: Any, start: int, entry: Any, kind: Any) -> Tensor:
    """Return the tensor that one entry of the header describes; ``start`` is the first byte after
    the header, ``kind`` is real or complex.
    """
    offsets = entry.get("data_offsets") if isinstance(entry, dict) else None
    if not is_shape(offsets) or len(offsets) != 2 or kind not in ("real", "complex"):
        raise ValueError("the header of the file of tensors is not what was written")
    x = _tensor(data, start + offsets[0], entry.get("dtype"), entry.get("shape"), kind == "complex")
    if offsets[1] - offsets[0] != x.nbytes:
        raise ValueError(
            f"a tensor of {x.nbytes} bytes is stored as {offsets[1] - offsets[0]} bytes"
        )
    return x


def _kind(x: Tensor) -> tuple[str, list[int], bool]:
    """Return the safetensors type, the shape and whether a tensor is complex; a complex tensor
    is stored as pairs of real numbers.
    """
    real_dtype = torch.empty(0, dtype=x.dtype).real.dtype if x.is_complex() else x.dtype
    if real_dtype not in _DTYPES:
        raise TypeError(f"a tensor of {x.dtype} cannot be stored")
    return _DTYPES[real_dtype], [*x.shape, 2] if x.is_complex() else list(x.shape), x.is_complex()


def tensor_kind(x: Tensor) -> str:
    """Return the name of a tensor's type in safetensors; raise ValueError for a type without a
    name.
    """
    name = "C64" if x.dtype == torch.complex64 else _DTYPES.get(x.dtype)
    if name is None:
        raise ValueError(f"safetensors has no name for {x.dtype}")
    return name


def _type_and_count(kind: Any, shape: Any) -> tuple[torch.dtype, int]:
    """Return the type and the number of elements of a stored tensor; raise `ValueError` if type or
    shape is invalid.
    """
    dtype = _NAMES.get(kind) if isinstance(kind, str) else None
    count = math.prod(shape) if is_shape(shape) else None
    if dtype is None or count is None or not is_count(count):
        raise ValueError(
            f"a stored tensor has the type {str(kind)[:20]} and the shape {str(shape)[:60]}"
        )
    return dtype, count


def _tensor(data: Any, offset: int, kind: Any, shape: Any, is_complex: bool) -> Tensor:
    """Return the tensor at an offset of ``data``; raise `ValueError` if type, shape or size is
    invalid.
    """
    dtype, count = _type_and_count(kind, shape)
    # pairs of floating-point numbers of at least 16 bits
    if is_complex and (shape[-1:] != [2] or not dtype.is_floating_point or dtype.itemsize < 2):
        raise ValueError(f"a complex tensor is stored as {kind} of the shape {shape}")
    if offset + count * dtype.itemsize > len(data):
        raise ValueError(f"a stored tensor of {count} elements is longer than its file")
    elements = (
        torch.frombuffer(data, dtype=dtype, count=count, offset=offset)
        if count
        else torch.empty(0, dtype=dtype)
    )
    x = elements.reshape(shape)
    return torch.view_as_complex(x) if is_complex else x
