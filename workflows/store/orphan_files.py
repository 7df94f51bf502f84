"""Orphan files: files of a store that belong to no result, removed by `neusee cache gc`.

Whether a file is in use is decided under the lock and from the present metadata, not from the
file's age. Only a file whose owner cannot be determined is left alone for an hour.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import suppress

from neusee.workflows.store import metadata
from neusee.workflows.store.budget_eviction import entries
from neusee.workflows.store.metadata import UNREADABLE
from neusee.workflows.store.shared_folder import OLD, Disk

_WEEK = 7 * 86400.0  #: s for which a damaged entry is kept for inspection


def sweep(disk: Disk, dry: bool = False) -> list[tuple[str, int]]:
    """Remove the files that belong to no result; return path and bytes of each file (``dry``: remove nothing)."""
    if not os.path.isdir(disk.folder):
        return []
    gone = disk.sweep(dry, _WEEK) if os.path.isdir(f"{disk.folder}/tmp") else []
    finders: tuple[Callable[[Disk], Iterator[os.DirEntry[str]]], ...] = (_payloads, bands, _files, _damaged)
    for find in finders:
        gone += removed(disk, find, dry)
    return gone


def removed(disk: Disk, find: Callable[[Disk], Iterator[os.DirEntry[str]]], dry: bool) -> list[tuple[str, int]]:
    """Remove the files that ``find`` yields: look without the lock first, and once more under the lock."""
    gone = []
    with suppress(OSError):
        found = list(find(disk))
        if dry or not found:
            return [(entry.path, entry.stat(follow_symlinks=False).st_size) for entry in found]
        with disk.lock():
            for entry in find(disk):
                with suppress(OSError):
                    size = entry.stat(follow_symlinks=False).st_size
                    os.unlink(entry.path)
                    gone.append((entry.path, size))
    return gone


def _payloads(disk: Disk) -> Iterator[os.DirEntry[str]]:
    """Yield payloads without metadata; a payload whose metadata cannot be read is kept for its reader."""
    for entry in _below(disk.folder):
        key, _, suffix = entry.name.partition(".")
        if suffix == "safetensors":
            try:
                about = metadata.read(disk, key)
            except FileNotFoundError:
                yield entry
            except UNREADABLE:
                continue
            else:
                if not about.get("payload"):
                    yield entry


def bands(disk: Disk) -> Iterator[os.DirEntry[str]]:
    """Yield bands that no value needs; yield none if the metadata of another user's values cannot be read."""
    found, needed = list(_below(f"{disk.folder}/bands")), set[str]()
    for key in metadata.names(disk) if found else ():
        try:
            needed.update(metadata.bands(metadata.read(disk, key)))
        except PermissionError:
            return
        except UNREADABLE:
            continue
    yield from (entry for entry in found if entry.name not in needed)


def _files(disk: Disk) -> Iterator[os.DirEntry[str]]:
    """Yield pictures whose entry is gone, and half-written pictures."""
    for entry in _below(f"{disk.folder}/files"):
        try:
            wanted = not entry.name.startswith(".") and metadata.read(disk, entry.name[:32]).get("file") == entry.name
        except UNREADABLE:
            wanted = False
        if not wanted and _age(entry) > OLD:
            yield entry


def _damaged(disk: Disk) -> Iterator[os.DirEntry[str]]:
    """Yield damaged entries that were put aside more than a week ago."""
    for folder in (f"{disk.folder}/bad", f"{disk.folder}/bands/bad"):
        yield from (entry for entry in entries(folder) if _age(entry) > _WEEK)


def _below(base: str) -> Iterator[os.DirEntry[str]]:
    """Yield the files in the folders with names of two letters."""
    for folder in entries(base):
        if len(folder.name) == 2 and folder.is_dir(follow_symlinks=False):
            yield from entries(folder.path)


def _age(entry: os.DirEntry[str]) -> float:
    """Return the seconds since a file was last written or moved."""
    stat = entry.stat(follow_symlinks=False)
    return time.time() - max(stat.st_mtime, stat.st_ctime)
