"""One piece of work: a step with the keys of what it reads, and what comes of it.

A piece carries keys and parameters and never a tensor, so that it may be carried out here or
in another process; what a value is worth decides whether the store keeps it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from datetime import UTC, datetime
from typing import Any, Protocol

import torch

from neusee.nodes import Check, TensorStats
from neusee.workflows.engine.band_results import call_by_band, plain_of
from neusee.workflows.engine.memory_use import PeakMemory
from neusee.workflows.engine.node_call import call, examine
from neusee.workflows.engine.provenance import versions
from neusee.workflows.engine.write_behind import LARGE, WriteBehind
from neusee.workflows.graph.recipe_graph import Step
from neusee.workflows.graph.run_error import RunError
from neusee.workflows.keys.cache_key import Key, plain
from neusee.workflows.store.lease import Lease
from neusee.workflows.store.metadata import INLINE
from neusee.workflows.store.result_store import Store
from neusee.workflows.store.serialization import pack, tensors_in

Read = Key | tuple[Key, ...] | None  #: what one input reads: one value, a list of them, or nothing
Fetch = Callable[[Key], Any]
_FACTS = tuple(f.name for f in fields(TensorStats))
_WATCHED = 1 << 20  #: bytes of inputs from which the memory of a step is measured


class InputMissing(Exception):
    """A stored result turned out to be damaged or gone when it was read: plan again without it."""


@dataclass(frozen=True, slots=True)
class StepJob:
    """A step to be carried out."""

    step: Step
    key: Key
    origin: Mapping[str, Any]  #: everything that went into the key
    reads: tuple[Read, ...]  #: by input, in the node's order
    seed: int
    recipe: str
    device: str  #: where it computes: ``cpu``, ``cuda:1``
    lane: str  #: which of the executor's places has it
    wanted: bool = False  #: whether the result is asked for, and is kept whatever it costs
    quick: bool = False  #: whether its like took so little that no other process need wait for it
    anew: bool = False  #: whether to compute it although it is stored, because that is quicker
    below: float = 0.0  #: s to have its inputs again, were this result not kept
    parts: int = 1  #: into how many runs of bands it is cut for want of memory

    @property
    def sources(self) -> tuple[Key, ...]:
        """Every key that it reads."""
        return tuple(k for read in self.reads for k in ((read,) if isinstance(read, str) else read or ()))


@dataclass(slots=True)
class Outcome:
    """What became of a piece of work."""

    work: StepJob
    value: Any = None  #: absent where another process computed it
    facts: TensorStats | None = None
    checks: tuple[Check, ...] = ()
    began: float = 0.0  #: s of the clock of `time.time`
    seconds: float = 0.0
    bytes: int = 0
    deviation: tuple[float, float] | None = None  #: of a cheaper form: `Node.approximation_error`
    peak: int | None = None  #: bytes beside what was there before
    kept: bool = False  #: whether the store has the value
    waits: bool = False  #: it is written beside the next steps, and its lease goes with it
    held: bool = False  #: another process is at it
    found: bool = False  #: another process was quicker, and its result is there
    error: BaseException | None = None
    lost: tuple[Key, ...] = field(default=())  #: inputs that could not be read


@dataclass(frozen=True, slots=True)
class Lane:
    """A place that does one piece of work at a time."""

    device: str
    memory: float  #: bytes that may be planned with

    @property
    def kind(self) -> str:
        """``cpu`` or ``cuda``, without the number."""
        return self.device.partition(":")[0]


class Executor(Protocol):
    """Where work is done. Three calls, so that another engine can follow."""

    @property
    def lanes(self) -> Mapping[str, Lane]:
        """The places where work can be done, by name."""

    @property
    def shares(self) -> bool:
        """Whether values stay in this process; otherwise they travel through the store, by key."""

    def submit(self, work: Sequence[StepJob]) -> None:
        """Begin with ``work``, steps of one lane of which each feeds the next."""

    def wait(self, seconds: float | None = None) -> list[Outcome]:
        """What has ended since; at least one, unless nothing is under way or the time is over."""

    def cancel(self) -> None:
        """Begin with nothing more, and wait for what is under way."""


def carry_out(work: StepJob, fetch: Fetch, store: Store, later: WriteBehind | None = None) -> Outcome:
    """Compute one step and keep what is worth keeping, perhaps ``later``; a failure is part of the outcome."""
    if work.quick:
        return _carried_out(work, fetch, store, None, Lease())
    lease = store.claim(work.key)
    if lease is None:
        return Outcome(work, held=True)
    outcome = Outcome(work)
    try:
        if not work.anew and store.has(work.key):
            return Outcome(work, kept=True, found=True)
        outcome = _carried_out(work, fetch, store, later, lease)
        return outcome
    finally:
        if not outcome.waits:
            lease.release()


def _carried_out(work: StepJob, fetch: Fetch, store: Store, later: WriteBehind | None, lease: Lease) -> Outcome:
    try:
        inputs = [_gathered(read, fetch) for read in work.reads]
    except InputMissing as error:
        return Outcome(work, lost=error.args)
    try:
        return _kept(_computed(work, inputs, store), store, later, lease)
    except Exception as error:
        return Outcome(work, error=error)


def _gathered(read: Read, fetch: Fetch) -> Any:
    if read is None or isinstance(read, str):
        return None if read is None else fetch(read)
    return [fetch(key) for key in read]


def _computed(work: StepJob, inputs: list[Any], store: Store) -> Outcome:
    """The value, what is known of it, and what it cost."""
    step = work.step
    began, clock = time.time(), time.perf_counter()
    size = sum(t.nbytes for t in tensors_in(inputs))
    with PeakMemory(work.device, size >= _WATCHED or not inputs) as peak, torch.no_grad():
        if step.node.bands and (work.parts > 1 or work.device.startswith("cpu")):
            value = call_by_band(
                step,
                inputs,
                lambda given: call(step, given, step.params, work.seed, work.device),
                work.origin["code"],
                store.blobs,
                work.parts,
            )
        else:
            value = call(step, inputs, step.params, work.seed, work.device)
        bare = plain_of(value)
        checks = examine(step, bare, inputs)
    seconds = time.perf_counter() - clock
    if work.origin["params"] != {name: plain(param) for name, param in step.params.items()}:
        raise RunError(step, [], OSError("a file changed while it was read: run again"))
    found = sum(t.nbytes for t in tensors_in(bare))
    deviation = step.node.hooks.approximation_error(bare) if step.node.hooks.approximation_error else None
    return Outcome(work, value, TensorStats.of(bare), checks, began, seconds, found, deviation, peak.bytes)


def _kept(outcome: Outcome, store: Store, later: WriteBehind | None, lease: Lease) -> Outcome:
    """Store the value where that pays, and in any case what is known of it."""
    work, value, about = outcome.work, outcome.value, _about(outcome)
    small = outcome.bytes <= INLINE
    try:
        if work.quick and (small or not work.wanted) and not _pays(outcome, store, 0):
            outcome.kept = store.jot(work.key, value, about)
        elif not (work.wanted or small or _pays(outcome, store, outcome.bytes)):
            store.note(work.key, about)
        elif later is not None and outcome.bytes >= LARGE:
            pack(value)  # what cannot be stored is refused here, where the step is known
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
    """Whether to have the result again costs more than to write ``size`` bytes now and read them once."""
    return outcome.seconds + outcome.work.below > store.write_seconds(size) + store.read_seconds(size)


def _about(outcome: Outcome) -> dict[str, Any]:
    work = outcome.work
    return {
        "step": work.step.name,
        "recipe": work.recipe,
        "origin": dict(work.origin),
        "facts": outcome.facts and {name: getattr(outcome.facts, name) for name in _FACTS},
        "checks": [[check.text, check.ok] for check in outcome.checks],
        "seconds": outcome.seconds,
        "bytes": outcome.bytes,
        "peak": outcome.peak,
        "error": outcome.deviation,
        "device": work.device,
        "versions": versions(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }


__all__ = ["Executor", "Fetch", "InputMissing", "Lane", "Outcome", "Read", "StepJob", "carry_out"]
