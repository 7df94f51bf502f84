"""Writes of large results in the background, while the next steps compute.

A run ends after all writes. A result that waits stays in memory and keeps its lease, so that another
process that needs the same result finds either the lease or the result.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import suppress
from typing import Any

from neusee.workflows.keys.cache_key import Key

LARGE = 1 << 20  #: bytes; a larger result is written during the next step
_ROOM = 1 << 29  #: bytes that may wait; a larger result waits alone
_NICE = 10  #: how much nicer the writing thread is; 19 is the nicest


class WriteBehind:
    """Pending writes of results, one at a time in the background."""

    def __init__(self) -> None:
        self._pool: ThreadPoolExecutor | None = None
        self._sizes: dict[Key, int] = {}
        self._writes: dict[Key, Future[Any]] = {}
        self._guard = threading.Lock()

    def __contains__(self, key: Key) -> bool:
        return key in self._sizes

    def add(self, key: Key, size: int, write: Callable[[], Any]) -> None:
        """Start a write in the background; wait for earlier writes if too many bytes would be pending."""
        while self._sizes and sum(list(self._sizes.values())) + size > _ROOM:
            wait([self._writes[key] for key in list(self._sizes) if key in self._writes], return_when=FIRST_COMPLETED)
        with self._guard:
            self._pool = self._pool or ThreadPoolExecutor(1, "neusee store", _lower_priority)
            self._sizes[key] = size
            self._writes[key] = self._pool.submit(self._write, key, write)

    def finish(self) -> None:
        """Wait for all writes; raise the error of a failed write."""
        with self._guard:
            pool, self._pool = self._pool, None
            writes, self._writes = self._writes, {}
        if pool is not None:
            pool.shutdown(wait=True)
        for future in writes.values():
            future.result()

    def _write(self, key: Key, write: Callable[[], Any]) -> None:
        try:
            write()
        finally:
            del self._sizes[key]


def _lower_priority() -> None:
    """Lower the priority of the writing thread, so that the computing threads run first."""
    if sys.platform == "linux":  # on other systems the call would affect the whole process
        with suppress(OSError):
            thread = threading.get_native_id()
            os.setpriority(os.PRIO_PROCESS, thread, min(os.getpriority(os.PRIO_PROCESS, thread) + _NICE, 19))
