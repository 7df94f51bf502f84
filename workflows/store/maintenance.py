"""The upkeep of a store: its pins, what goes when room is needed, what is damaged."""

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
    """What went, or would go."""

    evicted: tuple[str, ...]  #: keys whose values went
    refused: tuple[str, ...]  #: keys whose values another user would have to remove
    freed: int  #: bytes of both kinds
    orphans: int  #: files that belonged to no result
    left: int  #: bytes


@dataclass(frozen=True, slots=True)
class Checked:
    """A result that was read as a whole."""

    key: str
    about: Metadata | None
    problem: str  #: empty where it is as it was written


def gc(store: Upkept, budget: int | None, dry: bool) -> Swept:
    """Remove what belongs to no result, and values beyond ``budget``, where there is one."""
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
    """Let values go until ``excess`` bytes are free; those that went, and those that we may not remove."""
    if excess <= 0:
        return [], []
    found = candidates(store.disk, store.pinned(), store.read_seconds)
    gone, refused = evict(store.disk, found, excess, dry)
    if gone and not dry:
        orphan_files.removed(store.disk, orphan_files.bands, dry)
    return gone, refused


def check(store: Upkept) -> Iterator[Checked]:
    """Read every value and compare every checksum; what is damaged is put aside."""
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
    """Keep a value whatever the budget."""
    disk.prepare()
    disk.make_folder(f"{disk.folder}/pins")
    open(f"{disk.folder}/pins/{key}", "wb").close()


def unpin(disk: Disk, key: str) -> None:
    """Let a value go again when room is needed."""
    with suppress(FileNotFoundError):
        os.unlink(f"{disk.folder}/pins/{key}")


def pinned(disk: Disk) -> set[str]:
    """The keys that are pinned."""
    try:
        return set(os.listdir(f"{disk.folder}/pins"))
    except OSError:
        return set()


def _is_gone(disk: Disk, key: str) -> bool:
    """Whether a value went, as values may, while we were about to read it."""
    try:
        return not is_kept(metadata.read(disk, key))
    except FileNotFoundError:
        return True
    except UNREADABLE:
        return False


def _beside(disk: Disk, path: str) -> bool:
    """Whether a file does not count against the budget: half-made or damaged."""
    return path.startswith((f"{disk.folder}/tmp/", f"{disk.folder}/bad/"))
