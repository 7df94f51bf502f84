"""The payload of a result: loaded, and its checksum compared as often as was asked for."""

from __future__ import annotations

import os
import random
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from neusee.workflows.store.metadata import Metadata
from neusee.workflows.store.shared_folder import Disk

if TYPE_CHECKING:
    from neusee.workflows.store.band_files import Blobs

_SAMPLED = 1 / 20  #: of the loads under ``sampled`` that are verified although the file has not been touched
_draw = random.Random()  # our own: the numbers that others draw do not depend on what is loaded


def blobs_of(disk: Disk) -> Blobs:
    """The bands of the stacks of a store."""
    from neusee.workflows.store.band_files import Blobs

    return Blobs(disk.root / "bands")


def load(disk: Disk, about: Metadata, verify: str, blobs: Blobs) -> tuple[Any, int]:
    """The value that ``about`` describes, and how many bytes of its payload were compared.

    Raises one of `UNREADABLE` where it cannot be trusted.
    """
    from neusee.workflows.store import serialization

    payload, bands = about["payload"], about.get("bands")
    check = verify == "always" or (verify == "sampled" and _draw.random() < _SAMPLED)
    tensors, compared = [serialization.from_text(*t) for t in about.get("tensors", ())], 0
    if payload:
        path = disk.path(about["key"], "safetensors")
        stamp = stamp_of(path)
        if stamp[1] != payload["size"]:
            raise ValueError(f"its payload has not the {payload['size']} bytes that were written")
        due = check or (verify == "sampled" and stamp != payload.get("stamp"))
        tensors, compared = serialization.read(path, payload["xxh3"] if due else None), payload["size"] if due else 0
    if bands and verify == "sampled" and not check:
        check = newest(disk, bands["names"]) > bands["newest"]
    return serialization.unpack(about["layout"], tensors, blobs, check), compared


def stamp_of(path: str) -> list[int]:
    """What changes when somebody writes to a file: which one it is, its bytes, its times in ns."""
    stat = os.stat(path)
    return [stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns]


def newest(disk: Disk, bands: Iterable[str]) -> int:
    """When a file of these bands was last written to, in ns."""
    stats = [os.stat(f"{disk.folder}/bands/{name[:2]}/{name}") for name in bands]
    return max((max(stat.st_mtime_ns, stat.st_ctime_ns) for stat in stats), default=0)
