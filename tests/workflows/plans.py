"""Plans to test the scheduler with: the published example, random graphs, an exact search, and a
referee.
"""

from __future__ import annotations

import itertools
import math
import random
from dataclasses import replace

from neusee.workflows.placement.heft_schedule import Cluster, Device, Link, Schedule, Task

#: Topcuoglu, Hariri, Wu, IEEE TPDS 13 (2002) 260, figure 2 and table 1: seconds by processor, and
#: by edge
_COSTS = (
    "14 16 9; 13 19 18; 11 13 19; 13 8 17; 12 13 10; 13 16 9; 7 15 11; 5 11 14; 18 12 20; 21 7 16"
)
_EDGES = (
    "1-2:18 1-3:12 1-4:9 1-5:11 1-6:14 2-8:19 2-9:16 3-7:23 4-8:27 4-9:23 5-9:13 6-8:15 7-10:17"
    " 8-10:11 9-10:13"
)
RANKS = [108.0, 77.0, 80.0, 80.0, 69.0, 190 / 3, 128 / 3, 107 / 3, 133 / 3, 44 / 3]

UNIT = Link(1.0, 0.0)  #: an edge of n bytes costs n seconds


def published() -> tuple[list[Task], Cluster]:
    """Ten tasks on three processors."""
    takes: dict[str, dict[str, float]] = {str(i): {} for i in range(1, 11)}
    for edge in _EDGES.split():
        (source, reader), size = edge.partition(":")[0].split("-"), edge.partition(":")[2]
        takes[reader][source] = float(size)
    rows = [[float(x) for x in row.split()] for row in _COSTS.split(";")]
    tasks = [
        Task(name, tuple(taken), {f"P{k}": s for k, s in enumerate(row, 1)}, takes=taken)
        for (name, taken), row in zip(takes.items(), rows, strict=True)
    ]
    return tasks, Cluster(tuple(Device(f"P{k}") for k in (1, 2, 3)), bus=UNIT)


def layered(
    seed: int, count: int, devices: int = 3, talk: float = 1.0
) -> tuple[list[Task], Cluster]:
    """Tasks in layers of one to four; ``talk`` is the mean cost of an edge over that of a task."""
    dice, layers, left = random.Random(seed), [], count
    while left:
        layers.append(min(left, dice.randint(1, 4)))
        left -= layers[-1]
    names = iter(f"t{i}" for i in range(count))
    rows = [[next(names) for _ in range(wide)] for wide in layers]
    tasks = []
    for above, row in zip([[], *rows], rows, strict=False):
        for name in row:
            sources = tuple(dice.sample(above, dice.randint(1, len(above)))) if above else ()
            seconds = {f"d{k}": dice.uniform(5, 25) for k in range(devices)}
            tasks.append(Task(name, sources, seconds, bytes=dice.uniform(0, 30) * talk))
    return tasks, Cluster(tuple(Device(f"d{k}") for k in range(devices)), bus=UNIT)


def crowded(seed: int) -> tuple[list[Task], Cluster, list[str]]:
    """A random graph with bytes, on one to four devices that may be too small for it, and what
    is kept.
    """
    dice = random.Random(seed)
    devices = tuple(
        Device(
            f"{dice.choice(['', 'n/'])}d{k}",
            dice.choice(["cpu", "cuda"]),
            dice.choice([120, 160, 200, 300]),
        )
        for k in range(dice.randint(1, 4))
    )
    tasks: list[Task] = []
    for i in range(dice.randint(4, 16)):
        able = (
            dice.sample(devices, dice.randint(1, len(devices))) if dice.random() < 0.5 else devices
        )
        seconds = {d.name: float(dice.choice([0, 1, 2, 3, dice.random()])) for d in able}
        sources = tuple(t.name for t in dice.sample(tasks, min(len(tasks), dice.randint(0, 3))))
        takes = {name: float(dice.randint(0, 20)) for name in sources if dice.random() < 0.1}
        size, work = (
            dice.choice([0, dice.randint(1, 60), 60 * dice.random()]),
            dice.choice([0, dice.randint(1, 160)]),
        )
        tasks.append(Task(f"t{i}", sources, seconds, size, work, dice.choice([1, 1, 3, 31]), takes))
    links = {("cpu", "cuda"): Link(20.0, 0.1), ("cuda", "cuda"): Link(200.0, 0.0)}
    keep = [t.name for t in tasks if dice.random() < 0.15]
    return tasks, Cluster(devices, links, Link(50.0, 0.05), Link(10.0, 0.5)), keep


