"""Executor in this process: one thread for each device, with the names of the devices."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import Any

import torch

from neusee.workflows.engine.cost_model import libraries_of
from neusee.workflows.engine.machine_resources import free_memory, pool_of, process_memory, there_is
from neusee.workflows.engine.step_job import Lane, Outcome, StepJob, WriteBehind, carry_out
from neusee.workflows.keys.cache_key import Key
from neusee.workflows.store.result_store import Store

# --- device names ---------------------------------------------------------------------------------

# Names of the devices of this machine for a run, such as ``cpu`` or ``cuda:0,cuda:1``.


def check_devices(text: str) -> None:
    """Raise ValueError for a list with the same device twice, or with a device that cannot compute
    here.

    ``cpu:0,cpu:1`` are two lanes of one CPU, and so two devices.
    """
    names = dict[tuple[str, int], str]()
    for name in text.split(","):
        try:
            torch_device = torch.empty(0, device=name).device
        except (RuntimeError, AssertionError) as error:
            raise ValueError(f"{name}: {_reason(str(error))}") from error
        if torch_device.type == "meta":
            raise ValueError(f"{name}: a tensor there has a shape and no values: write cpu or cuda")
        # "cuda" means the device on which torch allocates by default
        kind_and_index = torch_device.type, torch.device(name).index or torch_device.index or 0
        if kind_and_index in names:
            devices = (
                name
                if name == names[kind_and_index]
                else f"{names[kind_and_index]} and {name} are one device"
            )
            raise ValueError(
                f"{text}: names a device twice ({devices}): name each device once; cpu:0,cpu:1 are"
                " two lanes"
            )
        names[kind_and_index] = name


def _reason(text: str) -> str:
    """Return why a device cannot compute here: the error message of torch, or a sentence if the
    message names internal operators.
    """
    if "aten::" in text:
        return (
            "this build of PyTorch cannot compute there: write cpu, or cuda on a machine with a GPU"
            " of NVIDIA"
        )
    return text.partition("\n")[0]


# --- local executor -------------------------------------------------------------------------------

# Executor in this process: one thread for each device, or the thread of the caller if there is only
# one device.
#
# ``cpu:0,cpu:1`` are two lanes of one CPU, so that two small steps run at the same time.


_SHARE = 0.9  #: fraction of a device's memory that a schedule may use


def lanes_of(
    devices: Sequence[str], memory: int | None = None, nodes: Iterable[str] = ()
) -> dict[str, Lane]:
    """Return one `Lane` for each device; devices with a common memory divide the bytes that a
    schedule may use.

    Args:
        memory: the limit of the memory of each GPU, and for the CPU of the memory of this process
            with what the program itself holds; if None, most of a GPU, or most of the memory that
            is free now
        nodes: the paths of the nodes that will run, whose libraries the program holds as well
    """
    pools = [pool_of(device) for device in devices]
    lanes = {}
    for device in devices:
        # libraries and data of the program use no memory of a GPU
        program_bytes = program_memory(nodes) if pool_of(device) == "cpu" else 0
        limit = (
            memory_limit(memory)
            if pool_of(device) == "cpu"
            else memory or _SHARE * there_is(device)
        )
        lanes[device] = Lane(
            device, (limit - program_bytes) / pools.count(pool_of(device)), program_bytes
        )
    return lanes


def memory_limit(memory: int | None, workers: int = 1) -> float:
    """Return the memory limit of this process in bytes: ``memory``, or by default its present
    memory plus most of the free memory.

    If there are several ``workers``, they divide the free memory.
    """
    return memory or process_memory() + _SHARE * free_memory() / workers


def program_memory(nodes: Iterable[str] = ()) -> float:
    """Return the memory of this process in bytes before the first step, including the libraries
    that ``nodes`` load.
    """
    return process_memory() + libraries_of(nodes)


class Local:
    """An `Executor` in this process; with one device, `wait` computes the steps in the thread of
    the caller.
    """

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
        self._queue: deque[StepJob] = deque()  # jobs of a single device, computed in `wait`
        self.later = WriteBehind()
        self._pools: dict[str, ThreadPoolExecutor] = {}  # one thread for each of several devices
        self._running: set[Future[Outcome]] = set()  # jobs in these threads

    def submit(self, work: Sequence[StepJob]) -> None:
        """Add the jobs to the queue, or start the jobs in the threads of their devices."""
        for job in work:
            if len(self.lanes) == 1:
                self._queue.append(job)
            else:
                self._running.add(
                    self._pool(job.lane).submit(
                        carry_out, job, self._fetch, self._store, self.later
                    )
                )

    def wait(self, seconds: float | None = None) -> list[Outcome]:
        """Compute the next job in the queue and return its outcome, or wait for jobs in other
        threads.
        """
        if self._queue:
            return [carry_out(self._queue.popleft(), self._fetch, self._store, self.later)]
        if not self._running:
            return []
        ended, self._running = wait(self._running, seconds, FIRST_COMPLETED)
        return [future.result() for future in ended]

    def cancel(self) -> None:
        """Drop the jobs that have not begun, wait for the running jobs, and finish the writes of
        results.
        """
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
    threads_before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads_before)
