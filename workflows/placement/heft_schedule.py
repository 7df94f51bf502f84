"""Schedule of tasks on devices by the heuristic HEFT, with memory as a hard constraint."""

from __future__ import annotations

import heapq
import math
from bisect import bisect_left, bisect_right
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain, pairwise

import numpy as np

from neusee.workflows.placement.tasks_and_devices import (
    Cluster,
    Device,
    Graph,
    Link,
    Move,
    Schedule,
    Slot,
    Task,
    TooLarge,
    frugal,
    ranked,
    upward,
)

# --- memory profile -------------------------------------------------------------------------------

# Memory profile of one device: the bytes in use by the scheduled tasks, as a function of time.


#: memory reservation: start, end (infinity if not yet known), bytes
Hold = tuple[float, float, float]


class MemoryProfile:
    """Memory in use (bytes) on a device, as a step function of time that never rises above
    ``limit``.

    The memory of a result is reserved without end until the last reader of the result is placed,
    and then only until this reader ends. Reserved memory therefore only shrinks after `wait` has
    checked it, and no later placement, not even a placement in an earlier gap, can break a
    placement that fits.
    """

    def __init__(self, limit: float) -> None:
        self.limit = limit
        self.times = [-math.inf]
        # memory in use (bytes) from each of the times on; the array may be longer than the list of
        # times
        self.level = np.zeros(64)
        self.kept = 0.0  # memory (bytes) that is reserved without end

    def add(self, start: float, end: float, size: float) -> None:
        """Reserve ``size`` bytes of memory from ``start`` until ``end``; a negative ``size``
        frees reserved bytes.
        """
        if size and start < end:
            first_interval = self._cut(start)
            # each entry is the memory of an interval between two times; the last interval has no
            # end
            self.level[first_interval : self._cut(end) if end < math.inf else len(self.times)] += (
                size
            )
            self.kept += size if end == math.inf else 0.0

    def highest(self, start: float, end: float) -> float:
        """Return the peak memory in use (bytes) in the time interval [start, end)."""
        return float(self.level[self._within(start, end)].max())

    def free(self) -> float:
        """Return the number of bytes of memory that are free after all scheduled tasks have
        ended.
        """
        return self.limit - self.kept

    def wait(self, holds: Iterable[Hold]) -> float:
        """Return the smallest delay (s) of the reservations ``holds`` that keeps the memory in
        use within the limit.
        """
        delay = 0.0
        for start, end, size in stacked(holds):
            intervals = self._within(start, end)
            levels = self.level[intervals]
            if levels.max() > self.limit - size:
                # the interval after the last one that is too full
                next_interval = (
                    intervals.start + int(np.flatnonzero(levels > self.limit - size)[-1]) + 1
                )
                delay = max(
                    delay,
                    (self.times[next_interval] if next_interval < len(self.times) else math.inf)
                    - start,
                )
        return delay

    def _within(self, start: float, end: float) -> slice:
        """Return the intervals of time that overlap [start, end), as a slice of the profile."""
        first_interval = bisect_right(self.times, start) - 1
        return slice(
            first_interval,
            len(self.times)
            if end == math.inf
            else max(bisect_left(self.times, end), first_interval + 1),
        )

    def _cut(self, time: float) -> int:
        """Return the index of the time interval that begins at ``time``; split an interval at
        ``time`` if necessary.
        """
        index, count = bisect_left(self.times, time), len(self.times)
        if index < count and self.times[index] == time:
            return index
        # double the length of the array if it is full
        if count == len(self.level):
            self.level = np.concatenate([self.level, np.zeros(count)])
        self.times.insert(index, time)
        self.level[index + 1 : count + 1] = self.level[index:count].copy()
        # the new interval has the level of the interval that was split
        self.level[index] = self.level[index - 1]
        return index


def stacked(holds: Iterable[Hold]) -> Iterator[Hold]:
    """Yield the total memory reserved by ``holds`` as consecutive time intervals with a constant
    number of bytes.
    """
    changes = defaultdict[float, float](float)
    for start, end, size in holds:
        if start < end and size:
            changes[start] += size
            changes[end] -= size
    times, bytes_now = sorted(changes), 0.0
    for start, end in pairwise(times):
        bytes_now += changes[start]
        if bytes_now > 0:
            yield start, end, bytes_now


