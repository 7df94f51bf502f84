"""Eviction of values beyond the budget, removal of orphan files, and check for damage."""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

from neusee.workflows.keys.sealed_files import NotRead
from neusee.workflows.store import metadata
from neusee.workflows.store.journal import Journal
from neusee.workflows.store.metadata import UNREADABLE, Metadata, is_kept
from neusee.workflows.store.shared_folder import OLD, Disk, below, entries, read_file

# --- budget eviction ------------------------------------------------------------------------------

# Removal of values from a store that exceeds its size budget; values that save the least time per
# byte are removed first.
#
# The weight of a value halves for every week between its last use and the newest use in the store;
# today's date does not matter. Pinned values stay. The metadata of an evicted value stay as its
# receipt, so that origin and cost remain known. A process that is reading the value keeps its
# memory map.


LOW = 0.9  #: fraction of the budget that remains after an eviction
_HALF = 7 * 86400.0  #: time (s) in which the weight of an unused value halves
_FULL_DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@dataclass(frozen=True, slots=True)
class Candidate:
    """A stored value that may be evicted."""

    key: str
    size: int  #: bytes that the eviction frees
    seconds: float  #: time in s for computing the value, minus the time for loading the value
    used: float  #: time of the last use, s


def chosen(candidates: Iterable[Candidate], excess: float) -> list[Candidate]:
    """Return the stored values to remove so that ``excess`` bytes or more are freed, the least
    valuable value first.
    """
    evictable = [c for c in candidates if c.size > 0]
    newest = max((c.used for c in evictable), default=0.0)
    # the least valuable first
    evictable.sort(
        key=lambda c: (
            # time saved per byte (s), halved for each week without use; equal values are sorted by
            # age and key
            max(c.seconds, 0.0) / c.size * 2 ** ((c.used - newest) / _HALF),
            c.used,
            c.key,
        )
    )
    to_evict, freed = list[Candidate](), 0
    for candidate in evictable:
        if freed >= excess:
            break
        to_evict.append(candidate)
        freed += candidate.size
    # the last values may free so much that earlier ones need not be removed
    for candidate in to_evict[::-1]:
        if freed - candidate.size >= excess:
            to_evict.remove(candidate)
            freed -= candidate.size
    return to_evict


def evict(
    disk: Disk, among: Iterable[Candidate], excess: float, dry: bool
) -> tuple[list[Candidate], list[Candidate]]:
    """Delete stored values until ``excess`` bytes are freed; return the deleted and the
    undeletable values.
    """
    candidates_left, deleted, undeletable = (
        {c.key: c for c in among},
        list[Candidate](),
        list[Candidate](),
    )
    while excess > 0 and (batch := chosen(candidates_left.values(), excess)):
        for candidate in batch:
            del candidates_left[candidate.key]
            if dry or drop(disk, candidate.key):
                deleted.append(candidate)
                excess -= candidate.size
            else:
                undeletable.append(candidate)
    return deleted, undeletable


class CacheBudget:
    """Check of the size of a store against its budget, without counting all bytes at each write."""

    def __init__(self, disk: Disk, budget: int) -> None:
        self._disk, self.budget = disk, budget
        self._spare = 0.0  # bytes that may be written before all bytes are counted again

    def excess(self, size: int) -> float:
        """Return the number of bytes to evict from the store after a write of ``size`` bytes.

        All bytes of the store are counted again after writes of 5 % of the budget.
        """
        self._spare -= size
        if self._spare > 0:
            return 0.0
        stored = total(self._disk)
        self._spare = self.budget / 20
        if stored > self.budget:
            # evict more than the excess, so that the next writes fit without another eviction
            return stored - LOW * self.budget
        # count again before the budget can be exceeded
        self._spare = min(self._spare, self.budget - stored)
        return 0.0


def total(disk: Disk) -> int:
    """Return the total bytes of all results of a store, with their derived files."""
    return sum(size for _, size, _ in files(disk))


