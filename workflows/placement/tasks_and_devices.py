"""What a plan is made of: devices and the links between them, tasks and their costs, and when each runs where.

Seconds and bytes throughout; nothing here runs anything, or knows a tensor.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property


@dataclass(frozen=True, slots=True)
class Device:
    """Runs one task at a time; ``node2/cuda:1`` is one of machine ``node2``, ``cuda:1`` of this one."""

    name: str
    kind: str = "cpu"
    memory: float = math.inf

    @property
    def machine(self) -> str:
        return self.name.rpartition("/")[0]


@dataclass(frozen=True, slots=True)
class Link:
    """What lies between two devices: bytes/s, and s before the first byte."""

    bandwidth: float = math.inf
    latency: float = 0.0

    def seconds(self, size: float) -> float:
        return self.latency + size / self.bandwidth


#: PCI Express 4.0 x16 as copies from pinned memory reach it
BUS = Link(20e9, 10e-6)


@dataclass(frozen=True)
class Cluster:
    """Devices, and what it costs to bring a result from one to another."""

    devices: tuple[Device, ...]
    links: Mapping[tuple[str, str], Link] = field(default_factory=dict)  #: by kinds, in either order, on one machine
    bus: Link = BUS  #: kinds of one machine that ``links`` does not name
    network: Link = Link(12.5e9, 10e-6)  #: between machines

    def __post_init__(self) -> None:
        if not self.devices or len(self._by_name) < len(self.devices):
            names = ", ".join(d.name for d in self.devices)
            raise ValueError(f"a cluster is one device or more, each with a name of its own: {names or 'none'}")

    def link(self, a: str, b: str) -> Link:
        """The link between two devices; on the same device it takes no time."""
        if a == b:
            return Link()
        one, other = self._by_name[a], self._by_name[b]
        if one.machine != other.machine:
            return self.network
        pair = (one.kind, other.kind)
        return self.links.get(pair) or self.links.get((pair[1], pair[0])) or self.bus

    def seconds(self, a: str, b: str, size: float) -> float:
        """Time to bring ``size`` bytes from ``a`` to ``b``; 0 on the same device."""
        return self.link(a, b).seconds(size)

    @cached_property
    def _by_name(self) -> dict[str, Device]:
        return {d.name: d for d in self.devices}


@dataclass(frozen=True, slots=True)
class Task:
    """Something to run, and what it costs."""

    name: str
    sources: tuple[str, ...]
    seconds: Mapping[str, float]  #: by device name; a device that is missing cannot run it
    bytes: float = 0.0  #: of its result
    work: float = 0.0  #: bytes beside its inputs and its result while it runs; a task of 0 s may hold none
    parts: int = 1  #: into how many band slices it may be cut; ``work`` shrinks by that
    takes: Mapping[str, float] = field(default_factory=dict)  #: bytes of a source that travel here, if not all of it


@dataclass(frozen=True, slots=True)
class Slot:
    """A task in its place."""

    task: str
    device: str
    start: float
    end: float
    parts: int = 1
    after: str = ""  #: the task it waited for: its data, its device or its memory; empty if none


@dataclass(frozen=True, slots=True)
class Move:
    """A result on its way to another device, where the copy stays ``until`` its last use there."""

    task: str
    bytes: float
    source: str
    device: str
    start: float
    end: float
    until: float


@dataclass(frozen=True, slots=True)
class Schedule:
    """When each task runs and where, in order of time, and what that takes."""

    slots: tuple[Slot, ...]
    makespan: float
    peak: Mapping[str, float]  #: bytes by device, every device of the cluster
    transferred: float  #: bytes
    moves: tuple[Move, ...] = ()

    def utilisation(self) -> dict[str, float]:
        """Share of the makespan that each device works."""
        busy = dict.fromkeys(self.peak, 0.0)
        for slot in self.slots:
            busy[slot.device] += slot.end - slot.start
        return {name: time / self.makespan if self.makespan else 0.0 for name, time in busy.items()}

    def critical_path(self) -> tuple[Slot, ...]:
        """From the first slot on, each the reason why the next could not begin earlier, to the one that ends last."""
        by_name = {slot.task: slot for slot in self.slots}
        at = max(self.slots, key=lambda slot: slot.end, default=None)
        path = []
        while at is not None:
            path.append(at)
            at = by_name.get(at.after)
        return tuple(reversed(path))


class TooLarge(ValueError):
    """A task that fits nowhere: ``needed`` bytes at once on ``device``, which has ``memory``."""

    def __init__(self, task: str, device: str, needed: float, memory: float, parts: int = 1) -> None:
        self.task, self.device, self.needed, self.memory = task, device, needed, memory
        how = f" in {parts} parts" if parts > 1 else ""
        super().__init__(
            f"{task} does not fit: with its inputs and what must stay there it needs {_size(needed)} on {device}{how}, "
            f"which has {_size(memory)}"
        )

    @property
    def short(self) -> float:
        """Bytes that are missing."""
        return self.needed - self.memory


def _size(count: float) -> str:
    """Bytes to the last one, and as people read them."""
    exact = f"{count:,.0f} B"
    return exact if count < 1e6 else f"{exact} ({count / 1e9:.3g} GB)"
