"""Journal of a store: one line for every finished result, so that a query reads one file instead of
all results.

No result depends on the journal. Each line is one write and has its own seal; a line that is torn,
damaged or out of range is skipped. A journal that is missing or
damaged is rebuilt from the metadata of the results.
"""

from __future__ import annotations

import errno
import itertools
import os
import re
import stat
import threading
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from typing import Any, BinaryIO

from neusee.workflows.keys.sealed_files import FORMAT, seal_record, unseal_record
from neusee.workflows.store import metadata
from neusee.workflows.store.metadata import FIELDS, is_text
from neusee.workflows.store.shared_folder import Disk, append, read_file

Row = dict[str, Any]
_FIELDS = ("step", "recipe", "seconds", "bytes", "device", "peak", "size", "date")
#: fields that lines of earlier versions lack: the time of the clock alone says little of a step
_LATER_FIELDS = ("processor_seconds", "processor", "threads")
_CHECKED = [(name, FIELDS[name]) for name in (*_FIELDS, *_LATER_FIELDS, "kept")]
_START, NO_VALUE = b'{"key":"', b'"kept":false'  #: bytes that cannot occur inside a JSON text
_KEY = slice(len(_START), len(_START) + 32)
_NAMES = {"key", "node", "kept", *_FIELDS}
_HEAD = re.compile(rb'\{"journal":"[0-9a-f]{16}","format":%d\}' % FORMAT)
_SPARE = 20_000  #: number of lines above which a file of mostly superseded lines is rewritten
_LATEST = 1 << 20  #: bytes at the end of the file that `Journal.latest` reads, about 3000 lines
_TOTALS = re.compile(rb'^%s([^"]+)".*?,"bytes":(\d*).*?,"kept":(true|false)' % _START, re.M)


def row_of(key: str, about: Row) -> Row:
    """Return the journal line for the result ``key`` with the metadata ``about``."""
    node = (about.get("origin") or {}).get("node")
    return {
        "key": key,
        **{f: about.get(f) for f in (*_FIELDS, *_LATER_FIELDS)},
        "node": node,
        "kept": metadata.is_kept(about),
    }