def candidates(
    disk: Disk, pinned: Collection[str], read_seconds: Callable[[float], float]
) -> Iterator[Candidate]:
    """Yield every stored value that may be evicted, with the number of bytes that its eviction
    frees.

    A result in a format that this program cannot read counts as saving no time.
    """
    sizes, changes = dict[str, int](), dict[str, float]()
    # by file name without the folder, because keys are unique
    for path, size, changed in files(disk):
        sizes[os.path.basename(path)], changes[os.path.basename(path)] = size, changed
    for key in metadata.names(disk):
        value = _stored_value(disk, key, sizes, read_seconds)
        record = f"{key}.json"
        if value is not None and key not in pinned and record in changes:
            yield Candidate(key, value.size, value.seconds, changes[record])


@dataclass(frozen=True, slots=True)
class _StoredValue:
    """Size and saved time of a stored value."""

    size: int  #: bytes of its files
    seconds: float  #: time in s for computing the value, minus the time for loading the value


def _stored_value(
    disk: Disk, key: str, sizes: Mapping[str, int], read_seconds: Callable[[float], float]
) -> _StoredValue | None:
    """Return size and saved time of a stored value, or None if its metadata are unreadable or a
    receipt.
    """
    payload_bytes = sizes.get(f"{key}.safetensors", 0)
    try:
        entry = metadata.read(disk, key)
        if not metadata.is_kept(entry):
            return None
        # the last of the four entries of a tensor is its bytes as text
        inline_bytes = sum(len(tensor[-1]) for tensor in entry.get("tensors") or ())
        derived_bytes = sizes.get(entry.get("file") or "", 0)
        seconds = float(entry.get("seconds") or 0.0) - read_seconds(float(entry.get("bytes") or 0))
        return _StoredValue(payload_bytes + inline_bytes + derived_bytes, seconds)
    except NotRead:
        return _StoredValue(payload_bytes + sizes.get(f"{key}.json", 0), 0.0)
    except UNREADABLE:
        return None


def drop(disk: Disk, key: str) -> bool:
    """Delete a stored value but keep its metadata; return False if the value cannot be deleted."""
    try:
        # locked, so that no process stores the value again in between
        with disk.lock():
            try:
                entry = metadata.read(disk, key)
            except NotRead:
                # a record in another format: only the file of its tensors is known
                entry = {"payload": True}
                disk.unlink(disk.path(key, "json"))
            if metadata.is_kept(entry):
                # only metadata that could be read; others were deleted above
                if "key" in entry:
                    _write_receipt(disk, key, entry)
                _delete_files(disk, key, entry)
    except FileNotFoundError:
        pass  # another process was first
    except UNREADABLE:
        return False
    return True


def _write_receipt(disk: Disk, key: str, about: Metadata) -> None:
    """Record in the metadata of a value that the value was evicted; on a full disk, delete the
    metadata.
    """
    try:
        metadata.write(disk, key, metadata.receipt(about), over=True)
    except OSError as error:
        if error.errno not in _FULL_DISK_ERRORS:
            raise
        disk.unlink(disk.path(key, "json"))


def _delete_files(disk: Disk, key: str, about: Metadata) -> None:
    """Delete the file of tensors and the derived file of a value."""
    paths = [disk.path(key, "safetensors")] if about.get("payload") else []
    if name := about.get("file"):
        paths.append(f"{disk.folder}/files/{key[:2]}/{os.path.basename(name)}")
    for path in paths:
        with suppress(FileNotFoundError):
            disk.unlink(path)


def files(disk: Disk) -> Iterator[tuple[str, int, float]]:
    """Yield the path, size and time of last change of every file that counts against the size
    budget of a store.
    """
    for base in (disk.folder, f"{disk.folder}/files"):
        for entry in below(base):
            with suppress(OSError):
                stat = entry.stat(follow_symlinks=False)
                yield entry.path, stat.st_size, stat.st_mtime


# --- garbage files --------------------------------------------------------------------------------

# Orphan files: files of a store that belong to no result and are removed by `neusee cache gc`.
#
# The present metadata, read under the lock, decide whether a file is in use; the age of the file
# does not. Only a file whose owner cannot be determined is kept for an hour.


