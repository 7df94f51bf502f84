"""What lies in a store and belongs to no result: the sweep of `neusee cache gc`.

Whether something is in use is decided under the lock and by what the descriptions say now,
not by its age; only what has no owner that one could ask is left alone for an hour.
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

_WEEK = 7 * 86400.0  #: s for which a damaged entry may be looked at


def sweep(disk: Disk, dry: bool = False) -> list[tuple[str, int]]:
    """Remove what belongs to no result; the paths and bytes of what went, or would go."""
    if not os.path.isdir(disk.folder):
        return []
    gone = disk.sweep(dry, _WEEK) if os.path.isdir(f"{disk.folder}/tmp") else []
    finders: tuple[Callable[[Disk], Iterator[os.DirEntry[str]]], ...] = (_payloads, bands, _files, _damaged)
    for find in finders:
        gone += removed(disk, find, dry)
    return gone


def removed(disk: Disk, find: Callable[[Disk], Iterator[os.DirEntry[str]]], dry: bool) -> list[tuple[str, int]]:
    """Look without the lock whether there is anything, and once more with it."""
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
    """Payloads that no description refers to; one with a description that cannot be read stays for who reads it."""
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
    """Bands that no value needs; none while another user's description is not for us to read, for it may need some."""
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
    """Pictures whose entry went, and halves of them."""
    for entry in _below(f"{disk.folder}/files"):
        try:
            wanted = not entry.name.startswith(".") and metadata.read(disk, entry.name[:32]).get("file") == entry.name
        except UNREADABLE:
            wanted = False
        if not wanted and _age(entry) > OLD:
            yield entry


def _damaged(disk: Disk) -> Iterator[os.DirEntry[str]]:
    """What was put aside a week ago."""
    for folder in (f"{disk.folder}/bad", f"{disk.folder}/bands/bad"):
        yield from (entry for entry in entries(folder) if _age(entry) > _WEEK)


def _below(base: str) -> Iterator[os.DirEntry[str]]:
    """The files in the folders of two digits."""
    for folder in entries(base):
        if len(folder.name) == 2 and folder.is_dir(follow_symlinks=False):
            yield from entries(folder.path)


def _age(entry: os.DirEntry[str]) -> float:
    """Seconds since a file was last written or moved."""
    stat = entry.stat(follow_symlinks=False)
    return time.time() - max(stat.st_mtime, stat.st_ctime)
