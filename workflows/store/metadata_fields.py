"""Check of the metadata of a result, which are data that anybody may have written: types and ranges of the fields."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from neusee.workflows.store.layout_check import are_bands, checked_layout, is_checksum, is_count, is_shape

LONGEST = 1e9  #: s; no step takes longer
LARGEST = 1 << 50  #: bytes; no result or memory is larger
_LONGEST_TEXT = 4096


def is_text(value: Any) -> bool:
    """Return True for a text of one line without control characters."""
    return isinstance(value, str) and len(value) <= _LONGEST_TEXT and value.isprintable()


def is_seconds(value: Any) -> bool:
    """Return True for a finite time in s that a step may take."""
    return is_number(value) and 0 <= value <= LONGEST


def is_size(value: Any) -> bool:
    """Return True for a number of bytes that a result or a memory may have."""
    return is_number(value) and 0 <= value <= LARGEST


def is_number(value: Any) -> bool:
    """Return True for a finite number."""
    return type(value) is int or (type(value) is float and math.isfinite(value))


def _is_payload(value: Any) -> bool:
    known = isinstance(value, dict) and is_count(value.get("size")) and is_checksum(value.get("xxh3"))
    sha256, stamp = (value.get("sha256", ""), value.get("stamp", [])) if known else (None, None)
    return known and isinstance(sha256, str) and isinstance(stamp, list)


def _is_inline(value: Any) -> bool:
    return isinstance(value, list) and all(map(_is_tensor, value))


def _is_tensor(value: Any) -> bool:
    if not isinstance(value, list) or len(value) != 4:
        return False
    kind, shape, is_complex, text = value
    return isinstance(kind, str) and is_shape(shape) and isinstance(is_complex, bool) and isinstance(text, str)


def _is_bands(value: Any) -> bool:
    return isinstance(value, dict) and are_bands(value.get("names")) and is_count(value.get("newest"))


def _is_origin(value: Any) -> bool:
    return isinstance(value, dict) and all(value.get(name) is None or is_text(value[name]) for name in ("node", "code"))


def _is_checks(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(c, list) and [*map(type, c)] == [str, bool] for c in value)


def _is_file(value: Any) -> bool:
    return is_text(value) and "/" not in value and value not in ("", ".", "..")


def _is_error(value: Any) -> bool:
    return isinstance(value, list | tuple) and len(value) == 2 and all(isinstance(x, int | float) for x in value)


def _is_step_size(value: Any) -> bool:
    return isinstance(value, list | tuple) and len(value) == 4 and all(is_number(x) and x >= 0 for x in value)


#: what each field must be, unless it is missing or null
FIELDS: Mapping[str, Callable[[Any], bool]] = {
    "step": is_text,
    "recipe": is_text,
    "date": is_text,
    "device": is_text,
    "seconds": is_seconds,
    "bytes": is_size,
    "peak": is_size,
    "size": _is_step_size,
    "file_bytes": is_size,
    "kept": lambda value: isinstance(value, bool),
    "origin": _is_origin,
    "facts": lambda value: isinstance(value, dict),
    "versions": lambda value: isinstance(value, dict),
    "checks": _is_checks,
    "error": _is_error,
    "file": _is_file,
    "payload": _is_payload,
    "tensors": _is_inline,
    "bands": _is_bands,
}


def checked_fields(about: dict[str, Any], key: str) -> dict[str, Any]:
    """Return the metadata of the result ``key`` after a check of their fields.

    Raises `OtherFormat` for a layout of an unknown kind, and `ValueError` for any other field that cannot be right.
    """
    if (own := about.get("key")) != key:
        raise ValueError(f"the metadata of {key} belong to the key {own if is_text(own) else '?'}")
    for name, is_right in FIELDS.items():
        value = about.get(name)
        if value is not None and not is_right(value):
            raise ValueError(f"the field {name} of the metadata is not what was written: {str(value)[:60]!r}")
    if about.get("kept", True):
        named, bands = checked_layout(about.get("layout")), (about.get("bands") or {}).get("names", [])
        if named.keys() != set(bands) or "payload" not in about:
            raise ValueError("the metadata do not name the files that the layout of the value needs")
    return about
