"""Pictures of a run, each drawn once and stored under a key of the results that it shows."""

from __future__ import annotations

import importlib
import itertools
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from neusee.workflows.engine.machine_resources import give_back
from neusee.workflows.engine.node_call import to_device
from neusee.workflows.engine.runner import Result, run
from neusee.workflows.graph.recipe_graph import Recipe, StepRecord
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.keys.code_digest import Code, engine
from neusee.workflows.placement.tasks_and_devices import Schedule, Slot
from neusee.workflows.report.contents import FIGURES, Missing, Source, find, is_table
from neusee.workflows.store.derived_files import DerivedFiles
from neusee.workflows.store.result_store import Store

# --- shown values ---------------------------------------------------------------------------------

# Values that the pictures and data files of a run show, in memory only from their first use to
# their last.


def in_turn(groups: Sequence[Sequence[str]], result: Result) -> Iterator[Mapping[str, Any]]:
    """Yield for each group of steps the values of these steps, on the first device of the run.

    The values of the run itself are used where it has them. Other values are read from the store
    when their group comes, and the few that the store lacks are computed together before the first
    group. A value is deleted after the last group that needs it.
    """
    uses_left = Counter(itertools.chain.from_iterable(groups))
    # values that neither the run nor the store has are computed in one run
    values = dict(_computed([step for step in uses_left if _is_lacking(step, result)], result))
    for group in groups:
        values |= _read([step for step in group if step not in values], result)
        yield {step: values[step] for step in group}
        uses_left.subtract(group)
        # no later group needs them
        _drop([step for step in values if uses_left[step] <= 0], values)


def _drop(steps: Sequence[str], values: dict[str, Any]) -> None:
    """Delete the values of steps, and give their memory back."""
    for step in steps:
        del values[step]
    if steps:
        give_back()


def _is_lacking(step: str, result: Result) -> bool:
    """Return True for a step whose value neither the run nor its store has."""
    return step not in result.values and not result.store.has(result.keys[step])


def _read(steps: Iterable[str], result: Result) -> dict[str, Any]:
    """Return the values of steps from the run, from its store, or computed again if the store
    has lost them.
    """
    device, values, lost_steps = result.device.partition(",")[0], {}, list[str]()
    for step in steps:
        if step in result.values:
            values[step] = result.values[step]
            continue
        result_type = result.recipe.steps[step].node.hints.get("return", Any)
        with suppress(KeyError):
            values[step] = to_device(result.store.get(result.keys[step], result_type), device)
        if step not in values:
            lost_steps.append(step)
    return {**values, **_computed(lost_steps, result)}


def _computed(steps: Sequence[str], result: Result) -> Mapping[str, Any]:
    """Return the values of steps, computed by another run of the recipe."""
    return (
        run(result.recipe, result.store, sorted(steps), device=result.device).values
        if steps
        else {}
    )


# --- run pictures ---------------------------------------------------------------------------------

# Pictures of a run, each drawn once and stored under a cache key of the results that the picture
# shows.


GRAPH = (
    "graph",
    "The graph",
    (
        "Each box is a step; the items of one step share a box. A step stands below the steps that"
        " it reads."
    ),
)
TIMELINE = (
    "timeline",
    "Planned and actual times",
    (
        "Time and device of each step. Hollow bars show the plan, which uses the times of earlier"
        " runs. A step that never ran before has no hollow bar."
    ),
)


@dataclass(frozen=True, slots=True)
class DerivedFile:
    """A figure or data file of a run: ``make(path, …)`` that writes it, and the source of each
    argument.
    """

    name: str
    suffix: str
    kind: Sequence[Any]  #: the parts of the key that do not depend on the results
    needs: Mapping[str, str]
    make: Callable[..., None]
    #: True for a file that is made only if an argument is a table of the user
    only_tables: bool = False
    #: True for a file of uncompressed results: sending them elsewhere takes as long as writing
    copied: bool = False


#: a file, its key, and the arguments of its ``make``
Job = tuple[DerivedFile, str, Mapping[str, Source]]