def without(
    start: float, end: float, taken: Iterable[tuple[float, float]]
) -> Iterator[tuple[float, float]]:
    """Yield the parts of the time interval [start, end) outside the sorted, disjoint intervals
    in ``taken``.
    """
    for taken_start, taken_end in taken:
        if taken_start < end and taken_end > start:
            if start < taken_start:
                yield start, taken_start
            start = max(start, taken_end)
    if start < end:
        yield start, end


# --- partial schedule -----------------------------------------------------------------------------

# Partial schedule: the tasks placed so far, the idle times of each device, and the memory that each
# task will use.


Copy = tuple[float, float, float]  #: departure from the source, arrival, last use
#: number of the task, size of its result (bytes), number of the receiving device
Of = tuple[int, float, int]


def _most_memory(graph: Graph) -> float:
    """Return an upper bound on the memory (bytes) that any schedule uses on a device at any
    time.
    """
    task_numbers = range(len(graph.tasks))
    bytes_on_device = sum(graph.own) + max((graph.work(i, 1) for i in task_numbers), default=0.0)
    parts_sent = (graph.sizes[i] for i in task_numbers if graph.tasks[i].takes)
    return bytes_on_device + sum(
        max(0.0, math.ceil(size)) for size in chain.from_iterable(parts_sent)
    )


