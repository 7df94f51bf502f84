"""Job of one step: the step with the keys of its inputs, and the outcome of the job.

A job contains keys and parameters but no tensor, so that any process can compute the step. The cost
of a value decides whether the store keeps the value.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any, Protocol, TypeVar

import torch

from neusee.nodes import Check, TensorStats
from neusee.workflows.engine.allocation_limit import refusing_allocations
from neusee.workflows.engine.band_results import call_by_band, plain_of
from neusee.workflows.engine.cost_laws import measured_size
from neusee.workflows.engine.memory_use import PeakMemory
from neusee.workflows.engine.memory_watch import guarded
from neusee.workflows.engine.node_call import call, examine
from neusee.workflows.engine.provenance import timestamp, versions
from neusee.workflows.engine.step_process import ProcessEnded, call_in_fork, may_fork
from neusee.workflows.engine.write_behind import LARGE, WriteBehind
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.graph.run_error import RunError
from neusee.workflows.keys.cache_key import Key, device_kind, is_private, plain
from neusee.workflows.keys.input_file_digest import file_stamps
from neusee.workflows.keys.tainted_code import hold_back, may_be_stored
from neusee.workflows.keys.user_code import OwnCode
from neusee.workflows.observation.own_call import call_observed, say_hidden, say_lost, tainted_modules, undeclared
from neusee.workflows.observation.taints import Taint
from neusee.workflows.store.lease import Lease
from neusee.workflows.store.metadata import INLINE
from neusee.workflows.store.result_store import Store
from neusee.workflows.store.serialization import pack, tensors_in

Read = Key | tuple[Key, ...] | None  #: content of one input: one value, a list of values, or nothing
Fetch = Callable[[Key], Any]
#: function that is told each computed result: the recipe of the run, the keys known so far, the step and its value
Show = Callable[[Recipe, Mapping[str, Key], str, Any], None]
T = TypeVar("T")
_STATS = tuple(each.name for each in fields(TensorStats))
_WATCHED = 1 << 20  #: bytes of inputs from which the memory of a step is measured


class InputMissing(Exception):
    """Error for a stored result that is damaged or missing when it is read; the run then computes the result."""


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
    recompute: bool = False  #: True to compute a stored result because computing is faster than reading
    refetch_seconds: float = 0.0  #: s to obtain the inputs again if this result is not kept
    parts: int = 1  #: number of passes over the bands, for less memory
    own: OwnCode | None = None  #: the code of a step that is not of neusee, which is observed while it computes

    @property
    def sources(self) -> tuple[Key, ...]:
        """Return the cache keys of all values that the job reads."""
        return tuple(k for read in self.reads for k in ((read,) if isinstance(read, str) else read or ()))


@dataclass(slots=True)
class Outcome:
    """Outcome of a job: the value and its costs, or the reason why there is no value."""

    work: StepJob
    value: Any = None  #: None where another process computed the value
    facts: TensorStats | None = None
    checks: tuple[Check, ...] = ()
    began: float = 0.0  #: s, by `time.time`
    seconds: float = 0.0
    bytes: int = 0
    deviation: tuple[float, float] | None = None  #: error of a cheaper form: `Node.approximation_error`
    peak: int | None = None  #: peak bytes beside the memory in use before
    size: list[float] | None = None  #: the size of the step: `cost_laws.Size`
    kept: bool = False  #: True if the store has the value
    waits: bool = False  #: True if the value is written during the next steps; its lease is released afterwards
    held: bool = False  #: True if another process computes this result
    found: bool = False  #: True if another process has already stored this result
    error: BaseException | None = None
    lost: tuple[Key, ...] = ()  #: inputs that could not be read
    taints: tuple[Taint, ...] = ()  #: what an own step reached that its key does not cover; its value is not stored


@dataclass(frozen=True, slots=True)
class Lane:
    """A device or worker that computes one job at a time."""

    device: str
    memory: float  #: bytes that a schedule may use
    held: float = 0.0  #: bytes that the program itself holds beside them

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
        """Return True if values stay in this process, and False if steps exchange values through the store."""

    def submit(self, work: Sequence[StepJob]) -> None:
        """Start a chain of jobs on one device or worker; each job computes an input of the next job."""

    def wait(self, seconds: float | None = None) -> list[Outcome]:
        """Return the outcomes of jobs since the last call; while jobs run, wait at most ``seconds`` for an outcome."""

    def cancel(self) -> None:
        """Start no further job, and wait for the running jobs."""


def carry_out(work: StepJob, fetch: Fetch, store: Store, later: WriteBehind | None = None) -> Outcome:
    """Compute one step and store its result if storing saves time; return an error as part of the outcome."""
    if work.unlocked or is_private(work.key):
        return _carried_out(work, fetch, store, None, Lease())
    lease = store.claim(work.key)
    if lease is None:
        return Outcome(work, held=True)
    outcome = Outcome(work)
    try:
        if not work.recompute and store.has(work.key):
            return Outcome(work, kept=True, found=True)
        outcome = _carried_out(work, fetch, store, later, lease)
        return outcome
    finally:
        if not outcome.waits:
            lease.release()


def _carried_out(work: StepJob, fetch: Fetch, store: Store, later: WriteBehind | None, lease: Lease) -> Outcome:
    try:
        inputs = [gathered(read, fetch) for read in work.reads]
    except InputMissing as error:
        return Outcome(work, lost=error.args)
    try:
        return _kept(_computed(work, inputs, store), store, later, lease)
    except Exception as error:
        return Outcome(work, error=error)


def gathered(read: Read, fetch: Fetch) -> Any:
    """Fetch the value of an input: a single value, a list of values, or None for an absent input."""
    if read is None or isinstance(read, str):
        return None if read is None else fetch(read)
    return [fetch(key) for key in read]


def _computed(work: StepJob, inputs: list[Any], store: Store) -> Outcome:
    """Compute a step and return its value with statistics, checks and costs."""
    step = work.step
    seen = _Seen()
    evaluate = _observing(partial(call, step, params=step.params, seed=work.seed, device=work.device), work, seen)
    stamps = file_stamps(step.params)
    began, clock = time.time(), time.perf_counter()
    size = sum(t.nbytes for t in tensors_in(inputs))
    watched = size >= _WATCHED or not work.unlocked
    own_here = work.own is not None and work.device.startswith("cpu") and not _is_apart(work)
    with PeakMemory(work.device, watched) as peak, torch.no_grad(), guarded(), refusing_allocations(own_here):
        if step.node.bands and (work.parts > 1 or work.device.startswith("cpu")):
            value = call_by_band(step, inputs, evaluate, work.origin["code"], store.blobs, work.parts)
        else:
            value = evaluate(inputs)
        bare = plain_of(value)
        checks = _observing(examine, work, seen)(step, bare, inputs) if step.node.hooks.check else ()
    seconds = time.perf_counter() - clock
    same = stamps == file_stamps(step.params)
    if not same or work.origin["params"] != {name: plain(param) for name, param in step.params.items()}:
        raise RunError(step, [], OSError("an input file changed while it was read: run again"))
    found = sum(t.nbytes for t in tensors_in(bare))
    sized = measured_size(step.node, inputs, step.params, bare)
    deviation = step.node.hooks.approximation_error(bare) if step.node.hooks.approximation_error else None
    facts = TensorStats.of(bare)
    taints = tuple(dict.fromkeys(seen.taints))
    most = None if peak.bytes is None else peak.bytes + seen.peak
    return Outcome(work, value, facts, checks, began, seconds, found, deviation, most, sized, taints=taints)


@dataclass(slots=True)
class _Seen:
    """What was seen of the calls of own code in one step."""

    taints: list[Taint] = field(default_factory=list)
    peak: int = 0  #: peak bytes of a process of its own


def _observing(function: Callable[..., T], work: StepJob, seen: _Seen) -> Callable[..., T]:
    """Return a function that is observed where the code is not of neusee, and that adds what it finds to ``seen``."""
    own = work.own
    if own is None:
        return function

    def watched(*args: Any, **more: Any) -> T:
        try:
            value, found = _called_observed(partial(function, *args, **more), own, _is_apart(work), seen)
        except ProcessEnded as error:
            raise RunError(work.step, [], error) from error
        seen.taints.extend(found)
        if found:
            hold_back(tainted_modules(own, found))
        return value

    return watched


def _is_apart(work: StepJob) -> bool:
    """Return True for code that may change what other code finds: it runs in a process of its own."""
    return work.own is not None and work.own.may_change and work.device.startswith("cpu") and may_fork()


def _called_observed(function: Callable[[], T], own: OwnCode, apart: bool, seen: _Seen) -> tuple[T, list[Taint]]:
    """Call a function of own code, in a process of its own if ``apart`` and its value can be sent."""
    returned = call_in_fork(partial(call_observed, function, own), own.variables) if apart else None
    if returned is None:
        return call_observed(function, own)
    seen.peak = max(seen.peak, returned.peak or 0)
    value, found = returned.value
    home, lost = min(own.modules), [taint for taint in found if taint.kind == "memory"]
    say_lost(home, lost)
    say_hidden(home, returned.asked, own.free)
    return value, [*(taint for taint in found if taint not in lost), *undeclared(own, returned.asked)]


def _kept(outcome: Outcome, store: Store, later: WriteBehind | None, lease: Lease) -> Outcome:
    """Store the metadata of a result, and also its value if reading is faster than computing the result again."""
    own = outcome.work.own
    if is_private(outcome.work.key) or outcome.taints or (own and not may_be_stored(own.modules)):
        outcome.value = plain_of(outcome.value)
        return outcome
    work, value, about = outcome.work, outcome.value, _about(outcome)
    small = outcome.bytes <= INLINE
    not_worth = not (work.wanted or small or _pays(outcome, store, outcome.bytes))
    try:
        if work.unlocked and (not_worth or (small and not _pays(outcome, store, 0))):
            outcome.kept = store.put_small(work.key, value, about)
        elif not_worth:
            store.put_receipt(work.key, about)
        elif later is not None and outcome.bytes >= LARGE:
            pack(value)  # a value that cannot be stored raises here, where the step is known
            later.add(work.key, outcome.bytes, lambda: _written(store, work.key, value, about, lease))
            outcome.kept = outcome.waits = True
        else:
            outcome.kept = store.put(work.key, value, about)
    except TypeError as error:
        raise RunError(work.step, [], error) from error
    outcome.value = plain_of(outcome.value)
    return outcome


def _written(store: Store, key: Key, value: Any, about: dict[str, Any], lease: Lease) -> None:
    with lease:
        store.put(key, value, about)


def _pays(outcome: Outcome, store: Store, size: int) -> bool:
    """Return True if computing a result again takes longer than writing and reading ``size`` bytes."""
    return outcome.seconds + outcome.work.refetch_seconds > store.write_seconds(size) + store.read_seconds(size)


def _about(outcome: Outcome) -> dict[str, Any]:
    work = outcome.work
    return {
        "step": work.step.name,
        "recipe": work.recipe,
        "origin": dict(work.origin),
        "facts": outcome.facts and {name: getattr(outcome.facts, name) for name in _STATS},
        "checks": [[check.text, check.ok] for check in outcome.checks],
        "seconds": outcome.seconds,
        "bytes": outcome.bytes,
        "peak": outcome.peak,
        "size": outcome.size,
        "error": outcome.deviation,
        "device": work.device,
        "versions": versions(),
        "date": timestamp(),
    }