@dataclass(frozen=True, slots=True)
class Drawing:
    """The function ``module:function`` that draws a picture, which `files_beside` may call in
    another process.
    """

    path: str

    def __call__(self, file: Path, /, **arguments: Any) -> None:
        """Write the picture of the results ``arguments`` into a file."""
        file.write_bytes(_function(self.path)(**arguments))


def pictures(result: Result, shelf: DerivedFiles) -> tuple[dict[str, Path], dict[str, str]]:
    """Draw the pictures of a run; return the paths of the pictures, and the reason for each
    picture that is missing.
    """
    paths, missing = files_of(figure_files(), result, shelf)
    graph_file, _ = (
        shelf.find(key, ".png")
        or shelf.keep(key, ".png", "graph", partial(GRAPH_DRAWING, **arguments))
        for key, arguments in graphs(result.recipe, states_of(result.done))
    )
    return {**paths, "graph": graph_file}, missing


def figure_files() -> Iterator[DerivedFile]:
    """Yield the pictures that show results of steps."""
    for figure in FIGURES:
        kind = ("figure", figure.draw, _drawing_code())
        yield DerivedFile(
            figure.name, ".png", kind, figure.needs, Drawing(figure.draw), figure.only_tables
        )


def graphs(recipe: Recipe, states: Mapping[str, str]) -> list[tuple[str, Mapping[str, Any]]]:
    """Return key and arguments of the graph of a run, and in advance those of the graph of an
    identical later run.

    ``states`` has the state of each step, as `states_of` returns it.
    """
    states_of_next_run = {
        name: "left out" if state == "left out" else "cached" for name, state in states.items()
    }
    sources = {name: list(recipe.steps[name].sources) for name in states}
    return [
        (
            digest("graph", _drawing_code(), sources, step_states),
            {"sources": sources, "states": step_states},
        )
        for step_states in (states, states_of_next_run)
    ]


def states_of(done: Mapping[str, StepRecord]) -> dict[str, str]:
    """Return the state of each step as the graph of a run shows it: a result that no step needed
    is from the cache.
    """
    return {
        name: "cached" if record.state == "not needed" else str(record.state)
        for name, record in done.items()
    }


def _drawing_code() -> str:
    """Return the digest of the code of all modules that draw figures."""
    module_names = sorted({figure.draw.partition(":")[0] for figure in FIGURES})
    return engine(*module_names, "report.figures.graph_and_timeline")


def files_of(
    files: Iterable[DerivedFile], result: Result, shelf: DerivedFiles
) -> tuple[dict[str, Path], dict[str, str]]:
    """Make the figures or data files that the store lacks; return all paths, and the reason for
    each missing file.

    The reason is empty for a figure of tables where the recipe has none.
    """
    code, jobs, missing = Code(result.store.code_memo), list[Job](), dict[str, str]()
    for file in files:
        try:
            sources = arguments_of(file.needs, result.recipe, result.keys, code, result.store)
        except Missing as reason:
            missing[file.name] = str(reason)
            continue
        if file.only_tables and not any(
            is_table(argument.make({})) for argument in sources.values()
        ):
            missing[file.name] = ""
            continue
        jobs.append((file, key_of_file(file, sources), sources))
    code.save()
    return _made(jobs, result, shelf, missing), missing


def timeline(result: Result) -> dict[str, Any] | None:
    """Return the arguments of `TIMELINE_DRAWING`: the predicted and the actual times of all steps
    of a run.

    None if no step ran.
    """
    steps_run = [done for done in result.done.values() if done.state == "run"]
    if not steps_run:
        return None
    start_of_run = min(done.began for done in steps_run)
    bars = [
        (done.step, done.lane or done.device, done.began - start_of_run, done.seconds)
        for done in steps_run
    ]
    schedule = result.schedule or Schedule((), 0.0, {}, 0.0)
    return {"schedule": replace(schedule, slots=_planned(steps_run, schedule)), "rows": bars}