class PartialSchedule:
    """Unfinished schedule: a task is added after the tasks that compute its inputs, and keeps
    its device and times.
    """

    def __init__(self, graph: Graph, bounded: bool = True) -> None:
        self.graph, devices, count = graph, graph.cluster.devices, len(graph.tasks)
        # for each task, its device (-1: not placed), its number of parts, its start and its end
        self.where, self.parts = [-1] * count, [1] * count
        self.start, self.end = [0.0] * count, [0.0] * count
        # time at which the last reader placed so far has its input
        self.free_at: list[float] = [0.0] * count
        self.left = [len(readers) for readers in graph.readers]  # readers that are not placed yet
        # for each device, the starts and the ends of its idle intervals
        self.gaps: list[tuple[list[float], list[float]]] = [([0.0], [math.inf]) for _ in devices]
        # a device with at least this memory needs no profile
        largest_need = _most_memory(graph) if bounded else -math.inf
        self.rooms = [MemoryProfile(d.memory) if d.memory < largest_need else None for d in devices]
        # links between all pairs of devices; a device has no delay to itself
        self.links: list[list[Link]] = []
        for sender in devices:
            self.links.append(
                [graph.cluster.link(sender.name, receiver.name) for receiver in devices]
            )
        # least memory (bytes) of a task: its result, and its working memory in the largest allowed
        # number of parts
        self.least = [
            result_bytes + graph.work(i, graph.tasks[i].parts)
            for i, result_bytes in enumerate(graph.own)
        ]
        self.copies: dict[Of, list[Copy]] = {}  # copies of results on other devices
        self.placed: list[int] = []  # tasks in the order of their placement
        # tasks that did not fit: task, device, memory (bytes) needed there
        self.refused: list[tuple[int, int, float]] = []

    # --- where and when ---------------------------------------------------------------------------

    def place(self, i: int, among: Sequence[int]) -> bool:
        """Place task ``i`` on the device that finishes it first; return False if no device has
        enough memory.
        """
        earliest_end, best_device, best_start = math.inf, -1, 0.0
        for d in among:
            memory = self.rooms[d]
            # the memory cannot suffice, even after all earlier tasks have ended
            if memory is not None and (
                memory.free() < self.least[i] or self._needs(i, d) > memory.limit
            ):
                continue
            ready, seconds = self._ready(i, d), self.graph.seconds[i][d]
            # the task would end later here, even without waiting for the device
            if ready + seconds >= earliest_end:
                continue
            start = self._slot(i, d, ready, seconds, earliest_end)
            if start + seconds < earliest_end:
                earliest_end, best_device, best_start = start + seconds, d, start
        if best_device >= 0:
            self._commit(i, best_device, best_start, earliest_end)
        return best_device >= 0

    def gave_back(self, i: int) -> bool:
        """Return True if the placement of task ``i`` freed memory for which other tasks may be
        waiting.
        """
        return any(not self.left[j] for j in self.graph.sources[i]) or bool(self.refused)

    def force(self, i: int) -> None:
        """Place task ``i`` as if a device had enough memory for it, and record the memory that the
        task needs.
        """
        bytes_needed = {
            d: self._needs(i, d) for d in self.graph.able[i] if self.rooms[d] is not None
        }
        # the device that lacks the least memory
        d = min(
            bytes_needed, key=lambda d: (bytes_needed[d] - self.graph.cluster.devices[d].memory, d)
        )
        room = self.rooms[d]
        assert room is not None
        self.refused.append((i, d, bytes_needed[d]))
        # raise the limit to the needed memory, which the error reports
        room.limit = bytes_needed[d]
        self.place(i, [d])

    def _ready(self, i: int, d: int) -> float:
        """Return the earliest time at which all inputs of task ``i`` can be on device ``d``."""
        end, where, links = self.end, self.where, self.links
        return max(
            (
                end[source] + links[where[source]][d].seconds(size)
                for source, size in self._inputs(i)
            ),
            default=0.0,
        )

    def _inputs(self, i: int) -> Iterator[tuple[int, float]]:
        """Yield each task whose result task ``i`` reads, with the bytes to send if this result
        is on another device.
        """
        return zip(self.graph.sources[i], self.graph.sizes[i], strict=True)

    def _slot(self, i: int, d: int, ready: float, seconds: float, best: float) -> float:
        """Return the earliest start of task ``i`` on device ``d``, or infinity if it cannot end
        before ``best``.
        """
        starts, ends = self.gaps[d]
        # idle intervals that end late enough
        for gap in range(bisect_left(ends, ready + seconds), len(ends)):
            start = max(starts[gap], ready)
            if start + seconds >= best:
                return math.inf
            if start + seconds > ends[gap]:
                continue
            start = self._fitting(i, d, start, seconds, ends[gap])
            if start + seconds <= ends[gap] and start < math.inf:
                return start
            # later intervals need the same wait for memory
            ready = max(ready, start)
        return math.inf

    def _fitting(self, i: int, d: int, start: float, seconds: float, end: float) -> float:
        """Return the earliest start at which device ``d`` has enough memory for task ``i``.

        If the task cannot end before ``end``, where the idle gap ends, the returned start is too
        late for the gap.
        """
        memory, most_parts = self.rooms[d], self.graph.tasks[i].parts
        if memory is None:
            return start
        while start + seconds <= end and start < math.inf:
            delay = memory.wait(self._holds(i, d, start, start + seconds, most_parts))
            if not delay:
                return start
            # at least the next larger number, since a tiny delay could be lost to rounding
            start = max(start + delay, math.nextafter(start, math.inf))
        return start

    def _holds(self, i: int, d: int, start: float, end: float, parts: int) -> list[Hold]:
        """Return the memory reservations of task ``i`` on device ``d``: result, working memory
        and copies of inputs.
        """
        graph = self.graph
        holds = [
            (start, math.inf if graph.held(i) else end, graph.own[i]),
            (start, end, graph.work(i, parts)),
        ]
        for copy_of, departure in self._arriving(i, d, start):
            # a copy for an earlier reader on the device can be used by this task too
            new_spans = without(
                departure,
                end,
                ((from_time, until) for from_time, _, until in self.copies.get(copy_of, ())),
            )
            # copy_of[1]: bytes of the result
            holds += [
                (from_time, to_time, float(math.ceil(copy_of[1])))
                for from_time, to_time in new_spans
            ]
        return holds

    def _arriving(self, i: int, d: int, start: float) -> Iterator[tuple[Of, float]]:
        """Yield each input of task ``i`` that is on another device, with the latest start of the
        transfer.
        """
        for j, size in self._inputs(i):
            if self.where[j] != d:
                yield (
                    (j, size, d),
                    max(start - self.links[self.where[j]][d].seconds(size), self.end[j]),
                )

    def _needs(self, i: int, d: int) -> float:
        """Return the memory (bytes) that device ``d`` needs to run task ``i`` after all tasks
        scheduled so far.
        """
        room = self.rooms[d]
        assert room is not None
        copies = sum(math.ceil(size) for j, size in self._inputs(i) if self.where[j] != d)
        # memory that stays reserved without end, plus this task with its copies
        return room.limit - room.free() + self.least[i] + copies

    # --- records of a placement -------------------------------------------------------------------

    def _commit(self, i: int, d: int, start: float, end: float) -> None:
        """Place a task: reserve its memory and the time of the device, and free the results that no
        other task still reads.
        """
        graph, memory = self.graph, self.rooms[d]
        if memory is not None:
            self.parts[i] = self._fewest(i, d, start, end, memory)
            for hold in self._holds(i, d, start, end, self.parts[i]):
                memory.add(*hold)
        self.put(i, d, start, end)
        # reserve the time of the device
        self._fill(d, start, end)
        for copy_of, departure in self._arriving(i, d, start):
            self.copies[copy_of] = _joined([*self.copies.get(copy_of, ()), (departure, start, end)])
        for j in graph.sources[i]:
            # for a reader on another device, only the copy is needed from its start on
            self.free_at[j] = max(self.free_at[j], end if self.where[j] == d else start)
            self.left[j] -= 1
            memory_of_source = self.rooms[self.where[j]]
            if not self.left[j] and j not in graph.kept and memory_of_source is not None:
                memory_of_source.add(self.free_at[j], math.inf, -graph.own[j])

    def put(self, i: int, d: int, start: float, end: float) -> None:
        self.where[i], self.start[i], self.end[i], self.free_at[i] = d, start, end, end
        self.placed.append(i)

    def _fewest(self, i: int, d: int, start: float, end: float, room: MemoryProfile) -> int:
        """Return the smallest number of parts (groups of bands) with which task ``i`` fits into the
        memory of device ``d``.

        The largest allowed number always fits.
        """

        def fits(parts: int) -> bool:
            return not room.wait(self._holds(i, d, start, end, parts))

        # bisection works, because more parts need less memory
        return 1 + bisect_left(range(1, self.graph.tasks[i].parts), True, key=fits)

    def _fill(self, d: int, start: float, end: float) -> None:
        """Mark the time from ``start`` to ``end`` as busy on device ``d``."""
        starts, ends = self.gaps[d]
        gap = bisect_left(ends, end)
        gaps_left = [
            (gap_start, gap_end)
            for gap_start, gap_end in ((starts[gap], start), (end, ends[gap]))
            if gap_start < gap_end
        ]
        starts[gap : gap + 1] = [gap_start for gap_start, _ in gaps_left]
        ends[gap : gap + 1] = [gap_end for _, gap_end in gaps_left]

    # --- the finished schedule --------------------------------------------------------------------

    def too_large(self) -> TooLarge:
        """Return the error for the first task that fits on no device, with the bytes of memory
        that would suffice.
        """
        graph, (i, d, _) = self.graph, self.refused[0]
        needed, device = (
            max(bytes_needed for _, refused_on, bytes_needed in self.refused if refused_on == d),
            graph.cluster.devices[d],
        )
        return TooLarge(
            graph.tasks[i].name, device.name, needed, device.memory, graph.tasks[i].parts
        )

    def schedule(self) -> Schedule:
        """Return the finished schedule; all tasks must have been placed before."""
        devices = self.graph.cluster.devices
        # called first, because it merges transfers
        self._bridge()
        moves = sorted(self._moves(), key=lambda m: (m.start, m.task, m.device))
        slots = sorted(self._slots(), key=lambda slot: (slot.start, slot.end))
        holds = zip(devices, self._held(), strict=True)
        peak = {
            device.name: max((size for _, _, size in stacked(device_holds)), default=0.0)
            for device, device_holds in holds
        }
        return Schedule(
            tuple(slots),
            max(self.end, default=0.0),
            peak,
            sum(m.bytes for m in moves),
            tuple(moves),
        )

    def _bridge(self) -> None:
        """Avoid a second transfer of a result to a device by keeping the first copy there, if
        memory allows.
        """
        for (j, size, d), copies in self.copies.items():
            memory, joined_copies = self.rooms[d], copies[:1]
            # a copy is (departure, arrival, last use)
            for copy in copies[1:]:
                last_use = joined_copies[-1][2]
                if (
                    memory is None
                    or memory.highest(last_use, copy[0]) + math.ceil(size) <= memory.limit
                ):
                    if memory is not None:
                        memory.add(last_use, copy[0], math.ceil(size))
                    # the first copy stays until the last use of the second
                    joined_copies[-1] = (*joined_copies[-1][:2], max(last_use, copy[2]))
                else:
                    joined_copies.append(copy)
            self.copies[j, size, d] = joined_copies

    def _moves(self) -> Iterator[Move]:
        """Yield the transfers of the finished schedule."""
        devices = self.graph.cluster.devices
        for (j, size, d), copies in self.copies.items():
            task, source = self.graph.tasks[j].name, devices[self.where[j]].name
            for departure, arrival, last_use in copies:
                yield Move(task, size, source, devices[d].name, departure, arrival, last_use)

    def _held(self) -> list[list[Hold]]:
        """Return the memory reservations of the finished schedule, as one list for each device."""
        graph, holds_by_device = self.graph, list[list[Hold]]([] for _ in self.rooms)
        free_times, end_of_all = list(self.end), max(self.end, default=0.0)
        # a copy uses memory from its departure to its last use
        for (j, size, d), copies in self.copies.items():
            holds_by_device[d] += [
                (departure, last_use, float(math.ceil(size))) for departure, _, last_use in copies
            ]
            # a result stays until its last copy has arrived
            free_times[j] = max(free_times[j], copies[-1][1])
        for i, sources in enumerate(graph.sources):
            for j in sources:
                if self.where[j] == self.where[i]:
                    free_times[j] = max(free_times[j], self.end[i])
        # memory of the result, and working memory while the task runs
        for i, d in enumerate(self.where):
            holds_by_device[d].append(
                (self.start[i], end_of_all if i in graph.kept else free_times[i], graph.own[i])
            )
            holds_by_device[d].append((self.start[i], self.end[i], graph.work(i, self.parts[i])))
        return holds_by_device

    def _slots(self) -> Iterator[Slot]:
        """Yield the schedule entry of each task: device, start, end, and the task that delayed
        the start.
        """
        tasks, devices = self.graph.tasks, self.graph.cluster.devices
        task_before, task_ending_at = [-1] * len(devices), dict[float, int]()
        for i in sorted(self.placed, key=self.start.__getitem__):
            d, start = self.where[i], self.start[i]
            delayed_by = self._waited(i, task_before[d], task_ending_at.get(start, -1))
            name = tasks[delayed_by].name if delayed_by >= 0 else ""
            yield Slot(tasks[i].name, devices[d].name, start, self.end[i], self.parts[i], name)
            task_before[d] = i
            task_ending_at[self.end[i]] = i

    def _waited(self, i: int, before: int, other: int) -> int:
        """Return the task that delayed task ``i``: an input, the previous task on the device, or a
        task that freed memory.
        """
        start, d = self.start[i], self.where[i]
        for j, size in self._inputs(i):
            # the task started when this input arrived
            if self.end[j] + self.links[self.where[j]][d].seconds(size) == start:
                return j
        # the task started at time 0, or when the device became free
        if start == 0.0 or (before >= 0 and self.end[before] == start):
            return before
        candidates = [j for j in (before, *self.graph.sources[i]) if j >= 0]
        # otherwise a task that ended at this time freed memory
        return other if other >= 0 else max(candidates, key=self.end.__getitem__, default=-1)


