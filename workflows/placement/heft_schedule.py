"""Scheduling of tasks on devices by the heuristic HEFT, with memory as a hard constraint.

A schedule is a pure function of tasks, costs and devices, for this machine and for machines described in a file.
A result leaves a device after its last use. HEFT inserts tasks into idle gaps between placed tasks. A task that
does not fit into memory is cut into parts of bands, waits or runs elsewhere; a task that fits nowhere is refused
with the number of bytes that it needs.

Source: Topcuoglu, Hariri, Wu, IEEE Transactions on Parallel and Distributed Systems 13 (2002) 260.
"""

from __future__ import annotations

import heapq
import math
from bisect import bisect_left
from collections.abc import Collection, Sequence
from dataclasses import replace

from neusee.workflows.placement.partial_schedule import PartialSchedule
from neusee.workflows.placement.task_priorities import Graph, frugal, ranked, upward
from neusee.workflows.placement.tasks_and_devices import Cluster, Device, Link, Schedule, Slot, Task, TooLarge

__all__ = ["Cluster", "Device", "Link", "Schedule", "Slot", "Task", "TooLarge", "heft"]


def heft(tasks: Sequence[Task], cluster: Cluster, keep: Collection[str] = ()) -> Schedule:
    """Return the HEFT schedule: tasks by longest remaining path, each on the device with the earliest finish time.

    ``keep`` names the results that stay in memory to the end. If memory is short, orders of the tasks that need less
    memory are tried too. If one device alone would finish all tasks sooner, this device runs all tasks; tasks that one
    device could run alone are never refused.

    Raises: `TooLarge` if no schedule fits, with the memory that the closest schedule needs; ValueError for tasks that
    no device runs, and for cyclic dependencies.
    """
    graph = Graph(tasks, cluster, keep)
    if len(cluster.devices) == 1:
        return _alone(graph, _able(graph))
    orders = [ranked(graph, upward(graph)), graph.by(range(len(graph.tasks))), frugal(graph)]
    try:
        schedule = _best(graph, orders)
    except TooLarge as error:
        return _alone(graph, _able(graph), error)  # reports the memory for one device, if this is less
    sooner = {d: took for d in _able(graph) if (took := sum(row[d] for row in graph.seconds)) < schedule.makespan}
    try:
        return _alone(graph, sorted(sooner, key=sooner.__getitem__)) if sooner else schedule
    except TooLarge:
        return schedule


def _best(graph: Graph, orders: Sequence[Sequence[int]]) -> Schedule:
    """Return the schedule of the first task order if the memory suffices, else the shortest schedule that fits."""
    memory = {device.name: device.memory for device in graph.cluster.devices}
    schedule = _placed(PartialSchedule(graph, bounded=False), orders[0]).schedule()
    if all(peak <= memory[name] for name, peak in schedule.peak.items()):
        return schedule
    best, refused = None, list[TooLarge]()
    for order in (*orders[1:], orders[0]):
        board = _placed(PartialSchedule(graph), order, best.makespan if best else math.inf)
        if board.refused:
            refused.append(board.too_large())
        elif len(board.placed) == len(order):
            schedule = board.schedule()
            best = schedule if best is None or schedule.makespan < best.makespan else best
    if best is None:
        raise min(refused, key=lambda error: error.short)
    return best


def _placed(board: PartialSchedule, order: Sequence[int], below: float = math.inf) -> PartialSchedule:
    """Add the tasks to the partial schedule ``board`` in the order ``order``, and return ``board``.

    A task that does not fit into memory waits until later tasks free memory. The placement stops early if it cannot
    end before ``below``.
    """
    graph = board.graph
    missing, turn = [len(sources) for sources in graph.sources], {i: n for n, i in enumerate(order)}
    ready = [n for n, i in enumerate(order) if not missing[i]]
    waiting: list[int] = []
    while ready or waiting:
        forced = not ready
        if forced:
            ready, waiting = [min(waiting)], sorted(waiting)[1:]
        n = heapq.heappop(ready)
        i = order[n]
        if forced:
            board.force(i)
        elif not board.place(i, graph.able[i]):
            waiting.append(n)
            continue
        if below < math.inf and (forced or board.end[i] >= below):
            return board
        for reader in graph.readers[i]:
            missing[reader] -= 1
            if not missing[reader]:
                heapq.heappush(ready, turn[reader])
        if waiting and board.gave_back(i):
            ready, waiting = [*ready, *waiting], []
            heapq.heapify(ready)
    return board


# --- one device -----------------------------------------------------------------------------------------------------


def _able(graph: Graph) -> list[int]:
    """Return the devices that can run every task, in order of decreasing memory."""
    devices = graph.cluster.devices
    able = set(range(len(devices))).intersection(*graph.able)
    return sorted(able, key=lambda d: (-devices[d].memory, d))


def _alone(graph: Graph, devices: Sequence[int], *refused: TooLarge) -> Schedule:
    """Try each device alone, with two task orders each, and return the first schedule that fits into memory."""
    for d in devices:
        for order in (graph.by(range(len(graph.tasks))), frugal(graph)):
            try:
                return _sequence(graph, d, order)
            except TooLarge as error:
                refused = (*refused, error)
    raise min(refused, key=lambda error: error.short)


def _sequence(graph: Graph, d: int, order: Sequence[int]) -> Schedule:
    """Return the schedule of all tasks in ``order`` on device ``d``; raise `TooLarge` if the device lacks memory."""
    board, device = PartialSchedule(graph, bounded=False), graph.cluster.devices[d]
    left, held, peak, at = [len(readers) for readers in graph.readers], 0.0, 0.0, 0.0
    needed, largest = 0.0, 0
    for i in order:
        held += graph.own[i]
        board.parts[i] = _fewest(graph, i, device.memory - held)
        peak = max(peak, held + graph.work(i, board.parts[i]))
        least = held + graph.work(i, graph.tasks[i].parts)
        needed, largest = (least, i) if least > needed else (needed, largest)
        began, at = at, at + graph.seconds[i][d]
        board.put(i, d, began, at)
        for j in graph.sources[i]:
            left[j] -= 1
        held -= sum(graph.own[j] for j in (*graph.sources[i], i) if not left[j] and j not in graph.kept)
    if graph.tasks and needed > device.memory:
        task = graph.tasks[largest]
        raise TooLarge(task.name, device.name, needed, device.memory, task.parts)
    schedule = board.schedule()
    return replace(schedule, peak={**schedule.peak, device.name: peak})


def _fewest(graph: Graph, i: int, room: float) -> int:
    """Return the smallest number of band slices with which task ``i`` fits into ``room`` bytes of memory.

    If no allowed number suffices, return the largest allowed number.
    """
    most = graph.tasks[i].parts
    return 1 + bisect_left(range(1, most), True, key=lambda parts: graph.work(i, parts) <= room)
