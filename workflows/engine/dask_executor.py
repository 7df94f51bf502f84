"""Executor on a dask.distributed cluster, which receives cache keys instead of tensors.

A task is a chain of steps with the keys of its inputs. The worker reads values by key from the
store, or takes values of earlier tasks from memory, and writes the last result of the chain to the
store. The worker returns only the metadata of the results. If a worker dies, its finished results
are in the store, and a second worker may write a result again without harm.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import suppress
from dataclasses import replace
from typing import Any

import torch

from neusee.workflows.engine.dask_worker import lane_here, work_here
from neusee.workflows.engine.scheduler_link import SchedulerLink
from neusee.workflows.engine.step_job import Lane, Outcome, StepJob
from neusee.workflows.graph.run_error import RunError
from neusee.workflows.keys.cache_key import Key
from neusee.workflows.keys.seal import signature
from neusee.workflows.store.result_store import Store

_SHARE = 0.4  #: fraction of the planned memory for values that the next tasks of a worker may read
_LOOK = 1.0  #: s between two queries for the connected workers
_TRIES = 3  #: number of workers that may die during one chain before the run fails


class Dask:
    """An `Executor` on a cluster: ``client`` is a `distributed.Client`, and every worker can open ``store``."""

    shares = False

    def __init__(
        self, client: Any, store: Store, threads: int = 0, warn: Callable[[str], None] = warnings.warn
    ) -> None:
        """Use ``threads`` threads on a worker, by default as many as here; ``warn`` is told at once of a lost link."""
        self.where = getattr(store, "url", None) or str(store.root.absolute())
        self.link = SchedulerLink(client, warn)
        self.threads = threads or torch.get_num_threads()  # as many as here give the same round-off as here
        self._lanes: dict[str, Lane] = {}
        self._looked = -_LOOK
        self._running: dict[Any, tuple[StepJob, ...]] = {}
        self._tries: dict[Key, int] = {}
        self._bound = set[Any]()  # futures of chains that are meant for one worker

    @property
    def client(self) -> Any:
        """Return the `distributed.Client` that is connected now."""
        return self.link.client

    @property
    def lanes(self) -> Mapping[str, Lane]:
        """Return the device and memory of each worker, by address; the workers are queried at most once a second."""
        if time.monotonic() - self._looked > _LOOK or not self._lanes:
            self._look()
        return self._lanes

    def submit(self, work: Sequence[StepJob]) -> None:
        """Send a chain of jobs to the assigned worker, or to another worker if the assigned worker is gone."""
        lane = work[0].lane
        there = {"workers": [lane], "allow_other_workers": True} if lane in self.link.newest else {}
        self._tries[work[0].key] = self._tries.get(work[0].key, 0) + 1
        future = self.client.submit(
            work_here,
            tuple(work),
            self.where,
            self.threads,
            _SHARE * min((lane.memory for lane in self._lanes.values()), default=0.0),
            signature("worker", "", b""),
            key=f"neusee-{work[0].key}-{work[-1].key}-{self._tries[work[0].key]}",
            pure=False,
            retries=_TRIES,
            **there,
        )
        self._running[future] = tuple(work)
        if there:
            self._bound.add(future)

    def wait(self, seconds: float | None = None) -> list[Outcome]:
        """Return the outcomes of jobs that have arrived since the last call.

        Raises `ClusterLost` if the scheduler or all its workers are gone, and do not come back.
        """
        end = time.monotonic() + (float("inf") if seconds is None else seconds)
        while self._running:
            left = end - time.monotonic()
            self._rest(max(0.0, min(left, _LOOK)))
            if self.link.renewed():
                self.link.workers()
                self._submit_again(self._running)
            self._free_of_lost_workers()
            ended = [future for future in self._running if future.status != "pending"]
            found = [outcome for future in ended for outcome in self._taken(future)]
            if found or left <= 0:
                return found
        return []

    def cancel(self) -> None:
        """Drop the tasks that have not begun; running tasks continue, and their results are stored."""
        for future in self._running:
            future.release()  # waits for no answer, which a lost scheduler does not give
        self._running = {}
        self._bound.clear()

    def _submit_again(self, futures: Iterable[Any]) -> None:
        """Send chains once more; a worker may have stored their results meanwhile."""
        for future in list(futures):
            chain = self._running.pop(future)
            self._bound.discard(future)
            self.submit(chain)
            future.release()

    def _free_of_lost_workers(self) -> None:
        """Send again what was meant for a worker that is gone: dask would keep it for that worker if none was left."""
        if there := self.link.newest:
            self._submit_again([f for f in self._bound if self._running[f][0].lane not in there])

    def _rest(self, seconds: float) -> None:
        """Wait until a task ends, or for a time."""
        from distributed import wait

        with suppress(TimeoutError, CancelledError), self.client.as_current():
            wait(list(self._running), seconds, return_when="FIRST_COMPLETED")

    def _taken(self, future: Any) -> list[Outcome]:
        """Return the outcomes of a chain of jobs, or one outcome with a `RunError` if the workers died."""
        chain = self._running.pop(future)
        self._bound.discard(future)
        if future.status == "finished":
            with suppress(CancelledError, OSError):  # the link was lost before the outcomes came
                outcomes: list[Outcome] = future.result()
                for outcome in outcomes:  # another worker may have computed the chain
                    outcome.work = replace(outcome.work, lane=chain[0].lane)
                return outcomes
        cause = future.exception() if future.status == "error" else None
        if cause is None and self._tries[chain[0].key] < _TRIES:  # the task was lost with its worker or its scheduler
            self.submit(chain)
            return []
        return [Outcome(chain[0], error=RunError(chain[0].step, [], OSError(_why_not(cause))))]

    def _look(self) -> None:
        """Update the list of connected workers and their devices; wait until a worker is connected."""
        there = self.link.workers()
        if there is None and self._lanes:  # a cut, which may end
            return
        there = there or self.link.wait_for_workers()
        new = [address for address in there if address not in self._lanes]
        found: dict[str, Any] = {}
        with suppress(OSError):
            found = self.client.run(lane_here, workers=new, on_error="ignore") if new else {}
        known = {**self._lanes, **{address: Lane(*about) for address, about in found.items()}}
        self._lanes = {address: known[address] for address in sorted(there) if address in known}
        self._looked = time.monotonic()


def _why_not(cause: BaseException | None) -> str:
    """Return why no worker computed a step, without the advice of dask."""
    if cause is None:
        return "the link to the cluster was lost again and again while a worker computed the step"
    if type(cause).__name__ == "KilledWorker":
        return "every worker that computed the step died: too little memory, or killed; the log of a worker says more"
    return f"no worker could carry out the step: {type(cause).__name__}: {cause}"