def _joined(copies: list[Copy]) -> list[Copy]:
    """Merge copies of a result that overlap in time on a device, and return the copies in order
    of time.
    """
    joined: list[Copy] = []
    for copy in sorted(copies):
        if joined and copy[0] <= joined[-1][2]:
            joined[-1] = (*joined[-1][:2], max(joined[-1][2], copy[2]))
        else:
            joined.append(copy)
    return joined


# --- heft schedule --------------------------------------------------------------------------------

# Scheduling of tasks on devices by the heuristic HEFT, with memory as a hard constraint.
#
# A schedule is a pure function of tasks, costs and devices, for this machine and for machines
# described in a file. A result leaves a device after its last use. HEFT inserts tasks into idle
# gaps between placed tasks. A task that does not fit into memory is cut into parts of bands, waits
# or runs elsewhere; a task that fits nowhere is refused with the number of bytes that it needs.
#
# Source: Topcuoglu, Hariri, Wu, IEEE Transactions on Parallel and Distributed Systems 13 (2002)
# 260.


__all__ = ["Cluster", "Device", "Link", "Schedule", "Slot", "Task", "TooLarge", "heft"]


def heft(tasks: Sequence[Task], cluster: Cluster, keep: Collection[str] = ()) -> Schedule:
    """Return the HEFT schedule: tasks by longest remaining path, each on the device with the
    earliest finish time.

    ``keep`` names the results that stay in memory to the end. If memory is short, orders of the
    tasks that need less memory are tried too. If one device alone would finish all tasks sooner,
    this device runs all tasks; tasks that one device could run alone are never refused.

    Raises: `TooLarge` if no schedule fits, with the memory that the closest schedule needs;
            ValueError for tasks that
    no device runs, and for cyclic dependencies.
    """
    graph = Graph(tasks, cluster, keep)
    if len(cluster.devices) == 1:
        return _alone(graph, _able(graph))
    # three orders: by rank, as given, and with low memory
    orders = [ranked(graph, upward(graph)), graph.by(range(len(graph.tasks))), frugal(graph)]
    try:
        schedule = _best(graph, orders)
    except TooLarge as error:
        # the error reports the memory of a single device if that is less
        return _alone(graph, _able(graph), error)
    seconds = {
        d: sum(seconds_of_task[d] for seconds_of_task in graph.seconds) for d in _able(graph)
    }
    faster_alone = {
        d: device_seconds
        for d, device_seconds in seconds.items()
        if device_seconds < schedule.makespan
    }
    try:
        return (
            _alone(graph, sorted(faster_alone, key=faster_alone.__getitem__))
            if faster_alone
            else schedule
        )
    except TooLarge:
        return schedule


