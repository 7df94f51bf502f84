"""Values of results, written to and read from files, receipts and lines of small results."""

from __future__ import annotations

import hashlib
import os
import random
import stat
import threading
from collections.abc import Iterable, Iterator
from contextlib import suppress
from stat import S_ISREG
from typing import IO, TYPE_CHECKING, Any

from neusee.workflows.keys.sealed_files import seal_record, secrets
from neusee.workflows.store import lazy_imports as lazy
from neusee.workflows.store import metadata
from neusee.workflows.store.metadata import INLINE, UNREADABLE, Metadata, checked_layout, is_kept
from neusee.workflows.store.shared_folder import Disk, append, open_now

if TYPE_CHECKING:
    from torch import Tensor

    from neusee.workflows.store.band_files import Blobs


# --- payload --------------------------------------------------------------------------------------

# Conversion of values to metadata and tensors for the store, and loading of stored values.


#: fraction of the loads that mode ``sampled`` verifies although the file has not been touched
_SAMPLED = 1 / 20
# a separate generator, so that loads do not change the random numbers of a user
_draw = random.Random()


def described(
    key: str, value: Any, about: Metadata, blobs: Blobs | None = None
) -> tuple[Metadata, list[Tensor], dict[str, str]]:
    """Return the metadata of a new value, the tensors that need a file, and the checksums of its
    bands by name.

    Small tensors are part of the metadata.
    """
    layout, tensors = lazy.serialization.pack(value, blobs)
    size = inline = sum(t.nbytes for t in tensors)
    bands = checked_layout(layout)
    if bands:
        size = max(inline, about.get("bytes") or 0)
    entry = {"key": key, **about, "layout": layout, "bytes": size, "payload": None, "kept": True}
    if inline <= INLINE:
        entry["tensors"], tensors = [lazy.serialization.to_text(t) for t in tensors], []
    return entry, tensors, bands


def written(file: IO[bytes], tensors: list[Tensor]) -> Metadata:
    """Write tensors to a new file and to the disk; return the size and the digests of the file."""
    sha256 = hashlib.sha256() if secrets() else None
    write = lazy.serialization.write
    xxh3 = write(file, tensors, sha256) if sha256 else write(file, tensors)
    file.flush()
    os.fsync(file.fileno())
    return {"size": file.tell(), "xxh3": xxh3} | ({"sha256": sha256.hexdigest()} if sha256 else {})


def load(
    disk: Disk, about: Metadata, verify: str, blobs: Blobs, typed: bool = True
) -> tuple[Any, int]:
    """Return the value that the metadata ``about`` describe, and the number of bytes compared with
    the checksum.

    Only bytes of the payload file are counted. With ``typed=False``, named tuples are plain tuples.

    Raises one of the errors in `UNREADABLE` if the value is missing or damaged.
    """
    bands = about.get("bands")
    check = verify == "always" or (verify == "sampled" and _draw.random() < _SAMPLED)
    tensors, compared = [lazy.serialization.from_text(*t) for t in about.get("tensors") or ()], 0
    if about["payload"]:
        tensors, compared = _tensors_of_file(disk, about, verify, check)
    if bands and verify == "sampled" and not check:
        check = newest(blobs, bands["names"]) > bands["newest"]
    return lazy.serialization.unpack(about["layout"], tensors, blobs, check, typed), compared


def _tensors_of_file(
    disk: Disk, about: Metadata, verify: str, check: bool
) -> tuple[list[Tensor], int]:
    """Return the tensors in the file of a value, and the number of bytes compared with the
    checksum: all if ``check``, or if the file is not the one that was written.
    """
    payload, path = about["payload"], disk.path(about["key"], "safetensors")
    stamp = stamp_of(path)
    if stamp[1] != payload["size"]:
        raise ValueError(
            f"the file of tensors has {stamp[1]} bytes instead of {payload['size']} bytes"
        )
    due = check or (verify == "sampled" and stamp != payload.get("stamp"))
    # whatever ``verify`` says: the checksum has no key
    sha256 = payload.get("sha256", "") if secrets() else None
    tensors = lazy.serialization.read(path, payload["xxh3"] if due else None, sha256)
    return tensors, payload["size"] if due else 0


def check_kind(value: Any, kind: Any) -> None:
    """Raise `ValueError` for a value that does not have the annotated type ``kind``."""
    if not lazy.serialization.fits(value, kind):
        raise ValueError(f"the value is {type(value).__name__}, which the step does not return")


def stamp_of(path: str) -> list[int]:
    """Return the inode, size and times (ns) of a file; any write to the file changes one of these
    numbers.

    Raises `ValueError` for what is no file, such as a pipe.
    """
    about = os.stat(path)
    if not stat.S_ISREG(about.st_mode):
        raise ValueError(f"{path} is not a file")
    return [about.st_ino, about.st_size, about.st_mtime_ns, about.st_ctime_ns]


def newest(blobs: Blobs, names: Iterable[str]) -> int:
    """Return the time in ns of the last change of any of the band files ``names``."""
    stats = [os.stat(blobs.path(name)) for name in names]
    return max((max(stat.st_mtime_ns, stat.st_ctime_ns) for stat in stats), default=0)


# --- receipts -------------------------------------------------------------------------------------

