"""Maintenance of a store: pins, eviction and the check for damage."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

from neusee.workflows.store import metadata, orphan_files
from neusee.workflows.store.budget_eviction import Candidate, candidates, evict, files, total
from neusee.workflows.store.journal import Journal
from neusee.workflows.store.metadata import UNREADABLE, Metadata, is_kept
from neusee.workflows.store.shared_folder import Disk


class Upkept(Protocol):
    """The part of a store that its upkeep needs."""

    disk: Disk
    journal: Journal

    def pinned(self) -> set[str]: ...
    def read_seconds(self, size: float) -> float: ...
    def load(self, about: Metadata, verify: str) -> Any: ...
    def put_aside(self, key: str, error: Exception) -> None: ...


@dataclass(frozen=True, slots=True)
class Swept:
    """Summary of a clean-up, or with ``dry`` of the clean-up that would be done."""

    evicted: tuple[str, ...]  #: keys whose values were evicted
    refused: tuple[str, ...]  #: keys whose values only another user can remove
    freed: int  #: bytes of evicted values and of orphan files
    orphans: int  #: number of orphan files, which belonged to no result
    left: int  #: bytes that remain


@dataclass(frozen=True, slots=True)
class Checked:
    """A result whose bytes were all read and compared."""

    key: str
    about: Metadata | None
    problem: str  #: empty where the result is undamaged


def gc(store: Upkept, budget: int | None, dry: bool) -> Swept:
    """Remove orphan files and, if a ``budget`` is given, evict the values beyond it."""
    before = total(store.disk)
    orphans = dict(orphan_files.sweep(store.disk, dry))
    left = sum(size for path, size, _ in files(store.disk) if path not in orphans)
    gone, refused = make_room(store, left - budget, dry) if budget is not None else ([], [])
    after = left - sum(c.size for c in gone) if dry else total(store.disk)
    if not dry:
        store.journal.compact()
    freed = max(before - after, 0) + sum(size for path, size in orphans.items() if _beside(store.disk, path))
    return Swept(tuple(c.key for c in gone), tuple(c.key for c in refused), freed, len(orphans), after)


def make_room(store: Upkept, excess: float, dry: bool = False) -> tuple[list[Candidate], list[Candidate]]:
    """Evict values until ``excess`` bytes are free; return the evicted values and those that we may not remove."""
    if excess <= 0:
        return [], []
    found = candidates(store.disk, store.pinned(), store.read_seconds)
    gone, refused = evict(store.disk, found, excess, dry)
    if gone and not dry:
        orphan_files.removed(store.disk, orphan_files.bands, dry)
    return gone, refused


def check(store: Upkept) -> Iterator[Checked]:
    """Read every value, compare every checksum and put damaged results aside."""
    for key in metadata.names(store.disk):
        about, problem = None, ""
        try:
            about = metadata.read(store.disk, key)
            if is_kept(about):
                store.load(about, "always")
        except UNREADABLE as error:
            if _is_gone(store.disk, key):
                continue
            store.put_aside(key, error)
            problem = str(error) or type(error).__name__
        yield Checked(key, about, problem)


def pin(disk: Disk, key: str) -> None:
    """Exempt a value from eviction."""
    disk.prepare()
    disk.make_folder(f"{disk.folder}/pins")
    open(f"{disk.folder}/pins/{key}", "wb").close()


def unpin(disk: Disk, key: str) -> None:
    """Allow the eviction of a value again."""
    with suppress(FileNotFoundError):
        os.unlink(f"{disk.folder}/pins/{key}")


def pinned(disk: Disk) -> set[str]:
    """Return the keys that are pinned."""
    try:
        return set(os.listdir(f"{disk.folder}/pins"))
    except OSError:
        return set()


def _is_gone(disk: Disk, key: str) -> bool:
    """Return True if another process evicted a value while this process was about to read it."""
    try:
        return not is_kept(metadata.read(disk, key))
    except FileNotFoundError:
        return True
    except UNREADABLE:
        return False


def _beside(disk: Disk, path: str) -> bool:
    """Return True if a file is temporary or damaged, and so does not count against the budget."""
    return path.startswith((f"{disk.folder}/tmp/", f"{disk.folder}/bad/"))
