"""Pictures of a run. Each picture is stored by the key of its values, and is drawn once."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from neusee.workflows.engine.runner import Result, run
from neusee.workflows.graph.step_record import StepRecord
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.engine_digest import engine
from neusee.workflows.placement.tasks_and_devices import Schedule, Slot
from neusee.workflows.report.contents import FIGURES
from neusee.workflows.report.requirements import Found, Missing, find
from neusee.workflows.store.derived_files import DerivedFiles

GRAPH = (
    "graph",
    "The graph",
    "Each box is a step; the items of one step share a box. A step stands below the steps that it reads.",
)
TIMELINE = (
    "timeline",
    "Planned and actual times",
    "Time and device of each step. Hollow bars show the plan, which uses the times of earlier runs. A step that "
    "never ran before has no hollow bar.",
)


@dataclass(frozen=True, slots=True)
class Job:
    """A file that a run can provide: its name, its key, the values that it needs, and the function that writes it."""

    name: str
    suffix: str
    key: str
    found: Mapping[str, Found]
    make: Callable[..., bytes]


def pictures(result: Result, shelf: DerivedFiles) -> tuple[dict[str, Path], dict[str, str]]:
    """Return the path of every picture that can be drawn, and the reason why each other picture is missing."""
    code, drawing = Code(result.store.code_memo), _drawing()
    jobs, missing = [], {}
    for figure in FIGURES:
        try:
            found = needs(figure.needs, result, code)
        except Missing as why:
            missing[figure.name] = str(why)
            continue
        key = digest("figure", figure.draw, drawing, [[name, f.identity] for name, f in found.items()])
        jobs.append(Job(figure.name, ".png", key, found, _function(figure.draw)))
    code.save()
    made = finished(jobs, result, shelf, missing)
    return {**made, "graph": _graph(result, shelf, drawing)}, missing


def timeline(result: Result) -> bytes | None:
    """Draw the times of all steps beside the plan; return None if no step ran.

    Times differ from run to run, so the picture is not stored.
    """
    ran = [done for done in result.done.values() if done.state == "run"]
    if not ran:
        return None
    first = min(done.began for done in ran)
    rows = [(done.step, done.lane or done.device, done.began - first, done.seconds) for done in ran]
    known = [done for done in ran if done.predicted is not None]
    plan = result.schedule or Schedule((), 0.0, {}, 0.0)
    slots = {slot.task: slot for slot in plan.slots}
    whole = all(done.step in slots for done in known)
    planned = tuple(slots[done.step] for done in known) if whole else _in_turn(known)
    return _function("report.figures.gantt:timeline")(schedule=replace(plan, slots=planned), rows=rows)


def _in_turn(known: Iterable[StepRecord]) -> tuple[Slot, ...]:
    """Return one plan in place of several: on each lane, the steps follow each other in the order in which they ran."""
    end: dict[str, Slot] = {}
    slots = []
    for done in sorted(known, key=lambda done: done.began):
        lane, before = done.lane or done.device, end.get(done.lane or done.device)
        start = before.end if before else 0.0
        slots.append(Slot(done.step, lane, start, start + (done.predicted or 0.0), after=before.task if before else ""))
        end[lane] = slots[-1]
    return tuple(slots)


def needs(wanted: Mapping[str, str], result: Result, code: Code) -> dict[str, Found]:
    """Resolve the need of each argument; omit an argument if its need begins with ``?`` and its step is missing."""
    found = {}
    for argument, need in wanted.items():
        try:
            found[argument] = find(need.removeprefix("?"), result.recipe, result.keys, code)
        except Missing:
            if not need.startswith("?"):
                raise
    return found


def finished(jobs: Iterable[Job], result: Result, shelf: DerivedFiles, missing: dict[str, str]) -> dict[str, Path]:
    """Return the file of each job, either stored or made now; one run provides the values of all new files."""
    jobs = list(jobs)
    done = {job.name: path for job in jobs if (path := shelf.find(job.key, job.suffix))}
    todo = [job for job in jobs if job.name not in done]
    steps = {step for job in todo for f in job.found.values() for step in f.steps}
    values = run(result.recipe, result.store, sorted(steps), device=result.device).values if todo else {}
    for job in todo:
        arguments = {name: f.make(values) for name, f in job.found.items()}
        try:
            content = job.make(**arguments)
        except (ValueError, Missing, RuntimeError) as error:
            missing[job.name] = str(error).partition("\n")[0]
            continue
        done[job.name] = shelf.keep(job.key, job.suffix, job.name, content)
    return {job.name: done[job.name] for job in jobs if job.name in done}


def _function(path: str) -> Callable[..., bytes]:
    """Return the drawing function ``module:function``; its module is imported at the first call."""
    module, _, name = path.partition(":")

    def draw(**arguments: Any) -> bytes:
        found: bytes = getattr(importlib.import_module(f"neusee.workflows.{module}"), name)(**arguments)
        return found

    return draw


def _drawing() -> str:
    """Return a digest of the drawing code, so that a change of this code draws every picture again."""
    return engine(*sorted({figure.draw.partition(":")[0] for figure in FIGURES}), "report.figures.recipe_graph")


def _graph(result: Result, shelf: DerivedFiles, drawing: str) -> Path:
    """Draw the graph with the state of each step; also draw and store the graph of a fully cached run for later."""
    states = {name: "cached" if done.state == "not needed" else str(done.state) for name, done in result.done.items()}
    again = {name: "left out" if state == "left out" else "cached" for name, state in states.items()}
    sources = {name: list(result.recipe.steps[name].sources) for name in result.done}
    paths = []
    for now in (states, again):
        key = digest("graph", drawing, sources, now)
        path = shelf.find(key, ".png")
        if path is None:
            content = _function("report.figures.recipe_graph:graph")(sources=sources, states=now)
            path = shelf.keep(key, ".png", "graph", content)
        paths.append(path)
    return paths[0]