# Receipts of one store, the metadata of results without a value: a file is read again only after it
# has changed.


class Receipts:
    """The metadata files of one store, of which those of receipts are remembered with the stamp
    of their file.
    """

    def __init__(self, disk: Disk) -> None:
        self._disk = disk
        self._read: dict[str, tuple[list[int], Metadata]] = {}

    def find(self, key: str) -> Metadata | None:
        """Return the metadata of ``key``, with or without a value, as `metadata.find` does.

        Raises an error in `UNREADABLE` for damaged metadata.
        """
        try:
            stamp = stamp_of(self._disk.path(key, "json"))
        except (OSError, ValueError):
            # which tells what is wrong with the file, or that there is none
            return metadata.find(self._disk, key)
        if key in self._read and self._read[key][0] == stamp:
            return self._read[key][1]
        about = metadata.find(self._disk, key)
        if about is not None and not is_kept(about):
            self._read[key] = stamp, about
        return about


# --- small results --------------------------------------------------------------------------------

# Small results as lines of one common file, for results that are computed faster than a file is
# written.
#
# A line is one write. A line that is torn or fails its checksum is ignored; the loss of a line
# costs less than a millisecond of computation. All processes see the lines of each other, because a
# look-up of a key that is not known reads the lines added since the last look-up.


MOST = 64 << 20  #: bytes of the file above which the older half is dropped
_HEAD = b'{"key":"'
_KEY = slice(len(_HEAD), len(_HEAD) + 32)


class SmallResults:
    """The small results of one store: each result is one line of a common file."""

    def __init__(self, disk: Disk) -> None:
        self._disk, self._guard = disk, threading.Lock()
        self._path = f"{disk.folder}/brief.jsonl"
        self._lines: dict[str, bytes] = {}
        # lines that were read, with their metadata
        self._read: dict[str, tuple[bytes, Metadata]] = {}
        self._file, self._offset = 0, 0

    def find(self, key: str) -> Metadata | None:
        """Return the metadata of the small result ``key``, or None if its line is missing or
        damaged.
        """
        if key not in self._lines:
            self._read_new_lines()
        with suppress(*UNREADABLE):  # also a KeyError if the key has no line
            raw = self._lines[key]
            if key not in self._read or self._read[key][0] is not raw:
                self._read[key] = raw, metadata.unseal_of("small result", key, raw)
            return self._read[key][1]
        return None

    def append(self, about: Metadata) -> None:
        """Append a line with the metadata ``about`` of a small result to the common file.

        Raises `OSError` if the line cannot be written.
        """
        raw = seal_record("small result", about)
        try:
            self._write(raw)
        except (FileNotFoundError, IsADirectoryError):
            self._disk.prepare()
            if os.path.isdir(self._path):
                self._disk.put_aside(self._path)
            self._write(raw, os.O_CREAT)
            self._disk.share(self._path)

    def each(self) -> Iterator[tuple[str, Metadata]]:
        """Yield the key and the newest metadata of every small result."""
        for key in sorted(self.keys()):
            if (about := self.find(key)) is not None:
                yield key, about

    def keys(self) -> set[str]:
        """Return the keys of all small results, some of which may be damaged."""
        self._read_new_lines()
        return set(self._lines)

    def compact(self) -> None:
        """Rewrite the file of small results with only its newest lines; lines added meanwhile may
        be lost.

        The new file has at most half of `MOST` bytes.
        """
        self._read_new_lines()
        newest_lines, size = list[bytes](), 0
        for raw in reversed(self._lines.values()):
            size += len(raw) + 1
            if size > MOST // 2:
                break
            newest_lines.append(raw)
        with suppress(OSError):
            self._disk.replace(
                "brief.jsonl", b"".join(b"\n" + raw for raw in reversed(newest_lines))
            )

    def _write(self, raw: bytes, flags: int = 0) -> None:
        """Append a line break and a line to the file, so that an incomplete line of a killed
        process stays separate.
        """
        if append(self._path, b"\n" + raw, flags) != len(raw) + 1:
            raise OSError(f"{self._path}: the disk has no space left to record a result")

    def _add(self, line: bytes) -> None:
        """Keep a line of the file, as the newest of its key, unless it is no line of a result."""
        if line.startswith(_HEAD):
            key = line[_KEY].decode(errors="replace")
            if key.isalnum():  # it may be a part of a path
                self._lines.pop(key, None)
                self._lines[key] = line

    def _read_new_lines(self) -> None:
        """Read the lines added to the file of small results since the last call, or all lines of
        a replaced file.
        """
        try:
            stat = os.stat(self._path)
        except OSError:
            return
        if (stat.st_ino, stat.st_size) == (self._file, self._offset):
            return
        if not S_ISREG(stat.st_mode):
            return
        with self._guard, suppress(OSError), open(self._path, "rb", opener=open_now) as file:
            if stat.st_ino != self._file or stat.st_size < self._offset:
                self._lines, self._offset = {}, 0
            file.seek(self._offset)
            raw = file.read()
            end = raw.rfind(b"\n") if not raw.endswith(b"}") else len(raw)
            for line in raw[:end].split(b"\n"):
                self._add(line)
            self._file, self._offset = os.fstat(file.fileno()).st_ino, self._offset + max(0, end)
        if self._offset > MOST:
            self.compact()