def _best(graph: Graph, orders: Sequence[Sequence[int]]) -> Schedule:
    """Return the schedule of the first task order if the memory suffices, else the shortest
    schedule that fits.
    """
    memory = {device.name: device.memory for device in graph.cluster.devices}
    # try without memory limits first: this is fast and usually fits
    schedule = _placed(PartialSchedule(graph, bounded=False), orders[0]).schedule()
    if all(peak <= memory[name] for name, peak in schedule.peak.items()):
        return schedule
    return _shortest(graph, (*orders[1:], orders[0]))


def _shortest(graph: Graph, orders: Sequence[Sequence[int]]) -> Schedule:
    """Return the shortest schedule within the memory; if none fits, raise the error with the
    smallest lack of memory.
    """
    shortest, errors = None, list[TooLarge]()
    for order in orders:
        partial = _placed(
            PartialSchedule(graph), order, shortest.makespan if shortest else math.inf
        )
        if partial.refused:
            errors.append(partial.too_large())
        elif len(partial.placed) == len(order):
            schedule = partial.schedule()
            shortest = (
                schedule if shortest is None or schedule.makespan < shortest.makespan else shortest
            )
    if shortest is None:
        raise min(errors, key=lambda error: error.short)
    return shortest


def _placed(
    board: PartialSchedule, order: Sequence[int], below: float = math.inf
) -> PartialSchedule:
    """Add the tasks to the partial schedule ``board`` in the order ``order``, and return ``board``.

    A task that does not fit into memory waits until later tasks free memory. The placement stops
    early if it cannot end before ``below``.
    """
    queue = _Turns(board.graph, order)
    while queue.ready or queue.waiting:
        place_in_order, is_forced = queue.take()
        i = order[place_in_order]
        if is_forced:
            board.force(i)
        elif not board.place(i, board.graph.able[i]):
            queue.waiting.append(place_in_order)
            continue
        if below < math.inf and (is_forced or board.end[i] >= below):
            return board
        queue.release(i)
        if queue.waiting and board.gave_back(i):
            queue.try_again()
    return board


