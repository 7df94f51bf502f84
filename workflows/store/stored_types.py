"""Registry of the named tuples that a stored value may contain, by the name that a stored value gives.

The registry has the named tuples of `neusee.nodes.values`, and those in the annotations of the inputs and the result
of each node that this process has defined or imported. A name that a stored value gives is only looked up here, so
that no content of a store imports a module or chooses a function. A recipe imports its nodes, hence also the types of
the values that it makes and reads.
"""

from __future__ import annotations

import functools
import types
import typing
from collections.abc import Iterator
from typing import Any, TypeGuard, get_args, get_origin, get_type_hints

from torch import Tensor

from neusee.nodes import Node, registered_nodes, values

NamedTupleType = type[tuple[Any, ...]]

_types: dict[str, NamedTupleType] = {}
_looked_at: dict[str, Node] = {}
_all_nodes: list[tuple[Node, ...]] = [()]  #: those of the last look


class UnknownType(ValueError):
    """Error for a stored value that names a type outside the registry; the value counts as missing."""


def type_name(kind: type) -> str:
    """Return the name under which the registry has a named tuple: its module and its own name."""
    return f"{kind.__module__}:{kind.__qualname__}"


def stored_type(name: str) -> NamedTupleType:
    """Return the named tuple with the name ``name`` in the registry; raise `UnknownType` for any other name."""
    _update()
    if name not in _types:
        raise UnknownType(f"{name!r} is not the type of an input or a result of a node that this process knows")
    return _types[name]


def is_registered(kind: type) -> bool:
    """Return True if values of the named tuple ``kind`` can be stored."""
    _update()
    return _types.get(type_name(kind)) is kind


def made(kind: NamedTupleType, items: list[Any]) -> Any:
    """Return a named tuple with the fields ``items``, without a call of its class.

    Raises `ValueError` for a wrong number of fields, or for a field that does not fit its annotation.
    """
    names: tuple[str, ...] = kind._fields  # type: ignore[attr-defined]
    if len(items) != len(names):
        raise ValueError(f"{kind.__name__} has {len(names)} fields, not {len(items)}")
    hints = _hints(kind)
    for name, item in zip(names, items, strict=True):
        if not fits(item, hints.get(name, Any)):
            raise ValueError(f"the field {name} of {kind.__name__} cannot be {type(item).__name__}")
    return tuple.__new__(kind, items)


def fits(value: Any, kind: Any) -> bool:
    """Return True if a value has the annotated type ``kind``; a type that no stored value has allows every value."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin is typing.Annotated:
        return fits(value, inner[0])
    if origin in (typing.Union, types.UnionType):
        return any(fits(value, each) for each in inner)
    if origin in (list, dict) or (origin is tuple and not hasattr(value, "_fields")):
        return isinstance(value, origin) and _items_fit(value, origin, inner)
    if kind is None or kind is types.NoneType:
        return value is None
    if kind is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    if kind is int:
        return isinstance(value, int) and not isinstance(value, bool)
    simple = (
        isinstance(kind, type)
        and origin is None
        and (kind in (Tensor, bool, str, bytes, list, dict) or _is_named_tuple(kind))
    )
    return isinstance(value, kind) if simple else True


def _items_fit(value: Any, origin: type, inner: tuple[Any, ...]) -> bool:
    if origin is dict:
        return len(inner) != 2 or all(fits(item, inner[1]) for item in value.values())
    if origin is list or inner[1:] == (...,):
        return not inner or all(fits(item, inner[0]) for item in value)
    return len(value) == len(inner) and all(map(fits, value, inner))


def _is_named_tuple(kind: Any) -> TypeGuard[NamedTupleType]:
    return isinstance(kind, type) and issubclass(kind, tuple) and hasattr(kind, "_fields")


def _update() -> None:
    """Add the types of nodes that were defined or imported since the last call."""
    if not _types:
        for kind in vars(values).values():
            _add(kind)
    nodes = registered_nodes()
    if nodes == _all_nodes[0]:  # the same objects, as almost always
        return
    _all_nodes[0] = nodes
    for node in nodes:
        if _looked_at.get(name := f"{node.fn.__module__}:{node.fn.__name__}") is not node:
            _looked_at[name] = node
            for kind in _annotated(node):
                _add(kind)


def _annotated(node: Node) -> Iterator[Any]:
    try:
        hints = node.hints
    except Exception:  # an annotation may be any text; the check of a recipe reports it
        return
    yield from (hints.get(name) for name in (*node.inputs, "return"))


def _add(kind: Any) -> None:
    """Add a type and the types in its parts, if they are named tuples."""
    todo, seen = [kind], set[int]()
    while todo:
        kind = todo.pop()
        if id(kind) in seen:
            continue
        seen.add(id(kind))
        todo += get_args(kind)
        if _is_named_tuple(kind):
            _types[type_name(kind)] = kind
            todo += _hints(kind).values()


@functools.lru_cache(256)
def _hints(kind: type) -> dict[str, Any]:
    try:
        return get_type_hints(kind, include_extras=True)
    except Exception:  # an annotation may be any text
        return {}
