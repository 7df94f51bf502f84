"""Conversion of values to metadata and tensors for the store, and loading of stored values."""

from __future__ import annotations

import os
import random
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from neusee.workflows.store.metadata import INLINE, Metadata
from neusee.workflows.store.shared_folder import Disk

if TYPE_CHECKING:
    from torch import Tensor

    from neusee.workflows.store.band_files import Blobs

_SAMPLED = 1 / 20  #: fraction of the loads that mode ``sampled`` verifies although the file has not been touched
_draw = random.Random()  # a separate generator, so that loads do not change the random numbers of a user


def described(key: str, value: Any, about: Metadata, blobs: Blobs | None = None) -> tuple[Metadata, list[Tensor]]:
    """Return the metadata of a new value and the tensors that need a file; small tensors are part of the metadata."""
    from neusee.workflows.store import serialization

    layout, tensors = serialization.pack(value, blobs)
    size = inline = sum(t.nbytes for t in tensors)
    if serialization.blobs_in(layout):
        size = max(inline, about.get("bytes") or 0)
    entry = {"key": key, **about, "layout": layout, "bytes": size, "payload": None, "kept": True}
    if inline <= INLINE:
        entry["tensors"], tensors = [serialization.to_text(t) for t in tensors], []
    return entry, tensors


def load(disk: Disk, about: Metadata, verify: str, blobs: Blobs) -> tuple[Any, int]:
    """Return the value that the metadata ``about`` describe, and the number of bytes compared with the checksum.

    Only bytes of the payload file are counted.

    Raises one of the errors in `UNREADABLE` if the value is missing or damaged.
    """
    from neusee.workflows.store import serialization

    payload, bands = about["payload"], about.get("bands")
    check = verify == "always" or (verify == "sampled" and _draw.random() < _SAMPLED)
    tensors, compared = [serialization.from_text(*t) for t in about.get("tensors", ())], 0
    if payload:
        path = disk.path(about["key"], "safetensors")
        stamp = stamp_of(path)
        if stamp[1] != payload["size"]:
            raise ValueError(f"the file of tensors has {stamp[1]} bytes instead of {payload['size']} bytes")
        due = check or (verify == "sampled" and stamp != payload.get("stamp"))
        tensors, compared = serialization.read(path, payload["xxh3"] if due else None), payload["size"] if due else 0
    if bands and verify == "sampled" and not check:
        check = newest(blobs, bands["names"]) > bands["newest"]
    return serialization.unpack(about["layout"], tensors, blobs, check), compared


def stamp_of(path: str) -> list[int]:
    """Return the inode, size and times (ns) of a file; any write to the file changes one of these numbers."""
    stat = os.stat(path)
    return [stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns]


def newest(blobs: Blobs, names: Iterable[str]) -> int:
    """Return the time in ns of the last change of any of the band files ``names``."""
    stats = [os.stat(blobs.path(name)) for name in names]
    return max((max(stat.st_mtime_ns, stat.st_ctime_ns) for stat in stats), default=0)
