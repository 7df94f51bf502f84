"""Executor in this process: one thread for each device, or the thread of the caller if there is only one device.

``cpu:0,cpu:1`` are two lanes of one CPU, so that two small steps run at the same time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import Any

import torch

from neusee.workflows.engine.cost_laws import libraries_of
from neusee.workflows.engine.memory_use import free_memory, pool_of, process_memory, there_is
from neusee.workflows.engine.step_job import Lane, Outcome, StepJob, carry_out
from neusee.workflows.engine.write_behind import WriteBehind
from neusee.workflows.keys.cache_key import Key
from neusee.workflows.store.result_store import Store

_SHARE = 0.9  #: fraction of a device's memory that a schedule may use


def lanes_of(devices: Sequence[str], memory: int | None = None, nodes: Iterable[str] = ()) -> dict[str, Lane]:
    """Return one `Lane` for each device; devices with a common memory divide the bytes that a schedule may use.

    Args: memory: the limit of the memory of each GPU, and for the CPU of the memory of this process with what the
    program itself holds; if None, most of a GPU, or most of the memory that is free now. nodes: the paths of the nodes
    that will run, whose libraries the program holds as well.
    """
    pools = [pool_of(device) for device in devices]
    found = {}
    for device in devices:
        held = program_memory(nodes) if pool_of(device) == "cpu" else 0
        limit = memory_limit(memory) if pool_of(device) == "cpu" else memory or _SHARE * there_is(device)
        found[device] = Lane(device, (limit - held) / pools.count(pool_of(device)), held)
    return found


def memory_limit(memory: int | None, workers: int = 1) -> float:
    """Return the largest memory of this process in bytes: ``memory``, or most of what is free beside the process.

    Several processes, ``workers``, divide what is free.
    """
    return memory or process_memory() + _SHARE * free_memory() / workers


def program_memory(nodes: Iterable[str] = ()) -> float:
    """Return the memory of this process in bytes before the first step, with the libraries that ``nodes`` load."""
    return process_memory() + libraries_of(nodes)


class Local:
    """An `Executor` in this process; with one device, `wait` computes the steps in the thread of the caller."""

    shares = True

    def __init__(
        self,
        devices: Sequence[str],
        store: Store,
        fetch: Callable[[Key], Any],
        memory: int | None = None,
        nodes: Iterable[str] = (),
    ) -> None:
        self.lanes = lanes_of(devices, memory, nodes)
        self._store, self._fetch = store, fetch
        self._queue: deque[StepJob] = deque()
        self.later = WriteBehind()
        self._pools: dict[str, ThreadPoolExecutor] = {}
        self._running: set[Future[Outcome]] = set()

    def submit(self, work: Sequence[StepJob]) -> None:
        """Add the jobs to the queue, or start the jobs in the threads of their devices."""
        for job in work:
            if len(self.lanes) == 1:
                self._queue.append(job)
            else:
                self._running.add(self._pool(job.lane).submit(carry_out, job, self._fetch, self._store, self.later))

    def wait(self, seconds: float | None = None) -> list[Outcome]:
        """Compute the next job in the queue and return its outcome, or wait for jobs in other threads."""
        if self._queue:
            return [carry_out(self._queue.popleft(), self._fetch, self._store, self.later)]
        if not self._running:
            return []
        done, self._running = wait(self._running, seconds, FIRST_COMPLETED)
        return [future.result() for future in done]

    def cancel(self) -> None:
        """Drop the jobs that have not begun, wait for the running jobs, and finish the writes of results."""
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
    """Run a block of code with a single PyTorch thread, which is faster for small tensors."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
