"""Values of results, written to and read from files and lines of small results."""

from __future__ import annotations

import hashlib
import os
import random
import stat
import threading
from collections.abc import Iterator
from contextlib import suppress
from stat import S_ISREG
from typing import IO, TYPE_CHECKING, Any

from neusee.workflows.keys.sealed_files import seal_record, secrets
from neusee.workflows.store import lazy_imports as lazy
from neusee.workflows.store import metadata
from neusee.workflows.store.metadata import INLINE, UNREADABLE, Metadata
from neusee.workflows.store.shared_folder import Disk, append, open_now

if TYPE_CHECKING:
    from torch import Tensor


# --- payload --------------------------------------------------------------------------------------

# Conversion of values to metadata and tensors for the store, and loading of stored values.


#: fraction of the loads that the mode ``sampled`` verifies although the file has not changed
_SAMPLED = 1 / 20
# a separate generator, so that loads do not change the random numbers of a user
_draw = random.Random()


def described(key: str, value: Any, about: Metadata) -> tuple[Metadata, list[Tensor]]:
    """Return the metadata of a new value, and the tensors that need a file.

    Small tensors are part of the metadata.
    """
    layout, tensors = lazy.serialization.pack(value)
    tensor_bytes = sum(t.nbytes for t in tensors)
    entry = {
        "key": key,
        **about,
        "layout": layout,
        "bytes": tensor_bytes,
        "payload": None,
        "kept": True,
    }
    if tensor_bytes <= INLINE:
        entry["tensors"], tensors = [lazy.serialization.to_text(t) for t in tensors], []
    return entry, tensors


def written(file: IO[bytes], tensors: list[Tensor]) -> Metadata:
    """Write tensors to a new file and to the disk; return the size and the digests of the file."""
    sha256 = hashlib.sha256() if secrets() else None
    write = lazy.serialization.write
    checksum = write(file, tensors, sha256) if sha256 else write(file, tensors)
    file.flush()
    os.fsync(file.fileno())
    return {"size": file.tell(), "xxh3": checksum} | (
        {"sha256": sha256.hexdigest()} if sha256 else {}
    )


def load(disk: Disk, about: Metadata, verify: str, typed: bool = True) -> tuple[Any, int]:
    """Return the value that the metadata ``about`` describe, and the number of bytes compared with
    the checksum.

    Only bytes of the payload file are counted. With ``typed=False``, named tuples are plain tuples.

    Raises one of the errors in `UNREADABLE` if the value is missing or damaged.
    """
    compares = verify == "always" or (verify == "sampled" and _draw.random() < _SAMPLED)
    tensors, bytes_compared = (
        [lazy.serialization.from_text(*t) for t in about.get("tensors") or ()],
        0,
    )
    if about["payload"]:
        tensors, bytes_compared = _tensors_of_file(disk, about, verify, compares)
    return lazy.serialization.unpack(about["layout"], tensors, typed), bytes_compared


def _tensors_of_file(
    disk: Disk, about: Metadata, verify: str, check: bool
) -> tuple[list[Tensor], int]:
    """Return the tensors in the file of a value, and the number of bytes compared with the
    checksum: all if ``check``, or if the file is not the one that was written.
    """
    payload, path = about["payload"], disk.path(about["key"], "safetensors")
    file_stamp = stamp_of(path)
    # the second number of a stamp is the size
    if file_stamp[1] != payload["size"]:
        raise ValueError(
            f"the file of tensors has {file_stamp[1]} bytes instead of {payload['size']} bytes"
        )
    is_compared = check or (verify == "sampled" and file_stamp != payload.get("stamp"))
    # checked in every mode: unlike the checksum, the signed digest cannot be forged
    sha256 = payload.get("sha256", "") if secrets() else None
    tensors = lazy.serialization.read(path, payload["xxh3"] if is_compared else None, sha256)
    return tensors, payload["size"] if is_compared else 0


def check_kind(value: Any, kind: Any) -> None:
    """Raise `ValueError` for a value that does not have the annotated type ``kind``."""
    if not lazy.serialization.fits(value, kind):
        raise ValueError(f"the value is {type(value).__name__}, which the step does not return")


def stamp_of(path: str) -> list[int]:
    """Return the inode, size and times (ns) of a file; any write to the file changes one of these
    numbers.

    Raises `ValueError` for anything but a regular file, such as a pipe.
    """
    file_status = os.stat(path)
    if not stat.S_ISREG(file_status.st_mode):
        raise ValueError(f"{path} is not a file")
    return [
        file_status.st_ino,
        file_status.st_size,
        file_status.st_mtime_ns,
        file_status.st_ctime_ns,
    ]


