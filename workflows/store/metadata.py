"""Metadata of a result: one line of JSON that describes the result and ends with its own checksum."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, TypeGuard

import xxhash

from neusee.workflows.store.shared_folder import Disk

Metadata = dict[str, Any]
INLINE = 4096  #: bytes of tensors up to which a result is stored inside its JSON
UNREADABLE = (OSError, ValueError, LookupError, TypeError, AttributeError, ImportError)
_OF_THE_VALUE = ("layout", "payload", "tensors", "bands")
_SEAL = ',"seal":"'
_SEAL_SIZE = len(_SEAL) + 32 + 2
_encode = json.JSONEncoder(separators=(",", ":")).encode


def seal(about: Metadata) -> bytes:
    """Return the metadata of a result as JSON whose last field is the checksum of all bytes before that field."""
    body = _encode(about)[:-1].encode()
    return body + f'{_SEAL}{xxhash.xxh3_128_hexdigest(body)}"}}'.encode()


def unseal(raw: bytes) -> Metadata:
    """Return the metadata that `seal` wrote; raise `ValueError` if the checksum does not match."""
    body = raw[:-_SEAL_SIZE]
    if raw[-_SEAL_SIZE:] != f'{_SEAL}{xxhash.xxh3_128_hexdigest(body)}"}}'.encode():
        raise ValueError("checksum mismatch: the metadata have changed since they were written")
    about: Metadata = json.loads(body + b"}")
    return about


def read(disk: Disk, key: str) -> Metadata:
    """Return the metadata of ``key``; raise one of the errors in `UNREADABLE` if the file is missing or damaged."""
    with open(disk.path(key, "json"), "rb") as file:
        return unseal_of(key, file.read())


def unseal_of(key: str, raw: bytes) -> Metadata:
    """Return the metadata that `seal` wrote for ``key``; raise `ValueError` for the metadata of another key."""
    about = unseal(raw)
    if about["key"] != key:
        raise ValueError(f"the metadata of {key} belong to the key {about['key']}")
    return about


def write(disk: Disk, key: str, about: Metadata, over: bool) -> bool:
    """Write the metadata of ``key``; if ``over`` is False, keep an existing file and return False."""
    path = disk.path(key, "json")
    with disk.temporary(key) as (part, file):
        file.write(seal(about))
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
        except UNREADABLE as error:
            if not os.path.exists(disk.path(key, "json")):
                return None
            damage = error
    raise damage


def has_value(disk: Disk, key: str) -> bool:
    """Return True if the store has a value for ``key``, or metadata of ``key`` that cannot be read."""
    try:
        return is_kept(read(disk, key))
    except UNREADABLE:
        return os.path.exists(disk.path(key, "json"))


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
    """Yield the cache key of every result of a store in ascending order."""
    for path in sorted(disk.root.glob("[0-9a-f][0-9a-f]/*.json")):
        yield path.stem


def each(disk: Disk) -> Iterator[tuple[str, Metadata]]:
    """Yield the key and the metadata of every result of a store; skip metadata that cannot be read."""
    for key in names(disk):
        with suppress(*UNREADABLE):
            yield key, read(disk, key)
