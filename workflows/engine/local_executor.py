"""Executor in this process: one thread for each device, or no thread where there is one device.

``cpu:0,cpu:1`` are two lanes of one CPU, which helps where steps are too small to fill its cores.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import Any

from neusee.workflows.engine.memory_use import pool_of, there_is
from neusee.workflows.engine.step_job import Lane, Outcome, StepJob, carry_out
from neusee.workflows.engine.write_behind import WriteBehind
from neusee.workflows.keys.cache_key import Key
from neusee.workflows.store.result_store import Store

_SHARE = 0.9  #: fraction of a device's memory that a plan may use


def lanes_of(devices: Sequence[str], memory: int | None = None) -> dict[str, Lane]:
    """Return one lane for each device; lanes that use the same memory share its planned part."""
    pools = [pool_of(device) for device in devices]
    return {d: Lane(d, (memory or _SHARE * there_is(d)) / pools.count(pool_of(d))) for d in devices}


class Local:
    """An `Executor` in this process. With one device the work is done in `wait`, in the thread of the caller."""

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
        """Queue the steps of ``work``."""
        for one in work:
            if len(self.lanes) == 1:
                self._queue.append(one)
            else:
                self._running.add(self._pool(one.lane).submit(carry_out, one, self._fetch, self._store, self.later))

    def wait(self, seconds: float | None = None) -> list[Outcome]:
        """Carry out the next step, or wait until a thread ends one."""
        if self._queue:
            return [carry_out(self._queue.popleft(), self._fetch, self._store, self.later)]
        if not self._running:
            return []
        done, self._running = wait(self._running, seconds, FIRST_COMPLETED)
        return [future.result() for future in done]

    def cancel(self) -> None:
        """Drop the steps that have not begun, let running steps end, and write all results that are to be kept."""
        self._queue.clear()
        for pool in self._pools.values():
            pool.shutdown(wait=True, cancel_futures=True)
        self._pools, self._running = {}, set()
        self.later.finish()

    def _pool(self, lane: str) -> ThreadPoolExecutor:
        if lane not in self._pools:
            self._pools[lane] = ThreadPoolExecutor(1, f"neusee {lane}")
        return self._pools[lane]
