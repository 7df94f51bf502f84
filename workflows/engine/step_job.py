"""Job of one step: the step with the keys of its inputs, its outcome, and its late writes."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any, Protocol, TypeVar

import torch

from neusee.nodes import Check, TensorStats
from neusee.workflows.engine.cost_model import measured_size
from neusee.workflows.engine.machine_resources import PeakMemory, guarded, refusing_allocations
from neusee.workflows.engine.node_call import call, call_in_parts, examine
from neusee.workflows.engine.processor_speed import (
    Processor,
    process_seconds,
    processor,
    thread_seconds,
)
from neusee.workflows.engine.provenance import timestamp, versions
from neusee.workflows.engine.step_process import ProcessEnded, call_in_fork, may_fork
from neusee.workflows.graph.errors import RunError
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.keys.cache_key import (
    Key,
    counted_params,
    device_kind,
    file_stamps,
    is_private,
)
from neusee.workflows.keys.user_code import OwnCode, hold_back, may_be_stored
from neusee.workflows.observation.observed_call import (
    call_observed,
    say_hidden,
    say_lost,
    tainted_modules,
    undeclared,
)
from neusee.workflows.observation.taints import Taint
from neusee.workflows.store.lease import Lease
from neusee.workflows.store.metadata import INLINE
from neusee.workflows.store.result_store import Store
from neusee.workflows.store.serialization import pack, tensors_in

# --- write behind ---------------------------------------------------------------------------------

# Writes of large results in the background, while the next steps compute.
#
# A run ends after all writes. A result that waits to be written stays in memory and keeps its
# lease, so that another process that needs the same result finds either the lease or the result.


LARGE = 1 << 20  #: bytes; a larger result is written during the next step
_ROOM = 1 << 29  #: greatest total size (bytes) of waiting results; a larger result waits alone
_NICE = 10  #: increase of the nice value of the writing thread; 19 is the greatest nice value


class WriteBehind:
    """Pending writes of results, one at a time in the background."""

    def __init__(self) -> None:
        self._pool: ThreadPoolExecutor | None = None
        self._sizes: dict[Key, int] = {}  # size (bytes) of each write that has not ended
        # each write since the last `finish`, kept to report its error
        self._writes: dict[Key, Future[Any]] = {}
        self._guard = threading.Lock()

    def __contains__(self, key: Key) -> bool:
        return key in self._sizes

    def add(self, key: Key, size: int, write: Callable[[], Any]) -> None:
        """Start a write in the background; wait for earlier writes if too many bytes would be
        pending.
        """
        while self._sizes and sum(list(self._sizes.values())) + size > _ROOM:
            wait(
                [self._writes[key] for key in list(self._sizes) if key in self._writes],
                return_when=FIRST_COMPLETED,
            )
        with self._guard:
            # one thread: one write at a time
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
            thread_id = threading.get_native_id()
            os.setpriority(
                os.PRIO_PROCESS,
                thread_id,
                min(os.getpriority(os.PRIO_PROCESS, thread_id) + _NICE, 19),
            )


# --- step job -------------------------------------------------------------------------------------

# Job of one step: the step with the keys of its inputs, and the outcome of the job.
#
# A job contains keys and parameters but no tensor, so that any process can compute the step. The
# cost of a value decides whether the store keeps the value.


#: content of one input: one value, a list of values, or nothing
Read = Key | tuple[Key, ...] | None
Fetch = Callable[[Key], Any]
#: function that is called with each computed result: the recipe of the run, the keys known so far,
#: the step and its value
Show = Callable[[Recipe, Mapping[str, Key], str, Any], None]
T = TypeVar("T")
_STATISTICS = tuple(field.name for field in fields(TensorStats))
_WATCHED_BYTES = 1 << 20  #: size (bytes) of the inputs above which the memory of a step is measured


class InputMissing(Exception):
    """Error for a stored result that is damaged or missing when it is read; the run then
    computes the result.
    """


def keys_in(read: Read) -> tuple[Key, ...]:
    """Return the cache keys of the values of one input."""
    return (read,) if isinstance(read, str) else read or ()


@dataclass(frozen=True, slots=True)
class StepJob:
    """A step to compute, with the cache keys of its inputs."""

    step: Step
    key: Key
    origin: Mapping[str, Any]  #: every part of the key
    reads: tuple[Read, ...]  #: keys by input, in the node's order
    seed: int
    recipe: str
    device: str  #: device of the computation: ``cpu``, ``cuda:1``
    lane: str  #: name of the `Lane` (device or worker) that computes the job
    wanted: bool = False  #: True if the result is requested, and therefore kept whatever its cost
    unlocked: bool = False  #: compute without a lease, because the node takes so little time
    #: True to compute a stored result because computing is faster than reading
    recompute: bool = False
    refetch_seconds: float = 0.0  #: time (s) to obtain the inputs again if this result is not kept
    parts: int = 1  #: number of passes over the bands, for less memory
    #: the user's code behind the step, which is observed while it computes
    own: OwnCode | None = None

    @property
    def sources(self) -> tuple[Key, ...]:
        """Return the cache keys of all values that the job reads."""
        keys: list[Key] = []
        for input_keys in self.reads:
            keys += keys_in(input_keys)
        return tuple(keys)


@dataclass(slots=True)
class Outcome:
    """Outcome of a job: the value and its costs, or the reason why there is no value."""

    work: StepJob
    value: Any = None  #: None where another process computed the value
    facts: TensorStats | None = None
    checks: tuple[Check, ...] = ()
    began: float = 0.0  #: start time (s), from `time.time`
    seconds: float = 0.0  #: of the clock, which other work on the machine lengthens
    #: processor time (s) of the step and the processes that it started; None on a GPU
    processor_seconds: float | None = None
    processor: Processor | None = None  #: where the step ran; None on a GPU
    bytes: int = 0
    #: error of a cheaper form: `Node.approximation_error`
    deviation: tuple[float, float] | None = None
    peak: int | None = None  #: peak bytes beside the memory in use before
    size: list[float] | None = None  #: the size of the step: `cost_model.Size`
    kept: bool = False  #: True if the store has the value
    #: True if the value is written during the next steps; its lease is released afterwards
    is_written_later: bool = False
    held: bool = False  #: True if another process computes this result
    found: bool = False  #: True if another process has already stored this result
    error: BaseException | None = None
    lost: tuple[Key, ...] = ()  #: inputs that could not be read
    #: dependencies of a step of the user that its key does not cover; its value is not stored
    taints: tuple[Taint, ...] = ()


@dataclass(frozen=True, slots=True)
class Lane:
    """A device or worker that computes one job at a time."""

    device: str
    memory: float  #: bytes that a schedule may use
    held: float = 0.0  #: bytes that the program itself uses in addition

    @property
    def kind(self) -> str:
        """Return the kind of the device, such as ``cpu`` or ``cuda``."""
        return device_kind(self.device)


class Executor(Protocol):
    """Interface of an executor, which computes jobs in this process or on a cluster."""

    @property
    def lanes(self) -> Mapping[str, Lane]:
        """Return the devices or workers of the executor, by name."""

    @property
    def shares(self) -> bool:
        """Return True if values stay in this process, and False if steps exchange values through
        the store.
        """

    def submit(self, work: Sequence[StepJob]) -> None:
        """Start a chain of jobs on one device or worker; each job computes an input of the next
        job.
        """

    def wait(self, seconds: float | None = None) -> list[Outcome]:
        """Return the outcomes of jobs since the last call; while jobs run, wait at most
        ``seconds`` for an outcome.
        """

    def cancel(self) -> None:
        """Start no further job, and wait for the running jobs."""


def carry_out(
    work: StepJob, fetch: Fetch, store: Store, later: WriteBehind | None = None
) -> Outcome:
    """Compute one step and store its result if storing saves time; return an error as part of
    the outcome.
    """
    # no other process needs this result, or computing it twice costs less than the lease
    if work.unlocked or is_private(work.key):
        return _carried_out(work, fetch, store, None, Lease())
    lease = store.claim(work.key)
    if lease is None:
        return Outcome(work, held=True)
    outcome = Outcome(work)
    try:
        # another process stored it before the lease was free
        if not work.recompute and store.has(work.key):
            return Outcome(work, kept=True, found=True)
        outcome = _carried_out(work, fetch, store, later, lease)
        return outcome
    finally:
        if not outcome.is_written_later:
            lease.release()


def _carried_out(
    work: StepJob, fetch: Fetch, store: Store, later: WriteBehind | None, lease: Lease
) -> Outcome:
    """Fetch the inputs of a job, compute it and store its result; return an error as part of the
    outcome.
    """
    try:
        inputs = [gathered(input_keys, fetch) for input_keys in work.reads]
    except InputMissing as error:
        return Outcome(work, lost=error.args)
    try:
        return _kept(_computed(work, inputs), store, later, lease)
    except Exception as error:
        return Outcome(work, error=error)


def gathered(read: Read, fetch: Fetch) -> Any:
    """Fetch the value of an input: a single value, a list of values, or None for an absent
    input.
    """
    if read is None or isinstance(read, str):
        return None if read is None else fetch(read)
    return [fetch(key) for key in read]


def _computed(work: StepJob, inputs: list[Any]) -> Outcome:
    """Compute a step and return its value with statistics, checks and costs."""
    step, hooks = work.step, work.step.node.hooks
    observations = _Seen()
    file_stamps_before = file_stamps(step.params)
    on_cpu = device_kind(work.device) == "cpu"
    # code of the user may run in a thread of its own
    work_clock = thread_seconds if work.own is None else process_seconds
    began, clock_start, work_start = time.time(), time.perf_counter(), work_clock()
    input_bytes = sum(t.nbytes for t in tensors_in(inputs))
    # a small and quick step is not worth the measurement
    is_watched = input_bytes >= _WATCHED_BYTES or not work.unlocked
    with (
        PeakMemory(work.device, is_watched) as peak,
        torch.no_grad(),
        guarded(),
        refusing_allocations(_is_own_in_process(work)),
    ):
        value = _value(work, inputs, observations)
        checks = _observing(examine, work, observations)(step, value, inputs) if hooks.check else ()
    seconds, work_seconds = time.perf_counter() - clock_start, work_clock() - work_start
    _refuse_changed_files(work, file_stamps_before)
    return Outcome(
        work,
        value,
        bytes=sum(t.nbytes for t in tensors_in(value)),
        size=measured_size(step.node, inputs, step.params, value),
        deviation=hooks.approximation_error(value) if hooks.approximation_error else None,
        facts=TensorStats.of(value),
        checks=checks,
        began=began,
        seconds=seconds,
        processor_seconds=work_seconds if on_cpu else None,
        processor=processor() if on_cpu else None,
        # the memory of a forked process is counted separately
        peak=None if peak.bytes is None else peak.bytes + observations.peak,
        taints=tuple(dict.fromkeys(observations.taints)),
    )


def _is_own_in_process(work: StepJob) -> bool:
    """Return True for code of the user in this process: only then the system limits its
    allocations.
    """
    return work.own is not None and work.device.startswith("cpu") and not _needs_own_process(work)


def _value(work: StepJob, inputs: list[Any], observations: _Seen) -> Any:
    """Return the value of a step, computed in passes over its bands if the plan says so."""
    step = work.step
    evaluate = _observing(
        partial(call, step, params=step.params, seed=work.seed, device=work.device),
        work,
        observations,
    )
    if step.node.bands and work.parts > 1:
        return call_in_parts(step, inputs, evaluate, work.parts)
    return evaluate(inputs)


def _refuse_changed_files(work: StepJob, stamps: Any) -> None:
    """Raise `RunError` if an input file changed after the step began."""
    is_unchanged = stamps == file_stamps(work.step.params)
    if not is_unchanged or work.origin["params"] != counted_params(work.step):
        raise RunError(work.step, [], OSError("an input file changed while it was read: run again"))


@dataclass(slots=True)
class _Seen:
    """Observations of the calls of the user's code in one step."""

    taints: list[Taint] = field(default_factory=list)
    peak: int = 0  #: peak memory (bytes) of a separate process


