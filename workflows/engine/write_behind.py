"""Write large results while the next steps compute.

A run does not end before all is written. What waits stays in memory and keeps its lease, so that
another process which wants the same result finds either the one or the other.
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

LARGE = 1 << 20  #: bytes from which a result is written beside the next step
_ROOM = 1 << 29  #: bytes that may wait; one larger result waits alone
_NICE = 10


class WriteBehind:
    """Writes under way, one at a time."""

    def __init__(self) -> None:
        self._pool: ThreadPoolExecutor | None = None
        self._sizes: dict[Key, int] = {}
        self._writes: dict[Key, Future[Any]] = {}
        self._guard = threading.Lock()

    def __contains__(self, key: Key) -> bool:
        """Whether a result still waits to be written."""
        return key in self._sizes

    def add(self, key: Key, size: int, write: Callable[[], Any]) -> None:
        """Write when there is time; waits for earlier ones where ``size`` bytes more would be too many."""
        while self._sizes and sum(list(self._sizes.values())) + size > _ROOM:
            wait([self._writes[key] for key in list(self._sizes) if key in self._writes], return_when=FIRST_COMPLETED)
        with self._guard:
            self._pool = self._pool or ThreadPoolExecutor(1, "neusee store", _yielding)
            self._sizes[key] = size
            self._writes[key] = self._pool.submit(self._write, key, write)

    def finish(self) -> None:
        """Wait for all of them; an error of one is raised here."""
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


def _yielding() -> None:
    """Let whoever computes go first: its threads wait for each other, so that one without a core delays them all."""
    if sys.platform == "linux":  # elsewhere it would be the whole process; threads that this one starts are as nice
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
