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

_SHOWN_STEPS = 24  #: greatest number of listed steps


def cluster_lines(
    recipe: Recipe, estimates: Mapping[str, Estimate], machines: Machines
) -> list[str]:
    """Return text on the makespan, the devices, the transfers and the critical path of a run with
    an empty store.

    The seconds on a device are the measured seconds on the CPU, divided by the relative speed of
    the device.
    """
    # the time (s) is that on the machine where the steps were measured
    device_count, sequential_seconds = (
        len(machines.devices),
        sum(cost.seconds["cpu"] for cost in estimates.values()),
    )
    head = (
        f"{_count(len(estimates), 'step')} on {_count(device_count, 'device')}:"
        f" {machines.title or 'no title'}"
    )
    try:
        schedule = simulated(recipe, estimates, machines)
    except TooLarge as error:
        return [head, f"refused: {error}", *_guesses(estimates)]
    ratio_text = (
        f": {sequential_seconds / schedule.makespan:.3g} times as long" if schedule.makespan else ""
    )
    transfer_text = (
        f"{format_size(schedule.transferred)} in {_count(len(schedule.moves), 'copy', 'copies')}"
    )
    # steps that are computed in parts of their bands, with the number of parts
    parts_text = ", ".join(
        f"{slot.task} ({slot.parts})" for slot in schedule.slots if slot.parts > 1
    )
    return [
        head,
        "",
        (
            f"makespan     {_time(schedule.makespan)}; where they were measured, one after another,"
            f" {_time(sequential_seconds)}{ratio_text}"
        ),
        f"transferred  {transfer_text}",
        *([f"in parts     {parts_text}"] if parts_text else []),
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
    """Return the task of a step for the schedule: its sources, its time on each device that may run
    it, and its sizes in bytes.
    """
    hint = step.device or step.node.device
    allowed = [
        device
        for device in machines.devices
        if fits(device.name.rpartition("/")[2], device.kind, hint)
    ] or machines.devices
    seconds = {
        device.name: cost.seconds["cpu"] / machines.speed(device.name, step.node.path)
        for device in allowed
    }
    sources = tuple(dict.fromkeys(name for name in step.sources if name in among))
    return Task(step.name, sources, seconds, cost.bytes, cost.work, parts_of(step, cost))


def _devices(schedule: Schedule, machines: Machines) -> list[str]:
    """Return one text line for each device: busy fraction of the makespan, number of steps and
    peak memory.
    """
    busy_shares, step_counts = (
        schedule.utilisation(),
        Counter(slot.device for slot in schedule.slots),
    )
    rows = [
        [
            device.name,
            f"{busy_shares[device.name]:.0%}",
            str(step_counts[device.name]),
            format_size(schedule.peak[device.name]),
            format_size(device.memory),
        ]
        for device in machines.devices
    ]
    # mean over all devices
    mean_share = sum(busy_shares.values()) / len(busy_shares)
    table = columns([["device", "busy", "steps", "memory", "of"], *rows], ">")
    return [*table, f"the devices are busy {mean_share:.0%} of the time on average"]


def _path(schedule: Schedule) -> list[str]:
    """Return a table of the critical path, shortened in the middle if the path is long."""
    path = schedule.critical_path()
    busy_seconds = sum(slot.end - slot.start for slot in path)
    wait = f" of {_time(schedule.makespan)}; the rest is waiting for data or memory"
    wait_text = wait if busy_seconds < 0.999 * schedule.makespan else ""
    row_of_slot = [
        [slot.task, slot.device, _time(slot.start), _time(slot.end - slot.start)] for slot in path
    ]
    rows = [["critical path", "device", "at", "takes"], *row_of_slot]
    if len(path) > _SHOWN_STEPS:
        half_count = _SHOWN_STEPS // 2
        # one more row at the front: the head of the table
        rows = [
            *rows[: half_count + 1],
            [f"… {len(path) - _SHOWN_STEPS} more …", "", "", ""],
            *rows[-half_count:],
        ]
    return [*columns(rows), f"{_count(len(path), 'step')} on it, {_time(busy_seconds)}{wait_text}"]


def _guesses(estimates: Mapping[str, Estimate]) -> list[str]:
    """Return lines that list the steps whose costs are guesses; an empty list if there are none."""
    names = [name for name, cost in estimates.items() if not cost.known]
    if not names:
        return []
    remainder = f" and {len(names) - _SHOWN_STEPS} more" if len(names) > _SHOWN_STEPS else ""
    return ["", f"guesses, never measured: {', '.join(names[:_SHOWN_STEPS])}{remainder}"]


def _time(seconds: float) -> str:
    """Return a time as text in s or ms."""
    return f"{seconds:.3g} s" if seconds >= 1 or seconds == 0 else f"{seconds * 1e3:.3g} ms"


def _count(number: int, singular: str, many: str = "") -> str:
    """Return a number with its noun as text, such as ``3 steps``."""
    return f"{number} {singular if number == 1 else many or singular + 's'}"
