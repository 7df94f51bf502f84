"""CPOP, the other heuristic of the paper that describes HEFT: a competitor that shares no line with
the scheduler.

Source: Topcuoglu, Hariri, Wu, IEEE Transactions on Parallel and Distributed Systems 13 (2002) 260,
        section 4.2.
"""

from __future__ import annotations

from neusee.workflows.placement.tasks_and_devices import Cluster, Task

Slots = dict[str, tuple[str, float, float]]  #: device, start (s) and end (s) by task


def cpop(tasks: list[Task], cluster: Cluster) -> Slots:
    """The schedule in which the critical path runs on one device; memory is not looked at."""
    names = [device.name for device in cluster.devices]
    by_name = {task.name: task for task in tasks}
    readers = {task.name: [r.name for r in tasks if task.name in r.sources] for task in tasks}
    pairs = [(a, b) for a in names for b in names if a != b]

    def sent(source: str, reader: str, links: list[tuple[str, str]]) -> float:
        size = by_name[reader].takes.get(source, by_name[source].bytes)
        return sum(cluster.link(*pair).seconds(size) for pair in links) / max(len(links), 1)

    mean = {task.name: sum(task.seconds[d] for d in names) / len(names) for task in tasks}
    down: dict[str, float] = {}
    for task in tasks:  # each comes after its sources
        down[task.name] = max(
            (down[s] + mean[s] + sent(s, task.name, pairs) for s in task.sources), default=0.0
        )
    up: dict[str, float] = {}
    for task in reversed(tasks):
        rest = ((sent(task.name, r, pairs) + up[r]) for r in readers[task.name])
        up[task.name] = mean[task.name] + max(rest, default=0.0)
    through = {name: round(up[name] + down[name], 9) for name in by_name}

    path, at = [], max((t.name for t in tasks if not t.sources), key=through.__getitem__)
    while at:
        path.append(at)
        at = max(readers[at], key=through.__getitem__, default="")
    fastest = min(names, key=lambda d: sum(by_name[name].seconds[d] for name in path))

    slots: Slots = {}
    while len(slots) < len(tasks):
        ready = [t for t in tasks if t.name not in slots and all(s in slots for s in t.sources)]
        task = min(ready, key=lambda t: (-through[t.name], t.name))
        choices = []
        for d in [fastest] if task.name in path else names:
            data = [
                slots[s][2] + (sent(s, task.name, [(slots[s][0], d)]) if slots[s][0] != d else 0.0)
                for s in task.sources
            ]
            start = _gap(
                sorted(s[1:] for s in slots.values() if s[0] == d),
                max(data, default=0.0),
                task.seconds[d],
            )
            choices.append((start + task.seconds[d], d, start))
        end, d, start = min(choices, key=lambda choice: choice[0])
        slots[task.name] = (d, start, end)
    return slots


def _gap(busy: list[tuple[float, float]], ready: float, seconds: float) -> float:
    """The first time from ``ready`` on at which the device is idle for so long."""
    for start, end in busy:
        if ready + seconds <= start:
            return ready
        ready = max(ready, end)
    return ready
