"""Check of the layout of a stored value, which is data that anybody may have written.

A layout is a tree of small dicts, each with one kind: ``tensor``, ``bytes``, ``stacked``, ``class``, ``tuple``,
``list``, ``dict`` or ``value``. The check knows no class and makes no value.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any, TypeGuard

from neusee.workflows.keys.seal import OtherFormat

DEEPEST = 50  #: levels of a layout
_BAND = re.compile(r"[0-9A-Za-z]{2}[0-9A-Za-z-]{0,100}(\.[0-9]{1,6})?")  #: a name without a folder in it
_DIGITS = re.compile(r"[0-9a-f]{32}")
_KINDS = ("tensor", "bytes", "stacked", "class", "tuple", "list", "dict", "value")


def checked_layout(layout: Any) -> dict[str, str]:
    """Return the checksum (xxh3) of every band file that a layout names, by the name of the band.

    Raises `OtherFormat` for a kind of layout that this program does not know, and `ValueError` for any other mistake.
    """
    bands: dict[str, str] = {}
    todo: list[tuple[Any, int]] = [(layout, 0)]
    while todo:
        item, depth = todo.pop()
        if not isinstance(item, dict) or depth > DEEPEST:
            raise ValueError("the layout of the value is not a tree of mappings, or is too deep")
        known = [kind for kind in _KINDS if kind in item]
        if len(known) != 1 or len(item) != 1 + ("class" in item):
            raise OtherFormat(f"its layout has a kind that is not known: {', '.join(map(str, item))[:80]}")
        todo += [(inner, depth + 1) for inner in _inner(known[0], item, bands)]
    return bands


def _inner(kind: str, item: dict[str, Any], bands: dict[str, str]) -> Iterable[Any]:
    """Check one level of a layout, add its bands to ``bands``, and return the layouts in it."""
    body = item[kind]
    if kind in ("tensor", "bytes"):
        _expect(is_count(body), kind)
        return ()
    if kind == "value":
        _expect(body is None or isinstance(body, bool | int | float | str), kind)
        return ()
    if kind == "stacked":
        bands |= _stacked(body)
        return ()
    if kind == "dict":
        _expect(isinstance(body, dict), kind)
        return list(body.values())
    items = item.get("items") if kind == "class" else body
    _expect(isinstance(items, list) and (kind != "class" or isinstance(body, str)), kind)
    assert isinstance(items, list)
    return items


def _stacked(body: Any) -> dict[str, str]:
    _expect(isinstance(body, dict) and body.keys() == {"names", "xxh3", "dtype", "shape"}, "stacked")
    names, sums, shape = body["names"], body["xxh3"], body["shape"]
    _expect(isinstance(body["dtype"], str) and is_shape(shape) and isinstance(names, list), "stacked")
    if bad := [name for name in names if not is_band(name)]:
        raise ValueError(f"{str(bad[0])[:60]!r} is not the name of a band file")
    _expect(isinstance(sums, list) and all(map(is_checksum, sums)), "stacked")
    _expect(shape[:1] == [len(names)] and len(sums) == len(names), "stacked")
    return dict(zip(names, sums, strict=True))


def is_count(value: Any) -> bool:
    """Return True for an integer from 0 to 2^62."""
    return type(value) is int and 0 <= value <= 1 << 62


def is_shape(value: Any) -> TypeGuard[list[int]]:
    """Return True for the list of the sizes of a tensor along its axes."""
    return isinstance(value, list) and len(value) <= 60 and all(map(is_count, value))


def is_checksum(value: Any) -> TypeGuard[str]:
    """Return True for the 32 hexadecimal digits of a checksum."""
    return isinstance(value, str) and _DIGITS.fullmatch(value) is not None


def is_band(value: Any) -> bool:
    """Return True for the name of a band file, which names no folder."""
    return isinstance(value, str) and _BAND.fullmatch(value) is not None


def are_bands(value: Any) -> TypeGuard[list[str]]:
    """Return True for a list of names of band files."""
    return isinstance(value, list) and all(map(is_band, value))


def _expect(condition: bool, kind: str) -> None:
    if not condition:
        raise ValueError(f"the part {kind} of the layout of the value is not what was written")
