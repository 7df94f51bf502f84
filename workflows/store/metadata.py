"""Metadata of a result: one line of JSON that describes the result and ends with its own checksum."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, TypeGuard

from neusee.workflows.keys.seal import Kind, NotRead, seal_record, unseal_record
from neusee.workflows.store.metadata_fields import checked_fields
from neusee.workflows.store.shared_folder import Disk, entries, read_file

Metadata = dict[str, Any]
INLINE = 4096  #: bytes of tensors up to which a result is stored inside its JSON
UNREADABLE = (OSError, ValueError, LookupError, TypeError, AttributeError, RuntimeError, ArithmeticError, MemoryError)
_USED = 3600.0  #: smallest time in s between two records of the use of a value
_TOP = re.compile("[0-9a-f]{2}")
_OF_THE_VALUE = ("layout", "payload", "tensors", "bands")


def read(disk: Disk, key: str) -> Metadata:
    """Return the metadata of ``key``; raise one of the errors in `UNREADABLE` if the file is missing or damaged.

    Raises `NotRead` for the metadata of another format version, or without the signature that is asked for.
    """
    return unseal_of("result", key, read_file(disk.path(key, "json")))


def unseal_of(kind: Kind, key: str, raw: bytes) -> Metadata:
    """Return the metadata that `seal_record` wrote for ``key``; raise `ValueError` for the metadata of another key."""
    return checked_fields(unseal_record(kind, raw), key)


def write(disk: Disk, key: str, about: Metadata, over: bool) -> bool:
    """Write the metadata of ``key``; if ``over`` is False, keep an existing file and return False."""
    path = disk.path(key, "json")
    with disk.temporary(key) as (part, file):
        file.write(seal_record("result", about))
        file.flush()  # without a sync to disk, because torn metadata fail their checksum
        linked = disk.link(part, path)
        if over and not linked:
            disk.rename(part, path)
    return over or linked


def _read_whole(disk: Disk, key: str) -> Metadata:
    """Return the metadata of the result ``key`` after a check that its file of tensors has the right size.

    Raises an error in `UNREADABLE` if a file is missing or damaged.
    """
    about = read(disk, key)
    payload = about.get("payload")
    try:
        size = os.stat(disk.path(key, "safetensors")).st_size if payload else 0
    except FileNotFoundError:
        about = read(disk, key)
        if is_kept(about):
            raise
        return about  # the value was evicted between the two reads
    if payload and size != payload["size"]:
        raise ValueError(f"the file of tensors has {size} bytes instead of {payload['size']} bytes")
    return about


def find(disk: Disk, key: str) -> Metadata | None:
    """Return the metadata of ``key``, or None if there are none; raise an error in `UNREADABLE` for damaged metadata.

    Damaged metadata are read a second time before the result counts as damaged, because another process may be
    renaming the file at that moment.
    """
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
        if abs(time.time() - os.stat(path).st_mtime) > _USED:
            os.utime(path)


def is_kept(about: Metadata | None) -> TypeGuard[Metadata]:
    """Return True if the metadata of a result describe a stored value, not an evicted or unsaved value."""
    return about is not None and bool(about.get("kept", True))


def bands(about: Metadata) -> list[str]:
    """Return the names of the spectral bands of a stored value that have band files."""
    return list((about.get("bands") or {}).get("names", []))


def receipt(about: Metadata) -> Metadata:
    """Return the metadata of a result without the fields that describe the stored value."""
    return {k: v for k, v in about.items() if k not in _OF_THE_VALUE} | {"kept": False}


def names(disk: Disk) -> Iterator[str]:
    """Yield the cache key of every result of a store in ascending order; follow no symbolic link."""
    for folder in _folders(disk):
        found = (entry.name.rpartition(".") for entry in entries(folder.path))
        yield from sorted(key for key, _, suffix in found if suffix == "json" and key[:2] == folder.name)


def _folders(disk: Disk) -> list[os.DirEntry[str]]:
    found = [entry for entry in entries(disk.folder) if _TOP.fullmatch(entry.name)]
    return sorted((entry for entry in found if entry.is_dir(follow_symlinks=False)), key=lambda entry: entry.name)


def each(disk: Disk) -> Iterator[tuple[str, Metadata]]:
    """Yield the key and the metadata of every result of a store; skip metadata that cannot be read."""
    for key in names(disk):
        with suppress(*UNREADABLE):
            yield key, read(disk, key)