Find = Callable[[Disk], Iterator[os.DirEntry[str]]]
#: cannot occur inside a JSON text, where a quotation mark has a backslash
_HAS_PAYLOAD = b'"payload":{'
_WEEK = 7 * 86400.0  #: s for which a damaged entry is kept for inspection


def sweep(disk: Disk, dry: bool = False) -> list[tuple[str, int]]:
    """Remove the files of a store that belong to no result, or only list them if ``dry``; return
    paths and sizes.
    """
    if not os.path.isdir(disk.folder):
        return []
    # temporary files of dead processes
    swept_files = disk.sweep(dry, _WEEK) if os.path.isdir(f"{disk.folder}/tmp") else []
    for find_orphans in (_not_read, _payloads, _bands, _files, _damaged):
        swept_files += removed(disk, find_orphans, dry)
    return swept_files


def removed(disk: Disk, find: Find, dry: bool) -> list[tuple[str, int]]:
    """Remove the files that ``find`` yields, or only list them if ``dry``; return the path and
    size of each file.
    """
    paths_and_sizes = []
    with suppress(OSError):
        orphans = list(find(disk))  # without the lock; ``find`` decides again under the lock
        if dry or not orphans:
            return [(entry.path, entry.stat(follow_symlinks=False).st_size) for entry in orphans]
        with disk.lock():
            for entry in find(disk):
                with suppress(OSError):
                    size = entry.stat(follow_symlinks=False).st_size
                    disk.unlink(entry.path)
                    paths_and_sizes.append((entry.path, size))
    return paths_and_sizes


def _not_read(disk: Disk) -> Iterator[os.DirEntry[str]]:
    """Yield old metadata of another format version, or without the required signature."""
    for entry in below(disk.folder):
        key, _, suffix = entry.name.partition(".")
        if suffix == "json":
            with suppress(*UNREADABLE):
                if _age(entry) > _WEEK and _is_not_read(disk, key):
                    yield entry


def _is_not_read(disk: Disk, key: str) -> bool:
    """Return True if the metadata of a result are of another format version or unsigned."""
    try:
        metadata.read(disk, key)
    except NotRead:
        return True
    return False


def _payloads(disk: Disk) -> Iterator[os.DirEntry[str]]:
    """Yield the files of tensors to which no metadata refer; skip a file whose metadata cannot
    be read.
    """
    for entry in below(disk.folder):
        key, _, suffix = entry.name.partition(".")
        if suffix == "safetensors":
            with suppress(*UNREADABLE):
                try:
                    # the search for the text is fast; only metadata without it are checked
                    is_orphan = _HAS_PAYLOAD not in _raw(disk, key) and not metadata.read(
                        disk, key
                    ).get("payload")
                except FileNotFoundError:
                    is_orphan = True
                if is_orphan:
                    yield entry


def _bands(disk: Disk) -> Iterator[os.DirEntry[str]]:
    """Yield the files of single spectral bands that an earlier version wrote, a week after their
    last change.
    """
    for entry in below(f"{disk.folder}/bands"):
        if _age(entry) > _WEEK:
            yield entry


def _raw(disk: Disk, key: str) -> bytes:
    """Return the metadata of a result as they are stored, without a check.

    A search for a field in them decides about most files, in a third of the time of a check.
    """
    return read_file(disk.path(key, "json"))


def _files(disk: Disk) -> Iterator[os.DirEntry[str]]:
    """Yield old files such as pictures from results, if they are half-written or no metadata
    refer to them.
    """
    for entry in below(f"{disk.folder}/files"):
        try:
            is_needed = (
                not entry.name.startswith(".")
                # the name begins with the key of its result
                and metadata.read(disk, entry.name[:32]).get("file") == entry.name
            )
        except UNREADABLE:
            is_needed = False
        if not is_needed and _age(entry) > OLD:
            yield entry


def _damaged(disk: Disk) -> Iterator[os.DirEntry[str]]:
    """Yield the damaged files that were moved to ``bad/`` more than a week ago."""
    for folder in (f"{disk.folder}/bad", f"{disk.folder}/bands/bad"):
        yield from (entry for entry in entries(folder) if _age(entry) > _WEEK)


