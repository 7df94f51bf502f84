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

#: size (bytes) below which a result that only a decision needs is stored only if this saves time
_SMALL = 1 << 23
_HELD = 256  #: number of such results that must fit into the memory of a run
MOST_PARTS = 64  #: upper bound on the parts of a step


@dataclass(frozen=True, slots=True)
class Prepared:
    """Scheduled jobs of a run in the order of their start, with their predicted costs and the
    schedule.
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

    ``in_memory``: keys of values that are in memory already. Other values that no job
    computes are read.
    """
    kinds = sorted({lane.kind for lane in lanes.values()} | {"cpu"})
    expected = costs.in_turn(((w.key, w.step, abouts.get(w.key)) for w in works), kinds)
    read_bytes: dict[Key, float] = {}
    for job in works:
        for name, key in zip(job.step.sources, job.sources, strict=True):
            if key not in expected:
                read_bytes[key] = 0.0 if key in in_memory else costs.size_of(name)
    try:
        return _scheduled(works, expected, lanes, keep, read_bytes)
    except TooLarge as error:
        # the message includes the memory of the program itself
        raise error.with_program(lanes[error.device].held) from error


def _scheduled(
    works: Sequence[StepJob],
    expected: Mapping[Key, Estimate],
    lanes: Mapping[str, Lane],
    keep: Collection[Key],
    read: Mapping[Key, float],
) -> Prepared:
    """Return the jobs with their devices; ``read`` has the size (bytes) of each value that is read
    from the store.
    """
    first_lane, lane = next(iter(lanes.items()))
    for job in works:
        if expected[job.key].peak == math.inf:
            raise TooLarge(job.step.name, first_lane, math.inf, lane.memory)
    # one device needs no placement, unless steps must be cut into parts
    if len(lanes) == 1:
        sequential = _one_after_another(works, expected, first_lane, keep, read)
        if sequential.peak[first_lane] <= lane.memory:
            jobs = [job if job.lane else replace(job, lane=first_lane) for job in works]
            return Prepared(jobs, expected, sequential)
    return _shared_out(works, expected, lanes, keep, read)


def _shared_out(
    works: Sequence[StepJob],
    expected: Mapping[Key, Estimate],
    lanes: Mapping[str, Lane],
    keep: Collection[Key],
    read: Mapping[Key, float],
) -> Prepared:
    """Return the jobs on the devices that finish them earliest within the memory."""
    job_of_step = {job.step.name: job for job in works}
    names = {job.key: job.step.name for job in works}
    tasks = [_task(job, expected[job.key], lanes, names, read) for job in works]
    cluster = Cluster(tuple(Device(name, lane.kind, lane.memory) for name, lane in lanes.items()))
    schedule = heft(tasks, cluster, [names[key] for key in keep if key in names])
    slots = sorted(schedule.slots, key=lambda slot: (slot.start, slot.end))
    return Prepared(
        [_placed(job_of_step[slot.task], slot, lanes) for slot in slots], expected, schedule
    )


def room_for(
    expected: Mapping[Key, Estimate], executor: Executor, values: Mapping[Key, Any]
) -> MemoryProfile:
    """Return a function that returns True if one more job fits into memory, beside the running jobs
    and ``values``.
    """

    def room(work: StepJob, running: Sequence[StepJob]) -> bool:
        pool = pool_of(work.device)
        beside_jobs = [w for w in running if pool_of(w.device) == pool]
        # on a cluster each worker has its own memory
        if not beside_jobs or not executor.shares:
            return True
        held_bytes = sum(
            t.nbytes for t in tensors_in(list(values.values())) if pool_of(str(t.device)) == pool
        )
        needed_bytes = sum(expected[w.key].peak for w in (work, *beside_jobs))
        return held_bytes + needed_bytes <= sum(
            lane.memory for lane in executor.lanes.values() if pool_of(lane.device) == pool
        )

    return room


