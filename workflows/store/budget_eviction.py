"""Removal of values from a store beyond its size budget; values that save the least time per byte go first.

The weight of a value halves for every week between its last use and the newest use in the store; today's date does not
matter. Pinned values stay. The metadata of an evicted value stay as its receipt, so that origin and cost remain known.
A process that reads the value at that moment keeps its memory map.
"""

from __future__ import annotations

import errno
import os
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain

from neusee.workflows.keys.seal import NotRead
from neusee.workflows.store import metadata
from neusee.workflows.store.metadata import UNREADABLE, Metadata
from neusee.workflows.store.shared_folder import Disk, below

LOW = 0.9  #: fraction of the budget that remains after an eviction
_HALF = 7 * 86400.0  #: s in which the weight of an unused value halves
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@dataclass(frozen=True, slots=True)
class Candidate:
    """A stored value that may be evicted."""

    key: str
    size: int  #: bytes that the eviction frees
    seconds: float  #: time in s for computing the value, minus the time for loading the value
    used: float  #: time of the last use, s


def chosen(candidates: Iterable[Candidate], excess: float) -> list[Candidate]:
    """Return the stored values to remove so that ``excess`` bytes or more are freed, the least valuable value first."""
    evictable = [c for c in candidates if c.size > 0]
    newest = max((c.used for c in evictable), default=0.0)
    evictable.sort(key=lambda c: (max(c.seconds, 0.0) / c.size * 2 ** ((c.used - newest) / _HALF), c.used, c.key))
    going, freed = list[Candidate](), 0
    for candidate in evictable:
        if freed >= excess:
            break
        going.append(candidate)
        freed += candidate.size
    for candidate in going[::-1]:
        if freed - candidate.size >= excess:
            going.remove(candidate)
            freed -= candidate.size
    return going


def evict(disk: Disk, among: Iterable[Candidate], excess: float, dry: bool) -> tuple[list[Candidate], list[Candidate]]:
    """Delete stored values until ``excess`` bytes are freed; return the deleted and the undeletable values."""
    left, gone, refused = {c.key: c for c in among}, list[Candidate](), list[Candidate]()
    while excess > 0 and (batch := chosen(left.values(), excess)):
        for candidate in batch:
            del left[candidate.key]
            if dry or drop(disk, candidate.key):
                gone.append(candidate)
                excess -= candidate.size
            else:
                refused.append(candidate)
    return gone, refused


class CacheBudget:
    """Comparison of the size of a store with its size budget, without a count of all bytes at each write."""

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
            return stored - LOW * self.budget
        self._spare = min(self._spare, self.budget - stored)
        return 0.0


def total(disk: Disk) -> int:
    """Return the total bytes of all results of a store, with their derived files and bands."""
    return sum(size for _, size, _ in files(disk))


def candidates(disk: Disk, pinned: Collection[str], read_seconds: Callable[[float], float]) -> Iterator[Candidate]:
    """Yield every stored value that may be evicted, with the number of bytes that its eviction frees.

    The bytes of a band are divided among the values that use the band. A result that this program does not read saves
    no time.
    """
    sizes, changes = dict[str, int](), dict[str, float]()
    for path, size, changed in files(disk):
        sizes[os.path.basename(path)], changes[os.path.basename(path)] = size, changed
    values = [_stored_value(disk, key, sizes, read_seconds) for key in metadata.names(disk)]
    stored = [value for value in values if value is not None]
    users = Counter(chain.from_iterable(value.bands for value in stored))
    for value in stored:
        record = f"{value.key}.json"
        if value.key not in pinned and record in changes:
            bands = int(sum(sizes.get(name, 0) / users[name] for name in value.bands))
            yield Candidate(value.key, value.size + bands, value.seconds, changes[record])


@dataclass(frozen=True, slots=True)
class _StoredValue:
    """A value of a store, before the bytes of its bands are divided among their users."""

    key: str
    size: int  #: bytes of its own files
    seconds: float  #: time in s for computing the value, minus the time for loading the value
    bands: frozenset[str]  #: names of the files of its bands


def _stored_value(
    disk: Disk, key: str, sizes: Mapping[str, int], read_seconds: Callable[[float], float]
) -> _StoredValue | None:
    """Return what is known of a stored value, or None if its metadata are unreadable or a receipt."""
    payload = sizes.get(f"{key}.safetensors", 0)
    try:
        about = metadata.read(disk, key)
        if not metadata.is_kept(about):
            return None
        inline = sum(len(tensor[-1]) for tensor in about.get("tensors") or ())
        derived = sizes.get(about.get("file") or "", 0)
        saved = float(about.get("seconds") or 0.0) - read_seconds(float(about.get("bytes") or 0))
        return _StoredValue(key, payload + inline + derived, saved, frozenset(metadata.bands(about)))
    except NotRead:
        return _StoredValue(key, payload + sizes.get(f"{key}.json", 0), 0.0, frozenset())
    except UNREADABLE:
        return None


def drop(disk: Disk, key: str) -> bool:
    """Delete a stored value but keep its metadata; return False if the value cannot be deleted."""
    try:
        with disk.lock():
            try:
                about = metadata.read(disk, key)
            except NotRead:
                about = {"payload": True}
                disk.unlink(disk.path(key, "json"))
            if metadata.is_kept(about):
                if "key" in about:
                    _write_receipt(disk, key, about)
                _delete_files(disk, key, about)
    except FileNotFoundError:
        pass  # another process was first
    except UNREADABLE:
        return False
    return True


def _write_receipt(disk: Disk, key: str, about: Metadata) -> None:
    """Record in the metadata of a value that the value was evicted; on a full disk, delete the metadata."""
    try:
        metadata.write(disk, key, metadata.receipt(about), over=True)
    except OSError as error:
        if error.errno not in _FULL:
            raise
        disk.unlink(disk.path(key, "json"))


def _delete_files(disk: Disk, key: str, about: Metadata) -> None:
    paths = [disk.path(key, "safetensors")] if about.get("payload") else []
    if name := about.get("file"):
        paths.append(f"{disk.folder}/files/{key[:2]}/{os.path.basename(name)}")
    for path in paths:
        with suppress(FileNotFoundError):
            disk.unlink(path)


def files(disk: Disk) -> Iterator[tuple[str, int, float]]:
    """Yield the path, size and time of last change of every file that counts against the size budget of a store."""
    for base in (disk.folder, f"{disk.folder}/files", f"{disk.folder}/bands"):
        for entry in below(base):
            with suppress(OSError):
                stat = entry.stat(follow_symlinks=False)
                yield entry.path, stat.st_size, stat.st_mtime
