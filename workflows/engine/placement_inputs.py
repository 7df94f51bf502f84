"""Inputs of the placement of steps on devices: predicted costs, possible devices and memory."""

from __future__ import annotations

import math
from collections.abc import Collection, Container, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any
from weakref import WeakKeyDictionary

from neusee.workflows.engine.cost_model import Costs, Estimate, Size
from neusee.workflows.engine.dispatch import MemoryProfile
from neusee.workflows.engine.machine_resources import pool_of
from neusee.workflows.engine.node_call import places
from neusee.workflows.engine.step_job import Executor, Lane, StepJob
from neusee.workflows.graph.recipe_graph import Step
from neusee.workflows.keys.cache_key import Key, device_kind
from neusee.workflows.placement.heft_schedule import (
    Cluster,
    Device,
    Schedule,
    Slot,
    Task,
    TooLarge,
    heft,
)
from neusee.workflows.store.journal import Journal, Row
from neusee.workflows.store.result_store import Store
from neusee.workflows.store.serialization import tensors_in

#: bytes below which a result that only a decision needs is stored only where this pays
_SMALL = 1 << 23
_HELD = 256  #: how many such results fit into the memory of a run
MOST_PARTS = 64  #: upper bound on the parts of a step


@dataclass(frozen=True, slots=True)
class Prepared:
    """Scheduled jobs of a run in the order in which they begin, with their predicted costs and
    the schedule.
    """

    works: list[StepJob]
    expected: Mapping[Key, Estimate]
    schedule: Schedule | None


def prepare(
    works: Sequence[StepJob],
    costs: Costs,
    abouts: Mapping[Key, Mapping[str, Any]],
    lanes: Mapping[str, Lane],
    keep: Collection[Key],
    in_memory: Container[Key] = (),
) -> Prepared:
    """Assign a device to each job of a run and schedule the jobs; raise `TooLarge` if the memory is
    too small.

    The keys ``in_memory`` are of values that are in memory already. Other values that no job
    computes are read.
    """
    kinds = sorted({lane.kind for lane in lanes.values()} | {"cpu"})
    expected = costs.in_turn(((w.key, w.step, abouts.get(w.key)) for w in works), kinds)
    read: dict[Key, float] = {}
    for work in works:
        for name, key in zip(work.step.sources, work.sources, strict=True):
            if key not in expected:
                read[key] = 0.0 if key in in_memory else costs.size_of(name)
    try:
        return _scheduled(works, expected, lanes, keep, read)
    except TooLarge as error:
        raise error.with_program(lanes[error.device].held) from error


def _scheduled(
    works: Sequence[StepJob],
    expected: Mapping[Key, Estimate],
    lanes: Mapping[str, Lane],
    keep: Collection[Key],
    read: Mapping[Key, float],
) -> Prepared:
    """Return the jobs on their devices; ``read`` has the bytes of each value that is read from
    the store.
    """
    only, lane = next(iter(lanes.items()))
    for work in works:
        if expected[work.key].peak == math.inf:
            raise TooLarge(work.step.name, only, math.inf, lane.memory)
    if len(lanes) == 1:
        plain = _one_after_another(works, expected, only, keep, read)
        if plain.peak[only] <= lane.memory:
            jobs = [work if work.lane else replace(work, lane=only) for work in works]
            return Prepared(jobs, expected, plain)
    return _shared_out(works, expected, lanes, keep, read)


def _shared_out(
    works: Sequence[StepJob],
    expected: Mapping[Key, Estimate],
    lanes: Mapping[str, Lane],
    keep: Collection[Key],
    read: Mapping[Key, float],
) -> Prepared:
    """Return the jobs on the devices where they end soonest within the memory."""
    planned = {w.step.name: w for w in works}
    names = {w.key: w.step.name for w in works}
    tasks = [_task(w, expected[w.key], lanes, names, read) for w in works]
    cluster = Cluster(tuple(Device(name, lane.kind, lane.memory) for name, lane in lanes.items()))
    schedule = heft(tasks, cluster, [names[key] for key in keep if key in names])
    slots = sorted(schedule.slots, key=lambda slot: (slot.start, slot.end))
    return Prepared(
        [_placed(planned[slot.task], slot, lanes) for slot in slots], expected, schedule
    )


def room_for(
    expected: Mapping[Key, Estimate], executor: Executor, values: Mapping[Key, Any]
) -> MemoryProfile:
    """Return a function that is True if one more job fits into memory with the running jobs and
    ``values``.
    """

    def room(work: StepJob, running: Sequence[StepJob]) -> bool:
        pool = pool_of(work.device)
        beside = [w for w in running if pool_of(w.device) == pool]
        if not beside or not executor.shares:
            return True
        held = sum(
            t.nbytes for t in tensors_in(list(values.values())) if pool_of(str(t.device)) == pool
        )
        need = sum(expected[w.key].peak for w in (work, *beside))
        return held + need <= sum(
            lane.memory for lane in executor.lanes.values() if pool_of(lane.device) == pool
        )

    return room


def small_result(executor: Executor) -> float:
    """Return the bytes below which a result may stay in memory until it is read; 0 if values
    leave this process.
    """
    return (
        min(_SMALL, *(lane.memory / _HELD for lane in executor.lanes.values()))
        if executor.shares
        else 0.0
    )