def _observing(function: Callable[..., T], work: StepJob, observations: _Seen) -> Callable[..., T]:
    """Return a function that observes calls of the user's code and adds the findings to
    ``observations``; functions of neusee are returned unchanged.
    """
    own_code = work.own
    if own_code is None:
        return function

    def watched(*args: Any, **named: Any) -> T:
        try:
            value, taints = _called_observed(
                partial(function, *args, **named), own_code, _needs_own_process(work), observations
            )
        except ProcessEnded as error:
            raise RunError(work.step, [], error) from error
        observations.taints.extend(taints)
        if taints:
            # until the run has processed the taints, no result of these modules is stored
            hold_back(tainted_modules(own_code, taints))
        return value

    return watched


def _needs_own_process(work: StepJob) -> bool:
    """Return True for code that may change the state that other code uses: it runs in a separate,
    forked process.
    """
    return (
        work.own is not None
        and work.own.may_change
        and work.device.startswith("cpu")
        and may_fork()
    )


def _called_observed(
    function: Callable[[], T], own: OwnCode, in_own_process: bool, observations: _Seen
) -> tuple[T, list[Taint]]:
    """Call a function of the user's code, in a forked process if ``in_own_process`` and if its
    value can be sent.
    """
    # None if there was no fork, or if the value could not be sent
    returned = (
        call_in_fork(partial(call_observed, function, own), own.variables)
        if in_own_process
        else None
    )
    if returned is None:
        return call_observed(function, own)
    observations.peak = max(observations.peak, returned.peak or 0)
    value, taints = returned.value
    first_module, memory_taints = (
        min(own.modules),
        [taint for taint in taints if taint.kind == "memory"],
    )
    # the forked process has ended, and its changes in memory with it, so they taint nothing
    say_lost(first_module, memory_taints)
    say_hidden(first_module, returned.asked, own.free)
    return value, [
        *(taint for taint in taints if taint not in memory_taints),
        *undeclared(own, returned.asked),
    ]