class _Turns:
    """Positions in an order of tasks: those of tasks that may be placed now, smallest first, and
    those of tasks that wait for free memory.
    """

    def __init__(self, graph: Graph, order: Sequence[int]) -> None:
        self._readers = graph.readers
        # number of inputs of each task that are not placed yet
        self._missing = [len(sources) for sources in graph.sources]
        self._turn = {i: n for n, i in enumerate(order)}  # position of each task in the order
        self.ready = [n for n, i in enumerate(order) if not self._missing[i]]
        self.waiting: list[int] = []

    def take(self) -> tuple[int, bool]:
        """Return the next position, and True if only waiting tasks are left, so that this task must
        be placed although it does not fit.
        """
        if self.ready:
            return heapq.heappop(self.ready), False
        first_waiting, *self.waiting = sorted(self.waiting)
        return first_waiting, True

    def release(self, i: int) -> None:
        """Make those tasks ready that waited only for the result of task ``i``."""
        for reader in self._readers[i]:
            self._missing[reader] -= 1
            if not self._missing[reader]:
                heapq.heappush(self.ready, self._turn[reader])

    def try_again(self) -> None:
        """Make all waiting tasks ready."""
        self.ready, self.waiting = [*self.ready, *self.waiting], []
        heapq.heapify(self.ready)


