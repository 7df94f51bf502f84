"""Store of results: a folder with the files of each result, its speed and its warnings."""

from __future__ import annotations

import heapq
import os
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict, is_dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeVar

from neusee.workflows.keys.sealed_files import NotRead, Unsigned, seal_record, unseal_record
from neusee.workflows.store import metadata, payload
from neusee.workflows.store.cache_settings import Verify, budget_bytes, default_root, verify_mode
from neusee.workflows.store.eviction import LOW, CacheBudget, Maintained
from neusee.workflows.store.journal import Journal
from neusee.workflows.store.lease import Lease, Leases
from neusee.workflows.store.metadata import INLINE, UNREADABLE, Metadata, is_kept, record_use
from neusee.workflows.store.payload import SmallResults
from neusee.workflows.store.shared_folder import Disk, read_file

if TYPE_CHECKING:
    from torch import Tensor


# --- bandwidth ------------------------------------------------------------------------------------

# Read and write speed of a store of results, measured in normal use and saved in a file of the
# store.


Direction = Literal["read", "write"]
_SPEEDS_FILE = "speeds.json"
LARGE = 1_000_000  #: size (bytes) from which a transfer updates the speed
_USUAL: dict[Direction, float] = {"read": 8e9, "write": 0.4e9}  #: bytes / s
#: time (s) of each transfer regardless of its size; writing creates a file, which takes 0.5 to 2 ms
_SETUP_SECONDS: dict[Direction, float] = {"read": 5e-5, "write": 1e-3}
_SYNC_SECONDS = 3e-3  #: time (s) until a file is on the disk, for each result with a separate file
_NEWEST_WEIGHT = 0.3  #: weight of the newest transfer
_SAVED_CHANGE = (
    1.25  #: factor by which a speed must differ from the stored speed to be written to the file
)


class Speeds:
    """Read and write speed of one store in bytes per second."""

    def __init__(self, disk: Disk) -> None:
        self._disk = disk
        self._now: dict[Direction, float] = {}  # present estimates (bytes / s)
        self._written: dict[Direction, float] = {}  # values in the file (bytes / s)

    def seconds(self, way: Direction, size: float) -> float:
        """Return the predicted time in seconds for reading or writing ``size`` bytes in the
        store.
        """
        return _setup(way, size) + size / self._speed(way)

    def learn(self, way: Direction, size: int, seconds: float) -> None:
        """Update the estimated read or write speed of the store with the measured ``seconds`` of
        one transfer.
        """
        if size < LARGE:
            return
        measured_speed = size / max(seconds - _setup(way, size), 1e-6)
        # a weighted geometric mean, because speeds differ by factors
        self._now[way] = self._speed(way) ** (1 - _NEWEST_WEIGHT) * measured_speed**_NEWEST_WEIGHT
        saved_speed = self._written.get(way, _USUAL[way])
        if not saved_speed / _SAVED_CHANGE < self._now[way] < saved_speed * _SAVED_CHANGE:
            self._written = dict(self._now)
            with suppress(OSError):
                self._disk.replace(
                    _SPEEDS_FILE,
                    seal_record("speeds", {str(way): speed for way, speed in self._now.items()}),
                )

    def _speed(self, way: Direction) -> float:
        """Return the speed of reading or writing in bytes / s; at first the value in the file, or
        the usual value.
        """
        if not self._now:
            self._written = self._stored()
            self._now = {**_USUAL, **self._written}
        return self._now[way]

    def _stored(self) -> dict[Direction, float]:
        """Return the speeds in the file of the store; an empty dict if it is missing or invalid."""
        try:
            speeds = unseal_record("speeds", read_file(f"{self._disk.folder}/{_SPEEDS_FILE}"))
            # range of plausible speeds (bytes / s)
            return {
                direction: float(speeds[direction])
                for direction in _USUAL
                if 1e3 < speeds[direction] < 1e13
            }
        except (OSError, ValueError, LookupError, TypeError):
            return {}


def _setup(way: Direction, size: float) -> float:
    """Return the time (s) of a transfer that does not depend on its size."""
    return _SETUP_SECONDS[way] + (_SYNC_SECONDS if way == "write" and size > INLINE else 0.0)


# --- store warnings -------------------------------------------------------------------------------

# Warnings of a store, each issued once: about a folder that cannot be used, and about results that
# are not read.


_CONSEQUENCE = (
    "the run goes on, but results are not stored, so that the next run computes them again"
)


