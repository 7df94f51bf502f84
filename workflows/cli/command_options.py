"""The arguments and options that several commands share, and functions that read and check their values."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from neusee.workflows.cli.command_frame import fail, failing
from neusee.workflows.store.byte_sizes import parse_size

if TYPE_CHECKING:
    from neusee.workflows.engine.step_job import Executor
    from neusee.workflows.store.result_store import Store

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
Memory = Annotated[str, typer.Option("--memory", help="Limit of the memory of the program, and of each GPU: 6 GB.")]
Out = Annotated[Path, typer.Option("--out", help="Folder in which to make the folder of results.")]


def progress_lines(quiet: bool) -> Callable[[str], None]:
    """Return a function that prints a line of progress, or that prints nothing if ``quiet`` is True."""
    return (lambda line: None) if quiet else partial(print, flush=True)


def option_words(options: Mapping[str, Any]) -> list[str]:
    """Return ``--name value``, or ``--name`` for True, for each option; omit options that are False, 0 or empty."""
    return [f"--{name}" if value is True else f"--{name} {value}" for name, value in options.items() if value]


def check_device(device: str) -> None:
    """End the command if this machine does not have ``device``, which may be a list with commas."""
    from neusee.workflows.engine.device_names import check_devices

    with failing(ValueError, before="--device "):
        check_devices(device)


def memory_limit(text: str) -> int | None:
    """Return the value of the option ``--memory``, such as ``6 GB``, in bytes, or None for an empty text."""
    with failing(ValueError, before="--memory: "):
        return parse_size(text) if text else None


@contextmanager
def executor_of(place: str, store: Store) -> Iterator[Executor | None]:
    """Yield None for ``local``, or an executor on the cluster ``place``, and close it after the ``with`` block."""
    if place == "local":
        yield None
        return
    kind, _, count = place.partition(":")
    if not (kind == "dask" and (not count or count == "here" or count.isdecimal())) and "://" not in place:
        fail(f"--executor {place}: write local, dask, dask:4, or a scheduler's address such as tcp://host:8786")
    try:
        from neusee.workflows.engine.dask_executor import cluster
    except ModuleNotFoundError as error:
        fail(f'--executor {place}: {error.name} is not installed: pip install "neusee[distributed]"')
    with cluster(place, store) as executor:
        yield executor
