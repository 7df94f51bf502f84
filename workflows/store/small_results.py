"""Small results as sealed lines of one file, for results that take less time to compute than to write to a file.

A line is one write. A line that is torn or fails its checksum is ignored; the loss of a line
costs less than a millisecond of computation. All processes see the lines of each other,
because a look-up that misses reads the lines added since the last look-up.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

from neusee.workflows.store import metadata
from neusee.workflows.store.metadata import INLINE, UNREADABLE, Metadata
from neusee.workflows.store.shared_folder import Disk

MOST = 64 << 20  #: bytes of the file above which the older half is dropped
_HEAD = b'{"key":"'
_KEY = slice(len(_HEAD), len(_HEAD) + 32)


class SmallResults:
    """The lines of one store."""

    def __init__(self, disk: Disk) -> None:
        self._disk, self._guard = disk, threading.Lock()
        self._path = f"{disk.folder}/brief.jsonl"
        self._lines: dict[str, bytes] = {}
        self._file, self._offset = 0, 0

    def find(self, key: str) -> Metadata | None:
        """Return the content of the line of ``key``, or None where no line can be trusted."""
        if key not in self._lines:
            self._take_in()
        raw = self._lines.get(key)
        if raw is None:
            return None
        try:
            about = metadata.unseal(raw)
            return about if about["key"] == key else None
        except UNREADABLE:
            return None

    def put(self, key: str, value: Any, about: Metadata) -> Metadata:
        """Append a value if it is small, else its receipt; return the line. Raises `OSError` or `TypeError`."""
        from neusee.workflows.store import serialization

        layout, tensors = serialization.pack(value)
        size = sum(t.nbytes for t in tensors)
        entry = {"key": key, **about, "layout": layout, "bytes": size, "payload": None, "kept": True}
        if size <= INLINE:
            entry["tensors"] = [serialization.to_text(t) for t in tensors]
        else:
            entry = metadata.receipt(entry)
        self.append(entry)
        return entry

    def append(self, about: Metadata) -> None:
        """Append a line. Raises `OSError` where the line cannot be written."""
        raw = metadata.seal(about)
        try:
            self._write(raw, os.O_APPEND | os.O_WRONLY)
        except FileNotFoundError:
            self._disk.prepare()
            self._write(raw, os.O_APPEND | os.O_WRONLY | os.O_CREAT)
            self._disk.share(self._path)

    def each(self) -> Iterator[tuple[str, Metadata]]:
        """Yield every key with the content of its newest line."""
        self._take_in()
        for key in sorted(self._lines):
            if (about := self.find(key)) is not None:
                yield key, about

    def compact(self) -> None:
        """Keep the newest lines, up to half of `MOST` bytes; a line that is added meanwhile may be lost."""
        self._take_in()
        kept, size = list[bytes](), 0
        for raw in reversed(self._lines.values()):
            size += len(raw) + 1
            if size > MOST // 2:
                break
            kept.append(raw)
        with suppress(OSError), self._disk.temporary("brief") as (part, file):
            file.write(b"".join(b"\n" + raw for raw in reversed(kept)))
            file.flush()
            self._disk.share(part)
            os.replace(part, self._path)

    def _write(self, raw: bytes, flags: int) -> None:
        """Write a line with its line end first, so that a torn line of a killed process stays separate."""
        file = os.open(self._path, flags, 0o666)
        try:
            if os.write(file, b"\n" + raw) != len(raw) + 1:
                raise OSError(f"{self._path}: no space left for a line")
        finally:
            os.close(file)

    def _take_in(self) -> None:
        """Read the lines added since the last call, or the whole file where the file was replaced."""
        try:
            stat = os.stat(self._path)
        except OSError:
            return
        if (stat.st_ino, stat.st_size) == (self._file, self._offset):
            return
        with self._guard, suppress(OSError), open(self._path, "rb") as file:
            if stat.st_ino != self._file or stat.st_size < self._offset:
                self._lines, self._offset = {}, 0
            file.seek(self._offset)
            raw = file.read()
            whole = raw.rfind(b"\n") if not raw.endswith(b"}") else len(raw)
            for line in raw[:whole].split(b"\n"):
                if line.startswith(_HEAD):
                    self._lines.pop(line[_KEY].decode(errors="replace"), None)  # keep the newest line last
                    self._lines[line[_KEY].decode(errors="replace")] = line
            self._file, self._offset = os.fstat(file.fileno()).st_ino, self._offset + max(0, whole)
        if self._offset > MOST:
            self.compact()