class Warned:
    """Base class of `Store` with its warnings; `Store` defines the folder ``root``."""

    root: Path
    #: the warnings of all stores of this process, for the reports of studies
    failures: ClassVar[list[str]] = []
    failure = ""  #: the warning after the first write that failed
    _has_warned = False

    def report_failure(self, error: Exception, use: str = "written") -> None:
        """Warn that the folder cannot be written or read, once for each store; `failure` keeps
        the text for reports.
        """
        if not self.failure:
            self.pass_on(f"the cache {self.root} cannot be {use} ({error}): {_CONSEQUENCE}")
            warnings.warn(self.failure, stacklevel=5)

    def pass_on(self, failure: str) -> None:
        """Keep the warning ``failure`` for reports; this store, or that of a worker process, has
        issued it.
        """
        if not self.failure:
            self.failure = failure
            self.failures.append(failure)

    def leave(self, error: NotRead) -> None:
        """Issue one warning for all results that are ignored because they have another format or no
        signature.
        """
        if not self._has_warned:
            reason = (
                "without a signature by NEUSEE_CACHE_SECRET"
                if isinstance(error, Unsigned)
                else "of another version"
            )
            text = f"results {reason} in {self.root} are not read, and count as missing"
            warnings.warn(
                f"{text}: `neusee cache gc` removes those that nobody used for a week", stacklevel=4
            )
        self._has_warned = True


# --- result store ---------------------------------------------------------------------------------

# Store of results: a folder with the files ``<key>.json`` and ``<key>.safetensors`` of each result.
#
# The JSON holds the metadata of a result (the parts of its key, layout, statistics, checks,
# seconds, versions) and the whole value of a small result. Of an evicted or unsaved value only the
# metadata remain, called a receipt. A checksum covers every byte and is compared at each load. A
# result that fails the comparison is moved away with one warning and counts as missing. A result
# gets its final name when it is complete, so that a killed process leaves no incomplete result. If
# the folder cannot be written, a run issues one warning and continues.