def memory(cluster: Cluster) -> dict[str, float]:
    return {device.name: device.memory for device in cluster.devices}


def sized(cluster: Cluster, changed: dict[str, float]) -> Cluster:
    """The same devices with other memories."""
    return replace(
        cluster,
        devices=tuple(replace(d, memory=changed.get(d.name, d.memory)) for d in cluster.devices),
    )


# --- the referee ----------------------------------------------------------------------------------


def fouls(
    tasks: list[Task], cluster: Cluster, schedule: Schedule, keep: list[str] = ()
) -> list[str]:  # type: ignore[assignment]
    """What is wrong with a schedule, replayed from its slots and moves alone."""
    slots = {slot.task: slot for slot in schedule.slots}
    if not sorted(slots) == sorted(t.name for t in tasks) == sorted(s.task for s in schedule.slots):
        return ["not every task once"]
    found = []
    for slot in schedule.slots:
        task = next(t for t in tasks if t.name == slot.task)
        if (
            not math.isclose(slot.end - slot.start, task.seconds[slot.device], abs_tol=1e-9)
            or slot.start < 0
        ):
            found.append(f"{slot}: wrong time")
        if not 1 <= slot.parts <= task.parts:
            found.append(f"{slot}: wrong parts")
        found += [
            f"{slot}: no {source}"
            for source in task.sources
            if not _has(task, source, slots, schedule)
        ]
    for one, other in itertools.combinations(schedule.slots, 2):
        if one.device == other.device and max(one.start, other.start) < min(one.end, other.end):
            found.append(f"{one} overlaps {other}")
    for move in schedule.moves:
        needs = cluster.link(move.source, move.device).seconds(move.bytes)
        made = slots[move.task]
        if move.source != made.device or move.start < made.end:
            found.append(f"{move}: leaves too early")
        if not math.isclose(move.end - move.start, needs, abs_tol=1e-9) or move.until < move.end:
            found.append(f"{move}: wrong time")
    return [*found, *_totals(tasks, cluster, schedule, keep)]


def _has(task: Task, source: str, slots: dict, schedule: Schedule) -> bool:
    """Whether a source's result is on the task's device for as long as that runs."""
    mine, its = slots[task.name], slots[source]
    if mine.device == its.device:
        return its.end <= mine.start
    return any(
        move.task == source
        and move.device == mine.device
        and move.end <= mine.start
        and move.until >= mine.end
        and move.bytes == task.takes.get(source, move.bytes)
        for move in schedule.moves
    )


def _totals(tasks: list[Task], cluster: Cluster, schedule: Schedule, keep: list[str]) -> list[str]:
    found = []
    over = max((slot.end for slot in schedule.slots), default=0.0)
    if schedule.makespan != over:
        found.append(f"ends at {over}, not at {schedule.makespan}")
    if not math.isclose(schedule.transferred, sum(m.bytes for m in schedule.moves), abs_tol=1e-9):
        found.append("wrong bytes sent")
    for device in cluster.devices:
        peak = most_held(tasks, schedule, device.name, keep)
        if peak > device.memory:
            found.append(f"{peak} B on {device}")
        if not peak <= schedule.peak[device.name] <= peak + len(tasks) * 160:
            found.append(f"{device.name} holds {peak} B, not {schedule.peak[device.name]}")
    return found


