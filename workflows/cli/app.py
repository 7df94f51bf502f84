"""The command line: few commands, the same words everywhere, one line for each mistake.

Nothing heavy is imported before a command asks for it: ``neusee --help`` never sees torch.
"""

from __future__ import annotations

import gc
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from neusee.workflows.cli.cache_commands import cache
from neusee.workflows.cli.calibrate_command import calibrate
from neusee.workflows.cli.command_frame import (
    BAD,
    DONE,
    FAILED,
    MISSED,
    Debug,
    Device,
    Out,
    Words,
    bytes_of,
    check_device,
    executor_of,
    fail,
    load,
    refuse,
    say,
    the_store,
)
from neusee.workflows.cli.evaluate_command import evaluate
from neusee.workflows.cli.list_commands import nodes, recipes, schema
from neusee.workflows.cli.study_commands import study
from neusee.workflows.cli.sweep_command import sweep
from neusee.workflows.cli.train_command import train

if TYPE_CHECKING:
    from neusee.workflows.engine.step_job import Executor
    from neusee.workflows.graph.recipe_graph import Recipe
    from neusee.workflows.simulation.simulate_recipe import Simulation
    from neusee.workflows.store.result_store import Store

app = typer.Typer(
    name="neusee",
    help="Simulate what a laser does to a camera: its light, its glass and its sensor, as recipes. "
    "Start with `neusee run`. Each command explains itself: `neusee run --help`.",
    epilog="Exit codes: 0 done; 1 failed while running; 2 mistake in the recipe or the arguments; "
    "3 expected numbers missed, a check of a calibration failed, or damaged results found.",
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
Where = Annotated[
    str, typer.Option("--executor", help="Who computes: local, dask, dask:4 (workers), or tcp://scheduler:8786.")
]
Exact = Annotated[bool, typer.Option("--exact", help="Compute every step in full; omit nothing.")]
Memory = Annotated[
    str, typer.Option("--memory", help="Limit of a device's memory, such as 6 GB, as far as earlier runs tell.")
]


@app.command()
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
    recipe, command = load(words, exact=exact)
    from neusee.workflows.report import console

    check_device(device)
    room = bytes_of(memory, "--memory") if memory else None
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
    """Stop before anything runs where, as far as earlier runs tell, the memory cannot do."""
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
    from neusee.workflows.report.console import screen
    from neusee.workflows.simulation.simulate_recipe import simulate, steps_of, wanted
    from neusee.workflows.tolerance.cheaper_steps import with_substitutions

    recipe = with_substitutions(recipe, wanted(recipe))
    with screen(recipe, steps_of(recipe), silent) as shown:
        return simulate(recipe, store, out, command, device, shown.watch, executor, memory)


@app.command()
def validate(words: Words = None, debug: Debug = False) -> None:
    """Check a recipe without running it.

    All mistakes are listed at once, each with its file, line and column and the nearest known name.
    """
    recipe, command = load(words)
    from neusee.workflows.report.console import opening

    say(opening(recipe, " ".join(command[1:])))


@app.command()
def plan(
    words: Words = None,
    debug: Debug = False,
    device: Device = "cpu",
    memory: Memory = "",
    exact: Exact = False,
    devices: Annotated[
        str, typer.Option("--devices", help="Simulate these machines: a YAML file, or the example eight_a100.")
    ] = "",
) -> None:
    """Say what a run would compute, where and for how long.

    Nothing is computed. Seconds, bytes and memory are those of earlier runs of the same step, even at another size;
    a step that never ran shows a question mark. With --devices the run is simulated on machines that you do not
    have: makespan, utilisation and critical path.
    """
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
    room = bytes_of(memory, "--memory") if memory else None
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
    """Say why a step differs from its nearest earlier result.

    The answer names the value that changed and where it was written, such as
    `sensor.read_noise 10.5 -> 20 e- (argument 2)`, or the code that changed.
    """
    recipe, _ = load(words, before=1)
    from neusee.workflows.explain.why_rerun import why_lines

    try:
        say(why_lines(recipe, the_store(), step, device))
    except ValueError as error:
        fail(str(error))


@app.command()
def config(words: Words = None, debug: Debug = False) -> None:
    """Print every final value and where it comes from.

    The output is YAML: a recipe that can be run.
    """
    recipe, _ = load(words)
    from neusee.workflows.simulation.simulate_recipe import recipe_text

    say(recipe_text(recipe).splitlines())


@app.command()
def report(
    folder: Annotated[str, typer.Argument(metavar="RUN_FOLDER", help="A run's folder, or `latest`.")] = "latest",
    out: Annotated[Path, typer.Option("--out", help="Folder that holds the folders of runs.")] = Path("runs"),
    debug: Debug = False,
) -> None:
    """Write the page of a run again from stored results."""
    from neusee.workflows.report.run_folder import find_run
    from neusee.workflows.report.run_page import rebuild

    try:
        say([str(rebuild(find_run(folder, out)))])
    except FileNotFoundError as error:
        fail(str(error))


for command in (sweep, train, calibrate, evaluate, recipes, nodes, schema):
    app.command()(command)
app.add_typer(study, name="study")
app.add_typer(cache, name="cache")


def main(arguments: list[str] | None = None) -> None:
    """Entry point: every error is one line and an exit code, unless ``--debug`` asks for the stack."""
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
    """Print an error as one line; a mistake in the arguments and a failure while running differ in their code."""
    message = getattr(error, "format_message", None)
    if message is not None:
        print(f"{message()} (try `neusee --help`)", file=sys.stderr)
        return BAD
    cause = type(error).__name__
    text = str(error) if cause == "RunError" else f"{cause}: {error}"
    print(f"{text}   (--debug shows where)", file=sys.stderr)
    return FAILED
