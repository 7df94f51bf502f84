"""Forecast of a run from earlier runs: cache hits, bytes, seconds, memory and devices."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from textwrap import wrap
from typing import Any

from neusee.workflows.engine.cost_laws import sizes_of
from neusee.workflows.engine.cost_model import Costs, Estimate
from neusee.workflows.engine.local_executor import lanes_of, memory_limit
from neusee.workflows.engine.node_call import places
from neusee.workflows.engine.placement_inputs import past_costs, prepare, running_peak
from neusee.workflows.engine.resolve_keys import resolve
from neusee.workflows.engine.step_job import Lane, StepJob
from neusee.workflows.explain.forecast_table import forecast_rows, seconds_text, table_lines
from neusee.workflows.explain.report_memory import held_beside, report_peak, shown_steps
from neusee.workflows.graph.recipe_graph import Recipe, needed, nodes_of
from neusee.workflows.keys.cache_key import Key
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.placement.heft_schedule import Schedule, TooLarge
from neusee.workflows.report.contents import steps_of, wanted
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


def lanes_for(recipe: Recipe, device: str, memory: int | None) -> dict[str, Lane]:
    """Return the lanes of a run on the devices ``device``, with the libraries that its steps load in the program."""
    cheaper = with_substitutions(recipe, wanted(recipe))
    return lanes_of(device.split(","), memory, nodes_of(cheaper, wanted(recipe)))


def planned(recipe: Recipe, store: Store, lanes: Mapping[str, Lane], beside: float = 0.0) -> Plan:
    """Return the forecast of a run: the steps to compute and to read, their costs and their schedule.

    ``beside`` is the memory (bytes) of a run that makes files beside its steps, and 0 for one that makes them later.
    """
    recipe = with_substitutions(recipe, wanted(recipe))
    order = steps_of(recipe)
    devices = [lane.device for lane in lanes.values()]
    code = Code(store.code_memo)
    resolved = resolve(recipe, order, store, ",".join(devices), code)
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
    expected = costs.in_turn(((w.step.name, w.step, abouts.get(w.key)) for w in works), kinds)
    empty = Plan(recipe, order, keys, left_out, awake, loaded, expected, {}, None)
    try:
        found = prepare(works, costs, abouts, lanes, [keys[name] for name in wanted(recipe)])
    except TooLarge as error:
        return replace(empty, refused=str(error))
    where = {w.step.name: w.lane for w in found.works}
    running = running_peak(found.schedule, lanes) + (held_beside(recipe, costs, beside) if works else 0.0)
    plan = replace(empty, lanes=where, schedule=found.schedule, running=running)
    return _with_report(plan, store, costs, lanes, code)


def _with_report(plan: Plan, store: Store, costs: Costs, lanes: Mapping[str, Lane], code: Code) -> Plan:
    """Return the plan with the memory of the report, and with the reason if the limit is too small for the report."""
    cpu = [lane for lane in lanes.values() if lane.kind == "cpu"]
    shown = shown_steps(plan.recipe)
    order = needed(plan.recipe, shown)
    keys = resolve(plan.recipe, order, store, ",".join(lane.device for lane in lanes.values()), code).keys
    there = {plan.keys[name] for name in plan.order}
    makers: dict[Key, str] = {}
    for name in _awake(plan.recipe, keys, store, shown, there)[0]:
        makers.setdefault(keys[name], name)
    devices = [lane.device for lane in lanes.values()]
    works = [_work(plan.recipe, name, keys, devices) for name in order if name in set(makers.values())]
    costs = costs.with_sizes(sizes_of(plan.recipe, order))
    try:
        peak = report_peak(works, plan.recipe, {name: keys[name] for name in shown}, costs, lanes, plan.running)
    except TooLarge as error:
        return replace(plan, refused=f"for the report, {error}")
    limit = sum(lane.memory for lane in cpu) + max((lane.held for lane in cpu), default=0.0)
    plan = replace(plan, reporting=peak)
    if not cpu or peak <= limit:
        return plan
    why = f"the report needs {format_size(peak)} to show the results, and the limit is {format_size(limit)}"
    return replace(plan, refused=f"{why}: give more memory, or choose a smaller picture or number of bands")


@dataclass(frozen=True)
class Forecast:
    """Forecast of a run for a reader: lines of text, and the costs of each step as values for JSON."""

    lines: list[str]
    steps: list[dict[str, Any]]
    totals: dict[str, Any]
    refused: bool  #: True if the run would lack memory


def forecast(recipe: Recipe, store: Store, device: str = "cpu", memory: int | None = None) -> Forecast:
    """Return the forecast of a run with the table of its steps, its totals, and whether it would lack memory."""
    lanes = lanes_for(recipe, device, memory)
    plan = planned(recipe, store, lanes, memory_limit(None) if memory is None else 0.0)
    rows, totals = forecast_rows(plan, store), _totals(plan)
    return Forecast([*table_lines(rows), *_sums(plan, lanes, totals)], rows, totals, bool(plan.refused))


def _totals(plan: Plan) -> dict[str, Any]:
    """Return the totals of a forecast over all steps as values for JSON: seconds with their range, bytes and memory."""
    took = plan.schedule.makespan if plan.schedule else None
    sums = [(cost.seconds["cpu"], cost.spread[1]) for cost in plan.expected.values()]
    alone = sum(seconds for seconds, _ in sums)
    ends = {
        "least": sum(seconds * around.least for seconds, around in sums),
        "most": sum(seconds * around.most for seconds, around in sums),
    }
    ranged = {end: took * total / alone for end, total in ends.items()} if took and alone else {}
    return {
        "steps": len(plan.expected),
        "guesses": sum(not cost.known for cost in plan.expected.values()),
        "seconds": took and {"expected": took, **ranged},
        "bytes": sum(cost.bytes for cost in plan.expected.values()),
        "memory_of_steps": plan.running or None,
        "memory_of_report": plan.reporting or None,
    }


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
    return cluster_lines(recipe, costs.in_turn(((name, recipe.steps[name], None) for name in names), kinds), cluster)


def _sums(plan: Plan, lanes: Mapping[str, Lane], totals: Mapping[str, Any]) -> list[str]:
    """Return text lines with the totals of a forecast over all steps, and with the steps that may be left out."""
    lines = []
    if unsure := [name for name, known in plan.left_out.items() if known is None]:
        lines += _wrapped(f"left out or not, depending on the values of the inputs: {', '.join(unsure)}")
    seconds = totals["seconds"]
    took = f"about {seconds_text(seconds)} s" if seconds else "no schedule" if seconds is None else "no time"
    guessed = f", {totals['guesses']} of them guessed at the upper end, because never measured"
    read, new = format_size(sum(plan.loaded.values())), format_size(int(totals["bytes"]))
    would = f"{totals['steps']} of {len(plan.order)} steps would run{guessed if totals['guesses'] else ''}"
    lines += _wrapped(f"{would}: {took}, {new} new, {read} to load")
    if plan.schedule and plan.expected:
        for name, lane in lanes.items():
            peak = format_size(plan.schedule.peak.get(name, 0.0))
            lines.append(f"memory  {name}: {peak} at most, of {format_size(max(lane.memory, 0.0))}")
    if plan.running and plan.expected:
        held = format_size(max(lane.held for lane in lanes.values()))
        lines += _wrapped(
            f"memory  process: {format_size(plan.running)} while the steps run, of which the program itself holds "
            f"{held}; {format_size(plan.reporting)} while the report is written"
        )
    return [*lines, *(_wrapped(f"refused: {plan.refused}") if plan.refused else [])]


def _wrapped(text: str) -> list[str]:
    """Return a text as lines of at most 80 columns; the later lines are indented."""
    return wrap(text, 80, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


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
