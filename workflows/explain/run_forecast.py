"""Forecast of a run from earlier runs: cache hits, seconds, memory and devices."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from textwrap import wrap
from typing import Any

from neusee.workflows.engine.cost_model import Costs, Estimate, Range, program_law, sizes_of
from neusee.workflows.engine.local_executor import lanes_of, memory_limit, program_memory
from neusee.workflows.engine.node_call import places
from neusee.workflows.engine.placement_inputs import past_costs, prepare, running_peak
from neusee.workflows.engine.resolve_keys import resolve
from neusee.workflows.engine.step_job import Lane, StepJob
from neusee.workflows.engine.wanted_steps import steps_of, wanted
from neusee.workflows.explain.cluster_forecast import cluster_lines
from neusee.workflows.graph.recipe_graph import Recipe, needed, nodes_of
from neusee.workflows.keys.cache_key import Key, device_kind
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.placement.heft_schedule import Schedule, TooLarge
from neusee.workflows.placement.machine_file import read_machines
from neusee.workflows.report.contents import FIGURES, files_of
from neusee.workflows.report.files_beside import LARGE_RESULT, ROOM
from neusee.workflows.report.terminal_text import columns
from neusee.workflows.store.cache_settings import UNITS, format_size
from neusee.workflows.store.metadata import Metadata
from neusee.workflows.store.result_store import Store
from neusee.workflows.tolerance.cheaper_steps import with_substitutions

# --- forecast table -------------------------------------------------------------------------------

# Table of a forecast: the expected cost of each step of a recipe, with its range, in 80 columns.


Row = dict[str, Any]
_SHORT_SECONDS, _SMALL_BYTES = (
    0.01,
    1e6,
)  #: time (s) and size (bytes) below which the table gives no exact cost
#: peak (bytes) below which its range is not shown, because freed memory is used again
_SURE = 1e7


def forecast_rows(plan: Plan, store: Store) -> list[Row]:
    """Return the forecast of each step of a recipe as values for JSON: its state, its costs and
    their ranges.

    A range is a dict with the keys ``expected``, ``least`` and ``most``. A guess counts at its
    upper end.
    """
    return [_row(name, plan, store) for name in plan.order]


def _row(name: str, plan: Plan, store: Store) -> Row:
    """Return the forecast of one step, in the form of `forecast_rows`."""
    step, metadata = plan.recipe.steps[name], store.about(plan.keys[name])
    row: Row = {
        "step": name,
        "node": step.node.path,
        "state": "",
        "where": "",
        "seconds": None,
        "bytes": None,
    }
    row |= {"memory": None, "guess": False, "reads": list(dict.fromkeys(step.sources))}
    if plan.left_out.get(name):
        return row | {"state": "left out"}
    if name in plan.expected:
        # "?" stands for a step without a device, because the memory is too small
        lane = plan.lanes.get(name, "?")
        return row | {"state": "run", "where": lane, **_costs(plan.expected[name], lane)}
    state = "run" if name in plan.awake else "not needed"
    if store.has(plan.keys[name]):
        state = "stored"
    measured_costs = (
        {"seconds": _ranged(metadata["seconds"], Range()), "bytes": metadata["bytes"]}
        if metadata
        else {}
    )
    return row | {"state": state, **measured_costs}


def _costs(cost: Estimate, where: str) -> Row:
    """Return the time, the size of the result and the memory of a step that will run, with their
    ranges.
    """
    seconds = cost.seconds.get(device_kind(where), cost.seconds["cpu"])
    memory_range, time_range = cost.spread
    peak = _ranged(cost.peak, memory_range)
    # the memory is at least the size of the result
    peak["least"] = max(peak["least"], cost.bytes)
    cost_fields = {"seconds": _ranged(seconds, time_range), "bytes": cost.bytes, "memory": peak}
    return cost_fields | {"guess": not cost.known, "bytes_guessed": not cost.sized}


def _ranged(expected: float, around: Range) -> dict[str, float]:
    """Return an expected value with the least and the largest value of its range."""
    return {"expected": expected, "least": expected * around.least, "most": expected * around.most}


def table_lines(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the table of a forecast as lines of text, from the rows of `forecast_rows`.

    A range follows its value, ``0.81 (0.7-1.2)``. A negligible value is written as below
    a limit, and a guess as ``guess`` with its largest value.
    """
    head = ["step", "where", "seconds", "bytes", "memory"]
    return columns([head, *(_cells(row) for row in rows)])


