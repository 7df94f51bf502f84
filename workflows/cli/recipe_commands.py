"""The commands for one recipe or one run of a recipe: run, validate, plan, why, config and report."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from neusee.workflows.cli.command_frame import fail, failing, load, refusing, say, say_line, the_store
from neusee.workflows.cli.command_list import FAILED, MISSED
from neusee.workflows.cli.command_options import (
    AsJson,
    Debug,
    Device,
    Exact,
    Memory,
    Out,
    Quiet,
    Words,
    check_device,
    check_executor,
    executor_of,
    within_memory,
)
from neusee.workflows.cli.interruption import kept_in, print_warning, resumable, say_json
from neusee.workflows.cli.repetition import keep_run, say_and_keep
from neusee.workflows.report.json_output import json_line
from neusee.workflows.report.next_commands import commands_to_try

if TYPE_CHECKING:
    from neusee.workflows.graph.recipe_graph import Recipe
    from neusee.workflows.simulation.simulate_recipe import Simulation
    from neusee.workflows.store.result_store import Store

Rerun = Annotated[
    list[str] | None,
    typer.Option("--rerun", metavar="STEP", help="Compute this step, and all that follow, though stored; repeatable."),
]
Where = Annotated[
    str,
    typer.Option("--executor", help="Who computes: local, dask:4 (workers), slurm:4 (jobs), or tcp://scheduler:8786."),
]
Job = Annotated[
    list[str] | None,
    typer.Option("--job", metavar="NAME=VALUE", help="What a job of SLURM asks for: queue=gpu, cores=4; repeatable."),
]


def run(
    words: Words = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
    device: Device = "cpu",
    executor: Where = "local",
    job: Job = None,
    memory: Memory = "",
    exact: Exact = False,
    rerun: Rerun = None,
    out: Out = Path("runs"),
) -> None:
    """Run a recipe and write its report.

    Steps whose results are in the cache are not computed again. Without a name the recipe is first_light. The folder
    of results holds report.html, the numbers, the pictures and the recipe with every final value.
    """
    check_executor(executor, job or [])
    with within_memory(memory) as limit:
        recipe, command = load(words, "run", exact=exact)
    _check_rerun(recipe, rerun or [])
    from neusee.workflows.report import console, contents
    from neusee.workflows.simulation.simulate_recipe import simulate
    from neusee.workflows.tolerance.cheaper_steps import with_substitutions

    check_device(device)
    silent = as_json or quiet
    before = _opening(recipe, command, silent)
    store = the_store()
    predicted = _predicted(recipe, store, device, limit, executor == "local", silent)
    cheaper = with_substitutions(recipe, contents.wanted(recipe))
    table = console.RunTable(cheaper, contents.steps_of(cheaper), console.mode_for(silent), predicted)
    with (
        resumable(lambda: kept_in(store, f"{table.finished} steps are finished, and results that take time are")),
        executor_of(executor, store, job or [], lambda line: None if silent else say_line(line)) as cluster,
        table,
    ):
        done = simulate(cheaper, store, out, command, device, table.watch, cluster, limit, rerun or [])
    hints = [] if silent else commands_to_try(recipe, command[2 : -1 if exact else None], _loads)
    _say_briefly(done, as_json) if silent else say(console.closing(done.document, str(done.page), hints))
    if done.document["missed"]:
        raise typer.Exit(MISSED)
    if executor == "local" and not rerun:
        keep_run(_text([*before, *table.printed()], done, hints), as_json, out, done, recipe, store)


def _opening(recipe: Recipe, command: Sequence[str], silent: bool) -> list[str]:
    """Say what is run, unless silent, and return what was said."""
    from neusee.workflows.report import console

    if silent:
        return []
    lines = console.opening(recipe, shlex.join(command[1:]))
    say(lines)
    return lines


def _check_rerun(recipe: Recipe, names: Sequence[str]) -> None:
    """End the command for a name in ``--rerun`` that is of no step."""
    from neusee.workflows.graph.recipe_graph import copies_of

    try:
        copies_of(recipe, names)
    except ValueError as error:
        fail(f"--rerun: {error}")


def _text(before: Sequence[str], done: Simulation, hints: Sequence[str]) -> Callable[[str, str], str]:
    """Return a function from the folder and the seconds of a run to all that the run has printed.

    Without ``hints`` that is the path of the page alone.
    """
    from neusee.workflows.report.console import closing

    def text(folder: str, took: str) -> str:
        page = f"{folder}/report.html"
        return "\n".join([*before, *closing(done.document, page, hints, took)]) if hints else page

    return text


def _say_briefly(done: Simulation, as_json: bool) -> None:
    """Print the path of the page of a run, or its document as JSON, and the warnings of the run on stderr."""
    if as_json:
        say_json({"report": str(done.page), **done.document})
    else:
        say([str(done.page)])
    for line in done.document["warnings"]:
        print_warning(line)


def _predicted(
    recipe: Recipe, store: Store, device: str, memory: int | None, local: bool, silent: bool
) -> dict[str, float]:
    """Print how long a run will take, and return the predicted seconds of each step, as far as they are known.

    A run on this machine ends before any step if the limit of memory, or the memory that is free, is too small.
    """
    from neusee.workflows.explain.run_forecast import lanes_for, planned
    from neusee.workflows.report.console import forecast_line

    if silent and not local:
        return {}
    plan = planned(recipe, store, lanes_for(recipe, device, memory))
    if local and plan.refused:
        fail(f"{'memory' if memory is None else '--memory'}: {plan.refused}; nothing was run")
    slots = plan.schedule.slots if plan.schedule else ()
    unknown = sum(not estimate.known for estimate in plan.expected.values())
    line = forecast_line(plan.schedule.makespan if plan.schedule else 0.0, len(plan.expected), unknown)
    if line and not silent:
        say([line])
    return {slot.task: slot.end - slot.start for slot in slots if plan.expected[slot.task].known}


def _loads(words: Sequence[str]) -> bool:
    """Return True if a recipe with its changes has no mistake."""
    from neusee.workflows.graph.diagnostics import RecipeError
    from neusee.workflows.recipe.loading import load as read

    try:
        read(words[0], list(words[1:]))
    except RecipeError:
        return False
    return True


def validate(words: Words = None, as_json: AsJson = False, debug: Debug = False) -> None:
    """Check a recipe without running it.

    All mistakes are listed at once, each with its file, line and column and the nearest known name.
    """
    recipe, command = load(words, "run")
    from neusee.workflows.report.console import contents_of, opening

    if as_json:
        text = json_line({"valid": True, "command": shlex.join(command), **contents_of(recipe)})
    else:
        text = "\n".join(opening(recipe, shlex.join(command[1:])))
    say_and_keep(text, recipe)


def plan(
    words: Words = None,
    as_json: AsJson = False,
    debug: Debug = False,
    device: Device = "cpu",
    memory: Memory = "",
    exact: Exact = False,
    devices: Annotated[
        str, typer.Option("--devices", help="Simulate these machines: a YAML file, or the example eight_a100.")
    ] = "",
) -> None:
    """Show which steps a run would compute, where and for how long.

    Nothing is computed. Bytes follow from the shape of each result; seconds and memory from laws of each node that
    were measured, and from earlier runs on this machine, each with its range. A guess for a node without a
    measurement is marked and counts at its upper end. With --devices the run is simulated on machines that you do
    not have: makespan, utilisation and critical path.
    """
    with within_memory(memory) as limit:
        recipe, command = load(words, "plan", exact=exact)
    from neusee.workflows.explain import run_forecast

    check_device(device)
    store = the_store()
    if devices:
        with refusing():
            found = run_forecast.Forecast(run_forecast.simulated_lines(recipe, store, devices), [], {}, False)
    else:
        found = run_forecast.forecast(recipe, store, device, limit)
    text = json_line({"command": shlex.join(command), **asdict(found)}) if as_json else "\n".join(found.lines)
    if found.totals.get("steps") == 0 and not found.refused:
        say_and_keep(text, recipe, store, found.totals["memory_of_report"] or 0.0)
    else:
        say([text])
    if found.refused:
        raise typer.Exit(FAILED)


def why(
    step: Annotated[str, typer.Argument(help="A step, such as raw or raw[mask].")],
    words: Words = None,
    debug: Debug = False,
    device: Device = "cpu",
) -> None:
    """Explain why a step differs from its nearest earlier result.

    The answer names the value that changed and where it was written, such as
    `sensor.read_noise 10.5 -> 20 e- (argument 2)`, or the code that changed.
    """
    recipe, _ = load(words, before=1)
    from neusee.workflows.explain.why_rerun import why_lines

    store = the_store()
    with failing(ValueError):
        lines = why_lines(recipe, store, step, device)
    say_and_keep("\n".join(lines), recipe, store)


def config(words: Words = None, debug: Debug = False) -> None:
    """Print every final value and where it comes from.

    The output is YAML: a recipe that can be run.
    """
    recipe, _ = load(words)
    from neusee.workflows.simulation.simulate_recipe import recipe_text

    say_and_keep("\n".join(recipe_text(recipe).splitlines()), recipe)


def report(
    folder: Annotated[str, typer.Argument(metavar="RUN_FOLDER", help="A run's folder, or `latest`.")] = "latest",
    out: Annotated[Path, typer.Option("--out", help="Folder that holds the folders of runs.")] = Path("runs"),
    debug: Debug = False,
) -> None:
    """Write the page of a run again from stored results."""
    from neusee.workflows.report.run_folder import find_run
    from neusee.workflows.report.run_html import rebuild

    with failing(FileNotFoundError):
        say([str(rebuild(find_run(folder, out)))])