class Store(Warned, Maintained):
    """Store of computed results in a folder, each under its cache key.

    A failure of the folder gives a missing result, never a wrong result.
    """

    def __init__(
        self,
        root: Path | str | None = None,
        *,
        verify: Verify | None = None,
        budget: int | None = None,
    ) -> None:
        """Open the store in the folder ``root``; environment variables such as $NEUSEE_CACHE
        replace missing arguments.

        ``verify="always"`` compares the checksum of every payload that is loaded. ``"sampled"``
        compares the checksum of a file that was touched after its last write, and otherwise at one
        load in twenty. ``"never"`` compares no such checksum. The checksum of the JSON and the size
        of every payload are always compared.
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
        self._known: dict[str, Metadata] = {}  # metadata that were read or written
        self._lost: set[str] = set()  # damaged results that the user may have no permission to move
        self._used: set[str] = set()  # keys of values that were loaded
        self._missed: set[str] = set()  # keys that were looked up but not found

    # another process receives the path and opens the store
    def __reduce__(self) -> tuple[Any, ...]:
        return partial(type(self), self.root, verify=self.verify, budget=self.budget), ()

    def has(self, key: str) -> bool:
        """Return True if the value of ``key`` is stored, without reading the value."""
        return is_kept(self.about(key))

    def about(self, key: str) -> Metadata | None:
        """Return the metadata of a result, or None; the field ``kept`` tells whether the value
        is stored as well.
        """
        entry = self._known.get(key)
        if is_kept(entry):
            return entry
        # a damaged result counts as missing
        if key in self._lost:
            return None
        entry = self.brief.find(key)
        if not is_kept(entry):
            try:
                # a receipt among the small results counts only if there is no file
                entry = metadata.find(self.disk, key) or entry
            except NotRead as error:
                self.leave(error)
            except UNREADABLE as error:
                self._put_aside(key, error)
        if entry is not None:
            self._known[key] = entry
        else:
            self._missed.add(key)
        return entry

    def asked(self) -> dict[str, Metadata | None]:
        """Return the metadata of each result that this process has looked up so far; None for a
        missing result.
        """
        return {**dict.fromkeys(self._missed | self._lost), **self._known}

    def loaded(self) -> set[str]:
        """Return the keys of the values that this process has loaded so far."""
        return set(self._used)

    def get(self, key: str, kind: Any = Any) -> Any:
        """Return the value of ``key``; raise `KeyError` if no undamaged value is stored.

        ``kind`` is the annotated type of the value; a value that does not fit counts as damaged.
        """
        entry = self.about(key)
        while is_kept(entry):
            try:
                value = self.load(entry, self.verify, kind)
            except UNREADABLE as error:
                # another process may have replaced or evicted the value between metadata and bytes
                metadata_before, entry = entry, self._again(key)
                if entry == metadata_before or self.brief.find(key) == metadata_before:
                    self._put_aside(key, error)
                    break
            else:
                self._use(key)
                return value
        raise KeyError(key)

    def put(self, key: str, value: Any, about: Metadata) -> bool:
        """Store a value and its metadata; return False if the folder is not writable or the
        budget is too small.
        """
        return self._try(self._write, key, value, about)

    def put_receipt(self, key: str, about: Metadata) -> bool:
        """Store the metadata of a result without its value, unless the value or its metadata are
        stored already.
        """
        return self._try(self._write_receipt, key, about)

    def put_small(self, key: str, value: Any, about: Metadata) -> bool:
        """Store a small value in the common file of small values; for a larger value, store only
        the metadata.
        """
        return self._try(self._write_small, key, value, about)

    def entries(self) -> Iterator[tuple[str, Metadata]]:
        """Yield key and metadata of every result in the order of the keys, including results
        without a stored value.
        """
        small_keys, key_before = self.brief.keys(), ""
        for key in heapq.merge(metadata.names(self.disk), sorted(small_keys)):
            # a key may be in both places
            entry = self._listed(key, key in small_keys) if key != key_before else None
            key_before = key
            if entry is not None:
                yield key, entry

    def _listed(self, key: str, small: bool) -> Metadata | None:
        """Return the metadata of a result like `about`, but keep nothing in memory, so that a list
        may have any length.

        ``small``: True if the common file of small results has a line for the result.
        """
        if key in self._known or key in self._lost:
            return self.about(key)
        if small and is_kept(entry := self.brief.find(key)):
            return entry
        try:
            return metadata.read(self.disk, key)
        except UNREADABLE:
            return self.about(key)  # removed meanwhile, damaged, or in another format

    def claim(self, key: str) -> Lease | None:
        """Return the lease of ``key``, the right to compute its result, or None while a running
        process holds it.
        """
        return self._leases.claim(key)

    def read_seconds(self, size: float) -> float:
        """Return the predicted time in seconds for loading ``size`` bytes, based on earlier
        loads from this store.
        """
        return self._speeds.seconds("read", size)

    def write_seconds(self, size: float) -> float:
        """Return the predicted time in seconds for storing ``size`` bytes, based on earlier
        writes to this store.
        """
        return self._speeds.seconds("write", size)

    def _again(self, key: str) -> Metadata | None:
        """Read the metadata of a result again; return None if the metadata were removed or
        cannot be read.
        """
        # removed, so that the file is read
        self._known.pop(key, None)
        with suppress(*UNREADABLE):
            return metadata.read(self.disk, key)
        return None

    def load(self, about: Metadata, verify: str, kind: Any = Any) -> Any:
        """Return the value that the metadata ``about`` describe; raise an error in `UNREADABLE` if
        it is damaged.

        For the ``kind`` None the named tuples in the value are plain tuples, so that no type need
        be known.
        """
        began = time.perf_counter()
        value, size = payload.load(self.disk, about, verify, kind is not None)
        if kind is not None and kind is not Any:
            payload.check_kind(value, kind)
        self._speeds.learn("read", size, time.perf_counter() - began)
        return value

    def _use(self, key: str) -> None:
        """Record the use of a value as the modification time of its JSON file, at most once an
        hour.
        """
        if key not in self._used:
            self._used.add(key)
            record_use(self.disk, key)

    def _try(self, write: Callable[..., bool], key: str, *arguments: Any) -> bool:
        """Return the result of ``write``, called again if a folder was removed; on failure,
        return False and warn.
        """
        try:
            try:
                return write(key, *arguments)
            except FileNotFoundError:
                # another process has removed the folder of temporary files
                self.disk.forget()
                return write(key, *arguments)
        except OSError as error:
            self.report_failure(error)
            return False

    def _write(self, key: str, value: Any, about: Metadata) -> bool:
        """Write a value with its metadata. If it is larger than the budget allows, write only the
        metadata and return False.
        """
        began = time.perf_counter()
        metadata_entry, tensors = payload.described(key, value, about)
        # larger than what an eviction leaves of the budget
        if self._room and metadata_entry["bytes"] > LOW * self._room.budget:
            self._write_receipt(key, metadata_entry)
            return False
        if tensors:
            self._write_tensors(key, metadata_entry, tensors)
            self._speeds.learn("write", sum(t.nbytes for t in tensors), time.perf_counter() - began)
        else:
            self._write_about(key, metadata_entry)
        self._lost.discard(key)
        self.journal.append(key, metadata_entry)
        self._make_room(metadata_entry["bytes"])
        return True

    def _write_small(self, key: str, value: Any, about: Metadata) -> bool:
        """Write a value into the file of small results. If it is too large for a line, write only
        its metadata and return False.
        """
        entry, tensors = payload.described(key, value, about)
        # the tensors do not fit into the metadata
        if tensors:
            entry = metadata.receipt(entry)
        self.brief.append(entry)
        self._lost.discard(key)
        self._known[key] = entry
        self.journal.append(key, entry)
        return is_kept(entry)

    def _write_tensors(self, key: str, entry: Metadata, tensors: list[Tensor]) -> None:
        """Write the file of tensors of a value, then the metadata that name it; keep a value
        stored earlier.
        """
        with self.disk.temporary(key) as (temporary, file):
            entry["payload"] = payload.written(file, tensors)
            with self.disk.lock():
                if key not in self._lost and metadata.has_value(self.disk, key):
                    # keep the value that is already stored
                    return
                path = self.disk.path(key, "safetensors")
                # the file has its name before the metadata that name it
                self.disk.rename(temporary, path)
                entry["payload"]["stamp"] = payload.stamp_of(path)
                self._write_about(key, entry)

    def _write_about(self, key: str, entry: Metadata) -> None:
        """Write metadata in place of existing ones, and keep them in memory."""
        metadata.write(self.disk, key, entry, over=True)
        self._known[key] = entry

    def _write_receipt(self, key: str, about: Metadata) -> bool:
        """Write the metadata of a result without its value, unless the store has metadata of the
        result.
        """
        entry = metadata.receipt({"key": key, **about})
        if self.about(key) is None and metadata.write(self.disk, key, entry, over=False):
            self._known[key] = entry
        self.journal.append(key, entry)
        return True

    def _make_room(self, size: int) -> None:
        """Evict values if a write of ``size`` bytes has exceeded the budget."""
        if self._room and (excess := self._room.excess(size)) > 0:
            self.journal.mark_evicted({candidate.key for candidate in self.make_room(excess)[0]})

    def _put_aside(self, key: str, error: Exception) -> None:
        """Put a damaged result aside and warn of it."""
        self.put_aside(key, error)
        if isinstance(error, OSError) and not isinstance(
            error, FileNotFoundError | PermissionError
        ):
            # the device fails: one warning is enough
            return self.report_failure(error, "read")
        warnings.warn(
            f"the stored result {key} is damaged ({error}) and counts as missing", stacklevel=5
        )
        return None

    def put_aside(self, key: str, error: Exception) -> None:
        """Move the files of a damaged result to ``bad/`` for inspection; a file of another user
        stays.
        """
        self._known.pop(key, None)
        self._lost.add(key)
        is_unreadable = isinstance(error, OSError) and not isinstance(error, FileNotFoundError)
        # a device that fails needs no inspection of the file
        for suffix in () if is_unreadable else ("json", "safetensors"):
            self.disk.put_aside(self.disk.path(key, suffix))
        small_result = self.brief.find(key)
        with suppress(OSError):
            # a later line replaces the damaged one
            if is_kept(small_result):
                self.brief.append(metadata.receipt(small_result))
            # the damaged file is gone, so that the key may be written again
            if not os.path.lexists(self.disk.path(key, "json")):
                self._lost.discard(key)


# --- memo -----------------------------------------------------------------------------------------

# Values that are computed only once: a value is read from the store, or computed and then stored.


T = TypeVar("T")


def compute_once(
    store: Store,
    key: str,
    kind: type[T],
    compute: Callable[[], T],
    about: Metadata,
    *,
    small: bool = False,
) -> T:
    """Return the value that ``store`` has under ``key``, or compute and store the value if it is
    missing.

    Args:
        kind: the type of the value. A dataclass is stored as the dict of its fields.
        about: metadata of the value, which get the date and the seconds that ``compute`` took
        small: whether to store the value with `Store.put_small`
    """
    with suppress(KeyError):
        stored = store.get(key, dict if is_dataclass(kind) else kind)
        make_value: Callable[..., T] = kind
        try:
            return make_value(**stored) if is_dataclass(kind) else make_value(stored)
        except (TypeError, ValueError) as error:  # a value with other fields
            store.put_aside(key, error)
    began = time.perf_counter()
    value = compute()
    time_and_date: Metadata = {
        "seconds": time.perf_counter() - began,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    store_value = store.put_small if small else store.put
    store_value(
        key,
        asdict(value) if is_dataclass(value) and not isinstance(value, type) else value,
        time_and_date | about,
    )
    return value