def _cells(row: Mapping[str, Any]) -> list[str]:
    """Return the cells of one row of the table."""
    state = row["where"] or row["state"]
    seconds, memory = row["seconds"], row["memory"]
    size = "" if row["bytes"] is None else format_size(row["bytes"])
    if row["guess"]:
        # show the largest value of each guess
        size = f"guess <{size}" if row["bytes_guessed"] else size
        return [
            row["step"],
            state,
            f"guess <{seconds['most']:.2g}",
            size,
            f"guess <{format_size(memory['most'])}",
        ]
    return [
        row["step"],
        state,
        seconds_text(seconds) if seconds else "",
        size,
        memory_text(memory) if memory else "",
    ]


def seconds_text(cost: Mapping[str, float]) -> str:
    """Return a duration in s with its range as text, such as ``0.81 (0.7-1.2)``."""
    if cost["expected"] < _SHORT_SECONDS:
        return f"<{_SHORT_SECONDS}"
    return f"{_figures(cost['expected'])}{_between(cost, 1.0)}"


def memory_text(cost: Mapping[str, float]) -> str:
    """Return a number of bytes with its range as text, such as ``120 MB (98-140)``."""
    if cost["expected"] < _SMALL_BYTES:
        return f"<{format_size(_SMALL_BYTES)}"
    text = format_size(cost["expected"])
    # the range is in the unit of the text
    return text if cost["expected"] < _SURE else f"{text}{_between(cost, UNITS[text.split()[1]])}"


def _between(cost: Mapping[str, float], unit: float) -> str:
    """Return the range of a cost as text, or an empty text for a cost that is known exactly."""
    low, high = (_figures(cost[end] / unit) for end in ("least", "most"))
    return f" ({low}-{high})" if low != high else ""


def _figures(value: float) -> str:
    """Return a number as text without an exponent: two decimals for numbers below 1, one decimal
    below 10, otherwise none.
    """
    if value < 0.995:
        return f"{value:.2f}"
    return f"{value:.1f}" if value < 9.95 else f"{value:.0f}"


# --- report memory --------------------------------------------------------------------------------

# Memory of the report of a run: the results shown in its pictures and data files, and the copies
# made for them.
#
# This includes the results that are kept for files made during the run.


#: The next three numbers are fitted by tests/benchmarks/bench_memory.py to the measured memory of
#: the reports of shipped recipes.
DRAWING = 74.3e6  #: memory (bytes) of the libraries that draw pictures and write files
#: share of the memory of the steps that the process does not return to the system
HELD_BACK = 0.0101
COPIES = 2.25  #: number of copies of the results in memory while a picture or file of them is made
# matches the name of a step, but not a parameter or a function of a step
_NEED = re.compile(r"\??(?P<step>[\w.]+(\[[^\]]*\])?)$")


def shown_steps(recipe: Recipe) -> list[str]:
    """Return the steps of the recipe whose results the pictures and data files of a run show."""
    groups = [recipe.outputs, *chain.from_iterable(_jobs(recipe))]
    names = dict.fromkeys(chain.from_iterable(groups))
    return [name for name in names if name in recipe.steps]


def held_beside(recipe: Recipe, costs: Costs, limit: float) -> float:
    """Return the largest total size (bytes) of the results that `FilesBeside` keeps in memory for
    files made during the run.

    The values that the run returns are not counted, because they stay in memory with or without
    files. ``limit`` is the memory (bytes) that the process may use; 0 means that no file is made
    during the run.
    """
    # limits (bytes) for: a result that waits with others; the sum of all waiting results; a result
    # that waits alone
    largest_small, room_for_small, largest_shown = (
        min(LARGE_RESULT, limit / 32),
        min(ROOM, limit / 16),
        limit / 16,
    )
    sizes = [costs.size_of(name) for name in shown_steps(recipe) if name not in wanted(recipe)]
    small_bytes = sum(size for size in sizes if size <= largest_small)
    return min(small_bytes, room_for_small) + max(
        (size for size in sizes if largest_small < size <= largest_shown), default=0.0
    )


