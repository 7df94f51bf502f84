"""The command line: few commands, the same words everywhere, one line for each mistake.

Nothing heavy is imported before a command asks for it: ``neusee --help`` never sees torch.
"""

from __future__ import annotations

import gc
import inspect
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from neusee import __version__
from neusee.workflows.cli.cache_commands import cache
from neusee.workflows.cli.calibrate_command import calibrate
from neusee.workflows.cli.command_frame import (
    BAD,
    DONE,
    FAILED,
    Debug,
    Device,
    Exact,
    Memory,
    Words,
    bytes_of,
    check_device,
    fail,
    load,
    refuse,
    say,
    the_store,
)
from neusee.workflows.cli.evaluate_command import evaluate
from neusee.workflows.cli.list_commands import nodes, recipes, schema
from neusee.workflows.cli.run_command import run
from neusee.workflows.cli.study_commands import study
from neusee.workflows.cli.sweep_command import sweep
from neusee.workflows.cli.train_command import train

if TYPE_CHECKING:
    from typer.models import CommandInfo

_HOW: Mapping[str, Any] = {
    "name": "neusee",
    "help": "Simulate what a laser does to a camera: its light, its glass and its sensor, as recipes. "
    "Start with `neusee run`. Each command explains itself: `neusee run --help`.",
    "epilog": "Exit codes: 0 done; 1 failed while running; 2 mistake in the recipe or the arguments; "
    "3 expected numbers missed, a check of a calibration failed, or damaged results found.",
    "context_settings": {"help_option_names": ["-h", "--help"]},
    "no_args_is_help": True,
    "rich_markup_mode": None,
    "pretty_exceptions_enable": False,
}
app = typer.Typer(**_HOW)
app.command()(run)


def _say_version(wanted: bool) -> None:
    if wanted:
        say([f"neusee {__version__}"])
        raise typer.Exit(DONE)


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", help="Show the version and exit.", callback=_say_version, is_eager=True)
    ] = False,
) -> None:
    pass


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


def _asked(arguments: Sequence[str]) -> typer.Typer:
    """Return the program with the options of the command that ``arguments`` name, and the help alone of all others.

    To read the options of every command takes a fifth of the start. A shell that completes a word needs all of them.
    """
    if any(name.endswith("_COMPLETE") for name in os.environ):
        return app
    name = next((word for word in arguments if not word.startswith("-")), "")
    light = typer.Typer(**_HOW)
    light.callback()(_options)
    for known in app.registered_commands:
        if _name(known) == name:
            light.registered_commands.append(known)
        else:
            light.command(_name(known), help=inspect.getdoc(known.callback))(_not_asked)
    for group in app.registered_groups:
        if group.name == name:
            light.registered_groups.append(group)
        elif group.typer_instance is not None:
            light.command(group.name, help=group.typer_instance.info.help)(_not_asked)
    return light


def _name(command: CommandInfo) -> str:
    return str(command.name or getattr(command.callback, "__name__", ""))


def _not_asked() -> None:
    pass


def main(arguments: list[str] | None = None) -> None:
    """Entry point: every error is one line and an exit code, unless ``--debug`` asks for the stack."""
    arguments = sys.argv[1:] if arguments is None else arguments
    gc.disable()  # what is imported stays: to look for garbage in it costs a tenth of the start
    try:
        sys.exit(_asked(arguments)(arguments, standalone_mode=False, prog_name="neusee") or DONE)
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
