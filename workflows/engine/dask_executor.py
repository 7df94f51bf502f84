"""Executor on a dask.distributed cluster, with its link to the scheduler and its workers."""

from __future__ import annotations

import logging
import random
import sys
import time
import warnings
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from importlib.util import find_spec, module_from_spec
from itertools import chain
from types import ModuleType
from typing import Any, get_args, get_origin

import torch

from neusee.nodes.own_modules import own_modules
from neusee.workflows.engine.machine_resources import FRESH_SECONDS, there_is
from neusee.workflows.engine.step_job import (
    InputMissing,
    Lane,
    Outcome,
    StepJob,
    carry_out,
    keys_in,
)
from neusee.workflows.graph.errors import RunError
from neusee.workflows.keys.cache_key import Key, code_of, is_private
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.module_digest import imported
from neusee.workflows.keys.sealed_files import Unsigned, check_signature, secrets, signature
from neusee.workflows.keys.user_code import own_code, taint_code, taints_of
from neusee.workflows.observation.observed_call import tainted_modules
from neusee.workflows.recipe.node_families import all_nodes
from neusee.workflows.store.remote_store import open_store
from neusee.workflows.store.result_store import Store
from neusee.workflows.store.serialization import tensors_in

# --- scheduler link -------------------------------------------------------------------------------

# The link to a dask scheduler: whether it answers, which workers it has, and when the run gives up.
#
# A link that is cut for less than `PATIENCE` recovers by itself: the client connects again, and
# asks again for missing outcomes. After that time the run ends with one sentence, and finished
# results stay in the cache.


PATIENCE = 60.0  #: time (s) without a scheduler, or without any worker, after which a run gives up
_ANSWER = 10.0  #: time limit (s) for an answer of the scheduler
_ATTEMPT = 5.0  #: time limit (s) of one attempt to connect again
_BETWEEN = 5.0  #: interval (s) between two queries while steps are computed
_LOGGERS = ("distributed", "tornado", "tornado.application", "asyncio")


class ClusterLost(OSError):
    """Error of a run whose scheduler or workers are gone; the finished steps stay in the cache."""


class SchedulerLink:
    """The connection to a scheduler through a `distributed.Client`; a lost connection is replaced
    by a new one.
    """

    def __init__(self, client: Any, warn: Callable[[str], None]) -> None:
        self.client, self._warn = client, warn
        self.address = str(client.scheduler.address)
        self._asked = self._workers_seen = time.monotonic()
        #: threads of each worker, from the last answer of the scheduler
        self.newest: Mapping[str, int] = {}
        self._lost: list[Any] = []  # earlier clients, to which futures of lost tasks still refer

    def renewed(self) -> bool:
        """Return True if the connection was lost and replaced by a new one, so that all tasks are
        lost.

        Raises `ClusterLost` if the scheduler does not return, or had no worker for too long.
        """
        client = self.client
        if (
            client.status != "running"
            or client.scheduler_comm is None
            or client.scheduler_comm.closed()
        ):
            self._connect_again()
            return True
        if time.monotonic() - self._asked > _BETWEEN:
            self.workers()
        return False

    def workers(self) -> Mapping[str, int] | None:
        """Return the number of threads by address of the connected workers, or None if the
        scheduler does not answer.

        Raises `ClusterLost` if there was no worker for too long.
        """
        threads: Mapping[str, int] | None = None
        with suppress(OSError, AttributeError):  # the latter while the client closes
            threads = self.client.sync(
                self.client.scheduler.ncores, workers=None, callback_timeout=_ANSWER
            )
        self._asked = present_time = time.monotonic()
        self.newest = threads or {}
        if threads or threads is None:
            self._workers_seen = present_time
        elif present_time - self._workers_seen > PATIENCE:
            raise ClusterLost(
                f"the scheduler {self.address} has had no worker for {PATIENCE:.0f} s"
            )
        return threads

    def wait_for_workers(self) -> Mapping[str, int]:
        """Return the connected workers as soon as there is one."""
        while not (workers := self.workers()):
            self.renewed()
            time.sleep(10 * FRESH_SECONDS)
        return workers

    def close(self) -> None:
        """Close the connection, and all earlier ones."""
        for client in (self.client, *self._lost):
            with suppress(Exception):
                client.close(timeout=_ANSWER)

    def _connect_again(self) -> None:
        """Connect to the scheduler with a new client, because a client that waits for a lost packet
        does not notice the return of the link.
        """
        self._warn(
            f"the scheduler {self.address} does not answer: waiting up to {PATIENCE:.0f} s for it"
            " to return"
        )
        # kept, because futures of lost tasks still refer to it
        self._lost.append(self.client)
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            with suppress(ClusterLost):
                self.client = connected(self.address, _ATTEMPT)
                self._workers_seen = time.monotonic()
                return
            time.sleep(10 * FRESH_SECONDS)
        raise ClusterLost(f"the scheduler {self.address} has ended, or the network to it is cut")