def small_result(executor: Executor) -> float:
    """Return the size (bytes) below which a result may stay in memory until it is read; 0 if values
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
    cpu_lanes = {name: lane for name, lane in lanes.items() if lane.kind == "cpu"}
    peaks = schedule.peak if schedule else {}
    return max((lane.held for lane in cpu_lanes.values()), default=0.0) + sum(
        peaks.get(name, 0.0) for name in cpu_lanes
    )


def joined(first: Schedule | None, then: Schedule | None) -> Schedule | None:
    """Join two schedules: the schedule ``then`` begins when the schedule ``first`` ends."""
    if first is None or then is None:
        return first or then
    delay = first.makespan
    # all times of the second schedule are shifted by this delay
    slots = (replace(slot, start=slot.start + delay, end=slot.end + delay) for slot in then.slots)
    moves = (
        replace(m, start=m.start + delay, end=m.end + delay, until=m.until + delay)
        for m in then.moves
    )
    peak = {
        name: max(first.peak.get(name, 0.0), then.peak.get(name, 0.0))
        for name in {**first.peak, **then.peak}
    }
    transferred = first.transferred + then.transferred
    return Schedule(
        (*first.slots, *slots), delay + then.makespan, peak, transferred, (*first.moves, *moves)
    )


def _placed(work: StepJob, slot: Slot, lanes: Mapping[str, Lane]) -> StepJob:
    """Return a job with the device and the number of parts that the plan assigns to it."""
    device = "cpu" if _cpu_only(work) else lanes[slot.device].device
    return replace(work, lane=slot.device, device=device, parts=slot.parts)


def _task(
    work: StepJob,
    estimate: Estimate,
    lanes: Mapping[str, Lane],
    names: Mapping[Key, str],
    read: Mapping[Key, float],
) -> Task:
    """Return the task of a job for the plan: name, sources, seconds by device, size of the result,
    further memory, and number of parts.
    """
    seconds = _seconds_by_lane(work, estimate, lanes)
    sources = tuple(dict.fromkeys(names[key] for key in work.sources if key in names))
    # including inputs that are read from the store
    working_bytes = estimate.work + sum(read[key] for key in set(work.sources) if key in read)
    return Task(
        work.step.name,
        sources,
        seconds,
        estimate.bytes,
        working_bytes,
        parts_of(work.step, estimate),
    )


def _seconds_by_lane(
    work: StepJob, estimate: Estimate, lanes: Mapping[str, Lane]
) -> dict[str, float]:
    """Return the predicted time (s) of a job on each device that may compute it."""
    if _cpu_only(work):
        cpu_lanes = [name for name, lane in lanes.items() if lane.kind == "cpu"]
        # without a lane on the CPU, the thread of a GPU lane computes on the CPU
        return dict.fromkeys(cpu_lanes or lanes, estimate.seconds["cpu"])
    allowed = places(work.step, [lane.device for lane in lanes.values()])
    allowed_lanes = {name: lane for name, lane in lanes.items() if lane.device in allowed}
    return {name: estimate.seconds[lane.kind] for name, lane in allowed_lanes.items()}


def parts_of(step: Step, estimate: Estimate) -> int:
    """Return the largest number of parts into which a step may be cut by band."""
    return min(estimate.bands or MOST_PARTS, MOST_PARTS) if step.node.bands else 1


def _cpu_only(work: StepJob) -> bool:
    """Return True if a job must run on the CPU, because of a device hint or because its random
    stream is that of the CPU.
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
    last_reader: dict[Key, Key] = {}
    for job in works:
        last_reader.update(dict.fromkeys(job.sources, job.key))
    start, held_bytes, peak_bytes, slots = 0.0, 0.0, 0.0, []
    for job in works:
        cost = expected[job.key]
        new_keys = {*job.sources, job.key} - in_memory
        in_memory |= new_keys
        # size of the inputs that are loaded now, and of the result
        held_bytes += sum(sizes[key] for key in new_keys)
        peak_bytes = max(peak_bytes, held_bytes + cost.work)
        ended_keys = {
            key
            for key in (*job.sources, job.key)
            # a value that no job reads is freed after its own job
            if last_reader.get(key, job.key) == job.key and key not in keep
        }
        held_bytes -= sum(sizes[key] for key in ended_keys)
        slots.append(
            Slot(job.step.name, lane, start, start + cost.seconds[device_kind(job.device)], 1)
        )
        start = slots[-1].end
    return Schedule(tuple(slots), start, {lane: peak_bytes}, 0.0)


def past_costs(store: Store, sizes: Mapping[str, Size]) -> Costs:
    """Return the costs of steps with the given sizes, learned from the newest lines of the journal
    of a result store.

    A process reads each line only once, so that the time of a run does not grow with the
    number of earlier runs.
    """
    rows = store.journal.latest()
    rows_read, learned, costs = _read.get(store.journal, (rows, 0, Costs([])))
    if rows_read is not rows or learned > len(rows):  # the journal was started again
        learned, costs = 0, Costs([])
    # the lines added since the last call
    costs.learn(rows[learned:])
    _read[store.journal] = rows, len(rows), costs
    return costs.with_sizes(sizes)


#: for each journal: the lines that were read, their number, and the costs learned from them
_read: WeakKeyDictionary[Journal, tuple[list[Row], int, Costs]] = WeakKeyDictionary()
