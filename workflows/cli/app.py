"""The command line: few commands, the same words everywhere, one line for each mistake.

A command imports what it needs when it runs: ``neusee --help`` never imports torch.
"""

from __future__ import annotations

import gc
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from neusee.workflows.cli.cache_commands import cache
from neusee.workflows.cli.calibrate_command import calibrate
from neusee.workflows.cli.catalogue import nodes, recipes, schema
from neusee.workflows.cli.command_frame import (
    BAD,
    DONE,
    FAILED,
    MISSED,
    Debug,
    Out,
    Words,
    check_device,
    executor_of,
    fail,
    load,
    parse_memory,
    refuse,
    say,
    split,
    the_store,
)
from neusee.workflows.cli.evaluate_command import evaluate
from neusee.workflows.cli.study_commands import study
from neusee.workflows.cli.train_command import train

if TYPE_CHECKING:
    from neusee.workflows.engine.step_job import Executor
    from neusee.workflows.graph.recipe_graph import Recipe
    from neusee.workflows.simulation.simulate_recipe import Simulation
    from neusee.workflows.store.result_store import Store

app = typer.Typer(
    name="neusee",
    help="What a laser does to a camera: its light, its glass and its sensor, as recipes. "
    "`neusee run` is the place to start.",
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
app.add_typer(cache, name="cache")
app.add_typer(study, name="study")
for command in (calibrate, evaluate, train, recipes, nodes, schema):
    app.command()(command)

Device = Annotated[str, typer.Option("--device", help="Where to compute: cpu, cuda, or several: cuda:0,cuda:1,cpu.")]
Where = Annotated[
    str, typer.Option("--executor", help="Who computes: local, dask, dask:4 (workers), or tcp://scheduler:8786.")
]
KeepAll = Annotated[bool, typer.Option("--exact", help="Leave nothing out: every step in full.")]
Memory = Annotated[str, typer.Option("--memory", help="What a device may use, such as 6 GB; more is refused.")]


@app.command()
def run(
    words: Words = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="The report's path alone.")] = False,
    debug: Debug = False,
    device: Device = "cpu",
    executor: Where = "local",
    memory: Memory = "",
    exact: KeepAll = False,
    out: Out = Path("runs"),
) -> None:
    """Run a recipe, from the cache where it can, and write its report."""
    recipe, command = load(words, exact=exact)
    from neusee.workflows.report import console

    check_device(device)
    room = parse_memory(memory, "--memory") if memory else None
    if not (as_json or quiet):
        say(console.opening(recipe, " ".join(command[1:])))
    store = the_store()
    if room is not None:
        _refuse_too_large(recipe, store, device, room)
    with executor_of(executor, store) as carries_out:
        done = _simulate(recipe, store, command, device, out, as_json or quiet, carries_out, room)
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
    """Exit before anything runs if the memory is too small, by the sizes of earlier runs."""
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
    from neusee.workflows.simulation.simulate_recipe import simulate, steps_of, wanted
    from neusee.workflows.tolerance.cheaper_steps import with_substitutions

    recipe = with_substitutions(recipe, wanted(recipe))
    with RunTable(recipe, steps_of(recipe), mode_for(silent)) as shown:
        return simulate(recipe, store, out, command, device, shown.watch, executor, memory)


@app.command()
def validate(words: Words = None, debug: Debug = False) -> None:
    """Check a recipe: every mistake at once, and nothing is run."""
    recipe, command = load(words)
    from neusee.workflows.report.console import opening

    say(opening(recipe, " ".join(command[1:])))


@app.command()
def plan(
    words: Words = None,
    debug: Debug = False,
    device: Device = "cpu",
    memory: Memory = "",
    exact: KeepAll = False,
    devices: Annotated[str, typer.Option("--devices", help="Machines to simulate: a YAML file, or eight_a100.")] = "",
) -> None:
    """Say what would run, where, for how long and with how much memory; compute nothing."""
    recipe, _ = load(words, exact=exact)
    from neusee.workflows.explain import run_forecast

    check_device(device)
    if devices:
        from neusee.workflows.graph.diagnostics import RecipeError

        try:
            say(run_forecast.simulated_lines(recipe, the_store(), devices))
        except RecipeError as error:
            refuse(error)
        return
    room = parse_memory(memory, "--memory") if memory else None
    lines, refused = run_forecast.plan_lines(recipe, the_store(), device, room)
    say(lines)
    if refused:
        raise typer.Exit(FAILED)


