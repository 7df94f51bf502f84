"""The commands that read a recipe or a finished run and compute no step: validate, plan, why, config, report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from neusee.workflows.cli.command_frame import (
    Debug,
    Device,
    Exact,
    Memory,
    Words,
    check_device,
    failing,
    load,
    memory_limit,
    refusing,
    say,
    the_store,
)
from neusee.workflows.cli.command_list import FAILED


def validate(words: Words = None, debug: Debug = False) -> None:
    """Check a recipe without running it.

    All mistakes are listed at once, each with its file, line and column and the nearest known name.
    """
    recipe, command = load(words, "run")
    from neusee.workflows.report.console import opening

    say(opening(recipe, " ".join(command[1:])))


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
        with refusing():
            say(run_forecast.simulated_lines(recipe, the_store(), devices))
        return
    lines, refused = run_forecast.plan_lines(recipe, the_store(), device, memory_limit(memory))
    say(lines)
    if refused:
        raise typer.Exit(FAILED)


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

    with failing(ValueError):
        say(why_lines(recipe, the_store(), step, device))


def config(words: Words = None, debug: Debug = False) -> None:
    """Print every final value and where it comes from.

    The output is YAML: a recipe that can be run.
    """
    recipe, _ = load(words)
    from neusee.workflows.simulation.simulate_recipe import recipe_text

    say(recipe_text(recipe).splitlines())


def report(
    folder: Annotated[str, typer.Argument(metavar="RUN_FOLDER", help="A run's folder, or `latest`.")] = "latest",
    out: Annotated[Path, typer.Option("--out", help="Folder that holds the folders of runs.")] = Path("runs"),
    debug: Debug = False,
) -> None:
    """Write the page of a run again from stored results."""
    from neusee.workflows.report.run_folder import find_run
    from neusee.workflows.report.run_page import rebuild

    with failing(FileNotFoundError):
        say([str(rebuild(find_run(folder, out)))])
