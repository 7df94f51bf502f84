"""Data types of a schedule: devices with their links, tasks with their costs, and the device and times of each task.

All times are in s and all sizes in bytes. No code here runs a task or reads a tensor.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property


@dataclass(frozen=True, slots=True)
class Device:
    """A device that runs one task at a time, such as ``cuda:1``, or ``node2/cuda:1`` on the machine ``node2``."""

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
    links: Mapping[tuple[str, str], Link] = field(default_factory=dict)  #: by kinds in either order, within one machine
    bus: Link = BUS  #: for kinds of one machine that ``links`` does not name
    network: Link = Link(12.5e9, 10e-6)  #: between machines

    def __post_init__(self) -> None:
        if not self.devices or len(self._by_name) < len(self.devices):
            names = ", ".join(d.name for d in self.devices)
            raise ValueError(f"a cluster needs one or more devices with different names, not: {names or 'none'}")

    def link(self, a: str, b: str) -> Link:
        """Return the link between two devices; from a device to itself, the link has no delay."""
        if a == b:
            return Link()
        one, other = self._by_name[a], self._by_name[b]
        if one.machine != other.machine:
            return self.network
        pair = (one.kind, other.kind)
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
    bytes: float = 0.0  #: size of the result
    work: float = 0.0  #: memory during the run beside inputs and result, in bytes; 0 for a task of 0 s
    parts: int = 1  #: upper bound on the number of band slices, among which ``work`` is divided
    takes: Mapping[str, float] = field(default_factory=dict)  #: bytes that a source sends, if not its whole result


@dataclass(frozen=True, slots=True)
class Slot:
    """Entry of a task in a schedule: the device, the start and the end of the task."""

    task: str
    device: str
    start: float
    end: float
    parts: int = 1
    after: str = ""  #: the task that delayed the start, by its data, device or memory; empty if none


@dataclass(frozen=True, slots=True)
class Move:
    """Transfer of a result to another device, and the time until which this device keeps the copy."""

    task: str
    bytes: float
    source: str
    device: str
    start: float
    end: float
    until: float


@dataclass(frozen=True, slots=True)
class Schedule:
    """A schedule: the device and times of each task, in order of time, with makespan, peak memory and transfers."""

    slots: tuple[Slot, ...]
    makespan: float
    peak: Mapping[str, float]  #: bytes by device, every device of the cluster
    transferred: float  #: bytes
    moves: tuple[Move, ...] = ()

    def utilisation(self) -> dict[str, float]:
        """Return the fraction of the makespan during which each device works, by the name of the device."""
        busy = dict.fromkeys(self.peak, 0.0)
        for slot in self.slots:
            busy[slot.device] += slot.end - slot.start
        return {name: time / self.makespan if self.makespan else 0.0 for name, time in busy.items()}

    def critical_path(self) -> tuple[Slot, ...]:
        """Return the critical path: a chain of tasks, each of which delays the next, up to the task that ends last."""
        by_name = {slot.task: slot for slot in self.slots}
        at = max(self.slots, key=lambda slot: slot.end, default=None)
        path = []
        while at is not None:
            path.append(at)
            at = by_name.get(at.after)
        return tuple(path[::-1])


class TooLarge(ValueError):
    """Error for a task that fits on no device, with the bytes that the task needs and the bytes that a device has."""

    def __init__(self, task: str, device: str, needed: float, memory: float, parts: int = 1) -> None:
        self.task, self.device, self.needed, self.memory, self.parts = task, device, needed, memory, parts
        cut = f" in {parts} parts" if parts > 1 else ""
        super().__init__(
            f"{task} does not fit: its inputs, result and results kept there need {_size(needed)} on {device}{cut}, "
            f"which has {_size(memory)}"
        )

    def with_program(self, held: float) -> TooLarge:
        """Return the error with the memory that the program itself holds on the device, as part of need and limit."""
        more = TooLarge(self.task, self.device, self.needed, self.memory, self.parts)
        cut = f" in {self.parts} parts" if self.parts > 1 else ""
        more.args = (
            f"{self.task} needs {_size(self.needed + held)}{cut}, of which the program itself holds {_size(held)}, and "
            f"the limit is {_size(self.memory + held)}: give more memory, or choose a smaller picture, pupil or number "
            "of bands",
        )
        return more

    @property
    def short(self) -> float:
        """Return the number of bytes by which the memory of the device is too small."""
        return self.needed - self.memory


def _size(count: float) -> str:
    if count == math.inf:
        return "more bytes than a machine can address"
    exact = f"{count:,.0f} B"
    return exact if count < 1e6 else f"{exact} ({count / 1e9:.3g} GB)"
