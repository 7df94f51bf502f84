"""Dispatch of jobs: each job is submitted when its inputs are ready, and its outcome is
collected.
"""

from __future__ import annotations

import itertools
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

from neusee.workflows.engine.step_job import Executor, Outcome, StepJob
from neusee.workflows.keys.cache_key import Key, device_kind

_FIRST_PAUSE, _LONGEST_PAUSE = (
    0.01,
    0.5,
)  #: pauses (s) between attempts at a job that another process computes

Chain = tuple[StepJob, ...]  #: jobs of which each feeds only the next job
#: a function that returns True if the memory suffices for one more step beside the running steps
MemoryProfile = Callable[[StepJob, Sequence[StepJob]], bool]


class Loop:
    """Progress of a run: chains of jobs that wait for inputs, ready chains, and the chain that each
    device computes.
    """

    def __init__(
        self,
        chains: Sequence[Chain],
        executor: Executor,
        begin: Callable[[StepJob], StepJob],
        room: MemoryProfile,
    ) -> None:
        self.executor, self.begin, self.room = executor, begin, room
        self.busy: dict[str, Chain] = {}  # by device or worker: the chain that it computes
        self._chain_of: dict[Key, int] = {}
        for i, chain in enumerate(chains):
            self._chain_of.update({job.key: i for job in chain})
        self._chains = list(chains)
        # for each chain, the keys of the values of other chains that it waits for
        self._missing = [self._outside(chain) for chain in chains]
        # for each value, the chains that wait for it
        self._after: dict[Key, list[int]] = {}
        for i, missing in enumerate(self._missing):
            for key in missing:
                self._after.setdefault(key, []).append(i)
        self._ready = [i for i, missing in enumerate(self._missing) if not missing]
        self._ready.reverse()  # the next chain is the last item, which a list can remove fastest
        # chains that another process computes: time of the next attempt, and the last pause
        self._held: dict[int, tuple[float, float]] = {}
        self._open = len(chains)  # chains that are not done

    def outcomes(self) -> Iterator[Outcome]:
        """Yield the outcome of each job when it arrives, until all jobs are done; the outcome of a
        failed job contains the error.
        """
        while self._open:
            self._hand_out()
            if not self.busy and not self._held:
                name = (
                    self._chains[self._ready[-1]][0].step.name
                    if self._ready
                    else "the remaining steps"
                )
                raise RuntimeError(f"no device or worker is left to compute {name}")
            for outcome in self.executor.wait(self._patience()):
                self._settle(outcome)
                # a result that another process computes is tried again later, and yielded then
                if not outcome.held:
                    yield outcome

    def _outside(self, chain: Chain) -> set[Key]:
        """Return the keys of the values that a chain of jobs reads from other chains of the same
        run.
        """
        own_keys = {job.key for job in chain}
        read_keys = set[Key]().union(*(job.sources for job in chain))
        return {key for key in read_keys if key in self._chain_of and key not in own_keys}

    def _hand_out(self) -> None:
        """Submit to every idle device or worker the next ready chain of jobs that may run there."""
        self._make_due_chains_ready()
        for lane, lane_state in self.executor.lanes.items():
            if lane in self.busy or not self._ready:
                continue
            ready_index = self._first_for(lane, lane_state.device)
            if ready_index is not None:
                chain = self._chains[self._ready.pop(ready_index)]
                # the chain was planned for another device or worker
                if chain[0].lane != lane:
                    chain = tuple(_moved(job, lane, lane_state.device) for job in chain)
                chain = self.busy[lane] = (self.begin(chain[0]), *chain[1:])
                self.executor.submit(chain)

    def _first_for(self, lane: str, device: str) -> int | None:
        """Return the index of the next ready chain of jobs that the device or worker ``lane`` may
        compute, or None.

        A chain of another lane may move to ``lane`` if the other lane is busy or lost.
        """
        running = list(itertools.chain.from_iterable(self.busy.values()))
        lanes = self.executor.lanes
        # the list is in reverse order: the next chain is last
        for ready_index in range(len(self._ready) - 1, -1, -1):
            chain = self._chains[self._ready[ready_index]]
            planned_lane = chain[0].lane
            # a device of the same kind may compute it, if its own is busy or lost
            may_move = (planned_lane in self.busy or planned_lane not in lanes) and device_kind(
                chain[0].device
            ) == device_kind(device)
            if (planned_lane == lane or may_move) and (not running or self.room(chain[0], running)):
                return ready_index
        return None

    def _make_due_chains_ready(self) -> None:
        """Make those chains ready whose pause is over."""
        present_time = time.monotonic()
        for chain_index in [
            chain_index
            for chain_index, (attempt_time, _) in self._held.items()
            if attempt_time <= present_time
        ]:
            self._ready.append(chain_index)
            # no further attempt until this one has its outcome; the pause is kept to double it
            self._held[chain_index] = (float("inf"), self._held[chain_index][1])

    def _patience(self) -> float | None:
        """Return the time (s) to wait for running jobs; None means no limit. If only other
        processes compute, sleep for this time first.
        """
        attempt_times = [
            attempt_time for attempt_time, _ in self._held.values() if attempt_time < float("inf")
        ]
        if not attempt_times:
            return None
        pause = max(0.0, min(attempt_times) - time.monotonic())
        if not self.busy:
            time.sleep(pause)
        return pause

    def _settle(self, outcome: Outcome) -> None:
        """Mark the device of a finished job as idle, and the chains that waited only for its
        result as ready.
        """
        key = outcome.work.key
        chain_index = self._chain_of[key]
        is_last = key == self._chains[chain_index][-1].key
        # in each of these cases no later job of the chain runs on the device
        if outcome.held or is_last or outcome.error or outcome.lost:
            self.busy.pop(outcome.work.lane, None)
        if outcome.held:
            self._hold(chain_index, key)
            return
        if is_last:
            self._open -= 1
            self._held.pop(chain_index, None)
        self._free_waiting(key)

    def _free_waiting(self, key: Key) -> None:
        """Mark the chains that waited only for a result as ready."""
        waiting_chains = self._after.pop(key, ())
        for i in waiting_chains:
            self._missing[i].discard(key)
        freed_chains = [i for i in waiting_chains if not self._missing[i]]
        self._ready += freed_chains
        if len(self.executor.lanes) > 1 or freed_chains:
            # the list is in reverse order: the next chain is last
            self._ready.sort(reverse=True)

    def _hold(self, i: int, key: Key) -> None:
        """Postpone a chain, from the job that another process computes, with twice the previous
        pause.
        """
        chain = self._chains[i]
        # the first pause is `_FIRST_PAUSE`: twice the half of it
        pause = min(_LONGEST_PAUSE, 2 * self._held.get(i, (0.0, _FIRST_PAUSE / 2))[1])
        self._held[i] = (time.monotonic() + pause, pause)
        # the jobs before this one are done
        self._chains[i] = chain[[job.key for job in chain].index(key) :]


