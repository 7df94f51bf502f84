"""The commands ``neusee study``: accuracy, stability, leave-out, calibration and uncertainty."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from neusee.workflows.cli.command_frame import FAILED, Debug, Out, Words, check_device, fail, load, say, the_store

study = typer.Typer(
    help="What a recipe's numbers are worth, where it breaks, what it need not compute.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


class Move(StrEnum):
    """The moves of the walkers of `calibrate`."""

    DE = "de"
    STRETCH = "stretch"


class Points(StrEnum):
    """The ways to draw uncertain inputs."""

    DRAWS = "draws"
    SOBOL = "sobol"


Quiet = Annotated[bool, typer.Option("--quiet", help="The page's path alone.")]


@study.command()
def accuracy(
    words: Words = None,
    seeds: Annotated[int, typer.Option("--seeds", min=1, help="Draws of the noise, for the error bars.")] = 3,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer points.")] = False,
    quiet: Quiet = False,
    debug: Debug = False,
    out: Out = Path("runs"),
) -> None:
    """Draw error against run time, of the whole recipe and of each step, over tolerances and knobs."""
    _made("accuracy", words, quiet, out, seeds=seeds, quick=quick)


@study.command()
def stability(words: Words = None, quiet: Quiet = False, debug: Debug = False, out: Out = Path("runs")) -> None:
    """Run stiff and extreme cases against float64, forward and gradient; fail where one does not hold."""
    _made("stability", words, quiet, out)


@study.command("leave-out")
def leave_out(words: Words = None, quiet: Quiet = False, debug: Debug = False, out: Out = Path("runs")) -> None:
    """Compute each omission in full beside it; fail where one changes more than was said."""
    _made("leave-out", words, quiet, out)


@study.command()
def calibration(
    words: Words = None,
    simulations: Annotated[int, typer.Option("--simulations", min=20, help="Sensors drawn from the prior.")] = 200,
    move: Annotated[Move, typer.Option("--move", help="How walkers move.")] = Move.DE,
    quiet: Quiet = False,
    debug: Debug = False,
    out: Out = Path("runs"),
) -> None:
    """Simulate sensors, calibrate each, rank the truth among the draws; fail where ranks or coverage are not right."""
    _made("calibration", words, quiet, out, simulations=simulations, move=move.value)


@study.command()
def uncertainty(
    words: Words = None,
    error: Annotated[
        float, typer.Option("--error", min=1e-3, max=1.0, help="Of each sd, relative; ends there.")
    ] = 0.05,
    most: Annotated[int, typer.Option("--most", min=64, help="Draws, at most.")] = 1000,
    points: Annotated[Points, typer.Option("--points", help="Independent draws, or points of Sobol.")] = Points.DRAWS,
    workers: Annotated[int, typer.Option("--workers", min=0, help="Draws at once; 0: one a core.")] = 0,
    device: Annotated[str, typer.Option("--device", help="Where to compute: cpu or cuda.")] = "cpu",
    quiet: Quiet = False,
    debug: Debug = False,
    out: Out = Path("runs"),
) -> None:
    """Draw what is uncertain (laws such as "normal(1 e-, 0.1 e-)", a posterior); show how the outputs scatter."""
    check_device(device)
    how = {"error": error, "most": most, "points": points.value, "workers": workers, "device": device}
    _made("uncertainty", words, quiet, out, **how)


def _made(kind: str, words: list[str] | None, quiet: bool, out: Path, **options: Any) -> None:
    recipe, command = load(words)
    from neusee.workflows.engine.node_call import RunError
    from neusee.workflows.studies import run_study as studies

    given = [f"--{name}" if value is True else f"--{name} {value}" for name, value in options.items() if value]
    command = ["neusee", "study", kind, *command[2:], *given]
    tell = (lambda line: None) if quiet else (lambda line: say([line]))
    try:
        folder = studies.made(kind, recipe, the_store(), out, command, tell, **options)
    except (RunError, ValueError, ImportError) as error:
        fail(str(error), FAILED)
    say([str(folder / "report.html")])
    if count := studies.failed(folder):
        fail(f"{count} do not hold: see {folder / 'report.html'}", FAILED)
