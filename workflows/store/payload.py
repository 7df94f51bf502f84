"""Load the payload of a result and compare its checksum as often as the verify mode asks."""

from __future__ import annotations

import os
import random
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from neusee.workflows.store.metadata import Metadata
from neusee.workflows.store.shared_folder import Disk

if TYPE_CHECKING:
    from neusee.workflows.store.band_files import Blobs

_SAMPLED = 1 / 20  #: fraction of the loads that mode ``sampled`` verifies although the file has not been touched
_draw = random.Random()  # a generator of the store's own: loads do not change the random numbers of a user


def blobs_of(disk: Disk) -> Blobs:
    """Return the band files of the store in ``disk``."""
    from neusee.workflows.store.band_files import Blobs

    return Blobs(disk.root / "bands")


def load(disk: Disk, about: Metadata, verify: str, blobs: Blobs) -> tuple[Any, int]:
    """Return the value that ``about`` describes and the number of payload bytes whose checksum was compared.

    Raises one of `UNREADABLE` where the value cannot be trusted.
    """
    from neusee.workflows.store import serialization

    payload, bands = about["payload"], about.get("bands")
    check = verify == "always" or (verify == "sampled" and _draw.random() < _SAMPLED)
    tensors, compared = [serialization.from_text(*t) for t in about.get("tensors", ())], 0
    if payload:
        path = disk.path(about["key"], "safetensors")
        stamp = stamp_of(path)
        if stamp[1] != payload["size"]:
            raise ValueError(f"the payload has {stamp[1]} bytes instead of the {payload['size']} that were written")
        due = check or (verify == "sampled" and stamp != payload.get("stamp"))
        tensors, compared = serialization.read(path, payload["xxh3"] if due else None), payload["size"] if due else 0
    if bands and verify == "sampled" and not check:
        check = newest(disk, bands["names"]) > bands["newest"]
    return serialization.unpack(about["layout"], tensors, blobs, check), compared


def stamp_of(path: str) -> list[int]:
    """Return inode, bytes and times (ns) of a file; one of these numbers changes when a process writes to the file."""
    stat = os.stat(path)
    return [stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns]


def newest(disk: Disk, bands: Iterable[str]) -> int:
    """Return the time (ns) of the last write to the files of these bands."""
    stats = [os.stat(f"{disk.folder}/bands/{name[:2]}/{name}") for name in bands]
    return max((max(stat.st_mtime_ns, stat.st_ctime_ns) for stat in stats), default=0)