def _planned(ran: Sequence[StepRecord], plan: Schedule) -> tuple[Slot, ...]:
    """Return the slots of the steps that ran, from the plan if it has all of them and none is a
    guess.
    """
    predicted = [done for done in ran if done.predicted is not None]
    slots = {slot.task: slot for slot in plan.slots}
    # where the time of a step is only a guess, the gap that it leaves in the schedule is no plan to
    # compare with
    if len(predicted) == len(ran) and all(done.step in slots for done in predicted):
        return tuple(slots[done.step] for done in predicted)
    return _in_turn(predicted)


def _in_turn(predicted: Iterable[StepRecord]) -> tuple[Slot, ...]:
    """Return a schedule of predicted times in which the steps of each device follow each other
    as they ran.
    """
    last_slot: dict[str, Slot] = {}
    slots = []
    for done in sorted(predicted, key=lambda done: done.began):
        lane = done.lane or done.device
        slot_before = last_slot.get(lane)
        start = slot_before.end if slot_before else 0.0
        end = start + (done.predicted or 0.0)
        # a step begins when the one before it on its device ends
        task_before = slot_before.task if slot_before else ""
        slots.append(Slot(done.step, lane, start, end, after=task_before))
        last_slot[lane] = slots[-1]
    return tuple(slots)


def arguments_of(
    needs: Mapping[str, str], recipe: Recipe, keys: Mapping[str, str], code: Code, store: Store
) -> dict[str, Source]:
    """Find the source of each argument of a drawing function; omit arguments marked by ``?`` whose
    step is missing.

    Raises `Missing` for another argument whose step is missing.
    """
    sources = {}
    for argument, need in needs.items():
        try:
            sources[argument] = find(need.removeprefix("?"), recipe, keys, code, store)
        except Missing:
            if not need.startswith("?"):
                raise
    return sources


def steps_of(sources: Mapping[str, Source]) -> frozenset[str]:
    """Return the steps that the sources of all arguments need."""
    return frozenset(itertools.chain.from_iterable(source.steps for source in sources.values()))


def key_of_file(file: DerivedFile, sources: Mapping[str, Source]) -> str:
    """Return the key of a file: the digest of its kind and of the results that it shows."""
    return digest(*file.kind, [[name, source.identity] for name, source in sources.items()])


def _made(
    jobs: Sequence[Job], result: Result, shelf: DerivedFiles, missing: dict[str, str]
) -> dict[str, Path]:
    """Compute the figures or data files that the store lacks from the results of a run, and
    return all paths.
    """
    paths = _stored(jobs, shelf)
    # a job: file, key, sources of its arguments
    lacking = [job for job in jobs if job[0].name not in paths]
    steps_of_jobs = [sorted(steps_of(sources)) for _, _, sources in lacking]
    for (file, key, sources), values in zip(lacking, in_turn(steps_of_jobs, result), strict=True):
        arguments = {name: source.make(values) for name, source in sources.items()}
        try:
            paths[file.name] = shelf.keep(
                key, file.suffix, file.name, partial(file.make, **arguments)
            )
        except (ValueError, Missing, RuntimeError) as error:
            missing[file.name] = str(error).partition("\n")[0]
    return {file.name: paths[file.name] for file, _, _ in jobs if file.name in paths}


def _stored(jobs: Sequence[Job], shelf: DerivedFiles) -> dict[str, Path]:
    """Return the paths of the files that the store has."""
    paths = {}
    for file, key, _ in jobs:
        if path := shelf.find(key, file.suffix):
            paths[file.name] = path
    return paths


def _function(path: str) -> Callable[..., bytes]:
    """Return the drawing function named ``module:function``, whose module is imported at the
    first call.
    """
    module, _, name = path.partition(":")
    return lambda **arguments: getattr(importlib.import_module(f"neusee.workflows.{module}"), name)(
        **arguments
    )


GRAPH_DRAWING = Drawing("report.figures.graph_and_timeline:graph")
# not stored, for no two runs take the same times
TIMELINE_DRAWING = Drawing("report.figures.graph_and_timeline:timeline")
