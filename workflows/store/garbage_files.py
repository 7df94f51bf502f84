"""Orphan files: files of a store that belong to no result and are removed by `neusee cache gc`.

The present metadata, read under the lock, decide whether a file is in use; the age of the file does not. Only a file
whose owner cannot be determined is kept for an hour.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import suppress

from neusee.workflows.keys.seal import NotRead, checked_body
from neusee.workflows.store import metadata
from neusee.workflows.store.layout_check import are_bands
from neusee.workflows.store.metadata import UNREADABLE
from neusee.workflows.store.shared_folder import OLD, Disk, below, entries, read_file

Find = Callable[[Disk], Iterator[os.DirEntry[str]]]
_HAS_PAYLOAD, _HAS_BANDS = (
    b'"payload":{',
    b'"bands":{',
)  #: no text in JSON contains a quotation mark without a backslash
_WEEK = 7 * 86400.0  #: s for which a damaged entry is kept for inspection


def sweep(disk: Disk, dry: bool = False) -> list[tuple[str, int]]:
    """Remove the files of a store that belong to no result, or only list them if ``dry``; return paths and sizes."""
    if not os.path.isdir(disk.folder):
        return []
    gone = disk.sweep(dry, _WEEK) if os.path.isdir(f"{disk.folder}/tmp") else []
    for find in (_not_read, _payloads, bands, _files, _damaged):
        gone += removed(disk, find, dry)
    return gone


def removed(disk: Disk, find: Find, dry: bool) -> list[tuple[str, int]]:
    """Remove the files that ``find`` yields, or only list them if ``dry``; return the path and size of each file."""
    gone = []
    with suppress(OSError):
        orphans = list(find(disk))  # without the lock; ``find`` decides again under the lock
        if dry or not orphans:
            return [(entry.path, entry.stat(follow_symlinks=False).st_size) for entry in orphans]
        with disk.lock():
            for entry in find(disk):
                with suppress(OSError):
                    size = entry.stat(follow_symlinks=False).st_size
                    disk.unlink(entry.path)
                    gone.append((entry.path, size))
    return gone


def _not_read(disk: Disk) -> Iterator[os.DirEntry[str]]:
    """Yield old metadata of another format version, or without the signature that is asked for."""
    for entry in below(disk.folder):
        key, _, suffix = entry.name.partition(".")
        if suffix == "json":
            with suppress(*UNREADABLE):
                if _age(entry) > _WEEK and _is_not_read(disk, key):
                    yield entry


def _is_not_read(disk: Disk, key: str) -> bool:
    try:
        metadata.read(disk, key)
    except NotRead:
        return True
    return False


def _payloads(disk: Disk) -> Iterator[os.DirEntry[str]]:
    """Yield the files of tensors to which no metadata refer; skip a file whose metadata cannot be read."""
    for entry in below(disk.folder):
        key, _, suffix = entry.name.partition(".")
        if suffix == "safetensors":
            with suppress(*UNREADABLE):
                try:
                    orphan = _HAS_PAYLOAD not in _raw(disk, key) and not metadata.read(disk, key).get("payload")
                except FileNotFoundError:
                    orphan = True
                if orphan:
                    yield entry


def bands(disk: Disk) -> Iterator[os.DirEntry[str]]:
    """Yield the band files that no stored value uses, or nothing if metadata of another user cannot be read.

    The bands of results of another format version count as used.
    """
    files, needed = list(below(f"{disk.folder}/bands")), set[str]()
    for key in metadata.names(disk) if files else ():
        try:
            raw = _raw(disk, key)
            if _HAS_BANDS in raw:
                about = json.loads(checked_body(raw)[0] + b"}")
                needed.update(about["bands"]["names"] if are_bands(about["bands"]["names"]) else ())
        except PermissionError:
            return
        except UNREADABLE:
            continue
    yield from (entry for entry in files if entry.name not in needed)


def _raw(disk: Disk, key: str) -> bytes:
    """Return the metadata of a result as they are stored, without a check.

    Whether a field is in them decides about most files, and takes a third of the time of a check.
    """
    return read_file(disk.path(key, "json"))


def _files(disk: Disk) -> Iterator[os.DirEntry[str]]:
    """Yield old files such as pictures from results, if they are half-written or no metadata refer to them."""
    for entry in below(f"{disk.folder}/files"):
        try:
            needed = not entry.name.startswith(".") and metadata.read(disk, entry.name[:32]).get("file") == entry.name
        except UNREADABLE:
            needed = False
        if not needed and _age(entry) > OLD:
            yield entry


def _damaged(disk: Disk) -> Iterator[os.DirEntry[str]]:
    """Yield the damaged files that were moved to ``bad/`` more than a week ago."""
    for folder in (f"{disk.folder}/bad", f"{disk.folder}/bands/bad"):
        yield from (entry for entry in entries(folder) if _age(entry) > _WEEK)


def _age(entry: os.DirEntry[str]) -> float:
    stat = entry.stat(follow_symlinks=False)
    return time.time() - max(stat.st_mtime, stat.st_ctime)
