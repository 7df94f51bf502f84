"""Forecast of a run on other machines: makespan, utilisation, transfers and peak memory."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from neusee.workflows.engine.cost_model import Estimate
from neusee.workflows.engine.node_call import fits
from neusee.workflows.engine.placement_inputs import parts_of
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.placement.heft_schedule import Schedule, Task, TooLarge, heft
from neusee.workflows.placement.machine_file import Machines
from neusee.workflows.report.terminal_text import columns
from neusee.workflows.store.cache_settings import format_size

_SHOWN = 24  #: steps of the critical path


def cluster_lines(
    recipe: Recipe, estimates: Mapping[str, Estimate], machines: Machines
) -> list[str]:
    """Return text on the makespan, the devices, the transfers and the critical path of a run with
    an empty store.

    The seconds on a device are the measured seconds on the CPU, divided by the relative speed of
    the device.
    """
    devices, alone = len(machines.devices), sum(cost.seconds["cpu"] for cost in estimates.values())
    head = (
        f"{_count(len(estimates), 'step')} on {_count(devices, 'device')}:"
        f" {machines.title or 'no title'}"
    )
    try:
        schedule = simulated(recipe, estimates, machines)
    except TooLarge as error:
        return [head, f"refused: {error}", *_guesses(estimates)]
    faster = f": {alone / schedule.makespan:.3g} times as long" if schedule.makespan else ""
    sent = f"{format_size(schedule.transferred)} in {_count(len(schedule.moves), 'copy', 'copies')}"
    cut = ", ".join(f"{slot.task} ({slot.parts})" for slot in schedule.slots if slot.parts > 1)
    return [
        head,
        "",
        (
            f"makespan     {_time(schedule.makespan)}; where they were measured, one after another,"
            f" {_time(alone)}{faster}"
        ),
        f"transferred  {sent}",
        *([f"in parts     {cut}"] if cut else []),
        "",
        *_devices(schedule, machines),
        "",
        *_path(schedule),
        *_guesses(estimates),
    ]


def simulated(recipe: Recipe, estimates: Mapping[str, Estimate], machines: Machines) -> Schedule:
    """Return the schedule of the steps of a recipe on other machines; raise `TooLarge` if the
    memory is too small.
    """
    tasks = [
        _task(recipe.steps[name], cost, estimates, machines) for name, cost in estimates.items()
    ]
    return heft(
        tasks,
        machines.cluster,
        [name for name in dict.fromkeys(recipe.outputs) if name in estimates],
    )


def _task(step: Step, cost: Estimate, among: Mapping[str, Estimate], machines: Machines) -> Task:
    hint = step.device or step.node.device
    allowed = [
        d for d in machines.devices if fits(d.name.rpartition("/")[2], d.kind, hint)
    ] or machines.devices
    seconds = {
        d.name: cost.seconds["cpu"] / machines.speed(d.name, step.node.path) for d in allowed
    }
    sources = tuple(dict.fromkeys(name for name in step.sources if name in among))
    return Task(step.name, sources, seconds, cost.bytes, cost.work, parts_of(step, cost))


def _devices(schedule: Schedule, machines: Machines) -> list[str]:
    """Return one text line for each device: busy fraction of the makespan, number of steps and
    peak memory.
    """
    shares, steps = schedule.utilisation(), Counter(slot.device for slot in schedule.slots)
    rows = [
        [
            d.name,
            f"{shares[d.name]:.0%}",
            str(steps[d.name]),
            format_size(schedule.peak[d.name]),
            format_size(d.memory),
        ]
        for d in machines.devices
    ]
    mean = sum(shares.values()) / len(shares)
    table = columns([["device", "busy", "steps", "memory", "of"], *rows], ">")
    return [*table, f"the devices are busy {mean:.0%} of the time on average"]


def _path(schedule: Schedule) -> list[str]:
    """Return a table of the critical path, shortened in the middle if the path is long."""
    path = schedule.critical_path()
    busy = sum(slot.end - slot.start for slot in path)
    wait = f" of {_time(schedule.makespan)}; the rest is waiting for data or memory"
    share = wait if busy < 0.999 * schedule.makespan else ""
    times = [
        [slot.task, slot.device, _time(slot.start), _time(slot.end - slot.start)] for slot in path
    ]
    rows = [["critical path", "device", "at", "takes"], *times]
    if len(path) > _SHOWN:
        half = _SHOWN // 2
        rows = [*rows[: half + 1], [f"… {len(path) - _SHOWN} more …", "", "", ""], *rows[-half:]]
    return [*columns(rows), f"{_count(len(path), 'step')} on it, {_time(busy)}{share}"]


def _guesses(estimates: Mapping[str, Estimate]) -> list[str]:
    names = [name for name, cost in estimates.items() if not cost.known]
    if not names:
        return []
    remainder = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ["", f"guesses, never measured: {', '.join(names[:_SHOWN])}{remainder}"]


def _time(seconds: float) -> str:
    return f"{seconds:.3g} s" if seconds >= 1 or seconds == 0 else f"{seconds * 1e3:.3g} ms"


def _count(number: int, singular: str, many: str = "") -> str:
    return f"{number} {singular if number == 1 else many or singular + 's'}"
