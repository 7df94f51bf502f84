"""Metadata of a result: one line of JSON that describes the result and ends with its own checksum."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import xxhash

from neusee.workflows.store.shared_folder import Disk

Metadata = dict[str, Any]
INLINE = 4096  #: bytes of tensors up to which a result is stored inside its JSON
UNREADABLE = (OSError, ValueError, LookupError, TypeError, AttributeError, ImportError)
_OF_THE_VALUE = ("layout", "payload", "tensors", "bands")
_USED = 3600.0  #: s between two records of the use of a value
_SEAL = ',"seal":"'
_SEAL_SIZE = len(_SEAL) + 32 + 2
_encode = json.JSONEncoder(separators=(",", ":")).encode


def seal(about: Metadata) -> bytes:
    """Return JSON whose last field is the checksum of all bytes before that field."""
    body = _encode(about)[:-1].encode()
    return body + f'{_SEAL}{xxhash.xxh3_128_hexdigest(body)}"}}'.encode()


def unseal(raw: bytes) -> Metadata:
    """Return the metadata that `seal` wrote; raise `ValueError` where the checksum does not match."""
    body = raw[:-_SEAL_SIZE]
    if raw[-_SEAL_SIZE:] != f'{_SEAL}{xxhash.xxh3_128_hexdigest(body)}"}}'.encode():
        raise ValueError("checksum mismatch: the metadata have changed since they were written")
    about: Metadata = json.loads(body + b"}")
    return about


def read(disk: Disk, key: str) -> Metadata:
    """Return the metadata of ``key``; raise one of `UNREADABLE` where the file cannot be trusted."""
    with open(disk.path(key, "json"), "rb") as file:
        about = unseal(file.read())
    if about["key"] != key:
        raise ValueError(f"the metadata belong to the key {about['key']}")
    return about


def read_whole(disk: Disk, key: str) -> Metadata:
    """Return the metadata of ``key``, whose payload exists and has its size; raise one of `UNREADABLE` otherwise."""
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
        raise ValueError(f"the payload has {size} bytes instead of the {payload['size']} that were written")
    return about


def find(disk: Disk, key: str) -> Metadata | None:
    """Return the result of `read_whole`, or None where no file has the name.

    Metadata that cannot be trusted are read a second time before the result counts as damaged,
    because another process may be renaming the file at that moment.
    """
    for _ in range(2):
        try:
            return read_whole(disk, key)
        except UNREADABLE as error:
            if not os.path.exists(disk.path(key, "json")):
                return None
            damage = error
    raise damage


def has_value(disk: Disk, key: str) -> bool:
    """Return True if ``key`` has a value, or a file that cannot be read."""
    try:
        return is_kept(read(disk, key))
    except UNREADABLE:
        return os.path.exists(disk.path(key, "json"))


def is_kept(about: Metadata) -> bool:
    """Return True if the value is stored, and not the receipt alone."""
    return bool(about.get("kept", True))


def bands(about: Metadata) -> list[str]:
    """Return the names of the bands that the value keeps in files of their own."""
    names: list[str] = (about.get("bands") or {}).get("names", [])
    return names


def receipt(about: Metadata) -> Metadata:
    """Return the metadata of a result without the fields that describe the stored value."""
    return {k: v for k, v in about.items() if k not in _OF_THE_VALUE} | {"kept": False}


def note_use(disk: Disk, key: str) -> None:
    """Record the use of a value as the change time of its JSON file, at most once an hour."""
    path = disk.path(key, "json")
    with suppress(OSError):
        if abs(time.time() - os.stat(path).st_mtime) > _USED:
            os.utime(path)


def names(disk: Disk) -> Iterator[str]:
    """Yield the key of every result in ascending order."""
    for path in sorted(disk.root.glob("[0-9a-f][0-9a-f]/*.json")):
        yield path.stem


def each(disk: Disk) -> Iterator[tuple[str, Metadata]]:
    """Yield every key with its metadata; skip metadata that cannot be read."""
    for key in names(disk):
        with suppress(*UNREADABLE):
            yield key, read(disk, key)
