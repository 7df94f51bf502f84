"""Small results as lines of one common file, for results that are computed faster than a file is written.

A line is one write. A line that is torn or fails its checksum is ignored; the loss of a line costs less than a
millisecond of computation. All processes see the lines of each other, because a look-up of a key that is not known
reads the lines added since the last look-up.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import suppress
from stat import S_ISREG

from neusee.workflows.keys.seal import seal_record
from neusee.workflows.store import metadata
from neusee.workflows.store.metadata import UNREADABLE, Metadata
from neusee.workflows.store.shared_folder import Disk, append, open_now

MOST = 64 << 20  #: bytes of the file above which the older half is dropped
_HEAD = b'{"key":"'
_KEY = slice(len(_HEAD), len(_HEAD) + 32)


class SmallResults:
    """The small results of one store: each result is one line of a common file."""

    def __init__(self, disk: Disk) -> None:
        self._disk, self._guard = disk, threading.Lock()
        self._path = f"{disk.folder}/brief.jsonl"
        self._lines: dict[str, bytes] = {}
        self._read: dict[str, tuple[bytes, Metadata]] = {}  # lines that were read, with their metadata
        self._file, self._offset = 0, 0

    def find(self, key: str) -> Metadata | None:
        """Return the metadata of the small result ``key``, or None if its line is missing or damaged."""
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
        """Rewrite the file of small results with only its newest lines; lines added meanwhile may be lost.

        The new file has at most half of `MOST` bytes.
        """
        self._read_new_lines()
        kept, size = list[bytes](), 0
        for raw in reversed(self._lines.values()):
            size += len(raw) + 1
            if size > MOST // 2:
                break
            kept.append(raw)
        with suppress(OSError):
            self._disk.replace("brief.jsonl", b"".join(b"\n" + raw for raw in reversed(kept)))

    def _write(self, raw: bytes, flags: int = 0) -> None:
        """Append a line break and a line to the file, so that an incomplete line of a killed process stays separate."""
        if append(self._path, b"\n" + raw, flags) != len(raw) + 1:
            raise OSError(f"{self._path}: the disk has no space left to record a result")

    def _read_new_lines(self) -> None:
        """Read the lines added to the file of small results since the last call, or all lines of a replaced file."""
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
            whole = raw.rfind(b"\n") if not raw.endswith(b"}") else len(raw)
            for line in raw[:whole].split(b"\n"):
                if line.startswith(_HEAD):
                    key = line[_KEY].decode(errors="replace")
                    if key.isalnum():  # it may be a part of a path
                        self._lines.pop(key, None)  # keep the newest line last
                        self._lines[key] = line
            self._file, self._offset = os.fstat(file.fileno()).st_ino, self._offset + max(0, whole)
        if self._offset > MOST:
            self.compact()
