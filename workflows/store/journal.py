"""Journal of a store: one line for every finished result, so that a query reads one file instead of all results.

No result depends on the journal. Each line is one write, and a torn line is skipped. A journal that is missing or
damaged is rebuilt from the metadata of the results.
"""

from __future__ import annotations

import itertools
import json
import os
import re
import threading
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from typing import Any

from neusee.workflows.store import metadata
from neusee.workflows.store.shared_folder import Disk, append

Row = dict[str, Any]
_FIELDS = ("step", "recipe", "seconds", "bytes", "device", "peak", "size", "date")
_TEXT, _NUMBER = str | None, int | float | None
_KINDS = {"key": str, "step": _TEXT, "node": _TEXT, "seconds": _NUMBER, "bytes": _NUMBER, "kept": bool}
_HEAD = re.compile(rb'\{"journal":"[0-9a-f]{16}"\}')
_encode = json.JSONEncoder(separators=(",", ":")).encode
_SPARE = 20_000  #: superseded lines from which the file is rewritten


def row_of(key: str, about: Row) -> Row:
    """Return the journal line for the result ``key`` with the metadata ``about``."""
    node = (about.get("origin") or {}).get("node")
    return {"key": key, **{f: about.get(f) for f in _FIELDS}, "node": node, "kept": metadata.is_kept(about)}


class Journal:
    """Journal of one store: a file with one line for each finished result, the newest line last."""

    def __init__(self, disk: Disk, others: Callable[[], Iterable[tuple[str, Row]]] = tuple) -> None:
        """Open the journal of a store; ``others`` yields key and metadata of each result without its own file."""
        self._disk, self._others, self._guard = disk, others, threading.RLock()
        self._path = f"{disk.folder}/journal.jsonl"
        self._forget()

    def append(self, key: str, about: Row) -> None:
        """Append the line of a result to the journal; ignore a failure, because no result depends on the journal."""
        with suppress(OSError):
            try:
                append(self._path, b"\n" + _encode(row_of(key, about)).encode())
            except FileNotFoundError:
                with self._guard:
                    self._rebuild()

    def rows(self) -> list[Row]:
        """Return every line of the journal as a dict, which the caller must not change.

        The fields of a line are key, step, recipe, node, seconds, bytes, device, peak, size, date and kept.
        """
        self._read()
        return self._rows

    def of_step(self, name: str) -> list[Row]:
        """Return the journal lines of the step ``name``, the newest line last."""
        return [row for row in self.rows() if row["step"] == name]

    def mark_evicted(self, keys: Collection[str]) -> None:
        """Record in the journal that the values of ``keys`` are no longer stored."""
        with self._guard:
            self._read()
            self._replace([{**row, "kept": False} if row["key"] in keys else row for row in self._rows])

    def compact(self) -> None:
        """Rewrite the journal with the newest line of each existing result, and mark the evicted values."""
        self._read()
        known = {row["key"]: (i, row) for i, row in enumerate(self._rows)}
        lines = []
        for key, about in self._each():
            at, row = known.get(key, (-1, row_of(key, about)))
            lines.append((at, {**row, "kept": metadata.is_kept(about)}))
        lines.sort(key=lambda line: (line[0], str(line[1].get("date"))))
        with self._guard:
            self._replace([row for _, row in lines])

    def _forget(self) -> None:
        self._rows: list[Row] = []
        self._head, self._offset, self._fileless = b"", 0, False

    def _read(self) -> None:
        with self._guard:
            if not self._fileless:
                self._read_new_lines()

    def _read_new_lines(self) -> None:
        """Read the lines added to the journal file since the last call; rebuild a missing or damaged file."""
        try:
            with open(self._path, "rb") as file:
                head = file.readline(100).strip()
                if head != self._head or os.fstat(file.fileno()).st_size < self._offset:
                    self._forget()
                file.seek(self._offset or len(head))
                raw = file.read()
        except FileNotFoundError:
            return self._rebuild()
        except OSError:
            return
        if not _HEAD.fullmatch(head):
            return self._rebuild()
        self._head, self._offset = head, (self._offset or len(head)) + len(raw)
        self._rows += _parsed(raw)
        if len(self._rows) > _SPARE and len(self._rows) > 2 * len({row["key"] for row in self._rows}):
            self._replace(list({row["key"]: row for row in self._rows}.values()))

    def _each(self) -> Iterator[tuple[str, Row]]:
        return itertools.chain(metadata.each(self._disk), self._others())

    def _rebuild(self) -> None:
        rows = [row_of(key, about) for key, about in self._each()]
        self._replace(sorted(rows, key=lambda row: str(row["date"])))

    def _replace(self, rows: list[Row]) -> None:
        """Replace the journal file by the lines ``rows``; a line that another process adds meanwhile may be lost."""
        self._forget()
        self._rows = rows
        self._head = f'{{"journal":"{os.urandom(8).hex()}"}}'.encode()
        raw = b"".join([self._head, *(b"\n" + _encode(row).encode() for row in rows)])
        self._offset = len(raw)
        try:
            if rows:
                self._disk.replace("journal.jsonl", raw)
        except OSError:
            self._fileless = True


def _parsed(raw: bytes) -> Iterator[Row]:
    """Yield the valid lines of the journal text ``raw``, decoded from JSON; skip damaged lines."""
    lines = [line for line in raw.split(b"\n") if line]
    try:
        rows = json.loads(b"[" + b",".join(lines) + b"]")
    except ValueError:
        rows = [_row(line) for line in lines]
    for row in rows:
        if isinstance(row, dict) and all(isinstance(row.get(name, ...), kind) for name, kind in _KINDS.items()):
            yield row


def _row(line: bytes) -> Any:
    try:
        return json.loads(line)
    except ValueError:
        return None