def running_peak(schedule: Schedule | None, lanes: Mapping[str, Lane]) -> float:
    """Return the predicted peak memory of this process in bytes while the steps run, over all
    lanes on the CPU.
    """
    cpu = {name: lane for name, lane in lanes.items() if lane.kind == "cpu"}
    peaks = schedule.peak if schedule else {}
    return max((lane.held for lane in cpu.values()), default=0.0) + sum(
        peaks.get(name, 0.0) for name in cpu
    )


def joined(first: Schedule | None, then: Schedule | None) -> Schedule | None:
    """Join two schedules: the schedule ``then`` begins when the schedule ``first`` ends."""
    if first is None or then is None:
        return first or then
    by = first.makespan
    slots = (replace(slot, start=slot.start + by, end=slot.end + by) for slot in then.slots)
    moves = (replace(m, start=m.start + by, end=m.end + by, until=m.until + by) for m in then.moves)
    peak = {
        name: max(first.peak.get(name, 0.0), then.peak.get(name, 0.0))
        for name in {**first.peak, **then.peak}
    }
    transferred = first.transferred + then.transferred
    return Schedule(
        (*first.slots, *slots), by + then.makespan, peak, transferred, (*first.moves, *moves)
    )


def _placed(work: StepJob, slot: Slot, lanes: Mapping[str, Lane]) -> StepJob:
    device = "cpu" if _cpu_only(work) else lanes[slot.device].device
    return replace(work, lane=slot.device, device=device, parts=slot.parts)


def _task(
    work: StepJob,
    estimate: Estimate,
    lanes: Mapping[str, Lane],
    names: Mapping[Key, str],
    read: Mapping[Key, float],
) -> Task:
    seconds = _seconds_by_lane(work, estimate, lanes)
    sources = tuple(dict.fromkeys(names[key] for key in work.sources if key in names))
    beside = estimate.work + sum(read[key] for key in set(work.sources) if key in read)
    return Task(
        work.step.name, sources, seconds, estimate.bytes, beside, parts_of(work.step, estimate)
    )


def _seconds_by_lane(
    work: StepJob, estimate: Estimate, lanes: Mapping[str, Lane]
) -> dict[str, float]:
    """Return the predicted time (s) of a job on each device that may compute it."""
    if _cpu_only(work):
        on_cpu = [name for name, lane in lanes.items() if lane.kind == "cpu"]
        return dict.fromkeys(on_cpu or lanes, estimate.seconds["cpu"])
    allowed = places(work.step, [lane.device for lane in lanes.values()])
    here = {name: lane for name, lane in lanes.items() if lane.device in allowed}
    return {name: estimate.seconds[lane.kind] for name, lane in here.items()}


def parts_of(step: Step, estimate: Estimate) -> int:
    """Return the largest number of parts into which a step may be cut by band."""
    return min(estimate.bands or MOST_PARTS, MOST_PARTS) if step.node.bands else 1


def _cpu_only(work: StepJob) -> bool:
    """Return True if a job must run on the CPU, because of a device hint or of a random stream
    for the CPU.
    """
    hint = work.step.device or work.step.node.device
    return hint == "cpu" or (work.step.node.random and work.device == "cpu")


def _one_after_another(
    works: Sequence[StepJob],
    expected: Mapping[Key, Estimate],
    lane: str,
    keep: Collection[Key],
    read: Mapping[Key, float],
) -> Schedule:
    """Return the schedule of jobs one after another on one device; each value is freed after its
    last use.
    """
    sizes = {**read, **{key: cost.bytes for key, cost in expected.items()}}
    in_memory = set[Key]()
    last: dict[Key, Key] = {}
    for work in works:
        last.update(dict.fromkeys(work.sources, work.key))
    now, held, peak, slots = 0.0, 0.0, 0.0, []
    for work in works:
        cost = expected[work.key]
        new = {*work.sources, work.key} - in_memory
        in_memory |= new
        held += sum(sizes[key] for key in new)
        peak = max(peak, held + cost.work)
        ended = {
            key
            for key in (*work.sources, work.key)
            if last.get(key, work.key) == work.key and key not in keep
        }
        held -= sum(sizes[key] for key in ended)
        slots.append(
            Slot(work.step.name, lane, now, now + cost.seconds[device_kind(work.device)], 1)
        )
        now = slots[-1].end
    return Schedule(tuple(slots), now, {lane: peak}, 0.0)


def past_costs(store: Store, sizes: Mapping[str, Size]) -> Costs:
    """Return the costs of steps with the given sizes, from the newest lines of the journal of a
    result store.

    Each line is read once in a process, so that the time that a run takes does not grow with the
    runs before it.
    """
    rows = store.journal.latest()
    read, count, costs = _read.get(store.journal, (rows, 0, Costs([])))
    if read is not rows or count > len(rows):  # the journal began anew
        count, costs = 0, Costs([])
    costs.learn(rows[count:])
    _read[store.journal] = rows, len(rows), costs
    return costs.with_sizes(sizes)


#: the lines of each journal that were read, their number, and the costs that they tell
_read: WeakKeyDictionary[Journal, tuple[list[Row], int, Costs]] = WeakKeyDictionary()