# --- one device -----------------------------------------------------------------------------------


def _able(graph: Graph) -> list[int]:
    """Return the devices that can run every task, in order of decreasing memory."""
    devices = graph.cluster.devices
    able_devices = set(range(len(devices))).intersection(*graph.able)
    return sorted(able_devices, key=lambda d: (-devices[d].memory, d))


def _alone(graph: Graph, devices: Sequence[int], *refused: TooLarge) -> Schedule:
    """Try each device alone, with two task orders each, and return the first schedule that fits
    into memory.
    """
    for d in devices:
        for order in (graph.by(range(len(graph.tasks))), frugal(graph)):
            try:
                return _sequence(graph, d, order)
            except TooLarge as error:
                refused = (*refused, error)
    raise min(refused, key=lambda error: error.short)


def _sequence(graph: Graph, d: int, order: Sequence[int]) -> Schedule:
    """Return the schedule of all tasks in ``order`` on device ``d``; raise `TooLarge` if the
    device lacks memory.
    """
    partial, device = PartialSchedule(graph, bounded=False), graph.cluster.devices[d]
    readers_left, held_bytes, peak_bytes, end = (
        [len(readers) for readers in graph.readers],
        0.0,
        0.0,
        0.0,
    )
    needed, largest_task = 0.0, 0
    for i in order:
        held_bytes += graph.own[i]
        # use the fewest parts that the memory allows
        partial.parts[i] = _fewest(graph, i, device.memory - held_bytes)
        peak_bytes = max(peak_bytes, held_bytes + graph.work(i, partial.parts[i]))
        # least memory: with the largest number of parts that the task allows
        least_need = held_bytes + graph.work(i, graph.tasks[i].parts)
        needed, largest_task = (least_need, i) if least_need > needed else (needed, largest_task)
        start, end = end, end + graph.seconds[i][d]
        partial.put(i, d, start, end)
        for j in graph.sources[i]:
            readers_left[j] -= 1
        held_bytes -= sum(
            graph.own[j]
            for j in (*graph.sources[i], i)
            if not readers_left[j] and j not in graph.kept
        )
    if graph.tasks and needed > device.memory:
        task = graph.tasks[largest_task]
        raise TooLarge(task.name, device.name, needed, device.memory, task.parts)
    schedule = partial.schedule()
    return replace(schedule, peak={**schedule.peak, device.name: peak_bytes})


def _fewest(graph: Graph, i: int, room: float) -> int:
    """Return the smallest number of parts (groups of bands) with which task ``i`` fits into
    ``room`` bytes of memory.

    If no allowed number suffices, return the largest allowed number.
    """
    limit = graph.tasks[i].parts
    # bisection works, because more parts need less memory; it gives the largest number if none
    # suffices
    return 1 + bisect_left(range(1, limit), True, key=lambda parts: graph.work(i, parts) <= room)
