"""Metadata of a result: one line of JSON, with a check of its fields and of its layout."""

from __future__ import annotations

import math
import os
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from typing import Any, TypeGuard

from neusee.workflows.keys.sealed_files import (
    Kind,
    NotRead,
    OtherFormat,
    seal_record,
    unseal_record,
)
from neusee.workflows.store.shared_folder import Disk, entries, read_file

# --- layout check ---------------------------------------------------------------------------------

# Check of the layout of a stored value. Stored data may come from anybody.
#
# A layout is a tree of small dicts, each with one kind: ``tensor``, ``bytes``, ``class``,
# ``tuple``, ``list``, ``dict`` or ``value``. The check knows no class and makes no value.


DEEPEST = 50  #: greatest depth of a layout
_DIGITS = re.compile(r"[0-9a-f]{32}")
_KINDS = ("tensor", "bytes", "class", "tuple", "list", "dict", "value")


def check_layout(layout: Any) -> None:
    """Raise `OtherFormat` for a kind of layout that this program does not know, and `ValueError`
    for any other mistake.

    An earlier version kept spectral bands in files of their own, with the kind ``stacked``.
    """
    layouts_left: list[tuple[Any, int]] = [(layout, 0)]
    while layouts_left:
        item, depth = layouts_left.pop()
        if not isinstance(item, dict) or depth > DEEPEST:
            raise ValueError("the layout of the value is not a tree of mappings, or is too deep")
        kinds = [kind for kind in _KINDS if kind in item]
        # a class has the entry ``items`` beside its name; any other kind has a single entry
        if len(kinds) != 1 or len(item) != 1 + ("class" in item):
            raise OtherFormat(
                f"its layout has a kind that is not known: {', '.join(map(str, item))[:80]}"
            )
        layouts_left += [(inner_layout, depth + 1) for inner_layout in _inner(kinds[0], item)]


def _inner(kind: str, item: dict[str, Any]) -> Iterable[Any]:
    """Check one level of a layout, and return the layouts inside it."""
    content = item[kind]
    if kind in ("tensor", "bytes"):
        _expect(is_count(content), kind)
        return ()
    # a number or text that needs no tensor
    if kind == "value":
        _expect(content is None or isinstance(content, bool | int | float | str), kind)
        return ()
    if kind == "dict":
        _expect(isinstance(content, dict), kind)
        return list(content.values())
    items = item.get("items") if kind == "class" else content
    _expect(isinstance(items, list) and (kind != "class" or isinstance(content, str)), kind)
    assert isinstance(items, list)
    return items


def is_count(value: Any) -> bool:
    """Return True for an integer from 0 to 2^62."""
    return type(value) is int and 0 <= value <= 1 << 62


def is_shape(value: Any) -> TypeGuard[list[int]]:
    """Return True for the list of the sizes of a tensor along its axes."""
    return isinstance(value, list) and len(value) <= 60 and all(map(is_count, value))


def is_checksum(value: Any) -> TypeGuard[str]:
    """Return True for the 32 hexadecimal digits of a checksum."""
    return isinstance(value, str) and _DIGITS.fullmatch(value) is not None


def _expect(condition: bool, kind: str) -> None:
    if not condition:
        raise ValueError(f"the part {kind} of the layout of the value is not what was written")


# --- metadata fields ------------------------------------------------------------------------------

# Check of the metadata of a result: types and ranges of the fields. Stored data may come from
# anybody.


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
    """Return True for a valid description of a file of tensors: its size, its digests and its
    stamp.
    """
    is_payload = (
        isinstance(value, dict) and is_count(value.get("size")) and is_checksum(value.get("xxh3"))
    )
    sha256, stamp = (
        (value.get("sha256", ""), value.get("stamp", [])) if is_payload else (None, None)
    )
    return is_payload and isinstance(sha256, str) and isinstance(stamp, list)


def _is_inline(value: Any) -> bool:
    return isinstance(value, list) and all(map(_is_tensor, value))


def _is_tensor(value: Any) -> bool:
    """Return True for a valid tensor in the metadata: type, shape, whether it is complex, and its
    bytes as text.
    """
    if not isinstance(value, list) or len(value) != 4:
        return False
    kind, shape, is_complex, text = value
    return (
        isinstance(kind, str)
        and is_shape(shape)
        and isinstance(is_complex, bool)
        and isinstance(text, str)
    )


def _is_origin(value: Any) -> bool:
    return isinstance(value, dict) and all(
        value.get(name) is None or is_text(value[name]) for name in ("node", "code")
    )


def _is_checks(value: Any) -> bool:
    return isinstance(value, list) and all(
        isinstance(c, list) and [*map(type, c)] == [str, bool] for c in value
    )


def _is_file(value: Any) -> bool:
    return is_text(value) and "/" not in value and value not in ("", ".", "..")


def _is_error(value: Any) -> bool:
    return (
        isinstance(value, list | tuple)
        and len(value) == 2
        and all(isinstance(x, int | float) for x in value)
    )


def _is_step_size(value: Any) -> bool:
    return (
        isinstance(value, list | tuple)
        and len(value) == 4
        and all(is_number(x) and x >= 0 for x in value)
    )


#: the check of each field, applied unless the field is missing or null
FIELDS: Mapping[str, Callable[[Any], bool]] = {
    "step": is_text,
    "recipe": is_text,
    "date": is_text,
    "device": is_text,
    "seconds": is_seconds,
    "processor_seconds": is_seconds,
    "processor": is_text,
    "threads": is_count,
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
}