def chains_of(works: Sequence[StepJob], fused: bool) -> list[Chain]:
    """Group jobs into chains: single jobs, or if ``fused``, jobs on one device of which each feeds
    only the next job.
    """
    if not fused:
        return [(job,) for job in works]
    readers = Counter(itertools.chain.from_iterable(set(job.sources) for job in works))
    planned = {job.key for job in works}
    chains: dict[Key, list[StepJob]] = {}  # by the key of the last job
    for job in works:
        # a job joins a chain if it reads exactly one planned result, which no other job reads
        planned_sources = list(planned.intersection(job.sources))
        is_only_reader = len(planned_sources) == 1 and readers[planned_sources[0]] == 1
        chain = chains.get(planned_sources[0]) if is_only_reader else None
        if chain and _continues(chain, job):
            del chains[planned_sources[0]]
            chains[job.key] = [*chain, job]
        else:
            chains[job.key] = [job]
    return _in_order_of_first_jobs(chains.values(), works)


def _in_order_of_first_jobs(
    chains: Iterable[list[StepJob]], works: Sequence[StepJob]
) -> list[Chain]:
    """Return the chains, sorted by the position of their first jobs in ``works``."""
    position = {job.key: i for i, job in enumerate(works)}
    return sorted(map(tuple, chains), key=lambda chain: position[chain[0].key])


def _continues(chain: Sequence[StepJob], work: StepJob) -> bool:
    """Return True if a job runs on the device of a chain and the last result of the chain is not
    requested itself.
    """
    return not chain[-1].wanted and chain[-1].lane == work.lane


def _moved(work: StepJob, lane: str, device: str) -> StepJob:
    """Assign a job to another device or worker and return the job; a job that needs the CPU
    still uses the CPU.
    """
    return replace(
        work,
        lane=lane,
        device=device if device_kind(work.device) == device_kind(device) else work.device,
    )