def most_held(tasks: list[Task], schedule: Schedule, device: str, keep: list[str]) -> float:
    """Most bytes on a device in the middle between any two events that follow one another."""
    spans: list[tuple[float, float, float]] = [
        (m.start, m.until, math.ceil(m.bytes)) for m in schedule.moves if m.device == device
    ]
    slots = {slot.task: slot for slot in schedule.slots}
    for task in tasks:
        slot = slots[task.name]
        if slot.device != device:
            continue
        readers = [slots[t.name] for t in tasks if task.name in t.sources]
        last = max([slot.end, *(r.end for r in readers if r.device == device)])
        last = max([last, *(m.end for m in schedule.moves if m.task == task.name)])
        spans.append(
            (slot.start, schedule.makespan if task.name in keep else last, math.ceil(task.bytes))
        )
        spans.append((slot.start, slot.end, math.ceil(task.work / slot.parts)))
    times = sorted({t for start, end, _ in spans for t in (start, end)})
    return max(
        (
            sum(size for start, end, size in spans if start <= a and b <= end)
            for a, b in itertools.pairwise(times)
        ),
        default=0.0,
    )


# --- the exact search -----------------------------------------------------------------------------


class Exact:
    """The shortest makespan of all schedules, by branch and bound; memory is not looked at.

    Every best schedule can be built in the order of its starts, each task as early as its data and
    its device allow, so no other orders are tried.
    """

    def __init__(self, tasks: list[Task], cluster: Cluster, best: float) -> None:
        self.names = [task.name for task in tasks]
        index = {name: i for i, name in enumerate(self.names)}
        self.devices = [device.name for device in cluster.devices]
        self.cost = [[task.seconds[d] for d in self.devices] for task in tasks]
        self.least = [min(row) for row in self.cost]
        self.sources = [[index[s] for s in task.sources] for task in tasks]
        self.sent = [
            [
                cluster.link(*self.devices[:2]).seconds(t.takes.get(s, tasks[index[s]].bytes))
                for s in t.sources
            ]
            for t in tasks
        ]
        self.tail = list(self.least)
        for i in reversed(range(len(tasks))):  # tasks come after their sources
            for j in self.sources[i]:
                self.tail[j] = max(self.tail[j], self.least[j] + self.tail[i])
        self.best = best + 1e-9
        self._search({}, [0.0] * len(self.devices), 0.0, 0.0)

    def _search(
        self, done: dict[int, tuple[int, float]], free: list[float], last: float, over: float
    ) -> None:
        """Place one more task after those of ``done``: device and end by task."""
        if len(done) == len(self.names):
            self.best = min(self.best, over)
            return
        ready = [
            i for i, s in enumerate(self.sources) if i not in done and all(j in done for j in s)
        ]
        left = sum(seconds for i, seconds in enumerate(self.least) if i not in done)
        if (sum(max(f, last) for f in free) + left) / len(free) >= self.best:
            return
        choices = []
        for i in ready:
            for d in range(len(free)):
                start = max(
                    [free[d], *(self._arrives(i, k, d, done) for k in range(len(self.sources[i])))]
                )
                bound = start + self.cost[i][d] + self.tail[i] - self.least[i]
                if start >= last and bound < self.best:
                    choices.append((bound, i, d, start))
        for bound, i, d, start in sorted(choices):
            if bound < self.best:
                end = start + self.cost[i][d]
                after = [end if k == d else f for k, f in enumerate(free)]
                self._search({**done, i: (d, end)}, after, start, max(over, end))

    def _arrives(self, i: int, k: int, d: int, done: dict[int, tuple[int, float]]) -> float:
        on, end = done[self.sources[i][k]]
        return end if on == d else end + self.sent[i][k]


def least_memory(tasks: list[Task], keep: list[str]) -> float:
    """The smallest memory with which some order runs on one device, by trying all orders."""
    readers = {t.name: {r.name for r in tasks if t.name in r.sources} for t in tasks}
    best: dict[frozenset[str], float] = {frozenset(): 0.0}
    for _ in tasks:
        following: dict[frozenset[str], float] = {}
        for done, peak in best.items():
            held = sum(
                math.ceil(t.bytes)
                for t in tasks
                if t.name in done and (t.name in keep or readers[t.name] - done)
            )
            for task in tasks:
                if task.name not in done and done.issuperset(task.sources):
                    now = held + math.ceil(task.bytes) + math.ceil(task.work / task.parts)
                    key = done | {task.name}
                    following[key] = min(following.get(key, math.inf), max(peak, now))
        best = following
    return next(iter(best.values()))