def checked_fields(about: dict[str, Any], key: str) -> dict[str, Any]:
    """Return the metadata of the result ``key`` after a check of their fields.

    Raises `OtherFormat` for a layout of an unknown kind, and `ValueError` for any other field that
    is invalid.
    """
    if (stated_key := about.get("key")) != key:
        raise ValueError(
            f"the metadata of {key} belong to the key {stated_key if is_text(stated_key) else '?'}"
        )
    for name, is_right in FIELDS.items():
        value = about.get(name)
        if value is not None and not is_right(value):
            raise ValueError(
                f"the field {name} of the metadata is not what was written: {str(value)[:60]!r}"
            )
    # metadata of a stored value: the layout must be known, and the file of tensors stated
    if about.get("kept", True):
        check_layout(about.get("layout"))
        if "payload" not in about:
            raise ValueError(
                "the metadata do not name the files that the layout of the value needs"
            )
    return about


# --- metadata -------------------------------------------------------------------------------------

# Metadata of a result: one line of JSON that describes the result and ends with its own checksum.


Metadata = dict[str, Any]
INLINE = 4096  #: bytes of tensors up to which a result is stored inside its JSON
UNREADABLE = (
    OSError,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    RuntimeError,
    ArithmeticError,
    MemoryError,
)
_USE_RECORD_SECONDS = 3600.0  #: smallest time in s between two records of the use of a value
_RESULT_FOLDER = re.compile("[0-9a-f]{2}")
_OF_THE_VALUE = ("layout", "payload", "tensors")


def read(disk: Disk, key: str) -> Metadata:
    """Return the metadata of ``key``; raise one of the errors in `UNREADABLE` if the file is
    missing or damaged.

    Raises `NotRead` for metadata of another format version, or without the required
    signature.
    """
    return unseal_of("result", key, read_file(disk.path(key, "json")))


def unseal_of(kind: Kind, key: str, raw: bytes) -> Metadata:
    """Return the metadata that `seal_record` wrote for ``key``; raise `ValueError` for the
    metadata of another key.
    """
    return checked_fields(unseal_record(kind, raw), key)


def write(disk: Disk, key: str, about: Metadata, over: bool) -> bool:
    """Write the metadata of ``key``; if ``over`` is False, keep an existing file and return
    False.
    """
    path = disk.path(key, "json")
    with disk.temporary(key) as (temporary, file):
        file.write(seal_record("result", about))
        file.flush()  # without a sync to disk, because torn metadata fail their checksum
        # False if the file exists
        is_new = disk.link(temporary, path)
        if over and not is_new:
            disk.rename(temporary, path)
    return over or is_new


def _read_whole(disk: Disk, key: str) -> Metadata:
    """Return the metadata of the result ``key`` after a check that its file of tensors has the
    right size.

    Raises an error in `UNREADABLE` if a file is missing or damaged.
    """
    entry = read(disk, key)
    payload_entry = entry.get("payload")
    try:
        file_size = os.stat(disk.path(key, "safetensors")).st_size if payload_entry else 0
    except FileNotFoundError:
        entry = read(disk, key)
        if is_kept(entry):
            raise
        return entry  # the value was evicted between the two reads
    if payload_entry and file_size != payload_entry["size"]:
        raise ValueError(
            f"the file of tensors has {file_size} bytes instead of {payload_entry['size']} bytes"
        )
    return entry


def find(disk: Disk, key: str) -> Metadata | None:
    """Return the metadata of ``key``, or None if there are none; raise an error in `UNREADABLE` for
    damaged metadata.

    Damaged metadata are read a second time before the result counts as damaged, because another
    process may be renaming the file at that moment.
    """
    # the second reading decides
    for _ in range(2):
        try:
            return _read_whole(disk, key)
        except NotRead:
            raise
        except UNREADABLE as error:
            if not os.path.exists(disk.path(key, "json")):
                return None
            damage = error
    raise damage


def has_value(disk: Disk, key: str) -> bool:
    """Return True if the store has a value for ``key``, or metadata of ``key`` that are damaged."""
    try:
        return is_kept(read(disk, key))
    except NotRead:
        return False
    except UNREADABLE:
        return os.path.exists(disk.path(key, "json"))


def record_use(disk: Disk, key: str) -> None:
    """Record the use of a value as the modification time of its JSON file, at most once an hour."""
    path = disk.path(key, "json")
    with suppress(OSError):
        if abs(time.time() - os.stat(path).st_mtime) > _USE_RECORD_SECONDS:
            os.utime(path)


def is_kept(about: Metadata | None) -> TypeGuard[Metadata]:
    """Return True if the metadata of a result describe a stored value, not an evicted or unsaved
    value.
    """
    return about is not None and bool(about.get("kept", True))


def receipt(about: Metadata) -> Metadata:
    """Return the metadata of a result without the fields that describe the stored value."""
    return {k: v for k, v in about.items() if k not in _OF_THE_VALUE} | {"kept": False}


def names(disk: Disk) -> Iterator[str]:
    """Yield the cache key of every result of a store in ascending order; follow no symbolic
    link.
    """
    for folder in _folders(disk):
        files = (entry.name.rpartition(".") for entry in entries(folder.path))
        yield from sorted(
            key for key, _, suffix in files if suffix == "json" and key[:2] == folder.name
        )


def _folders(disk: Disk) -> list[os.DirEntry[str]]:
    """Return the folders of a store that hold results, whose names are two hexadecimal digits,
    in order.
    """
    named_folders = [
        entry for entry in entries(disk.folder) if _RESULT_FOLDER.fullmatch(entry.name)
    ]
    return sorted(
        (entry for entry in named_folders if entry.is_dir(follow_symlinks=False)),
        key=lambda entry: entry.name,
    )


def each(disk: Disk) -> Iterator[tuple[str, Metadata]]:
    """Yield the key and the metadata of every result of a store; skip metadata that cannot be
    read.
    """
    for key in names(disk):
        with suppress(*UNREADABLE):
            yield key, read(disk, key)
