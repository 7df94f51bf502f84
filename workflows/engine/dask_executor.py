"""Executor on a dask.distributed cluster, which receives cache keys instead of tensors.

A task is a chain of steps with the keys of its inputs. The worker reads values by key from the
store, or takes values of earlier tasks from memory, and writes the last result of the chain to the
store. The worker returns only the metadata of the results. If a worker dies, its finished results
are in the store, and a second worker may write a result again without harm.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from typing import Any, get_args, get_origin

import torch

from neusee.nodes.own_modules import own_modules
from neusee.workflows.engine.memory_use import there_is
from neusee.workflows.engine.step_job import InputMissing, Lane, Outcome, StepJob, carry_out
from neusee.workflows.graph.run_error import RunError
from neusee.workflows.keys.cache_key import Key, code_of, is_private
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.seal import Unsigned, check_signature, secrets, signature
from neusee.workflows.keys.tainted_code import taint_code, taints_of
from neusee.workflows.keys.user_code import own_code
from neusee.workflows.observation.own_call import tainted_modules
from neusee.workflows.recipe.node_families import all_nodes
from neusee.workflows.store.remote_store import open_store
from neusee.workflows.store.result_store import Store
from neusee.workflows.store.serialization import tensors_in

_SHARE = 0.4  #: fraction of the planned memory for values that the next tasks of a worker may read
_PLANNED = 0.6  #: fraction of the memory of a worker that a schedule may use
_LOOK = 1.0  #: s between two queries for the connected workers
_TRIES = 3  #: number of workers that may die during one chain before the run fails


class Dask:
    """An `Executor` on a cluster: ``client`` is a `distributed.Client`, and every worker can open ``store``."""

    shares = False

    def __init__(self, client: Any, store: Store) -> None:
        self.client, self.where = client, getattr(store, "url", None) or str(store.root.absolute())
        self.threads = torch.get_num_threads()  # the same thread count gives the same round-off as in this process
        self._lanes: dict[str, Lane] = {}
        self._looked = -_LOOK
        self._running: dict[Any, tuple[StepJob, ...]] = {}
        self._tries: dict[Key, int] = {}

    @property
    def lanes(self) -> Mapping[str, Lane]:
        """Return the device and memory of each worker, by address; the workers are queried at most once a second."""
        if time.monotonic() - self._looked > _LOOK or not self._lanes:
            self._look()
        return self._lanes

    def submit(self, work: Sequence[StepJob]) -> None:
        """Send a chain of jobs to the assigned worker, or to another worker if the assigned worker is gone."""
        self._tries[work[0].key] = self._tries.get(work[0].key, 0) + 1
        future = self.client.submit(
            work_here,
            tuple(work),
            self.where,
            self.threads,
            _SHARE * min((lane.memory for lane in self._lanes.values()), default=0.0),
            signature("worker", "", b""),
            key=f"neusee-{work[0].key}-{work[-1].key}-{self._tries[work[0].key]}",
            workers=[work[0].lane] if work[0].lane in self._lanes else None,
            allow_other_workers=True,
            pure=False,
            retries=_TRIES,
        )
        self._running[future] = tuple(work)

    def wait(self, seconds: float | None = None) -> list[Outcome]:
        """Return the outcomes of jobs that have arrived since the last call."""
        from distributed import wait

        if not self._running:
            return []
        try:
            with self.client.as_current():
                done = wait(list(self._running), seconds, return_when="FIRST_COMPLETED").done
        except TimeoutError:
            return []
        return [outcome for future in done for outcome in self._taken(future)]

    def cancel(self) -> None:
        """Cancel the tasks that have not begun; running tasks continue, and their results are stored."""
        if self._running:
            self.client.cancel(list(self._running))
            self._running = {}

    def _taken(self, future: Any) -> list[Outcome]:
        """Return the outcomes of a chain of jobs, or one outcome with a `RunError` if the workers died."""
        chain = self._running.pop(future)
        if future.status == "finished":
            outcomes: list[Outcome] = future.result()
            for outcome in outcomes:  # another worker may have computed the chain
                outcome.work = replace(outcome.work, lane=chain[0].lane)
            return outcomes
        cause = future.exception() if future.status == "error" else None
        if cause is None and self._tries[chain[0].key] < _TRIES:  # the task was lost with its worker or its scheduler
            self.submit(chain)
            return []
        text = f"no worker could carry out the step ({cause or future.status})"
        return [Outcome(chain[0], error=RunError(chain[0].step, [], OSError(text)))]

    def _look(self) -> None:
        """Update the list of connected workers and their devices; wait until a worker is connected."""
        if not self.client.nthreads():
            self.client.wait_for_workers(1, timeout=60)
        there = self.client.nthreads()
        new = [address for address in there if address not in self._lanes]
        found = self.client.run(lane_here, workers=new) if new else {}
        known = {**self._lanes, **{address: Lane(*about) for address, about in found.items()}}
        self._lanes = {address: known[address] for address in sorted(there) if address in known}
        self._looked = time.monotonic()


# --- on a worker ----------------------------------------------------------------------------------------------------


class _Here:
    """State of one worker between tasks: the store, digests of code, and the most recently used values."""

    def __init__(self, where: str, room: float) -> None:
        self.store = open_store(where)
        self.code, self.own = Code(self.store.code_memo), own_modules()
        self.values: OrderedDict[Key, Any] = OrderedDict()
        self.room, self.held = room, 0

    def look_again(self) -> None:
        """Compute digests of code anew if a job has brought modules of a user, which may change what others compute."""
        if self.own != own_modules():
            self.code, self.own = Code(self.store.code_memo), own_modules()

    def fetch(self, key: Key, kinds: Mapping[Key, Any]) -> Any:
        """Return the value of a key; ``kinds`` are the annotated types of the inputs of a step, by their keys."""
        if key not in self.values:
            try:
                self.keep(key, self.store.get(key, kinds.get(key, Any)))
            except KeyError:
                raise InputMissing(key) from None
        self.values.move_to_end(key)
        return self.values[key]

    def keep(self, key: Key, value: Any) -> None:
        self.held += _size(value) - _size(self.values.get(key))
        self.values[key] = value
        self.values.move_to_end(key)
        while self.held > self.room and len(self.values) > 1:
            self.held -= _size(self.values.popitem(last=False)[1])


_here: dict[str, _Here] = {}


def lane_here(dask_worker: Any) -> tuple[str, float]:
    """Return the device of a worker, and the memory (bytes) that a schedule may use on this device."""
    if torch.cuda.is_available():
        return "cuda:0", _PLANNED * there_is("cuda:0")
    allowed = getattr(dask_worker.memory_manager, "memory_limit", None)
    return "cpu", _PLANNED * min(there_is("cpu"), allowed or float("inf"))


def work_here(chain: tuple[StepJob, ...], where: str, threads: int, room: float, signed: str = "") -> list[Outcome]:
    """Compute a chain of jobs on a worker; return outcomes without values, and cache up to ``room`` bytes of values.

    ``signed`` is a signature by the secret of the caller, which this worker needs too.
    """
    if not _same_secret(signed):
        text = "NEUSEE_CACHE_SECRET of a worker is not that of this process: set the same secret there"
        return [Outcome(chain[0], error=RunError(chain[0].step, [], OSError(text)))]
    if torch.get_num_threads() != threads:
        torch.set_num_threads(threads)
    here = _here.get(where) or _here.setdefault(where, _Here(where, room))
    here.look_again()
    outcomes: list[Outcome] = []
    refetch = chain[0].refetch_seconds
    for work in chain:
        outcome = _one_here(replace(work, refetch_seconds=refetch), here)
        outcomes.append(outcome)
        if outcome.held or outcome.error or outcome.lost:
            break
        refetch = 0.0 if outcome.kept else outcome.seconds + refetch
    return [_light(outcome) for outcome in outcomes]


def _same_secret(signed: str) -> bool:
    try:
        check_signature(signed, "worker", "", b"")
    except Unsigned:
        return False
    return bool(secrets()) == bool(signed)


def _one_here(work: StepJob, here: _Here) -> Outcome:
    if is_private(work.key):
        text = "the loaded code is not that of its file, so no other process can use the result: restart Python"
        return Outcome(work, error=RunError(work.step, [], OSError(text)))
    if code_of(work.step, here.code) != work.origin["code"]:
        text = (
            f"the code of {work.step.node.path} differs on a worker: install the same version and packages there, and "
            "set the same time zone and settings of NumPy and torch"
        )
        return Outcome(work, error=RunError(work.step, [], OSError(text)))
    work = replace(work, own=own_code(work.step, here.code))
    if work.own and (known := taints_of(work.own.modules)):  # of an earlier job, whose memo may still hold it
        return Outcome(work, taints=known)
    outcome = carry_out(work, partial(here.fetch, kinds=kinds_of(work)), here.store)
    if work.own and outcome.taints:
        taint_code(tainted_modules(work.own, outcome.taints), outcome.taints)
        outcome.value = None
    if outcome.value is not None:
        here.keep(work.key, outcome.value)
    return outcome


def kinds_of(work: StepJob) -> dict[Key, Any]:
    """Return the annotated type of each input of a job, by the key of the input.

    Where a type is not annotated, the value may be a named tuple of any node, so all families of nodes are imported.
    """
    node, kinds = work.step.node, dict[Key, Any]()
    for name, read in zip(node.inputs, work.reads, strict=True):
        kind = node.hints.get(name, Any)
        if isinstance(read, tuple):
            lists = [each for each in (kind, *get_args(kind)) if get_origin(each) is list]
            kind = get_args(lists[0])[0] if lists else Any
        if kind is Any:
            list(all_nodes())
        kinds |= dict.fromkeys(read if isinstance(read, tuple) else [read] if read else [], kind)
    return kinds


def _light(outcome: Outcome) -> Outcome:
    """Return an outcome that pickle can send: without the value, and with any error as a `RunError`."""
    outcome.value = None
    if outcome.error is not None and not isinstance(outcome.error, RunError):
        outcome.error = RunError(outcome.work.step, [], outcome.error)
    return outcome


def _size(value: Any) -> int:
    return 0 if value is None else sum(t.nbytes for t in tensors_in(value))


# --- from the command line ------------------------------------------------------------------------------------------


@contextmanager
def cluster(where: str, store: Store) -> Iterator[Dask]:
    """Yield an executor for ``dask:4`` (four local workers), ``dask:here`` (this process) or a scheduler address."""
    from distributed import Client, LocalCluster

    kind, _, count = where.partition(":")
    address: Any = where
    with ExitStack() as open_now:
        if kind == "dask":
            here = count == "here"
            workers = 1 if here or not count else int(count)
            local = LocalCluster(
                n_workers=workers, threads_per_worker=1, processes=not here, dashboard_address=None, silence_logs=40
            )
            address = open_now.enter_context(local)
        yield Dask(open_now.enter_context(Client(address, set_as_default=False)), store)