def report_peak(
    works: list[StepJob],
    recipe: Recipe,
    keys: Mapping[str, str],
    costs: Costs,
    lanes: Mapping[str, Lane],
    running: float = 0.0,
) -> float:
    """Return the predicted peak memory of this process in bytes while the report is written.

    Args:
        works: the steps that only the report needs
        keys: the keys of the results that are shown, by step
        running: the predicted peak memory of this process while the steps run
    """
    schedule = prepare(works, costs, {}, lanes, list(keys.values())).schedule if works else None
    making_peak = max(schedule.peak.values(), default=0.0) if schedule else 0.0
    program_bytes = max((lane.held for lane in lanes.values()), default=0.0) or program_memory()
    shown_bytes = COPIES * shown_at_once(recipe, costs)
    return (
        program_bytes
        + DRAWING
        + HELD_BACK * max(0.0, running - program_bytes)
        + max(making_peak, shown_bytes)
    )


def shown_at_once(recipe: Recipe, costs: Costs) -> float:
    """Return the largest total size (bytes) of the results that are in memory at the same time
    while pictures and files are made.

    The outputs of the recipe stay in memory. Any other result is in memory from the first picture
    or file that shows it to the last, as in `workflows.report.shown_values`.
    """
    largest = 0.0
    for groups in _jobs(recipe):
        uses_left, in_memory = Counter(chain.from_iterable(groups)), set(recipe.outputs)
        for group in groups:
            in_memory.update(group)
            largest = max(
                largest, sum(costs.size_of(name) for name in in_memory if name in recipe.steps)
            )
            uses_left.subtract(group)
            # results that no later picture shows are freed
            in_memory = {
                name for name in in_memory if uses_left[name] > 0 or name in recipe.outputs
            }
    return largest


def _jobs(recipe: Recipe) -> tuple[Sequence[Sequence[str]], ...]:
    """Return the steps that each picture shows, and the steps that each data file shows."""
    steps_of_pictures = [list(_found(recipe, figure.needs)) for figure in FIGURES]
    return steps_of_pictures, [
        list(_found(recipe, needs)) for _, needs in files_of(recipe).values()
    ]


def _found(recipe: Recipe, needs: Mapping[str, str]) -> Iterator[str]:
    """Yield the names of the steps that the needs of a picture or file match; ``*`` stands for any
    item.
    """
    for match in filter(None, map(_NEED.match, needs.values())):
        pattern = re.escape(match["step"]).replace(r"\*", "[^,]*")
        yield from (name for name in recipe.steps if re.fullmatch(pattern, name))


# --- run forecast ---------------------------------------------------------------------------------

# Forecast of a run from earlier runs: cache hits, bytes, seconds, memory and devices.


@dataclass(frozen=True)
class Plan:
    """Forecast of a run: the steps to compute and to read, with their costs and their schedule."""

    recipe: Recipe
    order: list[str]
    keys: dict[str, Key]
    #: True for a step that is left out; None if only the values of its inputs can decide
    left_out: dict[str, bool | None]
    awake: set[str]  #: steps that would be computed or left out
    loaded: dict[str, int]  #: size (bytes) of each stored result that would be read, by step
    expected: Mapping[str, Estimate]  #: by step, for the steps that would run
    lanes: Mapping[str, str]  #: by step
    schedule: Schedule | None
    refused: str = ""  #: the reason why the memory is too small; empty if it suffices
    #: peak memory of this process in bytes while the steps run, the program itself included
    running: float = 0.0
    reporting: float = 0.0  #: peak memory of this process in bytes while the report is written


def lanes_for(recipe: Recipe, device: str, memory: int | None) -> dict[str, Lane]:
    """Return the lanes of a run on the devices ``device``; the memory of the program includes the
    libraries that the steps load.
    """
    cheaper_recipe = with_substitutions(recipe, wanted(recipe))
    return lanes_of(device.split(","), memory, nodes_of(cheaper_recipe, wanted(recipe)))


