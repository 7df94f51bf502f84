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
    KeepAll,
    Memory,
    Out,
    Words,
    bytes_of,
    check_device,
    fail,
    load,
    refuse,
    say,
    split,
    the_store,
)
from neusee.workflows.cli.evaluate_command import evaluate
from neusee.workflows.cli.list_commands import nodes, recipes, schema
from neusee.workflows.cli.run_command import run
from neusee.workflows.cli.study_commands import study
from neusee.workflows.cli.train_command import train

if TYPE_CHECKING:
    from typer.models import CommandInfo

_HOW: Mapping[str, Any] = {
    "name": "neusee",
    "help": "What a laser does to a camera: its light, its glass and its sensor, as recipes. "
    "`neusee run` is the place to start.",
    "context_settings": {"help_option_names": ["-h", "--help"]},
    "no_args_is_help": True,
    "rich_markup_mode": None,
    "pretty_exceptions_enable": False,
}
app = typer.Typer(**_HOW)
app.add_typer(cache, name="cache")
app.add_typer(study, name="study")
for command in (run, calibrate, evaluate, train, recipes, nodes, schema):
    app.command()(command)


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
    keep_all: KeepAll = False,
    devices: Annotated[str, typer.Option("--devices", help="Machines to simulate: a YAML file, or eight_a100.")] = "",
) -> None:
    """Say what would run, where, for how long and with how much memory; compute nothing."""
    recipe, _ = load(words, keep_all=keep_all)
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
    from neusee.workflows.graph.diagnostics import RecipeError
    from neusee.workflows.sweeps.sweep_run import run_sweep

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
