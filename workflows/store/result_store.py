"""Store of results: a folder of results by key, ``<2>/<key>.safetensors`` beside ``<key>.json``.

The JSON describes a result: the recipe of its key, its layout, statistics, checks, seconds and
versions. The JSON contains the whole value of a small result; of an evicted or unsaved value
the JSON alone remains, called a receipt. A checksum covers every byte and is compared at each
load. A result that fails the comparison is put aside with one warning and counts as missing.
A result is renamed to its final name only when it is complete, so that a killed process leaves
no half result. Where the folder cannot be written, a run warns once and goes on.
"""

from __future__ import annotations

import heapq
import os
import time
import warnings
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neusee.workflows.store import maintenance, metadata, payload
from neusee.workflows.store.bandwidth import Speeds
from neusee.workflows.store.budget_eviction import LOW, CacheBudget
from neusee.workflows.store.environment import Verify, budget_bytes, default_root, verify_mode
from neusee.workflows.store.journal import Journal
from neusee.workflows.store.lease import Lease, Leases
from neusee.workflows.store.maintenance import Checked, Swept
from neusee.workflows.store.metadata import INLINE, UNREADABLE, Metadata, is_kept
from neusee.workflows.store.shared_folder import Disk
from neusee.workflows.store.small_results import SmallResults

if TYPE_CHECKING:
    from torch import Tensor

    from neusee.workflows.store.band_files import Blobs