def _age(entry: os.DirEntry[str]) -> float:
    """Return the time (s) since a file was changed, moved or renamed."""
    stat = entry.stat(follow_symlinks=False)
    return time.time() - max(stat.st_mtime, stat.st_ctime)


# --- maintenance ----------------------------------------------------------------------------------

# Maintenance of a store: protection and eviction of values, removal of orphan files, and a check
# for damage.


@dataclass(frozen=True, slots=True)
class Swept:
    """Summary of a clean-up of a store, which was either done or only simulated."""

    evicted: tuple[str, ...]  #: keys whose values were evicted
    #: keys whose values cannot be deleted, for example because another user owns them
    refused: tuple[str, ...]
    freed: int  #: bytes of evicted values and of orphan files
    orphans: int  #: number of orphan files, which belonged to no result
    left: int  #: bytes that remain


@dataclass(frozen=True, slots=True)
class Checked:
    """Outcome of the check of one result, in which all bytes were compared with their checksums."""

    key: str
    about: Metadata | None
    problem: str  #: empty if the result is undamaged


def _outside_budget(sizes: Mapping[str, int], folder: str) -> int:
    """Return the bytes of those files that do not count towards the budget of the store."""
    uncounted = (f"{folder}/tmp/", f"{folder}/bad/", f"{folder}/bands/")
    return sum(size for path, size in sizes.items() if path.startswith(uncounted))


class Maintained(Protocol):
    """Base class of `Store` with the methods for maintenance, such as eviction and a check for
    damage.

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
        """Remove files that belong to no result, and evict values until the store has at most
        ``budget`` bytes.

        A ``budget`` of None means the budget of the store.
        """
        budget = self.budget if budget is None else budget
        bytes_before = total(self.disk)
        orphans = dict(sweep(self.disk, dry))
        uncounted_bytes = _outside_budget(orphans, self.disk.folder)
        bytes_after_sweep = bytes_before - (sum(orphans.values()) - uncounted_bytes)
        deleted, refused = (
            self.make_room(bytes_after_sweep - budget, dry) if budget is not None else ([], [])
        )
        # a dry run can only predict
        bytes_after = (
            bytes_after_sweep - sum(c.size for c in deleted)
            if dry or not deleted
            else total(self.disk)
        )
        if not dry:
            self.journal.compact()
        freed = max(bytes_before - bytes_after, 0) + uncounted_bytes
        return Swept(
            tuple(c.key for c in deleted),
            tuple(c.key for c in refused),
            freed,
            len(orphans),
            bytes_after,
        )

    def make_room(
        self, excess: float, dry: bool = False
    ) -> tuple[list[Candidate], list[Candidate]]:
        """Delete stored values until ``excess`` bytes are freed; return the deleted and the
        undeletable values.
        """
        if excess <= 0:
            return [], []
        deleted, refused = evict(
            self.disk, candidates(self.disk, self.pinned(), self.read_seconds), excess, dry
        )
        if deleted and not dry:
            for candidate in deleted:
                self._known.pop(candidate.key, None)
        return deleted, refused

    def check(self) -> Iterator[Checked]:
        """Yield the outcome of a check of every stored result; move damaged results to the folder
        ``bad/``.

        The check reads every value and compares every checksum. It needs no type of a value, so it
        imports no node.

        The mode ``verify`` of the store has no effect on this check.
        """
        for key in metadata.names(self.disk):
            entry, problem = None, ""
            try:
                entry = metadata.read(self.disk, key)
                if is_kept(entry):
                    self.load(entry, "always", None)
            except NotRead as error:
                self.leave(error)
                continue
            except UNREADABLE as error:
                if not metadata.has_value(self.disk, key):
                    continue  # another process evicted the value meanwhile
                self.put_aside(key, error)
                problem = str(error) or type(error).__name__
            yield Checked(key, entry, problem)

    def pin(self, key: str) -> None:
        """Protect the stored value of ``key`` from eviction. Raises `OSError` if the folder
        cannot be written.
        """
        self.disk.prepare()
        self.disk.make_folder(f"{self.disk.folder}/pins")
        os.close(
            os.open(
                f"{self.disk.folder}/pins/{key}", os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW, 0o666
            )
        )

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