def planned(recipe: Recipe, store: Store, lanes: Mapping[str, Lane], beside: float = 0.0) -> Plan:
    """Return the forecast of a run: the steps to compute and to read, their costs and their
    schedule.

    ``beside`` is the memory (bytes) of a run that makes files during its steps; 0 for a run that
    makes them later.
    """
    recipe = with_substitutions(recipe, wanted(recipe))
    order = steps_of(recipe)
    devices = _devices_of(lanes)
    code = Code(store.code_memo)
    resolved = resolve(recipe, order, store, ",".join(devices), code)
    keys, left_out = resolved.keys, {name: resolved.left_out(name) for name in order}
    awake_steps, loaded = _awake(recipe, keys, store, wanted(recipe))
    # the first of several steps with the same key computes the value
    makers = _first_of_each_key(_running(order, awake_steps, left_out), keys)
    jobs = [_work(recipe, name, keys, devices) for name in makers]
    costs = past_costs(store, sizes_of(recipe, order)) if jobs else Costs([])
    metadata_by_key = _metadata_of(jobs, store)
    kinds = sorted({lane.kind for lane in lanes.values()} | {"cpu"})
    # computed even if no schedule fits into memory
    expected = costs.in_turn(
        ((job.step.name, job.step, metadata_by_key.get(job.key)) for job in jobs), kinds
    )
    plan_without_lanes = Plan(
        recipe, order, keys, left_out, awake_steps, loaded, expected, {}, None
    )
    try:
        prepared = prepare(
            jobs, costs, metadata_by_key, lanes, [keys[name] for name in wanted(recipe)]
        )
    except TooLarge as error:
        return replace(plan_without_lanes, refused=str(error))
    lane_of_step = {job.step.name: job.lane for job in prepared.works}
    peak_while_running = running_peak(prepared.schedule, lanes)
    if jobs:
        peak_while_running += held_beside(recipe, costs, beside)
    plan = replace(
        plan_without_lanes,
        lanes=lane_of_step,
        schedule=prepared.schedule,
        running=peak_while_running,
    )
    return _with_report(plan, store, costs, lanes, code)


def _devices_of(lanes: Mapping[str, Lane]) -> list[str]:
    """Return the device of each lane."""
    return [lane.device for lane in lanes.values()]


def _running(
    order: Iterable[str], awake: Container[str], left_out: Mapping[str, bool | None]
) -> list[str]:
    """Return the steps that will run, as far as this is known."""
    return [name for name in order if name in awake and not left_out[name]]


def _memory_of(lanes: Collection[Lane]) -> float:
    """Return the memory (bytes) that the process may use on ``lanes``, including the memory of the
    program itself.
    """
    return sum(lane.memory for lane in lanes) + max((lane.held for lane in lanes), default=0.0)


def _first_of_each_key(names: Iterable[str], keys: Mapping[str, Key]) -> list[str]:
    """Return the steps ``names`` without those that have the same key as an earlier step."""
    makers: dict[Key, str] = {}
    for name in names:
        makers.setdefault(keys[name], name)
    return list(makers.values())


def _metadata_of(works: Iterable[StepJob], store: Store) -> dict[Key, Metadata]:
    """Return the metadata of those results of jobs that the store has, by key."""
    keys_and_metadata = ((job.key, store.about(job.key)) for job in works)
    return {key: metadata for key, metadata in keys_and_metadata if metadata}


def _with_report(
    plan: Plan, store: Store, costs: Costs, lanes: Mapping[str, Lane], code: Code
) -> Plan:
    """Return the plan with the memory of the report. If the memory limit is too small for the
    report, the plan states the reason.
    """
    cpu_lanes = [lane for lane in lanes.values() if lane.kind == "cpu"]
    steps_shown, devices = shown_steps(plan.recipe), _devices_of(lanes)
    order = needed(plan.recipe, steps_shown)
    keys = resolve(plan.recipe, order, store, ",".join(devices), code).keys
    # results that the run has computed are in memory or stored
    keys_of_run = {plan.keys[name] for name in plan.order}
    awake_steps = _awake(plan.recipe, keys, store, steps_shown, keys_of_run)[0]
    makers = set(_first_of_each_key(awake_steps, keys))
    jobs = [_work(plan.recipe, name, keys, devices) for name in order if name in makers]
    # includes steps that only the report needs
    costs = costs.with_sizes(sizes_of(plan.recipe, order))
    try:
        peak = report_peak(
            jobs,
            plan.recipe,
            {name: keys[name] for name in steps_shown},
            costs,
            lanes,
            plan.running,
        )
    except TooLarge as error:
        return replace(plan, refused=f"for the report, {error}")
    limit = _memory_of(cpu_lanes)
    plan = replace(plan, reporting=peak)
    if not cpu_lanes or peak <= limit:
        return plan
    reason = (
        f"the report needs {format_size(peak)} to show the results, and the limit is"
        f" {format_size(limit)}"
    )
    return replace(
        plan, refused=f"{reason}: give more memory, or choose a smaller picture or number of bands"
    )


