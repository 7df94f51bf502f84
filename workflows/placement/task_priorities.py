"""Priorities of tasks: orders in which a scheduler places tasks, by rank or for the least use of memory."""

from __future__ import annotations

import heapq
import math
from collections.abc import Collection, Sequence
from typing import Any

from neusee.workflows.graph.diagnostics import nearest
from neusee.workflows.placement.tasks_and_devices import Cluster, Task


class Graph:
    """A graph of numbered tasks: sources and readers of each task, bytes to send, and devices that can run the task."""

    def __init__(self, tasks: Sequence[Task], cluster: Cluster, keep: Collection[str] = ()) -> None:
        self.tasks, self.cluster = tuple(tasks), cluster
        index = {task.name: i for i, task in enumerate(self.tasks)}
        if len(index) < len(self.tasks):
            twice = next(t.name for i, t in enumerate(self.tasks) if index[t.name] != i)
            raise ValueError(f"two tasks have the name {twice}")
        for name in (*(s for task in self.tasks for s in task.sources), *keep):
            if name not in index:
                raise ValueError(f"there is no task {name}; {nearest(name, index)}")
        self.sources = [[index[s] for s in dict.fromkeys(task.sources)] for task in self.tasks]
        self.readers: list[list[int]] = [[] for _ in self.tasks]
        for i, sources in enumerate(self.sources):
            for j in sources:
                self.readers[j].append(i)
        self.kept = {index[name] for name in keep}
        self.sizes = [
            [task.takes.get(self.tasks[j].name, self.tasks[j].bytes) for j in sources]
            for task, sources in zip(self.tasks, self.sources, strict=True)
        ]
        self.own = [float(math.ceil(task.bytes)) for task in self.tasks]  # whole bytes add up without round-off
        self.able = [[d for d, device in enumerate(cluster.devices) if device.name in t.seconds] for t in self.tasks]
        self.seconds = [[t.seconds.get(device.name, math.inf) for device in cluster.devices] for t in self.tasks]
        self._check()

    def held(self, i: int) -> bool:
        """Return True if a later task reads the result of task ``i``, or if the run keeps the result to the end."""
        return bool(self.readers[i]) or i in self.kept

    def work(self, i: int, parts: int) -> float:
        return float(math.ceil(self.tasks[i].work / parts))

    def by(self, keys: Sequence[Any]) -> list[int]:
        """Return the tasks in order, each after its inputs; the ready task with the smallest key comes next."""
        missing = [len(sources) for sources in self.sources]
        ready = [(keys[i], i) for i, count in enumerate(missing) if not count]
        heapq.heapify(ready)
        order = []
        while ready:
            i = heapq.heappop(ready)[1]
            order.append(i)
            for reader in self.readers[i]:
                missing[reader] -= 1
                if not missing[reader]:
                    heapq.heappush(ready, (keys[reader], reader))
        return order

    def _check(self) -> None:
        there = ", ".join(device.name for device in self.cluster.devices)
        for task, able in zip(self.tasks, self.able, strict=True):
            if not able:
                raise ValueError(f"{task.name} needs {', '.join(task.seconds) or 'a device'}; the cluster has {there}")
            if not all(0 <= seconds < math.inf for seconds in task.seconds.values()):
                raise ValueError(f"{task.name} must take a finite time of 0 s or more, not {dict(task.seconds)} s")
        if len(self.by(range(len(self.tasks)))) < len(self.tasks):
            raise ValueError("the tasks depend on each other in a cycle")


def ranked(graph: Graph, ranks: Sequence[float]) -> list[int]:
    """Return the tasks in order of decreasing rank; ranks that differ only by round-off count as equal."""
    return graph.by([(-float(f"{rank:.9g}"), graph.tasks[i].name) for i, rank in enumerate(ranks)])


def upward(graph: Graph) -> list[float]:
    """Return the upward rank of each task: the longest time (s) from its start to the end of the graph, at mean costs.

    Source: Topcuoglu, Hariri, Wu, IEEE TPDS 13 (2002) 260, eq. 8.
    """
    ranks, wait, cost = [0.0] * len(graph.tasks), _mean_transfer(graph), _mean_seconds(graph)
    onward = [0.0] * len(graph.tasks)
    for i in reversed(graph.by(range(len(graph.tasks)))):
        ranks[i] = cost[i] + onward[i]
        for j, size in zip(graph.sources[i], graph.sizes[i], strict=True):
            onward[j] = max(onward[j], wait[0] + wait[1] * size + ranks[i])
    return ranks


def frugal(graph: Graph) -> list[int]:
    """Return a depth-first order of the tasks that keeps the peak memory low.

    Of the inputs of a task, the input that frees most of its peak memory comes first. Of all depth-first
    orders of a tree this order has the smallest peak memory (Liu, ACM TOMS 12 (1986) 249).
    """
    need, befores = _needs(graph)
    left = {i: graph.own[i] if i in graph.kept else 0.0 for i, r in enumerate(graph.readers) if not r}
    place: dict[int, int] = {}
    stack = sorted(left, key=lambda i: (left[i] - need[i], i), reverse=True)
    while stack:
        i = stack[-1]
        missing = [j for j in befores[i] if j not in place]
        if missing:
            stack += reversed(missing)
            continue
        place.setdefault(stack.pop(), len(place))
    return list(place)


def _needs(graph: Graph) -> tuple[list[float], list[list[int]]]:
    """Return for each task the peak memory of a run up to this task, and the order of inputs with the lowest peak."""
    need, befores = [0.0] * len(graph.tasks), list[list[int]]([] for _ in graph.tasks)
    for i in graph.by(range(len(graph.tasks))):
        befores[i] = sorted(graph.sources[i], key=lambda j: (graph.own[j] - need[j], j))
        held = 0.0
        for j in befores[i]:
            need[i] = max(need[i], held + need[j])
            held += graph.own[j]
        need[i] = max(need[i], held + graph.own[i] + graph.work(i, graph.tasks[i].parts))
    return need, befores


def _mean_seconds(graph: Graph) -> list[float]:
    return [sum(row[d] for d in able) / len(able) for row, able in zip(graph.seconds, graph.able, strict=True)]


def _mean_transfer(graph: Graph) -> tuple[float, float]:
    """Return the mean latency (s) and the mean transfer time per byte (s) over all pairs of devices."""
    names = [device.name for device in graph.cluster.devices]
    links = [graph.cluster.link(a, b) for a in names for b in names if a != b]
    count = max(len(links), 1)
    return sum(link.latency for link in links) / count, sum(1.0 / link.bandwidth for link in links) / count
