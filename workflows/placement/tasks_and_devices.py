"""Tasks, devices and links of a schedule, and the order in which tasks are placed."""

from __future__ import annotations

import heapq
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain, permutations
from typing import Any

from neusee.workflows.graph.errors import nearest

# --- tasks and devices ----------------------------------------------------------------------------

# Data types of a schedule: devices with their links, tasks with their costs, and the device and
# times of each task.
#
# All times are in s and all sizes in bytes. No code here runs a task or reads a tensor.


@dataclass(frozen=True, slots=True)
class Device:
    """A device that runs one task at a time, such as ``cuda:1``, or ``node2/cuda:1`` on the
    machine ``node2``.
    """

    name: str
    kind: str = "cpu"
    memory: float = math.inf

    @property
    def machine(self) -> str:
        return self.name.rpartition("/")[0]


@dataclass(frozen=True, slots=True)
class Link:
    """Bandwidth (bytes/s) and latency (s) between two devices."""

    bandwidth: float = math.inf
    latency: float = 0.0

    def seconds(self, size: float) -> float:
        return self.latency + size / self.bandwidth


#: PCI Express 4.0 x16, as measured for copies from pinned memory
BUS = Link(20e9, 10e-6)


@dataclass(frozen=True)
class Cluster:
    """The devices of one or more machines, with the links between the devices."""

    devices: tuple[Device, ...]
    #: links within one machine, by the two kinds of devices in either order
    links: Mapping[tuple[str, str], Link] = field(default_factory=dict)
    bus: Link = BUS  #: link within one machine for kinds that ``links`` does not contain
    network: Link = Link(12.5e9, 10e-6)  #: link between machines

    def __post_init__(self) -> None:
        if not self.devices or len(self._by_name) < len(self.devices):
            names = ", ".join(d.name for d in self.devices)
            raise ValueError(
                f"a cluster needs one or more devices with different names, not: {names or 'none'}"
            )

    def link(self, a: str, b: str) -> Link:
        """Return the link between two devices; from a device to itself, the link has no delay."""
        if a == b:
            return Link()
        device, other_device = self._by_name[a], self._by_name[b]
        if device.machine != other_device.machine:
            return self.network
        pair = (device.kind, other_device.kind)
        return self.links.get(pair) or self.links.get((pair[1], pair[0])) or self.bus

    @cached_property
    def _by_name(self) -> dict[str, Device]:
        return {d.name: d for d in self.devices}


@dataclass(frozen=True, slots=True)
class Task:
    """A task to schedule, with its costs in seconds and bytes."""

    name: str
    sources: tuple[str, ...]
    seconds: Mapping[str, float]  #: by device name; a device without an entry cannot run the task
    bytes: float = 0.0  #: size of the result (bytes)
    #: memory during the run beside inputs and result, in bytes; 0 for a task of 0 s
    work: float = 0.0
    parts: int = 1  #: upper bound on the number of band slices, among which ``work`` is divided
    #: bytes that the task needs from a source, if not the whole result
    takes: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Slot:
    """Entry of a task in a schedule: the device, the start and the end of the task."""

    task: str
    device: str
    start: float
    end: float
    parts: int = 1
    #: the task that delayed the start, by its data, device or memory; empty if none
    after: str = ""


@dataclass(frozen=True, slots=True)
class Move:
    """Transfer of a result to another device, and the time until which this device keeps the
    copy.
    """

    task: str
    bytes: float
    source: str
    device: str
    start: float
    end: float
    until: float


@dataclass(frozen=True, slots=True)
class Schedule:
    """A schedule: the device and times of each task, in order of time, with makespan, peak
    memory and transfers.
    """

    slots: tuple[Slot, ...]
    makespan: float
    peak: Mapping[str, float]  #: peak memory (bytes) of every device of the cluster, by name
    transferred: float  #: bytes
    moves: tuple[Move, ...] = ()

    def utilisation(self) -> dict[str, float]:
        """Return the fraction of the makespan during which each device works, by the name of the
        device.
        """
        busy_seconds = dict.fromkeys(self.peak, 0.0)
        for slot in self.slots:
            busy_seconds[slot.device] += slot.end - slot.start
        return {
            name: device_seconds / self.makespan if self.makespan else 0.0
            for name, device_seconds in busy_seconds.items()
        }

    def critical_path(self) -> tuple[Slot, ...]:
        """Return the critical path: a chain of tasks, each of which delays the next, up to the
        task that ends last.
        """
        slot_of_task = {slot.task: slot for slot in self.slots}
        slot_on_path = max(self.slots, key=lambda slot: slot.end, default=None)
        path = []
        while slot_on_path is not None:
            path.append(slot_on_path)
            # the task that delayed this one; None for the first
            slot_on_path = slot_of_task.get(slot_on_path.after)
        return tuple(path[::-1])


