"""What stands beside a result: one line of JSON that says what it is, sealed with the checksum of itself."""

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
INLINE = 4096  #: bytes of tensors up to which a result stands in its JSON
UNREADABLE = (OSError, ValueError, LookupError, TypeError, AttributeError, ImportError)
_OF_THE_VALUE = ("layout", "payload", "tensors", "bands")
_USED = 3600.0  #: s
_SEAL = ',"seal":"'
_SEAL_SIZE = len(_SEAL) + 32 + 2
_encode = json.JSONEncoder(separators=(",", ":")).encode


def seal(about: Metadata) -> bytes:
    """JSON whose last field is the checksum of all before it."""
    body = _encode(about)[:-1].encode()
    return body + f'{_SEAL}{xxhash.xxh3_128_hexdigest(body)}"}}'.encode()


def unseal(raw: bytes) -> Metadata:
    """What `seal` wrote, or a `ValueError`."""
    body = raw[:-_SEAL_SIZE]
    if raw[-_SEAL_SIZE:] != f'{_SEAL}{xxhash.xxh3_128_hexdigest(body)}"}}'.encode():
        raise ValueError("its description is not the one that was written")
    about: Metadata = json.loads(body + b"}")
    return about


def read(disk: Disk, key: str) -> Metadata:
    """What stands beside ``key``; one of `UNREADABLE` where nothing can be trusted."""
    with open(disk.path(key, "json"), "rb") as file:
        about = unseal(file.read())
    if about["key"] != key:
        raise ValueError(f"it is the result of {about['key']}")
    return about


def read_whole(disk: Disk, key: str) -> Metadata:
    """What stands beside ``key``, whose payload is there and has its size; one of `UNREADABLE` otherwise."""
    about = read(disk, key)
    payload = about.get("payload")
    try:
        size = os.stat(disk.path(key, "safetensors")).st_size if payload else 0
    except FileNotFoundError:
        about = read(disk, key)
        if is_kept(about):
            raise
        return about  # the value went in between
    if payload and size != payload["size"]:
        raise ValueError(f"its payload has not the {payload['size']} bytes that were written")
    return about


def find(disk: Disk, key: str) -> Metadata | None:
    """`read_whole`, or None where nothing has the name.

    What cannot be trusted is read again before it is said to be damaged: it may just be taking its name.
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
    """Whether ``key`` has a value, or something that one cannot read."""
    try:
        return is_kept(read(disk, key))
    except UNREADABLE:
        return os.path.exists(disk.path(key, "json"))


def is_kept(about: Metadata) -> bool:
    """Whether there is a value, and not the receipt alone."""
    return bool(about.get("kept", True))


def bands(about: Metadata) -> list[str]:
    """The names of the bands of a value that are stored apart."""
    names: list[str] = (about.get("bands") or {}).get("names", [])
    return names


def receipt(about: Metadata) -> Metadata:
    """All that is known of a result, without its value."""
    return {k: v for k, v in about.items() if k not in _OF_THE_VALUE} | {"kept": False}


def note_use(disk: Disk, key: str) -> None:
    """Write down, in the time of the description's last change, that a value was of use; once an hour will do."""
    path = disk.path(key, "json")
    with suppress(OSError):
        if abs(time.time() - os.stat(path).st_mtime) > _USED:
            os.utime(path)


def names(disk: Disk) -> Iterator[str]:
    """The key of every result, in order."""
    for path in sorted(disk.root.glob("[0-9a-f][0-9a-f]/*.json")):
        yield path.stem


def each(disk: Disk) -> Iterator[tuple[str, Metadata]]:
    """Every key with what stands beside it; what cannot be read is passed over."""
    for key in names(disk):
        with suppress(*UNREADABLE):
            yield key, read(disk, key)