def connected(address: Any, seconds: float = PATIENCE) -> Any:
    """Return a `distributed.Client` of a scheduler; raise `ClusterLost` if none answers there."""
    from distributed import Client

    try:
        return Client(address, timeout=seconds, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ClusterLost(
            f"no scheduler of dask answers at {address} within {seconds:.0f} s"
        ) from error


def silence_logs() -> None:
    """Suppress the log messages of dask and its network libraries in this process; neusee reports
    to the user in its own sentences.
    """
    import distributed  # noqa: F401  makes its loggers, each with a handler of its own

    dask_loggers = [
        name for name in logging.root.manager.loggerDict if name.startswith(f"{_LOGGERS[0]}.")
    ]
    for name in (*_LOGGERS, *dask_loggers):
        logger = logging.getLogger(name)
        logger.handlers[:] = [logging.NullHandler()]
        logger.propagate = False


# --- dask worker ----------------------------------------------------------------------------------

# Code that runs on a worker of `dask.distributed`: it computes chains of steps, and returns
# outcomes without values.
#
# The worker reads values by key from the store, or takes values of earlier tasks from memory, and
# writes the last result of the chain to the store.


_PLANNED = 0.6  #: fraction of the memory of a worker that a schedule may use


class _Here:
    """State of one worker between tasks: the store, the digests of code, and the most recently used
    values.
    """

    def __init__(self, where: str, room: float) -> None:
        self.store = open_store(where)
        # digests by the modules that the caller had imported; None: the modules imported here
        self._codes: dict[frozenset[str] | None, Code] = {None: Code(self.store.code_memo)}
        self._own = own_modules()
        self.values: OrderedDict[Key, Any] = OrderedDict()
        # greatest and present size (bytes) of the values
        self.room, self.held = room, 0

    def look_again(self) -> None:
        """Compute the digests of code again if a job has loaded modules of the user, which may
        change the results of others.
        """
        if self._own != own_modules():
            self._codes, self._own = {None: Code(self.store.code_memo)}, own_modules()

    def code_for(self, work: StepJob) -> Code | None:
        """Return the digests of code with which a step has the same digest as for the caller, or
        None if its code differs here.

        What a package of the user holds depends on which of its modules were imported. The caller's
        count: this worker imports those that it lacks, and leaves out those that steps of other
        recipes imported here.
        """
        # try the modules that are imported here, and then those of the caller
        for imported_modules in (None, work.own.followed if work.own else frozenset[str]()):
            for module in sorted(imported_modules or ()):
                imported(module)
            code = self._codes.get(imported_modules) or self._codes.setdefault(
                imported_modules, Code(self.store.code_memo, imported_modules)
            )
            if code_of(work.step, code) == work.origin["code"]:
                return code
        return None

    def fetch(self, key: Key, kinds: Mapping[Key, Any]) -> Any:
        """Return the value of a key; ``kinds`` maps the key of each input of a step to its
        annotated type.
        """
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
        # the least recently used values are deleted; the newest stays whatever its size
        while self.held > self.room and len(self.values) > 1:
            self.held -= _size(self.values.popitem(last=False)[1])


_here: dict[str, _Here] = {}


def _chance_of_its_own() -> None:
    """Give dask its own copy of the module `random`: its threads draw while a step runs, which
    would count as draws of the step.
    """
    own_random = _second_random()
    for name, module in list(sys.modules.items()):
        if name.startswith(("distributed.", "dask.")) and getattr(module, "random", None) is random:
            module.random = own_random  # type: ignore[attr-defined]


@cache
def _second_random() -> ModuleType:
    """Return a second copy of the module `random` with its own generator."""
    specification = find_spec("random")
    assert specification is not None
    assert specification.loader is not None
    second = module_from_spec(specification)
    specification.loader.exec_module(second)
    return second


def lane_here(dask_worker: Any) -> tuple[str, float]:
    """Return the device of a worker, and the memory (bytes) that a schedule may use on this
    device.
    """
    if torch.cuda.is_available():
        return "cuda:0", _PLANNED * there_is("cuda:0")
    allowed = getattr(dask_worker.memory_manager, "memory_limit", None)
    return "cpu", _PLANNED * min(there_is("cpu"), allowed or float("inf"))


def work_here(
    chain: tuple[StepJob, ...], where: str, threads: int, room: float, signed: str = ""
) -> list[Outcome]:
    """Compute a chain of jobs on a worker, and return outcomes without values. The worker keeps up
    to ``room`` bytes of values.

    ``signed`` is a signature by the caller's secret; the worker must have the same secret.
    """
    if not _same_secret(signed):
        text = (
            "NEUSEE_CACHE_SECRET of a worker is not that of this process: set the same secret there"
        )
        return [Outcome(chain[0], error=RunError(chain[0].step, [], OSError(text)))]
    if torch.get_num_threads() != threads:
        torch.set_num_threads(threads)
    _chance_of_its_own()
    worker = _here.get(where) or _here.setdefault(where, _Here(where, room))
    worker.look_again()
    outcomes: list[Outcome] = []
    refetch = chain[0].refetch_seconds
    for job in chain:
        outcome = _one_here(replace(job, refetch_seconds=refetch), worker)
        outcomes.append(outcome)
        # the later jobs of a chain need this result
        if outcome.held or outcome.error or outcome.lost:
            break
        # a value that is not stored must be computed again, with its inputs
        refetch = 0.0 if outcome.kept else outcome.seconds + refetch
    return [_light(outcome) for outcome in outcomes]


def _same_secret(signed: str) -> bool:
    """Return True if the secret of this process confirms the caller's signature, or if neither side
    has a secret.
    """
    try:
        check_signature(signed, "worker", "", b"")
    except Unsigned:
        return False
    return bool(secrets()) == bool(signed)


def _one_here(work: StepJob, here: _Here) -> Outcome:
    """Compute one job on this worker; return its outcome, or the error of a worker that cannot
    compute it as the caller would.
    """
    if is_private(work.key):
        text = (
            "the loaded code is not that of its file, so no other process can use the result:"
            " restart Python"
        )
        return Outcome(work, error=RunError(work.step, [], OSError(text)))
    code = here.code_for(work)
    if code is None:
        text = (
            f"the code of {work.step.node.path} differs on a worker: install the same version and"
            " packages there, and set the same time zone and settings of NumPy and torch"
        )
        return Outcome(work, error=RunError(work.step, [], OSError(text)))
    work = replace(work, own=own_code(work.step, code))
    # taints of an earlier job, whose data the module may still keep
    if work.own and (earlier_taints := taints_of(work.own.modules)):
        return Outcome(work, taints=earlier_taints)
    outcome = carry_out(work, partial(here.fetch, kinds=kinds_of(work)), here.store)
    if work.own and outcome.taints:
        taint_code(tainted_modules(work.own, outcome.taints), outcome.taints)
        outcome.value = None
    if outcome.value is not None:
        here.keep(work.key, outcome.value)
    return outcome


def kinds_of(work: StepJob) -> dict[Key, Any]:
    """Return the annotated type of each input of a job, by the key of the input.

    Where a type is not annotated, the value may be a named tuple of any node, so all families of
    nodes are imported.
    """
    node, kinds = work.step.node, dict[Key, Any]()
    for name, input_keys in zip(node.inputs, work.reads, strict=True):
        kind = node.hints.get(name, Any)
        if isinstance(input_keys, tuple):
            # such as list[Tensor], or list[Tensor] | None
            list_types = [
                candidate for candidate in (kind, *get_args(kind)) if get_origin(candidate) is list
            ]
            kind = get_args(list_types[0])[0] if list_types else Any
        if kind is Any:
            list(all_nodes())
        kinds |= dict.fromkeys(keys_in(input_keys), kind)
    return kinds


def _light(outcome: Outcome) -> Outcome:
    """Return an outcome that pickle can send: without its value, and with any error wrapped in a
    `RunError`.
    """
    outcome.value = None
    if outcome.error is not None and not isinstance(outcome.error, RunError):
        outcome.error = RunError(outcome.work.step, [], outcome.error)
    return outcome


def _size(value: Any) -> int:
    """Return the total size of the tensors in a value, in bytes."""
    return 0 if value is None else sum(t.nbytes for t in tensors_in(value))


# --- dask executor --------------------------------------------------------------------------------

# Executor on a dask.distributed cluster, which receives cache keys instead of tensors.
#
# A task is a chain of steps with the keys of its inputs. The worker reads values by key from the
# store, or takes values of earlier tasks from memory, and writes the last result of the chain to
# the store. The worker returns only the metadata of the results. If a worker dies, its finished
# results are in the store, and a second worker may write a result again without harm.


_SHARE = 0.4  #: fraction of the planned memory for values that the next tasks of a worker may read
_LOOK = 1.0  #: interval (s) between two queries for the connected workers
_TRIES = 3  #: number of workers that may die while they compute one chain before the run fails


class Dask:
    """An `Executor` on a cluster: ``client`` is a `distributed.Client`, and every worker can
    open ``store``.
    """

    shares = False

    def __init__(
        self,
        client: Any,
        store: Store,
        threads: int = 0,
        warn: Callable[[str], None] = warnings.warn,
    ) -> None:
        """Use ``threads`` threads on a worker, by default as many as here; ``warn`` is called at
        once if the link is lost.
        """
        self.where = getattr(store, "url", None) or str(store.root.absolute())
        self.link = SchedulerLink(client, warn)
        # the same number of threads as here gives the same rounding as here
        self.threads = threads or torch.get_num_threads()
        self._lanes: dict[str, Lane] = {}
        self._looked = -_LOOK  # time (s) of the last query for workers; none yet
        self._running: dict[Any, tuple[StepJob, ...]] = {}  # chain of jobs of each future
        # number of times that each chain was sent, by its first key
        self._tries: dict[Key, int] = {}
        self._bound = set[Any]()  # futures of chains that are assigned to one worker

    @property
    def client(self) -> Any:
        """Return the `distributed.Client` that is connected now."""
        return self.link.client

    @property
    def lanes(self) -> Mapping[str, Lane]:
        """Return the device and memory of each worker, by address; the workers are queried at
        most once a second.
        """
        if time.monotonic() - self._looked > _LOOK or not self._lanes:
            self._look()
        return self._lanes

    def submit(self, work: Sequence[StepJob]) -> None:
        """Send a chain of jobs to the assigned worker, or to another worker if the assigned
        worker is gone.
        """
        assigned_worker = work[0].lane
        assignment = (
            {"workers": [assigned_worker], "allow_other_workers": True}
            if assigned_worker in self.link.newest
            else {}
        )
        self._tries[work[0].key] = self._tries.get(work[0].key, 0) + 1
        future = self.client.submit(
            work_here,
            tuple(work),
            self.where,
            self.threads,
            _SHARE * min((lane.memory for lane in self._lanes.values()), default=0.0),
            signature("worker", "", b""),
            # a new name for each attempt: dask returns the old result for an equal name
            key=f"neusee-{work[0].key}-{work[-1].key}-{self._tries[work[0].key]}",
            pure=False,
            retries=_TRIES,
            **assignment,
        )
        self._running[future] = tuple(work)
        if assignment:
            self._bound.add(future)

    def wait(self, seconds: float | None = None) -> list[Outcome]:
        """Return the outcomes of jobs that have arrived since the last call.

        Raises `ClusterLost` if the scheduler or all its workers are gone, and do not come back.
        """
        end = time.monotonic() + (float("inf") if seconds is None else seconds)
        while self._running:
            seconds_left = end - time.monotonic()
            self._rest(max(0.0, min(seconds_left, _LOOK)))
            if self.link.renewed():
                self.link.workers()
                self._submit_again(self._running)
            self._free_of_lost_workers()
            ended = [future for future in self._running if future.status != "pending"]
            outcomes = [*chain.from_iterable(map(self._taken, ended))]
            if outcomes or seconds_left <= 0:
                return outcomes
        return []

    def cancel(self) -> None:
        """Drop the tasks that have not begun; running tasks continue, and their results are
        stored.
        """
        for future in self._running:
            # this does not wait for an answer, which a lost scheduler would not send
            future.release()
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
        """Send again the chains that were assigned to a lost worker: dask would otherwise keep them
        for that worker if none was left.
        """
        if present := self.link.newest:
            self._submit_again([f for f in self._bound if self._running[f][0].lane not in present])

    def _rest(self, seconds: float) -> None:
        """Wait until a task ends, at most ``seconds``."""
        from distributed import wait

        with suppress(TimeoutError, CancelledError), self.client.as_current():
            wait(list(self._running), seconds, return_when="FIRST_COMPLETED")

    def _taken(self, future: Any) -> list[Outcome]:
        """Return the outcomes of a chain of jobs, or one outcome with a `RunError` if the
        workers died.
        """
        chain = self._running.pop(future)
        self._bound.discard(future)
        if future.status == "finished":
            with suppress(CancelledError, OSError):  # the link was lost before the outcomes came
                outcomes: list[Outcome] = future.result()
                for outcome in outcomes:  # another worker may have computed the chain
                    outcome.work = replace(outcome.work, lane=chain[0].lane)
                return outcomes
        # any other status is that of a lost or cancelled task
        cause = future.exception() if future.status == "error" else None
        # the task was lost with its worker or its scheduler
        if cause is None and self._tries[chain[0].key] < _TRIES:
            self.submit(chain)
            return []
        return [Outcome(chain[0], error=RunError(chain[0].step, [], OSError(_why_not(cause))))]

    def _look(self) -> None:
        """Update the list of connected workers and their devices; wait until a worker is
        connected.
        """
        present_workers = self.link.workers()
        if present_workers is None and self._lanes:  # the link is cut, but may recover
            return
        present_workers = present_workers or self.link.wait_for_workers()
        new_addresses = [address for address in present_workers if address not in self._lanes]
        device_and_memory: dict[str, Any] = {}
        with suppress(OSError):
            device_and_memory = (
                self.client.run(lane_here, workers=new_addresses, on_error="ignore")
                if new_addresses
                else {}
            )
        lanes = {
            **self._lanes,
            **{
                address: Lane(*device_and_bytes)
                for address, device_and_bytes in device_and_memory.items()
            },
        }
        self._lanes = {
            address: lanes[address] for address in sorted(present_workers) if address in lanes
        }
        self._looked = time.monotonic()


def _why_not(cause: BaseException | None) -> str:
    """Return the reason why no worker computed a step, without dask's own advice."""
    if cause is None:
        return "the link to the cluster was lost again and again while a worker computed the step"
    if type(cause).__name__ == "KilledWorker":
        return (
            "every worker that computed the step died: too little memory, or killed; the log of a"
            " worker says more"
        )
    return f"no worker could carry out the step: {type(cause).__name__}: {cause}"