class TooLarge(ValueError):
    """Error for a task that fits on no device, with the memory that the task needs and the memory
    of the device.
    """

    def __init__(
        self, task: str, device: str, needed: float, memory: float, parts: int = 1
    ) -> None:
        self.task, self.device, self.needed, self.memory, self.parts = (
            task,
            device,
            needed,
            memory,
            parts,
        )
        parts_text = f" in {parts} parts" if parts > 1 else ""
        super().__init__(
            f"{task} does not fit: its inputs, result and results kept there need {_size(needed)}"
            f" on {device}{parts_text}, which has {_size(memory)}"
        )

    def with_program(self, held: float) -> TooLarge:
        """Return the error with the memory of the program itself added to the need and to the
        limit.
        """
        error = TooLarge(self.task, self.device, self.needed, self.memory, self.parts)
        in_parts = f" in {self.parts} parts" if self.parts > 1 else ""
        error.args = (
            (
                f"{self.task} needs {_size(self.needed + held)}{in_parts}, of which the program"
                f" itself holds {_size(held)}, and the limit is {_size(self.memory + held)}: give"
                " more memory, or choose a smaller picture, pupil or number of bands"
            ),
        )
        return error

    @property
    def short(self) -> float:
        """Return the number of bytes by which the memory of the device is too small."""
        return self.needed - self.memory


def _size(count: float) -> str:
    """Return a number of bytes as text, exactly and in GB."""
    if count == math.inf:
        return "more bytes than a machine can address"
    exact_text = f"{count:,.0f} B"
    return exact_text if count < 1e6 else f"{exact_text} ({count / 1e9:.3g} GB)"


# --- task priorities ------------------------------------------------------------------------------

# Priorities of tasks: orders in which a scheduler places tasks, by rank or for low memory.


class Graph:
    """A graph of numbered tasks: sources and readers of each task, bytes to send, and devices
    that can run the task.
    """

    def __init__(self, tasks: Sequence[Task], cluster: Cluster, keep: Collection[str] = ()) -> None:
        self.tasks, self.cluster = tuple(tasks), cluster
        index = _numbers_of_names(self.tasks, keep)
        self.sources = [_sources_of(task, index) for task in self.tasks]
        self.readers = _readers_of(self.sources)
        self.kept = set(map(index.__getitem__, keep))  # tasks whose results are kept to the end
        # bytes that each task needs from each of its sources
        self.sizes = list(map(self._sent, self.tasks, self.sources))
        # whole numbers of bytes, so that sums have no rounding errors
        self.own = [float(math.ceil(task.bytes)) for task in self.tasks]
        # for each task, the devices that can run it
        self.able = [_able_devices(task, cluster) for task in self.tasks]
        self.seconds = [_seconds_by_device(task, cluster) for task in self.tasks]
        self._check()

    def _sent(self, task: Task, sources: list[int]) -> list[float]:
        """Return the bytes that a task needs from the result of each of its sources."""
        results = [self.tasks[j] for j in sources]
        return [task.takes.get(result.name, result.bytes) for result in results]

    def held(self, i: int) -> bool:
        """Return True if a later task reads the result of task ``i``, or if the run keeps the
        result to the end.
        """
        return bool(self.readers[i]) or i in self.kept

    def work(self, i: int, parts: int) -> float:
        return float(math.ceil(self.tasks[i].work / parts))

    def by(self, keys: Sequence[Any]) -> list[int]:
        """Return the tasks in an order in which each follows its inputs; among ready tasks, the one
        with the smallest key comes next.
        """
        missing_inputs = [len(sources) for sources in self.sources]
        ready = [(keys[i], i) for i, count in enumerate(missing_inputs) if not count]
        heapq.heapify(ready)
        order = []
        while ready:
            i = heapq.heappop(ready)[1]
            order.append(i)
            for reader in self.readers[i]:
                missing_inputs[reader] -= 1
                if not missing_inputs[reader]:
                    heapq.heappush(ready, (keys[reader], reader))
        return order

    def _check(self) -> None:
        """Raise ValueError for a task that no device runs, a time that is not finite, or a
        cycle.
        """
        names = ", ".join(device.name for device in self.cluster.devices)
        for task, able in zip(self.tasks, self.able, strict=True):
            if not able:
                raise ValueError(
                    f"{task.name} needs {', '.join(task.seconds) or 'a device'}; the cluster has"
                    f" {names}"
                )
            if not all(0 <= seconds < math.inf for seconds in task.seconds.values()):
                raise ValueError(
                    f"{task.name} must take a finite time of 0 s or more, not"
                    f" {dict(task.seconds)} s"
                )
        # a task in a cycle is never ready
        if len(self.by(range(len(self.tasks)))) < len(self.tasks):
            raise ValueError("the tasks depend on each other in a cycle")


def _numbers_of_names(tasks: Sequence[Task], keep: Collection[str]) -> dict[str, int]:
    """Return the number of each task by its name. Raise ValueError for a name of two tasks, and for
    an unknown name among sources or kept results.
    """
    number_of_task = {task.name: i for i, task in enumerate(tasks)}
    if len(number_of_task) < len(tasks):
        # the dict holds the number of the later of two tasks with the same name
        repeated_name = next(
            task.name for i, task in enumerate(tasks) if number_of_task[task.name] != i
        )
        raise ValueError(f"two tasks have the name {repeated_name}")
    names_read = chain.from_iterable(task.sources for task in tasks)
    for name in (*names_read, *keep):
        if name not in number_of_task:
            raise ValueError(f"there is no task {name}; {nearest(name, number_of_task)}")
    return number_of_task