@app.command()
def why(
    step: Annotated[str, typer.Argument(help="A step, such as raw or raw[mask].")],
    words: Words = None,
    debug: Debug = False,
    device: Device = "cpu",
) -> None:
    """Say what makes a step other than its nearest earlier result: which value, where, or whose code."""
    recipe, _ = load(words, before=1)
    from neusee.workflows.explain.why_rerun import why_lines

    try:
        say(why_lines(recipe, the_store(), step, device))
    except ValueError as error:
        fail(str(error))


@app.command()
def sweep(
    words: Words = None,
    paired: Annotated[bool, typer.Option("--zip", help="Pair the axes' values instead of combining them.")] = False,
    on_error: Annotated[str, typer.Option("--on-error", help="stop, or continue with the next point.")] = "stop",
    netcdf: Annotated[bool, typer.Option("--netcdf", help="Write sweep.nc too (needs neusee[xarray]).")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="The table's path alone.")] = False,
    debug: Debug = False,
    device: Device = "cpu",
    out: Out = Path("runs"),
) -> None:
    """Run a recipe over values: a=1,2,3 b='linspace(450 nm, 650 nm, 5)'; run it again to go on."""
    name, words, first = split(words)
    if on_error not in ("stop", "continue"):
        fail(f"--on-error {on_error}: write stop or continue")
    check_device(device)
    from neusee.workflows.cli.sweep_command import run_sweep
    from neusee.workflows.graph.diagnostics import RecipeError

    try:
        code = run_sweep(
            name,
            words,
            first=first,
            zip=paired,
            on_error="continue" if on_error == "continue" else "stop",
            netcdf=netcdf,
            device=device,
            out=out,
            store=the_store(),
            quiet=quiet,
        )
    except RecipeError as error:
        refuse(error)
    if code:
        raise typer.Exit(code)


@app.command()
def config(words: Words = None, debug: Debug = False) -> None:
    """Print every final value and where it comes from."""
    recipe, _ = load(words)
    from neusee.workflows.simulation.simulate_recipe import recipe_text

    say(recipe_text(recipe).splitlines())


@app.command()
def report(
    folder: Annotated[str, typer.Argument(metavar="RUN_FOLDER", help="A run's folder, or `latest`.")] = "latest",
    out: Annotated[Path, typer.Option("--out", help="Where the run's folders lie.")] = Path("runs"),
    debug: Debug = False,
) -> None:
    """Write a run's page again from what is stored."""
    from neusee.workflows.report.run_folder import find_run
    from neusee.workflows.report.run_page import rebuild

    try:
        say([str(rebuild(find_run(folder, out)))])
    except FileNotFoundError as error:
        fail(str(error))


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; an error is one line and an exit code, unless ``--debug`` asks for the traceback."""
    arguments = sys.argv[1:] if arguments is None else arguments
    gc.disable()  # what is imported stays: to look for garbage in it costs a tenth of the start
    try:
        sys.exit(app(arguments, standalone_mode=False) or DONE)
    except BrokenPipeError:
        sys.stderr.close()
        sys.exit(DONE)
    except (KeyboardInterrupt, typer.Abort):
        print("stopped; what was finished is kept, and a next run goes on from there", file=sys.stderr)
        sys.exit(130)
    except Exception as error:
        if "--debug" in arguments:
            raise
        sys.exit(_explained(error))


def _explained(error: Exception) -> int:
    """Print an error as one line and return its exit code, which tells a wrong argument from a failed run."""
    message = getattr(error, "format_message", None)
    if message is not None:
        print(f"{message()} (try `neusee --help`)", file=sys.stderr)
        return BAD
    cause = type(error).__name__
    text = str(error) if cause == "RunError" else f"{cause}: {error}"
    print(f"{text}   (--debug shows where)", file=sys.stderr)
    return FAILED
