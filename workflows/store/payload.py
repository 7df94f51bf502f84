"""Conversion of values to metadata and tensors for the store, and loading of stored values."""

from __future__ import annotations

import hashlib
import os
import random
import stat
from collections.abc import Iterable
from typing import IO, TYPE_CHECKING, Any

from neusee.workflows.keys.seal import secrets
from neusee.workflows.store.metadata import INLINE, Metadata
from neusee.workflows.store.shared_folder import Disk

if TYPE_CHECKING:
    from torch import Tensor

    from neusee.workflows.store.band_files import Blobs

_SAMPLED = 1 / 20  #: fraction of the loads that mode ``sampled`` verifies although the file has not been touched
_draw = random.Random()  # a separate generator, so that loads do not change the random numbers of a user


def described(
    key: str, value: Any, about: Metadata, blobs: Blobs | None = None
) -> tuple[Metadata, list[Tensor], dict[str, str]]:
    """Return the metadata of a new value, the tensors that need a file, and the checksums of its bands by name.

    Small tensors are part of the metadata.
    """
    from neusee.workflows.store import serialization

    layout, tensors = serialization.pack(value, blobs)
    size = inline = sum(t.nbytes for t in tensors)
    bands = serialization.blobs_in(layout)
    if bands:
        size = max(inline, about.get("bytes") or 0)
    entry = {"key": key, **about, "layout": layout, "bytes": size, "payload": None, "kept": True}
    if inline <= INLINE:
        entry["tensors"], tensors = [serialization.to_text(t) for t in tensors], []
    return entry, tensors, bands


def written(file: IO[bytes], tensors: list[Tensor]) -> Metadata:
    """Write tensors to a new file and to the disk; return the size and the digests of the file."""
    from neusee.workflows.store import serialization

    sha256 = hashlib.sha256() if secrets() else None
    xxh3 = serialization.write(file, tensors, sha256) if sha256 else serialization.write(file, tensors)
    file.flush()
    os.fsync(file.fileno())
    return {"size": file.tell(), "xxh3": xxh3} | ({"sha256": sha256.hexdigest()} if sha256 else {})


def load(disk: Disk, about: Metadata, verify: str, blobs: Blobs, typed: bool = True) -> tuple[Any, int]:
    """Return the value that the metadata ``about`` describe, and the number of bytes compared with the checksum.

    Only bytes of the payload file are counted. With ``typed=False``, named tuples are plain tuples.

    Raises one of the errors in `UNREADABLE` if the value is missing or damaged.
    """
    from neusee.workflows.store import serialization

    payload, bands = about["payload"], about.get("bands")
    check = verify == "always" or (verify == "sampled" and _draw.random() < _SAMPLED)
    tensors, compared = [serialization.from_text(*t) for t in about.get("tensors") or ()], 0
    if payload:
        path = disk.path(about["key"], "safetensors")
        stamp = stamp_of(path)
        if stamp[1] != payload["size"]:
            raise ValueError(f"the file of tensors has {stamp[1]} bytes instead of {payload['size']} bytes")
        due = check or (verify == "sampled" and stamp != payload.get("stamp"))
        sha256 = (payload.get("sha256", ""),) if secrets() else ()  # whatever ``verify`` says: the checksum has no key
        tensors = serialization.read(path, payload["xxh3"] if due else None, *sha256)
        compared = payload["size"] if due else 0
    if bands and verify == "sampled" and not check:
        check = newest(blobs, bands["names"]) > bands["newest"]
    return serialization.unpack(about["layout"], tensors, blobs, check, typed), compared


def check_kind(value: Any, kind: Any) -> None:
    """Raise `ValueError` for a value that does not have the annotated type ``kind``."""
    from neusee.workflows.store.stored_types import fits

    if not fits(value, kind):
        raise ValueError(f"the value is {type(value).__name__}, which the step does not return")


def stamp_of(path: str) -> list[int]:
    """Return the inode, size and times (ns) of a file; any write to the file changes one of these numbers.

    Raises `ValueError` for what is no file, such as a pipe.
    """
    about = os.stat(path)
    if not stat.S_ISREG(about.st_mode):
        raise ValueError(f"{path} is not a file")
    return [about.st_ino, about.st_size, about.st_mtime_ns, about.st_ctime_ns]


def newest(blobs: Blobs, names: Iterable[str]) -> int:
    """Return the time in ns of the last change of any of the band files ``names``."""
    stats = [os.stat(blobs.path(name)) for name in names]
    return max((max(stat.st_mtime_ns, stat.st_ctime_ns) for stat in stats), default=0)
