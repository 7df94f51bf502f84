"""Work in this process: one thread a device, or none at all where there is one device.

``cpu:0,cpu:1`` are two lanes of one CPU: worth it where steps are too small to fill its cores.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import Any

import torch

from neusee.workflows.engine.memory_use import pool_of, there_is
from neusee.workflows.engine.step_job import Lane, Outcome, StepJob, carry_out
from neusee.workflows.engine.write_behind import WriteBehind
from neusee.workflows.keys.cache_key import Key
from neusee.workflows.store.result_store import Store

_SHARE = 0.9  #: of the memory of a device that may be planned with


def lanes_of(devices: Sequence[str], memory: int | None = None) -> dict[str, Lane]:
    """One lane a device; lanes that use one memory share what may be planned with."""
    pools = [pool_of(device) for device in devices]
    return {d: Lane(d, (memory or _SHARE * there_is(d)) / pools.count(pool_of(d))) for d in devices}


class Local:
    """An `Executor` of this process. With one device it works in `wait`, in the caller's own thread."""

    shares = True

    def __init__(
        self, devices: Sequence[str], store: Store, fetch: Callable[[Key], Any], memory: int | None = None
    ) -> None:
        self.lanes = lanes_of(devices, memory)
        self._store, self._fetch = store, fetch
        self._queue: deque[StepJob] = deque()
        self.later = WriteBehind()
        self._pools: dict[str, ThreadPoolExecutor] = {}
        self._running: set[Future[Outcome]] = set()

    def submit(self, work: Sequence[StepJob]) -> None:
        """Queue one step."""
        for one in work:
            if len(self.lanes) == 1:
                self._queue.append(one)
            else:
                self._running.add(self._pool(one.lane).submit(carry_out, one, self._fetch, self._store, self.later))

    def wait(self, seconds: float | None = None) -> list[Outcome]:
        """Carry out the next step, or wait for a thread to end one."""
        if self._queue:
            return [carry_out(self._queue.popleft(), self._fetch, self._store, self.later)]
        if not self._running:
            return []
        done, self._running = wait(self._running, seconds, FIRST_COMPLETED)
        return [future.result() for future in done]

    def cancel(self) -> None:
        """Forget what has not begun, let what has come to its end, and write all that is to be kept."""
        self._queue.clear()
        for pool in self._pools.values():
            pool.shutdown(wait=True, cancel_futures=True)
        self._pools, self._running = {}, set()
        self.later.finish()

    def _pool(self, lane: str) -> ThreadPoolExecutor:
        if lane not in self._pools:
            self._pools[lane] = ThreadPoolExecutor(1, f"neusee {lane}")
        return self._pools[lane]


@contextmanager
def one_thread() -> Iterator[None]:
    """Compute with one thread of torch inside the block: small work ends before other threads are awake."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