@dataclass(frozen=True)
class Forecast:
    """Forecast of a run for a reader: lines of text, and the costs of each step as values for
    JSON.
    """

    lines: list[str]
    steps: list[dict[str, Any]]
    totals: dict[str, Any]
    refused: bool  #: True if the run would lack memory


def forecast(
    recipe: Recipe, store: Store, device: str = "cpu", memory: int | None = None
) -> Forecast:
    """Return the forecast of a run with the table of its steps, its totals, and whether it would
    lack memory.
    """
    lanes = lanes_for(recipe, device, memory)
    plan = planned(recipe, store, lanes, memory_limit(None) if memory is None else 0.0)
    rows, totals = forecast_rows(plan, store), _totals(plan)
    return Forecast(
        [*table_lines(rows), *_sums(plan, lanes, totals)], rows, totals, bool(plan.refused)
    )


def _totals(plan: Plan) -> dict[str, Any]:
    """Return the totals of a forecast over all steps as values for JSON: seconds with their
    range, bytes and memory.
    """
    makespan = plan.schedule.makespan if plan.schedule else None
    least_and_most = _range_of(makespan, plan.expected.values()) if makespan else {}
    steps = makespan and {"expected": makespan, **least_and_most}
    return {
        "steps": len(plan.expected),
        "guesses": sum(not cost.known for cost in plan.expected.values()),
        # steps whose time follows from runs on this processor
        "measured": sum(cost.measured for cost in plan.expected.values()),
        "seconds": steps,
        **(_seconds_of_command(plan, steps) if steps else {}),
        "bytes": sum(cost.bytes for cost in plan.expected.values()),
        "memory_of_steps": plan.running or None,
        "memory_of_report": plan.reporting or None,
    }


def _seconds_of_command(plan: Plan, steps: Mapping[str, float]) -> dict[str, dict[str, float]]:
    """Return the processor time (s) of import and report of a run, and of the whole command."""
    law = program_law()
    importing, reporting = (
        _ranged(seconds, law.range)
        for seconds in law.seconds(_shown_figures(plan.recipe), len(plan.order))
    )
    whole = {
        end: importing[end] + reporting[end] + steps.get(end, steps["expected"])
        for end in ("expected", "least", "most")
    }
    return {
        "seconds_of_import": importing,
        "seconds_of_report": reporting,
        "seconds_of_command": whole,
    }


def report_seconds(plan: Plan) -> float:
    """Return the expected processor time (s) of the report of a run."""
    return program_law().seconds(_shown_figures(plan.recipe), len(plan.order))[1]


def _shown_figures(recipe: Recipe) -> int:
    """Return the number of pictures of the report that show results of a recipe."""
    return sum(bool(steps) for steps in _jobs(recipe)[0])


def _range_of(took: float, costs: Collection[Estimate]) -> dict[str, float]:
    """Return the least and the largest time (s) of a run with the expected time ``took``; an empty
    dict if all its steps take no time.
    """
    seconds_and_spreads = [(cost.seconds["cpu"], cost.spread[1]) for cost in costs]
    total_seconds = sum(seconds for seconds, _ in seconds_and_spreads)
    if not total_seconds:
        return {}
    least_total = sum(seconds * spread.least for seconds, spread in seconds_and_spreads)
    most_total = sum(seconds * spread.most for seconds, spread in seconds_and_spreads)
    # assume that the makespan varies in proportion to the sum of the times of all steps
    return {"least": took * least_total / total_seconds, "most": took * most_total / total_seconds}


def simulated_lines(recipe: Recipe, store: Store, machines: str) -> list[str]:
    """Return the forecast of a run with an empty store on the machines of a YAML file, as lines
    of text.
    """
    cluster, recipe = read_machines(machines), with_substitutions(recipe, wanted(recipe))
    costs, kinds = (
        past_costs(store, sizes_of(recipe, steps_of(recipe))),
        sorted({"cpu", *(device.kind for device in cluster.devices)}),
    )
    names = steps_of(recipe)
    return cluster_lines(
        recipe, costs.in_turn(((name, recipe.steps[name], None) for name in names), kinds), cluster
    )