# --- small results --------------------------------------------------------------------------------

# Small results as lines of one common file, for results that are computed faster than a file is
# written.
#
# A line is one write. A line that is torn or fails its checksum is ignored; the loss of a line
# costs less than a millisecond of computation. All processes see the lines of each other, because a
# look-up of a key that is not known reads the lines added since the last look-up.


MOST_BYTES = 64 << 20  #: size (bytes) of the file above which the older half is dropped
_LINE_START = b'{"key":"'
_KEY_OF_LINE = slice(len(_LINE_START), len(_LINE_START) + 32)


class SmallResults:
    """The small results of one store: each result is one line of a common file."""

    def __init__(self, disk: Disk) -> None:
        self._disk, self._guard = disk, threading.Lock()
        self._path = f"{disk.folder}/brief.jsonl"
        self._lines: dict[str, bytes] = {}  # newest line of each key
        # lines that were read, with their metadata
        self._read: dict[str, tuple[bytes, Metadata]] = {}
        # inode of the file, and bytes read of it so far
        self._file, self._offset = 0, 0

    def find(self, key: str) -> Metadata | None:
        """Return the metadata of the small result ``key``, or None if its line is missing or
        damaged.
        """
        if key not in self._lines:
            self._read_new_lines()
        with suppress(*UNREADABLE):  # also a KeyError if the key has no line
            line = self._lines[key]
            # a newer line is another object
            if key not in self._read or self._read[key][0] is not line:
                self._read[key] = line, metadata.unseal_of("small result", key, line)
            return self._read[key][1]
        return None

    def append(self, about: Metadata) -> None:
        """Append a line with the metadata ``about`` of a small result to the common file.

        Raises `OSError` if the line cannot be written.
        """
        line = seal_record("small result", about)
        try:
            self._write(line)
        except (FileNotFoundError, IsADirectoryError):
            self._disk.prepare()
            if os.path.isdir(self._path):
                self._disk.put_aside(self._path)
            self._write(line, os.O_CREAT)
            self._disk.share(self._path)

    def each(self) -> Iterator[tuple[str, Metadata]]:
        """Yield the key and the newest metadata of every small result."""
        for key in sorted(self.keys()):
            if (entry := self.find(key)) is not None:
                yield key, entry

    def keys(self) -> set[str]:
        """Return the keys of all small results, some of which may be damaged."""
        self._read_new_lines()
        return set(self._lines)

    def compact(self) -> None:
        """Rewrite the file of small results with only its newest lines; lines added meanwhile may
        be lost.

        The new file has at most half of `MOST_BYTES` bytes.
        """
        self._read_new_lines()
        newest_lines, total_bytes = list[bytes](), 0
        for line in reversed(self._lines.values()):
            total_bytes += len(line) + 1
            if total_bytes > MOST_BYTES // 2:
                break
            newest_lines.append(line)
        with suppress(OSError):
            self._disk.replace(
                "brief.jsonl", b"".join(b"\n" + line for line in reversed(newest_lines))
            )

    def _write(self, raw: bytes, flags: int = 0) -> None:
        """Append a line break and a line to the file, so that an incomplete line of a killed
        process stays separate.
        """
        if append(self._path, b"\n" + raw, flags) != len(raw) + 1:
            raise OSError(f"{self._path}: the disk has no space left to record a result")

    def _add(self, line: bytes) -> None:
        """Keep a line of the file as the newest of its key; ignore a line that is no result."""
        if line.startswith(_LINE_START):
            key = line[_KEY_OF_LINE].decode(errors="replace")
            if key.isalnum():  # checked, because a key may become part of a path
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
            # the file was rewritten
            if stat.st_ino != self._file or stat.st_size < self._offset:
                self._lines, self._offset = {}, 0
            file.seek(self._offset)
            new_bytes = file.read()
            # a last line without its bracket is still being written
            end_of_lines = (
                new_bytes.rfind(b"\n") if not new_bytes.endswith(b"}") else len(new_bytes)
            )
            for line in new_bytes[:end_of_lines].split(b"\n"):
                self._add(line)
            self._file, self._offset = (
                os.fstat(file.fileno()).st_ino,
                self._offset + max(0, end_of_lines),
            )
        if self._offset > MOST_BYTES:
            self.compact()
