"""Journal of a store: one line for every finished result, so that a query need not read all results.

The journal is advice. Each line is one write, and a torn line is skipped. A journal that is
missing or damaged is rebuilt from the metadata of the results.
"""

from __future__ import annotations

import itertools
import json
import os
import re
import threading
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from typing import Any

from neusee.workflows.store import metadata
from neusee.workflows.store.shared_folder import Disk

Row = dict[str, Any]
_FIELDS = ("step", "recipe", "seconds", "bytes", "device", "peak", "date")
_TEXT, _NUMBER = str | None, int | float | None
_KINDS = {"key": str, "step": _TEXT, "node": _TEXT, "seconds": _NUMBER, "bytes": _NUMBER, "kept": bool}
_HEAD = re.compile(rb'\{"journal":"[0-9a-f]{16}"\}')
_encode = json.JSONEncoder(separators=(",", ":")).encode
_SPARE = 20_000  #: superseded lines from which the file is rewritten


def row_of(key: str, about: Row) -> Row:
    """Return the journal's line of a result."""
    node = (about.get("origin") or {}).get("node")
    return {"key": key, **{f: about.get(f) for f in _FIELDS}, "node": node, "kept": metadata.is_kept(about)}


class Journal:
    """The lines of one store, the newest last."""

    def __init__(self, disk: Disk, others: Callable[[], Iterable[tuple[str, Row]]] = tuple) -> None:
        """Open the journal of ``disk``; ``others`` yields the results that have no files of their own."""
        self._disk, self._others, self._guard = disk, others, threading.RLock()
        self._path = f"{disk.folder}/journal.jsonl"
        self._forget()

    def append(self, key: str, about: Row) -> None:
        """Append a line; a line that cannot be written is lost, which costs time and no result."""
        with suppress(OSError):
            try:
                self._write(b"\n" + _encode(row_of(key, about)).encode())
            except FileNotFoundError:
                with self._guard:
                    self._rebuild()

    def rows(self) -> list[Row]:
        """Return every line: key, step, recipe, node, seconds, bytes, device, peak, date, kept. Do not change them."""
        self._read()
        return self._rows

    def of_step(self, name: str) -> list[Row]:
        """Return the lines of a step, the newest last."""
        self._read()
        return self._by_step.get(name, [])

    def of_node(self, path: str) -> list[Row]:
        """Return the lines of a node, the newest last."""
        self._read()
        return self._by_node.get(path, [])

    def mark_evicted(self, keys: Collection[str]) -> None:
        """Mark the values of these keys as no longer kept."""
        with self._guard:
            self._read()
            self._replace([{**row, "kept": False} if row["key"] in keys else row for row in self._rows])

    def compact(self) -> None:
        """Rewrite the journal with the newest line of each result that exists, and with whether its value is kept."""
        self._read()
        known = {row["key"]: (i, row) for i, row in enumerate(self._rows)}
        found = []
        for key, about in self._each():
            at, row = known.get(key, (-1, row_of(key, about)))
            found.append((at, {**row, "kept": metadata.is_kept(about)}))
        found.sort(key=lambda item: (item[0], str(item[1].get("date"))))
        with self._guard:
            self._replace([row for _, row in found])

    def _write(self, line: bytes) -> None:
        file = os.open(self._path, os.O_WRONLY | os.O_APPEND)
        try:
            os.write(file, line)
        finally:
            os.close(file)

    def _forget(self) -> None:
        self._rows: list[Row] = []
        self._by_step: dict[str, list[Row]] = defaultdict(list)
        self._by_node: dict[str, list[Row]] = defaultdict(list)
        self._head, self._offset, self._fileless = b"", 0, False

    def _read(self) -> None:
        with self._guard:
            self._take_in()

    def _take_in(self) -> None:
        """Read the lines added since the last call; skip the file where none can be written."""
        if self._fileless:
            return None
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
            return None
        if not _HEAD.fullmatch(head):
            return self._rebuild()
        self._head, self._offset = head, (self._offset or len(head)) + len(raw)
        for row in _parsed(raw):
            self._take(row)
        if len(self._rows) > _SPARE and len(self._rows) > 2 * len({row["key"] for row in self._rows}):
            self._replace(list({row["key"]: row for row in self._rows}.values()))
        return None

    def _take(self, row: Row) -> None:
        self._rows.append(row)
        self._by_step[row["step"]].append(row)
        self._by_node[row["node"]].append(row)

    def _each(self) -> Iterator[tuple[str, Row]]:
        return itertools.chain(metadata.each(self._disk), self._others())

    def _rebuild(self) -> None:
        rows = [row_of(key, about) for key, about in self._each()]
        self._replace(sorted(rows, key=lambda row: str(row["date"])))

    def _replace(self, rows: list[Row]) -> None:
        """Replace the file by one with these rows; a line that another process adds meanwhile may be lost."""
        self._forget()
        for row in rows:
            self._take(row)
        self._head = f'{{"journal":"{os.urandom(8).hex()}"}}'.encode()
        raw = b"".join([self._head, *(b"\n" + _encode(row).encode() for row in rows)])
        self._offset = len(raw)
        try:
            if rows:
                with self._disk.temporary("journal") as (part, file):
                    file.write(raw)
                    file.flush()
                    self._disk.share(part)
                    os.replace(part, self._path)
        except OSError:
            self._fileless = True


def _parsed(raw: bytes) -> Iterator[Row]:
    """Yield the rows in the lines of ``raw``: parse all at once, or one by one where some lines are damaged."""
    lines = [line for line in raw.split(b"\n") if line]
    try:
        found = json.loads(b"[" + b",".join(lines) + b"]")
    except ValueError:
        found = [_row(line) for line in lines]
    for row in found:
        if isinstance(row, dict) and all(isinstance(row.get(name, ...), kind) for name, kind in _KINDS.items()):
            yield row


def _row(line: bytes) -> Any:
    try:
        return json.loads(line)
    except ValueError:
        return None