class Store:
    """Results by key. Every failure of the folder leads to a missing result, never to a wrong result."""

    def __init__(
        self, root: Path | str | None = None, *, verify: Verify | None = None, budget: int | None = None
    ) -> None:
        """Open the store in ``root``; None takes ``$NEUSEE_CACHE_VERIFY`` and ``$NEUSEE_CACHE_BUDGET`` (bytes).

        ``verify="always"`` compares the checksum of every payload that is loaded. ``"sampled"``
        compares a checksum where the file was touched after it was written, and otherwise one load in
        twenty. ``"never"`` compares none. The checksum of the JSON and the size of every payload are
        always compared.
        """
        self.root = default_root() if root is None else Path(root)
        self.verify: Verify = verify_mode(verify)
        self.budget = budget_bytes(budget)
        self.disk = Disk(self.root)
        self.brief = SmallResults(self.disk)
        self.journal = Journal(self.disk, self.brief.each)
        self.code_memo = self.root / "code.json"
        self._leases = Leases(self.disk)
        self._room = None if self.budget is None else CacheBudget(self.disk, self.budget)
        self._speeds = Speeds(self.disk)
        self._known: dict[str, Metadata] = {}
        self._lost: set[str] = set()  # damaged results, which the user may not be allowed to move away
        self._used: set[str] = set()
        self._warned = False

    def __reduce__(self) -> tuple[Any, ...]:  # it travels to another process as its place, and is opened there
        return partial(type(self), self.root, verify=self.verify, budget=self.budget), ()

    @cached_property
    def blobs(self) -> Blobs:
        """Return the folder of the bands of stacks."""
        return payload.blobs_of(self.disk)

    def has(self, key: str) -> bool:
        """Return True if the value is stored, without reading its payload."""
        about = self.about(key)
        return about is not None and is_kept(about)

    def about(self, key: str) -> Metadata | None:
        """Return the metadata of a result, or None; the field ``kept`` tells whether the value is stored as well."""
        if key in self._known and is_kept(self._known[key]):
            return self._known[key]
        if key in self._lost:
            return None
        about = self.brief.find(key)
        if about is None or not is_kept(about):
            try:
                about = metadata.find(self.disk, key) or about
            except UNREADABLE as error:
                self._put_aside(key, error)
        if about is not None:
            self._known[key] = about
        return about

    def get(self, key: str) -> Any:
        """Return the value; raise `KeyError` where no value exists that can be trusted."""
        about = self.about(key)
        while about is not None and is_kept(about):
            try:
                value = self.load(about, self.verify)
            except UNREADABLE as error:
                before, about = about, self._again(key)
                if about == before:
                    self._put_aside(key, error)
                    break
            else:
                self._use(key)
                return value
        raise KeyError(key)

    def put(self, key: str, value: Any, about: Metadata) -> bool:
        """Store a value with its metadata; return False where the folder (one warning) or the budget forbids it."""
        return self._try(self._write, key, value, about)

    def put_receipt(self, key: str, about: Metadata) -> bool:
        """Store the metadata of a result without its value, unless the value or its receipt is stored already."""
        return self._try(self._write_receipt, key, about)

    def pin(self, key: str) -> None:
        """Exempt a value from eviction. Raises `OSError` where the folder cannot be written."""
        maintenance.pin(self.disk, key)

    def unpin(self, key: str) -> None:
        """Allow the eviction of a value again."""
        maintenance.unpin(self.disk, key)

    def pinned(self) -> set[str]:
        """Return the keys that are pinned."""
        return maintenance.pinned(self.disk)

    def gc(self, budget: int | None = None, dry: bool = False) -> Swept:
        """Remove orphan files and evict values beyond ``budget`` (or the store's own), the cheapest per byte first."""
        swept = maintenance.gc(self, self.budget if budget is None else budget, dry)
        if not dry:
            self._forget(swept.evicted)
        return swept

    def check(self) -> Iterator[Checked]:
        """Read every value, compare every checksum whatever ``verify`` says, and put damaged results aside."""
        return maintenance.check(self)

    def put_small(self, key: str, value: Any, about: Metadata) -> bool:
        """Store a small value without a file of its own; store only the metadata of a larger value."""
        return self._try(self._write_small, key, value, about)

    def entries(self) -> Iterator[tuple[str, Metadata]]:
        """Yield every key with its metadata, receipts included, in the order of the keys."""
        for key in heapq.merge(metadata.names(self.disk), (key for key, _ in self.brief.each())):
            about = self.about(key)
            if about is not None:
                yield key, about

    def claim(self, key: str) -> Lease | None:
        """Return the lease to compute ``key``, or None while another process has it; look up again after a wait."""
        return self._leases.claim(key)

    def read_seconds(self, size: float) -> float:
        """Return the predicted seconds for loading ``size`` bytes, from the loads of this store."""
        return self._speeds.seconds("read", size)

    def write_seconds(self, size: float) -> float:
        """Return the predicted seconds for storing ``size`` bytes, from the writes of this store."""
        return self._speeds.seconds("write", size)

    def _again(self, key: str) -> Metadata | None:
        """Return the present metadata of a result, or None where another process has removed them."""
        self._known.pop(key, None)
        try:
            return metadata.read(self.disk, key)
        except UNREADABLE:
            return None

    def load(self, about: Metadata, verify: str) -> Any:
        """Return the value that ``about`` describes; raise one of `UNREADABLE` where the value cannot be trusted."""
        began = time.perf_counter()
        value, size = payload.load(self.disk, about, verify, self.blobs)
        self._speeds.learn("read", size, time.perf_counter() - began)
        return value

    def _use(self, key: str) -> None:
        if key not in self._used:
            self._used.add(key)
            metadata.note_use(self.disk, key)

    def _try(self, write: Callable[..., bool], key: str, *what: Any) -> bool:
        """Write; try once more where another process removed a needed folder or file meanwhile."""
        try:
            try:
                return write(key, *what)
            except FileNotFoundError:
                self.disk.forget()
                return write(key, *what)
        except OSError as error:
            if not self._warned:
                warnings.warn(f"{self.root} cannot be written ({error}): results are not kept", stacklevel=4)
            self._warned = True
            return False

    def _write(self, key: str, value: Any, about: Metadata) -> bool:
        from neusee.workflows.store import serialization

        began = time.perf_counter()
        layout, tensors = serialization.pack(value, self.blobs)
        apart, inline = serialization.blobs_in(layout), sum(t.nbytes for t in tensors)
        size = max(inline, about.get("bytes") or 0) if apart else inline
        entry = {"key": key, **about, "layout": layout, "bytes": size, "payload": None, "kept": True}
        if self._room and size > LOW * self._room.budget:
            self._write_receipt(key, entry)
            return False
        if inline <= INLINE:
            entry["tensors"], tensors = [serialization.to_text(t) for t in tensors], []
        if tensors or apart:
            self._write_parts(key, entry, tensors, value if apart else None)
            self._speeds.learn("write", inline, time.perf_counter() - began)
        else:
            self._write_about(key, entry)
        self._lost.discard(key)
        self.journal.append(key, entry)
        self._make_room(size)
        return True

    def _write_small(self, key: str, value: Any, about: Metadata) -> bool:
        entry = self._known[key] = self.brief.put(key, value, about)
        self.journal.append(key, entry)
        return is_kept(entry)

    def _write_parts(self, key: str, entry: Metadata, tensors: list[Tensor], banded: Any) -> None:
        """Write the large files first, then the metadata that name them; of two writers the first one stays."""
        from neusee.workflows.store import serialization

        with self.disk.temporary(key) as (part, file):
            if tensors:
                xxh3 = serialization.write(file, tensors)
                file.flush()
                os.fsync(file.fileno())
                entry["payload"] = {"size": file.tell(), "xxh3": xxh3}
            with self.disk.lock():
                if key not in self._lost and metadata.has_value(self.disk, key):
                    return
                if banded is not None:  # a sweep may have removed bands that no value names yet
                    names = serialization.blobs_in(serialization.pack(banded, self.blobs)[0])
                    entry["bands"] = {"names": names, "newest": payload.newest(self.disk, names)}
                if tensors:
                    path = self.disk.path(key, "safetensors")
                    self.disk.rename(part, path)
                    entry["payload"]["stamp"] = payload.stamp_of(path)
                self._write_about(key, entry)

    def _write_about(self, key: str, entry: Metadata) -> None:
        """Write the metadata without a sync to disk, because torn metadata fail their checksum."""
        path = self.disk.path(key, "json")
        with self.disk.temporary(key) as (part, file):
            file.write(metadata.seal(entry))
            file.flush()
            if not self.disk.link(part, path):
                self.disk.rename(part, path)
        self._known[key] = entry

    def _write_receipt(self, key: str, about: Metadata) -> bool:
        """Write a receipt unless the name is taken: an existing file tells no less than a receipt."""
        entry = metadata.receipt({"key": key, **about})
        if self.about(key) is None:
            with self.disk.temporary(key) as (part, file):
                file.write(metadata.seal(entry))
                file.flush()
                if self.disk.link(part, self.disk.path(key, "json")):
                    self._known[key] = entry
        self.journal.append(key, entry)
        return True

    def _make_room(self, size: int) -> None:
        """Evict values where ``size`` more bytes exceed the budget."""
        if self._room and (excess := self._room.excess(size)) > 0:
            gone = {candidate.key for candidate in maintenance.make_room(self, excess)[0]}
            self._forget(gone)
            self.journal.mark_evicted(gone)

    def _forget(self, keys: Collection[str]) -> None:
        for key in keys:
            self._known.pop(key, None)

    def _put_aside(self, key: str, error: Exception) -> None:
        self.put_aside(key, error)
        warnings.warn(f"the stored result {key} is damaged ({error}) and is put aside", stacklevel=5)

    def put_aside(self, key: str, error: Exception) -> None:
        """Move a damaged result to ``bad/`` for inspection; a file of another user stays."""
        self._known.pop(key, None)
        self._lost.add(key)
        unreadable = isinstance(error, OSError) and not isinstance(error, FileNotFoundError)
        for suffix in () if unreadable else ("json", "safetensors"):
            with suppress(OSError):
                self.disk.make_folder(f"{self.disk.folder}/bad")
                os.replace(self.disk.path(key, suffix), f"{self.disk.folder}/bad/{key}.{suffix}")
        if not os.path.lexists(self.disk.path(key, "json")):
            self._lost.discard(key)