def _sources_of(task: Task, index: Mapping[str, int]) -> list[int]:
    """Return the numbers of the tasks that a task reads, each once."""
    return [index[name] for name in dict.fromkeys(task.sources)]


def _readers_of(sources: Sequence[Sequence[int]]) -> list[list[int]]:
    """Return the tasks that read the result of each task."""
    readers: list[list[int]] = [[] for _ in sources]
    for i, sources_of_task in enumerate(sources):
        for j in sources_of_task:
            readers[j].append(i)
    return readers


def _able_devices(task: Task, cluster: Cluster) -> list[int]:
    """Return the numbers of the devices that can run a task."""
    return [d for d, device in enumerate(cluster.devices) if device.name in task.seconds]


def _seconds_by_device(task: Task, cluster: Cluster) -> list[float]:
    """Return the time (s) of a task on each device; infinity for a device that cannot run it."""
    return [task.seconds.get(device.name, math.inf) for device in cluster.devices]


def ranked(graph: Graph, ranks: Sequence[float]) -> list[int]:
    """Return the tasks in order of decreasing rank; ranks that differ only by rounding errors count
    as equal.
    """
    return graph.by([(-float(f"{rank:.9g}"), graph.tasks[i].name) for i, rank in enumerate(ranks)])


def upward(graph: Graph) -> list[float]:
    """Return the upward rank of each task: the longest time (s) from its start to the end of the
    graph, at mean costs.

    Source: Topcuoglu, Hariri, Wu, IEEE TPDS 13 (2002) 260, eq. 8.
    """
    ranks, latency_and_rate, mean_seconds = (
        [0.0] * len(graph.tasks),
        _mean_transfer(graph),
        _mean_seconds(graph),
    )
    longest_after = [0.0] * len(graph.tasks)
    for i in reversed(graph.by(range(len(graph.tasks)))):
        ranks[i] = mean_seconds[i] + longest_after[i]
        for j, size in zip(graph.sources[i], graph.sizes[i], strict=True):
            # eq. 8: rank = mean cost + max over readers of (mean transfer + rank of the reader)
            longest_after[j] = max(
                longest_after[j], latency_and_rate[0] + latency_and_rate[1] * size + ranks[i]
            )
    return ranks


def frugal(graph: Graph) -> list[int]:
    """Return a depth-first order of the tasks that keeps the peak memory low.

    Of the inputs of a task, the input that frees most of its peak memory comes first. Of all
    depth-first orders of a tree this order has the smallest peak memory (Liu, ACM TOMS 12 (1986)
    249).
    """
    peak_up_to, input_order = _needs(graph)
    # for each final task, the memory that stays in use after it
    bytes_after = {
        i: graph.own[i] if i in graph.kept else 0.0 for i, r in enumerate(graph.readers) if not r
    }
    position: dict[int, int] = {}
    # a stack: the last task comes first, which is the one that frees most of its peak
    stack = sorted(bytes_after, key=lambda i: (bytes_after[i] - peak_up_to[i], i), reverse=True)
    while stack:
        i = stack[-1]
        missing = [j for j in input_order[i] if j not in position]
        if missing:
            stack += reversed(missing)
            continue
        position.setdefault(stack.pop(), len(position))
    return list(position)


def _needs(graph: Graph) -> tuple[list[float], list[list[int]]]:
    """Return for each task the peak memory of a run up to this task, and the order of inputs
    with the lowest peak.
    """
    peak_up_to, input_order = [0.0] * len(graph.tasks), list[list[int]]([] for _ in graph.tasks)
    for i in graph.by(range(len(graph.tasks))):
        # the input that frees most of its peak comes first
        input_order[i] = sorted(graph.sources[i], key=lambda j: (graph.own[j] - peak_up_to[j], j))
        held_bytes = 0.0
        for j in input_order[i]:
            peak_up_to[i] = max(peak_up_to[i], held_bytes + peak_up_to[j])
            held_bytes += graph.own[j]
        peak_up_to[i] = max(
            peak_up_to[i], held_bytes + graph.own[i] + graph.work(i, graph.tasks[i].parts)
        )
    return peak_up_to, input_order


def _mean_seconds(graph: Graph) -> list[float]:
    """Return the mean time (s) of each task over the devices that can run it."""
    return [
        sum(seconds_of_task[d] for d in able) / len(able)
        for seconds_of_task, able in zip(graph.seconds, graph.able, strict=True)
    ]


def _mean_transfer(graph: Graph) -> tuple[float, float]:
    """Return the mean latency (s) and the mean transfer time per byte (s) over all pairs of
    devices.
    """
    names = [device.name for device in graph.cluster.devices]
    links = [graph.cluster.link(a, b) for a, b in permutations(names, 2)]
    count = max(len(links), 1)
    return (
        sum(link.latency for link in links) / count,
        sum(1.0 / link.bandwidth for link in links) / count,
    )
