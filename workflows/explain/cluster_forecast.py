"""Forecast of a recipe on other machines: makespan, utilisation, transfers and peak memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.placement.heft_and_cpop import Device, Schedule, Slot, Task, TooLarge, heft
from neusee.workflows.placement.machine_file import Machines
from neusee.workflows.report.run_timing import size_of

_MOST_PARTS = 64  #: upper bound on the parts of a step cut by bands; the number of bands is known when the step runs
_SHOWN = 24  #: steps of the critical path


class Cost(Protocol):
    """Cost of a step, from earlier runs."""

    @property
    def seconds(self) -> Mapping[str, float]: ...
    @property
    def bytes(self) -> float: ...
    @property
    def work(self) -> float: ...
    @property
    def known(self) -> bool: ...


def cluster_lines(recipe: Recipe, estimates: Mapping[str, Cost], machines: Machines) -> list[str]:
    """Return lines on makespan, devices, bytes sent, critical path, and on costs that were never measured.

    Every step of ``estimates`` runs, as if nothing were stored. The seconds on a device are those on the
    measured CPU divided by the device's speed. A plan that does not fit is one line with the needed bytes.
    """
    devices, alone = len(machines.devices), sum(map(_measured, estimates.values()))
    head = f"{_count(len(estimates), 'step')} on {_count(devices, 'device')}: {machines.title or 'no title'}"
    try:
        schedule = simulated(recipe, estimates, machines)
    except TooLarge as error:
        return [head, f"refused: {error}", *_guesses(estimates)]
    faster = f": {alone / schedule.makespan:.3g} times as long" if schedule.makespan else ""
    sent = f"{_size(schedule.transferred)} in {_count(len(schedule.moves), 'copy', 'copies')}"
    return [
        head,
        "",
        f"makespan     {_time(schedule.makespan)}; where they were measured, one after another, {_time(alone)}{faster}",
        f"transferred  {sent}",
        *([f"in parts     {cut}"] if (cut := _cut(schedule)) else []),
        "",
        *_devices(schedule, machines),
        "",
        *_path(schedule),
        *_guesses(estimates),
    ]


def simulated(recipe: Recipe, estimates: Mapping[str, Cost], machines: Machines) -> Schedule:
    """Return the schedule of a recipe's steps on other machines; raise `TooLarge` where the memory is too small."""
    tasks = [_task(recipe.steps[name], cost, estimates, machines) for name, cost in estimates.items()]
    return heft(tasks, machines.cluster, [name for name in dict.fromkeys(recipe.outputs) if name in estimates])


def _task(step: Step, cost: Cost, among: Mapping[str, Cost], machines: Machines) -> Task:
    hint = step.device or step.node.device
    allowed = [d for d in machines.devices if _fits(d, hint)] or machines.devices
    seconds = {d.name: _measured(cost) / machines.speed(d.name, step.node.path) for d in allowed}
    sources = tuple(dict.fromkeys(name for name in step.sources if name in among))
    return Task(step.name, sources, seconds, cost.bytes, cost.work, _MOST_PARTS if step.node.bands else 1)


def _fits(device: Device, hint: str) -> bool:
    """Return True if a hint such as ``cpu``, ``gpu`` or ``cuda:1`` allows a device."""
    if hint in ("any", ""):
        return True
    return device.kind != "cpu" if hint == "gpu" else hint in (device.kind, device.name.rpartition("/")[2])


def _measured(cost: Cost) -> float:
    """Return the seconds on the CPU on which the costs were measured."""
    return cost.seconds["cpu"]


# --- lines ----------------------------------------------------------------------------------------------------------


def _devices(schedule: Schedule, machines: Machines) -> list[str]:
    """Return one line for each device: its share of the makespan, its steps and its memory."""
    shares, steps = schedule.utilisation(), dict.fromkeys(schedule.peak, 0)
    for slot in schedule.slots:
        steps[slot.device] += 1
    rows = [["device", "busy", "steps", "memory", "of"]]
    for d in machines.devices:
        rows.append(
            [d.name, f"{shares[d.name]:.0%}", str(steps[d.name]), _size(schedule.peak[d.name]), _size(d.memory)]
        )
    mean = sum(shares.values()) / len(shares)
    return [*_columns(rows, ">"), f"the devices are busy {mean:.0%} of the time on average"]


def _path(schedule: Schedule) -> list[str]:
    """Return the critical path; the middle of a long path is left out."""
    path = schedule.critical_path()
    busy = sum(slot.end - slot.start for slot in path)
    share = (
        f" of {_time(schedule.makespan)}; the rest is waiting for data or memory"
        if busy < 0.999 * schedule.makespan
        else ""
    )
    rows = [["critical path", "device", "at", "takes"], *map(_row, path)]
    if len(path) > _SHOWN:
        half = _SHOWN // 2
        rows = [*rows[: half + 1], [f"… {len(path) - _SHOWN} more …", "", "", ""], *rows[-half:]]
    return [*_columns(rows), f"{_count(len(path), 'step')} on it, {_time(busy)}{share}"]


def _row(slot: Slot) -> list[str]:
    return [slot.task, slot.device, _time(slot.start), _time(slot.end - slot.start)]


def _cut(schedule: Schedule) -> str:
    """Return the steps that must be cut by bands to fit into memory."""
    return ", ".join(f"{slot.task} ({slot.parts})" for slot in schedule.slots if slot.parts > 1)


def _guesses(estimates: Mapping[str, Cost]) -> list[str]:
    names = [name for name, cost in estimates.items() if not cost.known]
    if not names:
        return []
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ["", f"guesses, never measured: {', '.join(names[:_SHOWN])}{more}"]


def _time(seconds: float) -> str:
    return f"{seconds:.3g} s" if seconds >= 1 or seconds == 0 else f"{seconds * 1e3:.3g} ms"


def _size(count: float) -> str:
    return size_of(count) if count < 1e12 else f"{count / 1e12:.3g} TB"


def _count(number: int, one: str, many: str = "") -> str:
    return f"{number} {one if number == 1 else many or one + 's'}"


def _columns(rows: Sequence[Sequence[str]], numbers: str = "<") -> list[str]:
    """Return aligned columns, the first one to the left."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    form = [f"<{widths[0]}", *(f"{numbers}{wide}" for wide in widths[1:])]
    return ["  ".join(f"{cell:{how}}" for cell, how in zip(row, form, strict=True)).rstrip() for row in rows]
