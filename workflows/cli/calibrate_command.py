"""The command ``neusee calibrate``: find the posterior of a sensor from calibration frames."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated, Any

import typer

from neusee.workflows.cli.command_frame import fail, failing, load, say, the_store
from neusee.workflows.cli.command_list import FAILED, MISSED
from neusee.workflows.cli.command_options import AsJson, Debug, Out, Quiet, Words, option_words, progress_lines
from neusee.workflows.cli.interruption import kept_in, resumable, say_folder


def calibrate(
    words: Words = None,
    walkers: Annotated[int, typer.Option("--walkers", min=16, help="Walkers in each of the four ensembles.")] = 64,
    move: Annotated[
        str, typer.Option("--move", help="Move of the walkers: de (differential evolution) or stretch.")
    ] = "de",
    draws: Annotated[int, typer.Option("--draws", min=100, help="Least number of independent draws.")] = 1000,
    quiet: Quiet = False,
    as_json: AsJson = False,
    debug: Debug = False,
    out: Out = Path("runs"),
) -> None:
    """Find the posterior of a sensor from calibration frames.

    Before drawing, the command says which parameters the frames cannot constrain. Afterwards it checks chains and
    fit; where a check fails, the page has a red banner and the exit code is 3. Run the same command again to
    continue. Needs: pip install -e ".[calibrate]".
    """
    recipe, command = load(words, "calibrate")
    store = the_store()
    from neusee.workflows.api import verbs
    from neusee.workflows.calibration.run_calibration import CalibrationRefused
    from neusee.workflows.graph.run_error import RunError

    options: dict[str, Any] = {"walkers": walkers, "move": move, "draws": draws}
    command += option_words(options)
    with (
        resumable(lambda: kept_in(store, "the draws up to the last line above are")),
        failing(RunError, ValueError, ImportError, code=FAILED),
        failing(CalibrationRefused, code=FAILED, before="refused, nothing was drawn: "),
    ):
        folder = verbs.calibrate(
            recipe, store=store, out=out, command=command, progress=progress_lines(quiet or as_json), **options
        )
    document = json.loads((folder / "posterior.json").read_text())
    if not quiet and not as_json:
        say(_lines(document["parameters"]))
    say_folder(folder, as_json)
    if count := document["failed"]:
        wrong = "; ".join(f"{c['name']}: {c['found']}" for c in document["checks"] if c["mark"] == "fail")
        fail(f"not fit for use: {count} checks fail ({wrong}); see {folder / 'report.html'}", MISSED)


def _lines(parameters: dict[str, dict[str, object]]) -> list[str]:
    from neusee.workflows.calibration.calibration_page import ParameterEstimate

    unknown = dict.fromkeys(("mean", "sd", "low", "high"), math.nan)  # what the frames do not tell is not in the file
    rows = [ParameterEstimate(**{**unknown, **row}) for row in parameters.values()]  # type: ignore[arg-type]
    return [f"{row.name.replace('_', ' '):20s} {row.text}" for row in rows]
