"""Execution of one run: keys of the steps, values in memory, and records."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from neusee.nodes import TensorStats
from neusee.workflows.engine.cost_model import Costs, Estimate, sizes_of
from neusee.workflows.engine.dispatch import Loop, chains_of
from neusee.workflows.engine.local_executor import Local
from neusee.workflows.engine.node_call import places
from neusee.workflows.engine.placement_inputs import (
    Prepared,
    joined,
    past_costs,
    prepare,
    room_for,
    small_result,
)
from neusee.workflows.engine.provenance import facts_in, loaded, ran, unneeded
from neusee.workflows.engine.step_job import (
    Executor,
    InputMissing,
    Outcome,
    Read,
    Show,
    StepJob,
    WriteBehind,
)
from neusee.workflows.engine.wanted_steps import Upstream, uses_of
from neusee.workflows.graph.errors import RunError
from neusee.workflows.graph.recipe_graph import (
    Event,
    Recipe,
    Step,
    StepRecord,
    Wire,
    dependents,
    in_order,
    needed,
    nodes_of,
)
from neusee.workflows.keys.cache_key import Key, is_private
from neusee.workflows.keys.code_digest import Code, KnownKeys
from neusee.workflows.keys.module_digest import say_once
from neusee.workflows.keys.user_code import own_code, taint_code
from neusee.workflows.observation.observed_call import WORDS, tainted_modules
from neusee.workflows.placement.heft_schedule import Schedule, TooLarge
from neusee.workflows.store.result_store import Store
from neusee.workflows.tolerance.skip_decision import ErrorBudget, SkipDecision

# --- run series -----------------------------------------------------------------------------------

# A series of runs, such as the points of a sweep: data that one run found and that the next run can
# use.


@dataclass(eq=False)
class RunSeries:
    """Data that the runs of a series share: the code of nodes, keys of steps, and statistics of
    results.

    The key of a result determines its statistics, so they stay valid even if it is no longer
    in the store.
    """

    known_keys: KnownKeys
    #: statistics of the results of the newest run only
    facts: dict[Key, TensorStats] = field(default_factory=dict)

    @classmethod
    def begun(cls, store: Store) -> RunSeries:
        """Return a series without a run; the code of nodes is read now."""
        return cls(KnownKeys(Code(store.code_memo)))

    def read_code_again(self, store: Store) -> None:
        """Forget the digests of code, and the keys that depend on them."""
        self.known_keys = KnownKeys(Code(store.code_memo))

    def keep(self, facts: Mapping[Key, TensorStats | None], keys: Iterable[Key]) -> None:
        """Keep the statistics of the results ``keys`` for the next run; those of earlier runs are
        deleted.

        Private results are left out: the next run computes them again, and they may differ.
        """
        public = [key for key in keys if not is_private(key)]
        keys_and_stats = ((key, facts.get(key)) for key in public)
        self.facts = {key: stats for key, stats in keys_and_stats if stats is not None}


# --- values in memory -----------------------------------------------------------------------------

# The values of a run in memory, each kept until no later step of the run needs it.


class ValuesInMemory(dict[Key, Any]):
    """Values by cache key, and whether the store has copies of them.

    ``later`` contains the values that are being written in the background.
    """

    def __init__(self, store: Store, later: WriteBehind) -> None:
        super().__init__()
        self._store, self._later = store, later
        # values that the store may lack; True after a write in the background
        self._unsure = dict[Key, bool]()

    def add(self, outcome: Outcome) -> None:
        """Add the value of a computed step."""
        key = outcome.work.key
        self[key] = outcome.value
        self._unsure.pop(key, None)
        if outcome.is_written_later or not outcome.kept:
            self._unsure[key] = outcome.is_written_later

    def free(self, keys: Iterable[Key], uses: Counter[Key], keep: bool) -> None:
        """Delete the values that no later step needs; with ``keep``, only those that the store has
        a copy of.
        """
        for key in keys:
            unused = uses[key] <= 0 and key in self and key not in self._later
            if unused and not (keep and self._is_only_here(key)):
                del self[key]

    def _is_only_here(self, key: Key) -> bool:
        """Return True if the store has no copy of a value; a write in the background may have
        failed.
        """
        return key in self._unsure and (not self._unsure[key] or not self._store.has(key))


# --- private steps --------------------------------------------------------------------------------

# Steps whose results are valid in this process only, because code of the user was observed to read
# something its key does not cover.


class TaintedRun(Exception):
    """Raised when the cache keys of a run are no longer valid, because a step of the user used
    something that its key does not include.

    The run begins again, with private keys for this code and for all steps that depend on it.
    """

    def __init__(self, outcome: Outcome) -> None:
        super().__init__(outcome.work.step.name)
        self.outcome = outcome


def refuse_taints(outcome: Outcome) -> None:
    """Taint the code of a step that used something its key does not cover; warn of it, and raise
    `TaintedRun`.

    A step whose code was tainted before has a private key, and the run continues.
    """
    if not outcome.taints or outcome.work.own is None:
        return
    step = outcome.work.step
    for taint in outcome.taints:
        text = (
            f"{step.name} ({step.node.path}): {WORDS[taint.kind]} {taint.what}, which its cache key"
            " does not cover"
        )
        say_once(
            step.node.fn.__module__,
            f"{text}: its result, and all that follow, are not stored."
            f" {taint.fix[0].upper()}{taint.fix[1:]}",
        )
    if taint_code(tainted_modules(outcome.work.own, outcome.taints), outcome.taints):
        raise TaintedRun(outcome)


# --- execution ------------------------------------------------------------------------------------

# Execution of one run: the keys of the steps, the values that are loaded or computed, and the
# records.
#
# No function is recursive over the graph. Values are kept by key: two steps with the same key are
# computed once. A step that is left out has the key of its input.


#: time (s) of a step below which two processes may both compute it, without a lease
_UNLOCKED_SECONDS = 1e-3


@dataclass(frozen=True, slots=True)
class RunRequest:
    """The results that a run must return, and the executor and the store that it uses."""

    recipe: Recipe
    outputs: tuple[str, ...]  #: steps whose values the run must return
    store: Store
    devices: list[str]  #: the preferred device comes first
    memory: int | None  #: bytes that this process, and each GPU, may use; None: the free memory
    executor: Executor | None  #: None for this process
    watch: Callable[[Event], None]  #: called when a step begins and when it ends
    show: Show  #: called with each computed result


class Execution:
    """State of a run in progress: keys of the steps, values in memory, and records of finished
    steps.
    """

    def __init__(
        self,
        request: RunRequest,
        series: RunSeries,
        carried: Mapping[str, Outcome],
        anew: Collection[str],
    ) -> None:
        recipe, store = request.recipe, request.store
        self.recipe, self.store, self.devices = recipe, store, request.devices
        self.watch, self.show = request.watch, request.show
        self.wanted = frozenset(request.outputs)
        self.own = Local(
            request.devices, store, self._fetch, request.memory, nodes_of(recipe, self.wanted)
        )
        self.executor = request.executor or self.own
        self.series = series
        self.code, self.began = series.known_keys.code, time.time()
        self._carried = carried  # outcomes of an earlier attempt, by step
        # keys of steps that are computed although the store has their results
        self._anew = set[Key]()
        self._asked_anew = dependents(recipe, anew) if anew else frozenset[str]()
        self.keys: dict[str, Key] = {}
        self.makers: dict[Key, Step] = {}  # the first step of each key
        self.origins: dict[Key, dict[str, Any]] = {}  # the parts of each key
        self.values = ValuesInMemory(store, self.own.later)
        self.facts: dict[Key, TensorStats | None] = {**self.series.facts}
        # time (s) to obtain again a value that was computed in this run
        self.again: dict[Key, float] = {}
        self.took: dict[str, float] = {}  # longest time (s) of a step of each node
        self.verdicts, self.ledger = dict[str, SkipDecision](), ErrorBudget(recipe)
        # records of finished steps, and of steps that did not run
        self.done, self._unneeded_records = dict[str, StepRecord](), dict[str, StepRecord]()
        self.receipts: dict[Key, dict[str, Any]] = {}  # metadata of values that were not kept
        self.costs: Costs | None = None
        # predicted costs of the steps that are being computed
        self.expected: Mapping[Key, Estimate] = {}
        self.schedule: Schedule | None = None

    def resolve(self, order: list[str]) -> None:
        """Compute the cache key of every step; leave out each step whose effect is within the
        tolerance.
        """
        for name in order:
            step = self.recipe.steps[name]
            if step.node.hooks.skip_bound is not None:
                # a step that may be left out: if it is, its result is that of another step
                verdict = self.verdicts[name] = self.ledger.verdict(
                    step, step.params, self._facts_of
                )
                if verdict.left_out:
                    key = self.keys[name] = self.keys[verdict.instead]
                    self._finish(
                        StepRecord(name, "left out", verdict.why, 0.0, key, bound=verdict.bound)
                    )
                    continue
            else:
                # the error bounds of its inputs determine that of its result
                self.ledger.pass_on(step)
            try:
                # a key depends on the kind of device where the step draws random numbers
                device = places(step, self.devices)[0]
                key, origin = self.series.known_keys.of(step, self.keys, self.recipe.seed, device)
            except (OSError, LookupError, TypeError) as error:
                raise RunError(step, [], error) from error
            self.keys[name] = key
            # computed although the store may have its result
            if name in self._asked_anew:
                self._anew.add(key)
            # the first of several steps with the same key computes the value
            if key not in self.makers:
                self.makers[key], self.origins[key] = step, origin
                # an earlier attempt may have computed its value
                self._take_over(name, key, origin)

    def _take_over(self, name: str, key: Key, origin: dict[str, Any]) -> None:
        """Use the value that an earlier attempt computed but could not store, if parameters and
        inputs are the same.
        """
        earlier_outcome = self._carried.get(name)
        if earlier_outcome is None or earlier_outcome.value is None:  # a worker sends no value
            return
        if any(
            # the digest of the code is not compared: it changed only because the code was tainted
            earlier_outcome.work.origin[origin_part] != origin[origin_part]
            for origin_part in ("params", "inputs")
        ):
            return
        outcome = replace(
            earlier_outcome, work=replace(earlier_outcome.work, key=key, origin=origin)
        )
        self.values.add(outcome)
        self.facts[key] = outcome.facts
        self.again[key] = outcome.seconds + outcome.work.refetch_seconds
        # it counts as a step that ran in this run
        self._finish(ran(outcome, "not stored", self._bound(name), self.began, None))

    def make(self, targets: list[Key], keep: bool, later: Sequence[Key] = ()) -> None:
        """Load the values with the cache keys ``targets`` that are stored, and compute the others.

        Values that the keys ``later`` need stay in memory, and with ``keep`` also each value that
        is not stored.
        """
        while True:
            upstream = Upstream(self.known, self.sources)
            order = in_order(upstream, targets)
            try:
                plan = [key for key in order if key in upstream.missing]
                # number of reads of each value that are still to come
                uses = uses_of(plan, [*targets, *later], upstream.knows, self.sources)
                return self._execute(plan, targets, keep, uses, asked=not (keep or later))
            # a stored value is damaged or was removed: the next plan counts it as missing
            except InputMissing:
                continue

    def close(self) -> None:
        """Save the digests of code and finish all writes. Delete the values and the executor, which
        refers back to this object.
        """
        self.series.keep(self.facts, self.makers)
        self.code.save()
        # finishes the writes too
        self.own.cancel()
        self.values.clear()
        del self.own, self.executor

    def account(self, order: list[str]) -> dict[str, StepRecord]:
        """Return the record of every step in running order; create records for the steps that
        did not run.
        """
        for name in order:
            if name in self.done:
                continue
            key = self.keys[name]
            record_of_key = self.done.get(self.makers[key].name)
            # neither this step nor another with the same key had to run
            if record_of_key is None or record_of_key.state == "not needed":
                self._finish(self.record_of_unneeded(name))
            else:
                self._finish(
                    replace(
                        record_of_key,
                        step=name,
                        state="cached",
                        why=f"the same key as {record_of_key.step}",
                        seconds=0.0,
                    )
                )
        return {name: self.done[name] for name in order}

    def record_of_unneeded(self, name: str) -> StepRecord:
        """Return the record of a step whose value no other step needed."""
        if name not in self._unneeded_records:
            key = self.keys[name]
            metadata = (
                self.store.about(key)
                if self.recipe.steps[name].node.hooks.approximation_error
                else None
            )
            self._unneeded_records[name] = unneeded(name, key, metadata, self._bound(name))
        return self._unneeded_records[name]

    def missing(self, names: Iterable[str]) -> set[Key]:
        """Return the cache keys of all values that must be computed to obtain the results of the
        steps ``names``.
        """
        upstream = Upstream(self.known, self.sources)
        # the walk looks up every value in `upstream`, which notes the missing ones
        in_order(upstream, [self.keys[name] for name in names])
        return set(upstream.missing)

    def sources(self, key: Key) -> list[Key]:
        return [self.keys[name] for name in self.makers[key].sources]

    def known(self, key: Key) -> bool:
        """Return True if a value is in memory or in the store. Remember the metadata of a value
        that was not stored.
        """
        if key in self.values:
            return True
        metadata = None if key in self._anew else self.store.about(key)
        # without "kept" the value is stored
        if metadata is None or metadata.get("kept", True):
            return metadata is not None
        self.receipts[key] = metadata
        return False

    def _reading(self, key: Key) -> float:
        """Return the predicted time (s) for reading a stored value, or infinity if the value is
        not stored.
        """
        metadata = self.store.about(key)
        # metadata without a size belong to an evicted value
        return self.store.read_seconds(metadata.get("bytes") or 0) if metadata else float("inf")

    def _execute(
        self,
        plan: list[Key],
        targets: list[Key],
        keep: bool,
        uses: Counter[Key],
        asked: bool,
    ) -> None:
        """Compute the values with the keys ``plan``, and then load the ``targets``.

        ``uses`` counts the reads of each value that are still to come; a value without any is
        deleted. ``asked``: the user requested the targets.
        """
        self.values.free(list(self.values), uses, keep)
        for keys, executor in self._by_executor(plan):
            keys_of_others = [key for key in plan if key not in keys]
            # values that later steps, or steps in another process, read must be kept for them
            read_by_others = set[Key]().union(*map(self.sources, keys_of_others))
            for outcome in self._outcomes(keys, {*targets, *read_by_others}, asked, executor):
                key, sources = outcome.work.key, outcome.work.sources
                if outcome.value is not None or not outcome.kept:
                    self.values.add(outcome)
                    self.show(self.recipe, self.keys, outcome.work.step.name, outcome.value)
                uses.subtract(sources)
                self.values.free([*sources, key], uses, keep)
        for key in targets:
            self._fetch(key)

    def _by_executor(self, plan: list[Key]) -> list[tuple[list[Key], Executor]]:
        """Return the keys of the steps that other processes may compute, and then of those whose
        results are valid in this process only; each with its executor.
        """
        private = [key for key in plan if self.executor is not self.own and is_private(key)]
        public = [key for key in plan if key not in private]
        # a group without steps is left out
        return [group for group in ((public, self.executor), (private, self.own)) if group[0]]

    def _outcomes(
        self,
        plan: list[Key],
        targets: Collection[Key],
        asked: bool,
        executor: Executor,
    ) -> Iterator[Outcome]:
        """Compute the values with the keys ``plan`` and yield each outcome; after an error no
        further step begins.
        """
        prepared = self._prepared(plan, targets, asked, executor)
        self.schedule = joined(self.schedule, prepared.schedule)
        # on a cluster a chain of steps goes to one worker
        chains = chains_of(prepared.works, fused=not executor.shares)
        if not executor.shares:  # values for other chains must be in the store
            chains = [(*chain[:-1], replace(chain[-1], wanted=True)) for chain in chains]
        self.expected = prepared.expected
        has_room = room_for(prepared.expected, executor, self.values)
        try:
            for outcome in Loop(chains, executor, self._begin, has_room).outcomes():
                self._note(outcome)
                yield outcome
        # Ctrl-C too: no job may be left running
        except BaseException:
            executor.cancel()
            raise

    def _prepared(
        self, plan: list[Key], targets: Collection[Key], asked: bool, executor: Executor
    ) -> Prepared:
        """Return the scheduled jobs that compute the values with the keys ``plan``; raise
        `RunError` if the memory is too small.
        """
        self.costs = self.costs or past_costs(
            self.store, sizes_of(self.recipe, needed(self.recipe, self.wanted))
        )
        # a small target stays in memory until it is read; a result that the user requested is kept
        # whatever its size
        threshold = 0.0 if asked else small_result(executor)
        large_targets = {
            key for key in targets if self.costs.size_of(self.makers[key].name) >= threshold
        }
        jobs = [self._work(key, key in large_targets, executor) for key in plan]
        try:
            return prepare(jobs, self.costs, self.receipts, executor.lanes, targets, self.values)
        except TooLarge as error:
            raise RunError(self.recipe.steps[error.task], [], error) from error

    def _work(self, key: Key, target: bool, executor: Executor) -> StepJob:
        """Return the job of the step that computes the value ``key``; if ``target``, its result is
        kept whatever its cost.
        """
        step = self.makers[key]
        reads = tuple(self._read(step.wires.get(name)) for name in step.node.inputs)
        device, lanes = places(step, self.devices)[0], executor.lanes
        # with several lanes, the plan decides
        lane = next(iter(lanes)) if len(lanes) == 1 else ""
        is_requested, name, seed = (
            target or step.name in self.wanted,
            self.recipe.name,
            self.recipe.seed,
        )
        job = StepJob(
            step,
            key,
            self.origins[key],
            reads,
            seed,
            name,
            device,
            lane,
            is_requested,
            recompute=key in self._anew,
        )
        return replace(job, own=own_code(step, self.code))

    def _read(self, wire: Wire) -> Read:
        """Return the key of the value that an input is connected to, a tuple of keys for a list of
        steps, or None.
        """
        return (
            self.keys[wire]
            if isinstance(wire, str)
            else wire and tuple(self.keys[name] for name in wire)
        )

    def _begin(self, work: StepJob) -> StepJob:
        """Report that a job begins; return the job with the predicted time for obtaining its
        inputs again.
        """
        self.watch(Event(work.step.name, None))
        # time (s): a value of this run may have to be computed again, other values are read
        refetch = sum(
            self.again[key] if key in self.again else self._reading(key)
            for key in set(work.sources)
        )
        return replace(
            # a quick step needs no lease: computing it twice costs less
            work,
            refetch_seconds=refetch,
            unlocked=self._probable_seconds(work) < _UNLOCKED_SECONDS,
        )

    def _probable_seconds(self, work: StepJob) -> float:
        """Return the time (s) of a job, as measured for its node in this run, or as predicted."""
        path, estimate = work.step.node.path, self.expected[work.key]
        if path in self.took:
            return self.took[path]
        return estimate.seconds["cpu"] if estimate.known else _UNLOCKED_SECONDS

    def _note(self, outcome: Outcome) -> None:
        """Record the outcome of a step, or raise the error in this outcome."""
        job, step, key = outcome.work, outcome.work.step, outcome.work.key
        if outcome.lost:
            # `make` plans again, without the lost values
            raise InputMissing(*outcome.lost)
        if outcome.error is not None:
            raise (
                outcome.error
                if isinstance(outcome.error, RunError)
                else RunError(step, [], outcome.error)
            )
        if outcome.found:
            self._finish(self._cached(key, "another process computed this result"))
            return
        refuse_taints(outcome)
        self._anew.discard(key)
        self.facts[key] = outcome.facts
        path = step.node.path
        self.took[path] = max(outcome.seconds, self.took.get(path, 0.0))
        compute_seconds = outcome.seconds + job.refetch_seconds
        # time to obtain the value again: read it, or compute it with its inputs
        self.again[key] = (
            self.store.read_seconds(outcome.bytes) if outcome.kept else compute_seconds
        )
        self._finish(
            ran(
                outcome,
                self._why(step.name, key),
                self._bound(step.name),
                self.began,
                self.expected[key],
            )
        )

    def _fetch(self, key: Key) -> Any:
        """Return a value from memory or from the store; raise `InputMissing` if neither has the
        value.
        """
        if key not in self.values:
            began = time.perf_counter()
            try:
                self.values[key] = self.store.get(
                    key, self.makers[key].node.hints.get("return", Any)
                )
            except KeyError:
                raise InputMissing(key) from None
            # the value was loaded, and not computed in this run
            if self.makers[key].name not in self.done:
                self._finish(self._cached(key, seconds=time.perf_counter() - began))
        return self.values[key]

    def _cached(self, key: Key, why: str = "", seconds: float = 0.0) -> StepRecord:
        """Return the record of a step whose result is stored; raise `InputMissing` if it is not."""
        metadata = self.store.about(key)
        if metadata is None:
            raise InputMissing(key)
        name = self.makers[key].name
        return loaded(name, key, metadata, self._bound(name), why, seconds)

    def _facts_of(self, name: str) -> TensorStats | None:
        """Return the statistics of the result of a step; compute the result if no statistics are
        known.
        """
        key, stats = self.keys[name], self.known_facts(name)
        if stats is None and key not in self.facts:
            self.make([key], keep=True)
        return stats or self.known_facts(name)

    def known_facts(self, name: str) -> TensorStats | None:
        """Return the statistics of the result of a step, from this run or from an earlier run."""
        key = self.keys[name]
        if (
            key not in self.facts
            and key not in self._anew
            and (metadata := self.store.about(key)) is not None
        ):
            self.facts[key] = facts_in(metadata)
        return self.facts.get(key)

    def _why(self, name: str, key: Key) -> str:
        """Return the reason why a step ran: its result was not stored, and why it was not left
        out.
        """
        reason = "faster to compute than to store" if key in self.receipts else "not in the store"
        return f"{reason}; {self.verdicts[name].why}" if name in self.verdicts else reason

    def _bound(self, name: str) -> float | None:
        """Return the error bound for leaving a step out, or None for a step that cannot be left
        out.
        """
        return self.verdicts[name].bound if name in self.verdicts else None

    def _finish(self, done: StepRecord) -> None:
        """Keep the record of a step, and report it."""
        self.done[done.step] = done
        self.watch(Event(done.step, done))
