"""Forecast of a run from earlier runs: cache hits, bytes, seconds, memory and devices."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from neusee.workflows.engine.cost_laws import sizes_of
from neusee.workflows.engine.cost_model import Costs, Estimate
from neusee.workflows.engine.local_executor import lanes_of
from neusee.workflows.engine.node_call import places
from neusee.workflows.engine.placement_inputs import past_costs, prepare, running_peak
from neusee.workflows.engine.resolve_keys import resolve
from neusee.workflows.engine.step_job import Lane, StepJob
from neusee.workflows.explain.report_memory import report_peak, shown_steps
from neusee.workflows.graph.recipe_graph import Recipe, needed
from neusee.workflows.keys.cache_key import Key, device_kind
from neusee.workflows.placement.heft_schedule import Schedule, TooLarge
from neusee.workflows.report.contents import steps_of, wanted
from neusee.workflows.report.text_table import columns
from neusee.workflows.store.byte_sizes import format_size
from neusee.workflows.store.result_store import Store
from neusee.workflows.tolerance.cheaper_steps import with_substitutions


@dataclass(frozen=True)
class Plan:
    """Forecast of a run: the steps to compute and to read, with their costs and their schedule."""

    recipe: Recipe
    order: list[str]
    keys: dict[str, Key]
    left_out: dict[str, bool | None]  #: None where only the inputs of a step can decide
    awake: set[str]  #: steps that would be computed or left out
    loaded: dict[str, int]  #: stored steps that would be read, with their bytes
    expected: Mapping[str, Estimate]  #: by step, for the steps that would run
    lanes: Mapping[str, str]  #: by step
    schedule: Schedule | None
    refused: str = ""  #: why the memory is too small
    running: float = 0.0  #: peak memory of this process in bytes while the steps run, the program itself included
    reporting: float = 0.0  #: peak memory of this process in bytes while the report is written


def planned(recipe: Recipe, store: Store, lanes: Mapping[str, Lane]) -> Plan:
    """Return the forecast of a run: the steps to compute and to read, their costs and their schedule."""
    recipe = with_substitutions(recipe, wanted(recipe))
    order = steps_of(recipe)
    devices = [lane.device for lane in lanes.values()]
    resolved = resolve(recipe, order, store, ",".join(devices))
    keys, left_out = resolved.keys, {name: resolved.left_out(name) for name in order}
    awake, loaded = _awake(recipe, keys, store, wanted(recipe))
    makers: dict[Key, str] = {}
    for name in order:
        if name in awake and not left_out[name]:
            makers.setdefault(keys[name], name)
    works = [_work(recipe, name, keys, devices) for name in makers.values()]
    costs = past_costs(store, sizes_of(recipe, order)) if works else Costs([])
    abouts = {work.key: about for work in works if (about := store.about(work.key))}
    kinds = sorted({lane.kind for lane in lanes.values()} | {"cpu"})
    expected = {w.step.name: costs.of(w.step, kinds, abouts.get(w.key)) for w in works}
    empty = Plan(recipe, order, keys, left_out, awake, loaded, expected, {}, None)
    try:
        found = prepare(works, costs, abouts, lanes, [keys[name] for name in wanted(recipe)])
    except TooLarge as error:
        return replace(empty, refused=str(error))
    where = {w.step.name: w.lane for w in found.works}
    plan = replace(empty, lanes=where, schedule=found.schedule, running=running_peak(found.schedule, lanes))
    return _with_report(plan, store, costs, lanes)


def _with_report(plan: Plan, store: Store, costs: Costs, lanes: Mapping[str, Lane]) -> Plan:
    """Return the plan with the memory of the report, and with the reason if the limit is too small for the report."""
    cpu = [lane for lane in lanes.values() if lane.kind == "cpu"]
    shown = shown_steps(plan.recipe)
    order = needed(plan.recipe, shown)
    keys = resolve(plan.recipe, order, store, ",".join(lane.device for lane in lanes.values())).keys
    there = {plan.keys[name] for name in plan.order}
    makers: dict[Key, str] = {}
    for name in _awake(plan.recipe, keys, store, shown, there)[0]:
        makers.setdefault(keys[name], name)
    devices = [lane.device for lane in lanes.values()]
    works = [_work(plan.recipe, name, keys, devices) for name in order if name in set(makers.values())]
    costs = costs.with_sizes(sizes_of(plan.recipe, order))
    try:
        peak = report_peak(works, {name: keys[name] for name in shown}, costs, lanes)
    except TooLarge as error:
        return replace(plan, refused=f"for the report, {error}")
    limit = sum(lane.memory for lane in cpu) + max((lane.held for lane in cpu), default=0.0)
    plan = replace(plan, reporting=peak)
    if not cpu or peak <= limit:
        return plan
    why = f"the report needs {format_size(peak)} to show the results, and the limit is {format_size(limit)}"
    return replace(plan, refused=f"{why}: give more memory, or choose a smaller picture or number of bands")


def plan_lines(recipe: Recipe, store: Store, device: str = "cpu", memory: int | None = None) -> tuple[list[str], bool]:
    """Return the table of a forecast as lines, and True if the run would lack memory."""
    lanes = lanes_of(device.split(","), memory)
    plan = planned(recipe, store, lanes)
    rows = [_row(name, plan, store) for name in plan.order]
    head = ["step", "node", "state", "where", "seconds", "bytes", "memory", "reads"]
    return [*columns([head, *rows]), *_sums(plan, lanes)], bool(plan.refused)


def simulated_lines(recipe: Recipe, store: Store, machines: str) -> list[str]:
    """Return the forecast of a run with an empty store on the machines of a YAML file, as lines of text."""
    from neusee.workflows.explain.cluster_forecast import cluster_lines
    from neusee.workflows.placement.machine_file import read_machines

    cluster, recipe = read_machines(machines), with_substitutions(recipe, wanted(recipe))
    costs, kinds = (
        past_costs(store, sizes_of(recipe, steps_of(recipe))),
        sorted({"cpu", *(device.kind for device in cluster.devices)}),
    )
    names = steps_of(recipe)
    return cluster_lines(recipe, {name: costs.of(recipe.steps[name], kinds) for name in names}, cluster)


def _row(name: str, plan: Plan, store: Store) -> list[str]:
    step, about = plan.recipe.steps[name], store.about(plan.keys[name])
    reads = ", ".join(dict.fromkeys(step.sources))
    if plan.left_out.get(name):
        return [name, step.node.path, "left out", "", "", "", "", reads]
    if name in plan.expected:
        cost = plan.expected[name]
        where = plan.lanes.get(name, "?")
        seconds = cost.seconds.get(device_kind(where), cost.seconds["cpu"])
        mark = "" if cost.known else "guess: "
        costs = [f"{mark}{seconds:.3f} s", f"{mark}{format_size(cost.bytes)}", f"{mark}{format_size(cost.peak)}"]
        return [name, step.node.path, "run", where, *costs, reads]
    state = "stored" if store.has(plan.keys[name]) else "run" if name in plan.awake else "not needed"
    known = [f"{about['seconds']:.3f} s", format_size(about["bytes"])] if about else ["", ""]
    return [name, step.node.path, state, "", *known, "", reads]


def _sums(plan: Plan, lanes: Mapping[str, Lane]) -> list[str]:
    """Return text lines with the totals of a forecast over all steps, and with the steps that may be left out."""
    ran, new = len(plan.expected), sum(e.bytes for e in plan.expected.values())
    guesses = sum(not e.known for e in plan.expected.values())
    lines = []
    if unsure := [name for name, known in plan.left_out.items() if known is None]:
        lines.append(f"left out or not, depending on the values of the inputs: {', '.join(unsure)}")
    took = f"about {plan.schedule.makespan:.3g} s" if plan.schedule else "no schedule"
    guessed = f", {guesses} of them guessed at the upper end, because never measured" if guesses else ""
    read = format_size(sum(plan.loaded.values()))
    lines.append(
        f"{ran} of {len(plan.order)} steps would run{guessed}: {took}, {format_size(int(new))} new, {read} to load"
    )
    if plan.schedule:
        for name, lane in lanes.items():
            peak = format_size(plan.schedule.peak.get(name, 0.0))
            lines.append(f"memory  {name}: {peak} at most, of {format_size(max(lane.memory, 0.0))}")
    if plan.running:
        held = format_size(max(lane.held for lane in lanes.values()))
        lines.append(
            f"memory  process: {format_size(plan.running)} while the steps run, of which the program itself holds "
            f"{held}; {format_size(plan.reporting)} while the report is written"
        )
    return [*lines, *([f"refused: {plan.refused}"] if plan.refused else [])]


def _work(recipe: Recipe, name: str, keys: Mapping[str, Key], devices: Sequence[str]) -> StepJob:
    step = recipe.steps[name]
    reads = tuple(tuple(keys[s] for s in ((w,) if isinstance(w, str) else w or ())) for w in step.wires.values())
    return StepJob(step, keys[name], {}, reads, recipe.seed, recipe.name, places(step, devices)[0], "")


def _awake(
    recipe: Recipe, keys: Mapping[str, Key], store: Store, targets: Iterable[str], there: Container[Key] = ()
) -> tuple[set[str], dict[str, int]]:
    """Return the steps that a run must compute, and the size (bytes) of each stored result that the run must read.

    Results with the keys ``there`` are known and need no step.
    """
    found, loaded, todo = set[str](), dict[str, int](), [*targets]
    while todo:
        name = todo.pop()
        if name in found or name in loaded or keys[name] in there:
            continue
        if store.has(keys[name]):
            about: dict[str, Any] = store.about(keys[name]) or {}
            loaded[name] = about.get("bytes", 0)
        else:
            found.add(name)
            todo += recipe.steps[name].sources
    return found, loaded