def _sums(plan: Plan, lanes: Mapping[str, Lane], totals: Mapping[str, Any]) -> list[str]:
    """Return text lines with the totals of a forecast over all steps, and with the steps that
    may be left out.
    """
    lines = []
    if undecided := [name for name, decision in plan.left_out.items() if decision is None]:
        lines += wrapped_text(
            f"left out or not, depending on the values of the inputs: {', '.join(undecided)}"
        )
    time_text = _took_text(totals["seconds"])
    # used only if there are guesses
    guess_text = f", {totals['guesses']} of them guessed at the upper end, because never measured"
    bytes_read, bytes_new = (
        format_size(sum(plan.loaded.values())),
        format_size(int(totals["bytes"])),
    )
    run_text = (
        f"{totals['steps']} of {len(plan.order)} steps would"
        f" run{guess_text if totals['guesses'] else ''}"
    )
    lines += wrapped_text(f"{run_text}: {time_text}, {bytes_new} new, {bytes_read} to load")
    if plan.expected:
        lines += [*_command_lines(totals), *_memory_lines(plan, lanes)]
    return [*lines, *(wrapped_text(f"refused: {plan.refused}") if plan.refused else [])]


def _command_lines(totals: Mapping[str, Any]) -> list[str]:
    """Return lines with the time of the whole command, and with where the times come from."""
    if not totals["seconds"]:
        return []
    importing, reporting, whole = (
        seconds_text(totals[f"seconds_of_{name}"]) for name in ("import", "report", "command")
    )
    text = f"with import {importing} s and report {reporting} s: {whole} s of processor time"
    if totals["measured"]:
        return wrapped_text(text)
    return wrapped_text(f"{text}; a guess by laws, before a step ran on this processor")


def _took_text(seconds: Mapping[str, float] | float | None) -> str:
    """Return the time of a run with its range as text."""
    if seconds is None:
        return "no schedule"
    return f"about {seconds_text(seconds)} s" if isinstance(seconds, Mapping) else "no time"


def _memory_lines(plan: Plan, lanes: Mapping[str, Lane]) -> list[str]:
    """Return lines with the peak memory of each device and of the process."""
    lines = []
    if plan.schedule:
        for name, lane in lanes.items():
            peak = format_size(plan.schedule.peak.get(name, 0.0))
            lines.append(f"memory  {name}: {peak} at most, of {format_size(max(lane.memory, 0.0))}")
    if plan.running:
        program_bytes = format_size(max(lane.held for lane in lanes.values()))
        lines += wrapped_text(
            f"memory  process: {format_size(plan.running)} while the steps run, of which the"
            f" program itself holds {program_bytes}; {format_size(plan.reporting)} while the report"
            " is written"
        )
    return lines


def wrapped_text(text: str) -> list[str]:
    """Return a text as lines of at most 80 columns; the later lines are indented."""
    return wrap(text, 80, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


def _work(recipe: Recipe, name: str, keys: Mapping[str, Key], devices: Sequence[str]) -> StepJob:
    """Return the job of a step, with the fields that a forecast needs."""
    step = recipe.steps[name]
    reads = tuple(
        # an input is connected to one step, several steps or none
        tuple(keys[source] for source in ((wire,) if isinstance(wire, str) else wire or ()))
        for wire in step.wires.values()
    )
    return StepJob(
        step, keys[name], {}, reads, recipe.seed, recipe.name, places(step, devices)[0], ""
    )


def _awake(
    recipe: Recipe,
    keys: Mapping[str, Key],
    store: Store,
    targets: Iterable[str],
    in_memory: Container[Key] = (),
) -> tuple[set[str], dict[str, int]]:
    """Return the steps that a run must compute, and the size (bytes) of each stored result that the
    run must read.

    Results with the keys ``in_memory`` are known and need no step.
    """
    awake_steps, loaded_bytes, names_left = set[str](), dict[str, int](), [*targets]
    while names_left:
        name = names_left.pop()
        if name in awake_steps or name in loaded_bytes or keys[name] in in_memory:
            continue
        if store.has(keys[name]):
            metadata: dict[str, Any] = store.about(keys[name]) or {}
            loaded_bytes[name] = metadata.get("bytes", 0)
        else:
            awake_steps.add(name)
            # the inputs of a missing result
            names_left += recipe.steps[name].sources
    return awake_steps, loaded_bytes
