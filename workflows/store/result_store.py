"""The store: a folder of results by key, ``<2>/<key>.safetensors`` beside ``<key>.json``.

The JSON says what a result is: the recipe of its key, its layout, facts, checks, seconds
and versions. Small results stand in it whole; of others it may be all that there is, a
receipt. Every byte is covered by a checksum that is compared on each load; an entry that
fails is put aside with one warning and counts as missing. A result gets its name only when
it is complete, so a killed process leaves no half of one. Where the folder cannot be
written, a run warns once and goes on.
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
    """Results by key. Every way in which a folder can fail is a missing result, never a wrong one."""

    def __init__(
        self, root: Path | str | None = None, *, verify: Verify | None = None, budget: int | None = None
    ) -> None:
        """``verify`` and ``budget`` (bytes): None takes ``$NEUSEE_CACHE_VERIFY`` and ``$NEUSEE_CACHE_BUDGET``.

        ``always`` compares the checksum of every payload that is loaded; ``sampled`` only where
        its file is not the one that was written, untouched, and one time in twenty; ``never`` none.
        What stands in the JSON is always compared, and the size of every payload.
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
        self._lost: set[str] = set()  # damaged, and perhaps not to be moved away
        self._used: set[str] = set()
        self._warned = False

    def __reduce__(self) -> tuple[Any, ...]:  # it travels to another process as its place, and is opened there
        return partial(type(self), self.root, verify=self.verify, budget=self.budget), ()

    @cached_property
    def blobs(self) -> Blobs:
        """The bands of stacks."""
        return payload.blobs_of(self.disk)

    def has(self, key: str) -> bool:
        """Whether there is a value; its payload is not read."""
        about = self.about(key)
        return about is not None and is_kept(about)

    def about(self, key: str) -> Metadata | None:
        """What is known of a result, without reading it; ``kept`` in it says whether there is a value too."""
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
        """The value, or `KeyError` where there is none that can be trusted."""
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
        """Keep a value with what is ``about`` it; False where the folder takes none (one warning) or the budget."""
        return self._try(self._write, key, value, about)

    def note(self, key: str, about: Metadata) -> bool:
        """Keep what is ``about`` a result without its value, unless there is a value or such a receipt already."""
        return self._try(self._write_receipt, key, about)

    def pin(self, key: str) -> None:
        """Keep a value whatever the budget. Raises `OSError` where the folder takes nothing."""
        maintenance.pin(self.disk, key)

    def unpin(self, key: str) -> None:
        """Let a value go again when room is needed."""
        maintenance.unpin(self.disk, key)

    def pinned(self) -> set[str]:
        """The keys that are pinned."""
        return maintenance.pinned(self.disk)

    def gc(self, budget: int | None = None, dry: bool = False) -> Swept:
        """Remove what belongs to no result, and, beyond ``budget`` (or the store's own), what saves least a byte."""
        swept = maintenance.gc(self, self.budget if budget is None else budget, dry)
        if not dry:
            self._forget(swept.evicted)
        return swept

    def check(self) -> Iterator[Checked]:
        """Read every value, whatever ``verify`` says; what is damaged is put aside."""
        return maintenance.check(self)

    def jot(self, key: str, value: Any, about: Metadata) -> bool:
        """Keep a small value, of a larger one what is ``about`` it, without a file: to lose it is no loss."""
        return self._try(self._jot, key, value, about)

    def entries(self) -> Iterator[tuple[str, Metadata]]:
        """Every result's key and what is known of it, in the order of the keys; receipts too."""
        for key in heapq.merge(metadata.names(self.disk), (key for key, _ in self.brief.each())):
            about = self.about(key)
            if about is not None:
                yield key, about

    def claim(self, key: str) -> Lease | None:
        """The right to compute ``key``; None while another live process has it. Who gets it late looks again first."""
        return self._leases.claim(key)

    def read_seconds(self, size: float) -> float:
        """What loading ``size`` bytes takes, as this store's own loads did."""
        return self._speeds.seconds("read", size)

    def write_seconds(self, size: float) -> float:
        """What keeping ``size`` bytes takes, as this store's own writes did."""
        return self._speeds.seconds("write", size)

    def _again(self, key: str) -> Metadata | None:
        """What stands beside a result now; None where somebody has removed it."""
        self._known.pop(key, None)
        try:
            return metadata.read(self.disk, key)
        except UNREADABLE:
            return None

    def load(self, about: Metadata, verify: str) -> Any:
        """The value that ``about`` describes; one of `UNREADABLE` where it cannot be trusted."""
        began = time.perf_counter()
        value, size = payload.load(self.disk, about, verify, self.blobs)
        self._speeds.learn("read", size, time.perf_counter() - began)
        return value

    def _use(self, key: str) -> None:
        if key not in self._used:
            self._used.add(key)
            metadata.note_use(self.disk, key)

    def _try(self, write: Callable[..., bool], key: str, *what: Any) -> bool:
        """Write; once more where what it needs was removed meanwhile."""
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

    def _jot(self, key: str, value: Any, about: Metadata) -> bool:
        entry = self._known[key] = self.brief.put(key, value, about)
        self.journal.append(key, entry)
        return is_kept(entry)

    def _write_parts(self, key: str, entry: Metadata, tensors: list[Tensor], banded: Any) -> None:
        """What is large first, then what names it; of two processes with one key the first one's stays."""
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
                if banded is not None:  # bands of no value yet may have been swept
                    names = serialization.blobs_in(serialization.pack(banded, self.blobs)[0])
                    entry["bands"] = {"names": names, "newest": payload.newest(self.disk, names)}
                if tensors:
                    path = self.disk.path(key, "safetensors")
                    self.disk.rename(part, path)
                    entry["payload"]["stamp"] = payload.stamp_of(path)
                self._write_about(key, entry)

    def _write_about(self, key: str, entry: Metadata) -> None:
        """A torn entry fails its seal, so this small file need not wait for the disk."""
        path = self.disk.path(key, "json")
        with self.disk.temporary(key) as (part, file):
            file.write(metadata.seal(entry))
            file.flush()
            if not self.disk.link(part, path):
                self.disk.rename(part, path)
        self._known[key] = entry

    def _write_receipt(self, key: str, about: Metadata) -> bool:
        """What has the name already stays: it tells no less."""
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
        """Let values go where ``size`` more bytes are too many."""
        if self._room and (excess := self._room.excess(size)) > 0:
            gone = {candidate.key for candidate in maintenance.make_room(self, excess)[0]}
            self._forget(gone)
            self.journal.mark_evicted(gone)

    def _forget(self, keys: Collection[str]) -> None:
        for key in keys:
            self._known.pop(key, None)

    def _put_aside(self, key: str, error: Exception) -> None:
        self.put_aside(key, error)
        warnings.warn(f"the stored result {key} is damaged ({error}): it is put aside", stacklevel=5)

    def put_aside(self, key: str, error: Exception) -> None:
        """Move a damaged entry to ``bad/``, where someone may look at it; what another user owns stays."""
        self._known.pop(key, None)
        self._lost.add(key)
        unreadable = isinstance(error, OSError) and not isinstance(error, FileNotFoundError)
        for suffix in () if unreadable else ("json", "safetensors"):
            with suppress(OSError):
                self.disk.make_folder(f"{self.disk.folder}/bad")
                os.replace(self.disk.path(key, suffix), f"{self.disk.folder}/bad/{key}.{suffix}")
        if not os.path.lexists(self.disk.path(key, "json")):
            self._lost.discard(key)
