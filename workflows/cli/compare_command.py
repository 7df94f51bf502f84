"""The command ``neusee compare``: what differs between two runs?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from neusee.workflows.cli.command_frame import fail, failing, say
from neusee.workflows.cli.command_list import MISSED, TYPED
from neusee.workflows.cli.command_options import AsJson, Debug, Out, Quiet
from neusee.workflows.cli.interruption import say_json

_RUN = "A run's folder: a name below --out, a path, or `latest`."


def compare(
    left: Annotated[str, typer.Argument(help=_RUN)],
    right: Annotated[str, typer.Argument(help=_RUN)],
    fail_above: Annotated[
        float, typer.Option("--fail-above", min=0.0, help="Exit with code 3 if a number differs by more, relatively.")
    ] = float("inf"),
    quiet: Quiet = False,
    as_json: AsJson = False,
    debug: Debug = False,
    out: Out = Path("runs"),
) -> None:
    """Compare two runs: numbers, pictures, recipe and code.

    The environment is compared too, and nothing is computed again. The page shows the pictures side by side with
    their difference. The exit code is 0 also where the runs differ, unless --fail-above says what may differ at
    most; a number that only one run has differs by more than any limit.
    """
    from neusee.workflows.comparison.run_record import NotComparable, read_record

    with failing(NotComparable):
        records = [read_record(where, out) for where in (left, right)]
        from neusee.workflows.comparison import compare_runs, comparison_text

        found = compare_runs.compare(*records)
    page = compare_runs.write_comparison(found, out, ["neusee", *TYPED]) / "report.html"
    if as_json:
        say_json({"report": str(page), **compare_runs.document(found)})
    else:
        say([str(page)] if quiet else [*comparison_text.lines(found), "", f"page   {page}"])
    if found.largest > fail_above:
        worst = max(found.numbers, key=lambda each: each.relative)
        fail(f"{worst.name} differs by {found.largest:.3g} relatively, more than {fail_above:g}", MISSED)
