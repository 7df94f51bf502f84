"""The arguments and options that several commands share, and two functions that read options."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

Words = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[RECIPE] [OVERRIDE]...",
        help="A recipe's name or file, then changes: a.b=1, +a.b=1, ~a.b, laser=six.",
        show_default=False,
    ),
]
Debug = Annotated[bool, typer.Option("--debug", help="Show where in the code an error arose.")]
Device = Annotated[str, typer.Option("--device", help="Where to compute: cpu, cuda, or several: cuda:0,cuda:1,cpu.")]
OneDevice = Annotated[str, typer.Option("--device", help="Where to compute: cpu or cuda.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print only the path of the page.")]
Exact = Annotated[bool, typer.Option("--exact", help="Compute every step in full; omit nothing.")]
Memory = Annotated[
    str, typer.Option("--memory", help="Limit of a device's memory, such as 6 GB, as far as earlier runs tell.")
]
Out = Annotated[Path, typer.Option("--out", help="Folder in which to make the folder of results.")]


def progress_lines(quiet: bool) -> Callable[[str], None]:
    """Return a function that prints a line of progress, or that prints nothing if ``quiet`` is True."""
    return (lambda line: None) if quiet else partial(print, flush=True)


def option_words(options: Mapping[str, Any]) -> list[str]:
    """Return ``--name value``, or ``--name`` for True, for each option; omit options that are False, 0 or empty."""
    return [f"--{name}" if value is True else f"--{name} {value}" for name, value in options.items() if value]
