"""The command ``neusee run``: run a recipe and write its report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from neusee.workflows.cli.command_frame import (
    Debug,
    Device,
    Exact,
    Memory,
    Out,
    Words,
    check_device,
    executor_of,
    fail,
    load,
    memory_limit,
    say,
    the_store,
)
from neusee.workflows.cli.command_list import MISSED

if TYPE_CHECKING:
    from neusee.workflows.engine.step_job import Executor
    from neusee.workflows.graph.recipe_graph import Recipe
    from neusee.workflows.simulation.simulate_recipe import Simulation
    from neusee.workflows.store.result_store import Store

Where = Annotated[
    str, typer.Option("--executor", help="Who computes: local, dask, dask:4 (workers), or tcp://scheduler:8786.")
]


def run(
    words: Words = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document instead of the table.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print only the path of the report.")] = False,
    debug: Debug = False,
    device: Device = "cpu",
    executor: Where = "local",
    memory: Memory = "",
    exact: Exact = False,
    out: Out = Path("runs"),
) -> None:
    """Run a recipe and write its report.

    Steps whose results are in the cache are not computed again. Without a name the recipe is first_light. The folder
    of results holds report.html, the numbers, the pictures and the recipe with every final value.
    """
    recipe, command = load(words, "run", exact=exact)
    from neusee.workflows.report import console

    check_device(device)
    limit = memory_limit(memory)
    if not (as_json or quiet):
        say(console.opening(recipe, " ".join(command[1:])))
    store = the_store()
    if limit is not None:
        _refuse_too_large(recipe, store, device, limit)
    with executor_of(executor, store) as computes:
        done = _simulate(recipe, store, command, device, out, as_json or quiet, computes, limit)
    if as_json:
        import json

        say([json.dumps({"report": str(done.page), **done.document}, ensure_ascii=False)])
    elif quiet:
        say([str(done.page)])
    else:
        say(console.closing(done.document, str(done.page), console.next_commands(recipe)))
    if done.document["missed"]:
        raise typer.Exit(MISSED)


def _refuse_too_large(recipe: Recipe, store: Store, device: str, memory: int) -> None:
    """End the command before anything runs if earlier runs show that the memory is too small."""
    from neusee.workflows.engine.local_executor import lanes_of
    from neusee.workflows.explain.run_forecast import planned

    if refused := planned(recipe, store, lanes_of(device.split(","), memory)).refused:
        fail(f"--memory: {refused}")


def _simulate(
    recipe: Recipe,
    store: Store,
    command: list[str],
    device: str,
    out: Path,
    silent: bool,
    executor: Executor | None,
    memory: int | None,
) -> Simulation:
    from neusee.workflows.report.console import RunTable, mode_for
    from neusee.workflows.report.contents import steps_of, wanted
    from neusee.workflows.simulation.simulate_recipe import simulate
    from neusee.workflows.tolerance.cheaper_steps import with_substitutions

    recipe = with_substitutions(recipe, wanted(recipe))
    with RunTable(recipe, steps_of(recipe), mode_for(silent)) as shown:
        return simulate(recipe, store, out, command, device, shown.watch, executor, memory)