def _kept(outcome: Outcome, store: Store, later: WriteBehind | None, lease: Lease) -> Outcome:
    """Store the metadata of a result, and also its value if reading is faster than computing the
    result again.
    """
    own_code = outcome.work.own
    if (
        is_private(outcome.work.key)
        or outcome.taints
        or (own_code and not may_be_stored(own_code.modules))
    ):
        return outcome
    try:
        _store(outcome, store, later, lease)
    except TypeError as error:
        raise RunError(outcome.work.step, [], error) from error
    return outcome


def _store(outcome: Outcome, store: Store, later: WriteBehind | None, lease: Lease) -> None:
    """Store a result in the way that saves time: only its metadata, a small value with its
    metadata, or a file, which may be written later.
    """
    job, value, metadata = outcome.work, outcome.value, _about(outcome)
    is_inline = outcome.bytes <= INLINE
    not_worth_it = not (job.wanted or is_inline or _pays(outcome, store, outcome.bytes))
    # without a lease, write no separate file if a record in a common file will do
    if job.unlocked and (not_worth_it or (is_inline and not _pays(outcome, store, 0))):
        outcome.kept = store.put_small(job.key, value, metadata)
    elif not_worth_it:
        store.put_receipt(job.key, metadata)
    elif later is not None and outcome.bytes >= LARGE:
        pack(value)  # a value that cannot be stored raises here, where the step is known
        later.add(job.key, outcome.bytes, lambda: _written(store, job.key, value, metadata, lease))
        outcome.kept = outcome.is_written_later = True
    else:
        outcome.kept = store.put(job.key, value, metadata)


def _written(store: Store, key: Key, value: Any, about: dict[str, Any], lease: Lease) -> None:
    """Write a result and release its lease."""
    with lease:
        store.put(key, value, about)


def _pays(outcome: Outcome, store: Store, size: int) -> bool:
    """Return True if computing a result again takes longer than writing and reading ``size``
    bytes.
    """
    return outcome.seconds + outcome.work.refetch_seconds > store.write_seconds(
        size
    ) + store.read_seconds(size)


def _about(outcome: Outcome) -> dict[str, Any]:
    """Return the metadata of a result."""
    job = outcome.work
    return {
        "step": job.step.name,
        "recipe": job.recipe,
        "origin": dict(job.origin),
        "facts": outcome.facts and {name: getattr(outcome.facts, name) for name in _STATISTICS},
        "checks": [[check.text, check.ok] for check in outcome.checks],
        "seconds": outcome.seconds,
        "processor_seconds": outcome.processor_seconds,
        "processor": outcome.processor and outcome.processor.name,
        "threads": outcome.processor and outcome.processor.threads,
        "bytes": outcome.bytes,
        "peak": outcome.peak,
        "size": outcome.size,
        "error": outcome.deviation,
        "device": job.device,
        "versions": versions(),
        "date": timestamp(),
    }
