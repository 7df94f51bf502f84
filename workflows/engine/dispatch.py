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

_FIRST_LOOK, _LONGEST = 0.01, 0.5  #: s between attempts at a job that another process computes

Chain = tuple[StepJob, ...]  #: jobs of which each feeds only the next job
#: a function that returns True if the memory suffices for one more step beside the running steps
MemoryProfile = Callable[[StepJob, Sequence[StepJob]], bool]


class Loop:
    """Progress of a run: chains of jobs that wait for inputs, chains that are ready, and the
    chain on each device.
    """

    def __init__(
        self,
        chains: Sequence[Chain],
        executor: Executor,
        begin: Callable[[StepJob], StepJob],
        room: MemoryProfile,
    ) -> None:
        self.executor, self.begin, self.room = executor, begin, room
        self.busy: dict[str, Chain] = {}
        self._chain_of: dict[Key, int] = {}
        for i, chain in enumerate(chains):
            self._chain_of.update({work.key: i for work in chain})
        self._chains = list(chains)
        self._missing = [self._outside(chain) for chain in chains]
        self._after: dict[Key, list[int]] = {}
        for i, missing in enumerate(self._missing):
            for key in missing:
                self._after.setdefault(key, []).append(i)
        self._ready = [i for i, missing in enumerate(self._missing) if not missing]
        self._ready.reverse()  # the next chain is the last item, which a list can remove fastest
        # chain -> time of the next attempt, and the wait after it
        self._held: dict[int, tuple[float, float]] = {}
        self._open = len(chains)

    def outcomes(self) -> Iterator[Outcome]:
        """Yield the outcome of each job, with the error of a failed job, when it arrives, until
        all jobs are done.
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
                if not outcome.held:
                    yield outcome

    def _outside(self, chain: Chain) -> set[Key]:
        """Return the keys of the values that a chain of jobs reads from other chains of the same
        run.
        """
        own = {work.key for work in chain}
        read = set[Key]().union(*(work.sources for work in chain))
        return {key for key in read if key in self._chain_of and key not in own}

    def _hand_out(self) -> None:
        """Submit to every idle device or worker the first ready chain of jobs that may run
        there.
        """
        self._look_again()
        for lane, where in self.executor.lanes.items():
            if lane in self.busy or not self._ready:
                continue
            place = self._first_for(lane, where.device)
            if place is not None:
                chain = self._chains[self._ready.pop(place)]
                if chain[0].lane != lane:
                    chain = tuple(_moved(work, lane, where.device) for work in chain)
                chain = self.busy[lane] = (self.begin(chain[0]), *chain[1:])
                self.executor.submit(chain)

    def _first_for(self, lane: str, device: str) -> int | None:
        """Return the index of the next ready chain of jobs that the device or worker ``lane`` may
        compute, or None.

        A chain of another lane may move to ``lane`` if the other lane is busy or lost.
        """
        running = list(itertools.chain.from_iterable(self.busy.values()))
        lanes = self.executor.lanes
        for place in range(len(self._ready) - 1, -1, -1):
            chain = self._chains[self._ready[place]]
            own = chain[0].lane
            moved = (own in self.busy or own not in lanes) and device_kind(
                chain[0].device
            ) == device_kind(device)
            if (own == lane or moved) and (not running or self.room(chain[0], running)):
                return place
        return None

    def _look_again(self) -> None:
        now = time.monotonic()
        for i in [i for i, (when, _) in self._held.items() if when <= now]:
            self._ready.append(i)
            self._held[i] = (float("inf"), self._held[i][1])

    def _patience(self) -> float | None:
        """Return the time (s) to wait for running jobs; if only other processes compute, first
        sleep for this time.
        """
        waits = [when for when, _ in self._held.values() if when < float("inf")]
        if not waits:
            return None
        pause = max(0.0, min(waits) - time.monotonic())
        if not self.busy:
            time.sleep(pause)
        return pause

    def _settle(self, outcome: Outcome) -> None:
        """Mark the device of a finished job as idle, and the chains that waited only for its
        result as ready.
        """
        key = outcome.work.key
        i = self._chain_of[key]
        last = key == self._chains[i][-1].key
        if outcome.held or last or outcome.error or outcome.lost:
            self.busy.pop(outcome.work.lane, None)
        if outcome.held:
            self._hold(i, key)
            return
        if last:
            self._open -= 1
            self._held.pop(i, None)
        self._free_waiting(key)

    def _free_waiting(self, key: Key) -> None:
        """Mark the chains that waited only for a result as ready."""
        waiting = self._after.pop(key, ())
        for i in waiting:
            self._missing[i].discard(key)
        freed = [i for i in waiting if not self._missing[i]]
        self._ready += freed
        if len(self.executor.lanes) > 1 or freed:
            self._ready.sort(reverse=True)

    def _hold(self, i: int, key: Key) -> None:
        """Let a chain wait, twice as long as before, from the job whose result another process
        computes.
        """
        chain = self._chains[i]
        pause = min(_LONGEST, 2 * self._held.get(i, (0.0, _FIRST_LOOK / 2))[1])
        self._held[i] = (time.monotonic() + pause, pause)
        self._chains[i] = chain[[work.key for work in chain].index(key) :]


def chains_of(works: Sequence[StepJob], fused: bool) -> list[Chain]:
    """Group jobs into chains: single jobs, or if ``fused``, jobs on one device that each feed
    only the next job.
    """
    if not fused:
        return [(work,) for work in works]
    readers = Counter(itertools.chain.from_iterable(set(work.sources) for work in works))
    planned = {work.key for work in works}
    chains: dict[Key, list[StepJob]] = {}  # by the key of the last job
    for work in works:
        above = list(planned.intersection(work.sources))
        is_alone = len(above) == 1 and readers[above[0]] == 1
        chain = chains.get(above[0]) if is_alone else None
        if chain and _continues(chain, work):
            del chains[above[0]]
            chains[work.key] = [*chain, work]
        else:
            chains[work.key] = [work]
    return _in_order_of_first_jobs(chains.values(), works)


def _in_order_of_first_jobs(
    chains: Iterable[list[StepJob]], works: Sequence[StepJob]
) -> list[Chain]:
    place = {work.key: i for i, work in enumerate(works)}
    return sorted(map(tuple, chains), key=lambda chain: place[chain[0].key])


def _continues(chain: Sequence[StepJob], work: StepJob) -> bool:
    """Return True if a job on the device of a chain reads a result that nobody else asked for."""
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
