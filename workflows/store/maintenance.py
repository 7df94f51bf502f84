"""Maintenance of a store: protection and eviction of values, removal of orphan files, and a check for damage."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

from neusee.workflows.keys.seal import NotRead
from neusee.workflows.store import garbage_files, metadata
from neusee.workflows.store.budget_eviction import Candidate, candidates, evict, total
from neusee.workflows.store.journal import Journal
from neusee.workflows.store.metadata import UNREADABLE, Metadata, is_kept
from neusee.workflows.store.shared_folder import Disk


@dataclass(frozen=True, slots=True)
class Swept:
    """Summary of a clean-up of a store, which was either done or only simulated."""

    evicted: tuple[str, ...]  #: keys whose values were evicted
    refused: tuple[str, ...]  #: keys whose values cannot be deleted, for example because another user owns them
    freed: int  #: bytes of evicted values and of orphan files
    orphans: int  #: number of orphan files, which belonged to no result
    left: int  #: bytes that remain


@dataclass(frozen=True, slots=True)
class Checked:
    """Outcome of the check of one result, in which all bytes were compared with their checksums."""

    key: str
    about: Metadata | None
    problem: str  #: empty if the result is undamaged


class Maintained(Protocol):
    """Base class of `Store` with the methods for maintenance, such as eviction and a check for damage.

    `Store` defines the members that are declared first.
    """

    disk: Disk
    journal: Journal
    budget: int | None
    _known: dict[str, Metadata]

    def read_seconds(self, size: float) -> float: ...
    def load(self, about: Metadata, verify: str, kind: Any = Any) -> Any: ...
    def leave(self, error: NotRead) -> None: ...
    def put_aside(self, key: str, error: Exception) -> None: ...

    def gc(self, budget: int | None = None, dry: bool = False) -> Swept:
        """Remove files that belong to no result, and evict values until the store has at most ``budget`` bytes.

        A ``budget`` of None means the budget of the store.
        """
        budget = self.budget if budget is None else budget
        before = total(self.disk)
        orphans = dict(garbage_files.sweep(self.disk, dry))
        uncounted = (f"{self.disk.folder}/tmp/", f"{self.disk.folder}/bad/")  # files outside the budget
        outside = sum(size for path, size in orphans.items() if path.startswith(uncounted))
        left = before - (sum(orphans.values()) - outside)
        gone, refused = self.make_room(left - budget, dry) if budget is not None else ([], [])
        after = left - sum(c.size for c in gone) if dry or not gone else total(self.disk)
        if not dry:
            self.journal.compact()
        freed = max(before - after, 0) + outside
        return Swept(tuple(c.key for c in gone), tuple(c.key for c in refused), freed, len(orphans), after)

    def make_room(self, excess: float, dry: bool = False) -> tuple[list[Candidate], list[Candidate]]:
        """Delete stored values until ``excess`` bytes are freed; return the deleted and the undeletable values."""
        if excess <= 0:
            return [], []
        gone, refused = evict(self.disk, candidates(self.disk, self.pinned(), self.read_seconds), excess, dry)
        if gone and not dry:
            garbage_files.removed(self.disk, garbage_files.bands, dry)
            for candidate in gone:
                self._known.pop(candidate.key, None)
        return gone, refused

    def check(self) -> Iterator[Checked]:
        """Yield the outcome of a check of every stored result; move damaged results to the folder ``bad/``.

        The check reads every value and compares every checksum. It needs no type of a value, so it imports no node.

        The mode ``verify`` of the store has no effect on this check.
        """
        for key in metadata.names(self.disk):
            about, problem = None, ""
            try:
                about = metadata.read(self.disk, key)
                if is_kept(about):
                    self.load(about, "always", None)
            except NotRead as error:
                self.leave(error)
                continue
            except UNREADABLE as error:
                if not metadata.has_value(self.disk, key):
                    continue  # another process evicted the value meanwhile
                self.put_aside(key, error)
                problem = str(error) or type(error).__name__
            yield Checked(key, about, problem)

    def pin(self, key: str) -> None:
        """Protect the stored value of ``key`` from eviction. Raises `OSError` if the folder cannot be written."""
        self.disk.prepare()
        self.disk.make_folder(f"{self.disk.folder}/pins")
        os.close(os.open(f"{self.disk.folder}/pins/{key}", os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW, 0o666))

    def unpin(self, key: str) -> None:
        """Allow the eviction of the value of ``key`` again."""
        with suppress(FileNotFoundError, NotADirectoryError):
            self.disk.unlink(f"{self.disk.folder}/pins/{key}")

    def pinned(self) -> set[str]:
        """Return the keys of the values that are protected from eviction."""
        try:
            return set(os.listdir(f"{self.disk.folder}/pins"))
        except OSError:
            return set()