class Journal:
    """Journal of one store: a file with one line for each finished result, the newest line last."""

    def __init__(self, disk: Disk, others: Callable[[], Iterable[tuple[str, Row]]] = tuple) -> None:
        """Open the journal of a store; ``others`` yields key and metadata of each result without
        its own file.
        """
        self._disk, self._others, self._guard = disk, others, threading.RLock()
        self._path = f"{disk.folder}/journal.jsonl"
        self._rows: list[Row] = []
        # True if the file cannot be written, so that the rows are in memory only
        self._fileless = False
        self._forget()

    def append(self, key: str, about: Row) -> None:
        """Append the line of a result to the journal; ignore a failure, because no result
        depends on the journal.
        """
        with suppress(OSError):
            try:
                append(self._path, b"\n" + seal_record("journal", row_of(key, about)))
            except FileNotFoundError:
                with self._guard:
                    self._rebuild()

    def rows(self) -> list[Row]:
        """Return every line of the journal as a dict, which the caller must not change.

        The fields of a line are key, step, recipe, node, seconds (of the clock), bytes, device,
        peak, size, date and kept, and of a step that ran on a CPU its processor_seconds,
        processor and threads.
        """
        self._read()
        return self._rows

    def latest(self) -> list[Row]:
        """Return the newest lines of the journal: all of a short one, and some thousand of a long
        one.

        The time that this takes does not grow with the number of results.
        """
        self._read(all_lines=False)
        return self._rows

    def totals(self) -> tuple[int, int, int]:
        """Return the number of stored results, their bytes, and the number of results without a
        stored value.

        The lines are counted without a check of their seals.
        """
        newest = dict[bytes, tuple[int, bool]]()
        with suppress(OSError), open(self._path, "rb", opener=_opened) as file:
            # a later line of a key replaces an earlier one
            for key, size, mark in _TOTALS.findall(file.read()):
                newest[key] = int(size or 0), mark == b"true"
        sizes = [size for size, has_value in newest.values() if has_value]
        return len(sizes), sum(sizes), len(newest) - len(sizes)

    def is_long(self) -> bool:
        """Return True if `latest` has only a part of the lines."""
        with suppress(OSError):
            return os.stat(self._path).st_size > _LATEST
        return False

    def of_step(self, name: str) -> list[Row]:
        """Return the journal lines of the step ``name``, the newest line last."""
        return [row for row in self.rows() if row["step"] == name]

    def mark_evicted(self, keys: Collection[str]) -> None:
        """Record in the journal that the values of ``keys`` are no longer stored."""
        with self._guard:
            self._read()
            self._replace(
                [{**row, "kept": False} if row["key"] in keys else row for row in self._rows]
            )

    def compact(self) -> None:
        """Rewrite the journal with the newest line of each existing result, and mark the evicted
        values.

        Lines are copied unchanged, so that a long journal needs little memory.
        """
        with self._guard:
            newest_lines = self._newest_lines()
            position = {key: i for i, key in enumerate(newest_lines)}
            # position in the old file (-1 for results without a line), date, and the line
            lines = list[tuple[int, str, bytes]]()
            for key in metadata.names(self._disk):
                with suppress(*metadata.UNREADABLE):
                    has_value = NO_VALUE not in read_file(self._disk.path(key, "json"))
                    lines.append(
                        (position.get(key, -1), *self._line(key, newest_lines.get(key), has_value))
                    )
            for key, entry in self._others():
                line_bytes = newest_lines.get(key) or seal_record("journal", row_of(key, entry))
                lines.append((position.get(key, -1), str(entry.get("date")), line_bytes))
            lines.sort(key=lambda line: line[:2])
            self._forget()
            self._replace_lines([line_bytes for _, _, line_bytes in lines])
            if self._fileless:
                self._rows = list(_parsed(b"\n".join(line_bytes for _, _, line_bytes in lines)))
            else:
                self._forget()  # the next query reads the file

    def _newest_lines(self) -> dict[str, bytes]:
        """Return the newest undamaged line of each key, the newest last."""
        line_of_key = dict[str, bytes]()
        with suppress(OSError), open(self._path, "rb", opener=_opened) as file:
            # skip the first line, which is the head
            for line in itertools.islice(file, 1, None):
                key = line[_KEY].decode(errors="replace")
                if line.startswith(_START) and any(_parsed(line := line.rstrip(b"\n"))):
                    # removed first, so that the key moves to the end
                    line_of_key.pop(key, None)
                    line_of_key[key] = line
        return line_of_key

    def _line(self, key: str, line: bytes | None, has_value: bool) -> tuple[str, bytes]:
        """Return the date and the line of a result; ``line`` is used again if it is correct."""
        if line is not None and has_value == (NO_VALUE not in line):
            # lines with a position need no date
            return "", line
        row = (
            row_of(key, metadata.read(self._disk, key))
            if line is None
            else unseal_record("journal", line)
        )
        return str(row["date"]), seal_record("journal", {**row, "kept": has_value})

    def _forget(self) -> None:
        """Forget the lines that were read, so that the next call reads the file from its
        beginning.
        """
        self._rows = []
        # first line; bytes read so far; whether there is no file; whether all lines were read
        self._head, self._offset, self._fileless, self._whole = b"", 0, False, True

    def _read(self, all_lines: bool = True) -> None:
        """Read the new lines of the file. If only its end was read before and ``all_lines`` are
        needed, read the whole file.
        """
        with self._guard:
            if all_lines and not self._whole:
                self._forget()
            if not self._fileless:
                self._read_new_lines(all_lines)

    def _read_new_lines(self, all_lines: bool) -> None:
        """Read the lines added to the journal file since the last call; rebuild a missing or
        damaged file.

        If ``all_lines`` is False, the first call reads only the end of the file.
        """
        try:
            with open(self._path, "rb", opener=_opened) as file:
                head = file.readline(100).strip()
                # another process has rewritten the file
                if head != self._head or os.fstat(file.fileno()).st_size < self._offset:
                    self._forget()
                start = self._offset or self._first_byte(file, len(head), all_lines)
                file.seek(start)
                new_bytes = file.read()
        except FileNotFoundError:
            return self._rebuild()
        except OSError:
            return None
        if not _HEAD.fullmatch(head):
            return self._rebuild()
        self._head, self._offset = head, start + len(new_bytes)
        self._rows += _parsed(new_bytes)
        if self._whole and len(self._rows) > _SPARE:
            self._drop_old_rows()
        return None

    def _drop_old_rows(self) -> None:
        """Rewrite the journal with the newest row of each key, if more than half of the rows are
        superseded.
        """
        newest = {row["key"]: row for row in self._rows}
        if len(self._rows) > 2 * len(newest):
            self._replace(list(newest.values()))

    def _first_byte(self, file: BinaryIO, head: int, all_lines: bool) -> int:
        """Return the offset at which the first read begins: after the first line, or at the start
        of a line near the end.
        """
        size = os.fstat(file.fileno()).st_size
        if all_lines or size - head <= _LATEST:
            return head
        self._whole = False
        file.seek(size - _LATEST)
        # skip the rest of a line that began before this offset
        file.readline(_LATEST)
        return file.tell()

    def _each(self) -> Iterator[tuple[str, Row]]:
        return itertools.chain(metadata.each(self._disk), self._others())

    def _rebuild(self) -> None:
        """Rewrite the journal from the metadata of all results, in the order of their dates."""
        rows = [row_of(key, entry) for key, entry in self._each()]
        self._replace(sorted(rows, key=lambda row: str(row["date"])))

    def _replace(self, rows: list[Row]) -> None:
        """Replace the journal file by the lines ``rows``; a line that another process adds
        meanwhile may be lost.
        """
        self._forget()
        self._replace_lines([seal_record("journal", row) for row in rows])
        self._rows = rows

    def _replace_lines(self, lines: list[bytes]) -> None:
        """Rewrite the journal file from ``lines``, with a new head from which other processes see
        the change. If that fails, the rows stay in memory only.
        """
        self._head = f'{{"journal":"{os.urandom(8).hex()}","format":{FORMAT}}}'.encode()
        content = b"\n".join([self._head, *lines])
        self._offset = len(content)
        try:
            if lines:
                self._disk.replace("journal.jsonl", content)
        except OSError:
            self._fileless = True


def _parsed(raw: bytes) -> Iterator[Row]:
    """Yield the undamaged lines of the journal text ``raw`` as dicts; skip any other line."""
    for line in raw.split(b"\n"):
        if line:
            with suppress(ValueError):
                row = unseal_record("journal", line)
                if _is_row(row):
                    yield row


def _is_row(row: Row) -> bool:
    """Return True for a line with all fields, each of its type."""
    if not row.keys() >= _NAMES:
        return False
    key, node = row["key"], row["node"]
    is_valid = (
        isinstance(key, str)
        and key.isalnum()
        and (node is None or is_text(node))
        and row["kept"] is not None
    )
    values = ((row.get(name), is_right) for name, is_right in _CHECKED)
    return is_valid and all(value is None or is_right(value) for value, is_right in values)


def _opened(path: str, flags: int) -> int:
    """Open the journal, which is a regular file, without following a symbolic link; never wait for
    a pipe.

    Raises `OSError` for anything but a regular file, such as an endless device.
    """
    file = os.open(path, flags | os.O_NONBLOCK | os.O_NOFOLLOW)
    if not stat.S_ISREG(os.fstat(file).st_mode):
        os.close(file)
        raise OSError(errno.EINVAL, "not a regular file", path)
    return file
