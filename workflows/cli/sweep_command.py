"""The command ``neusee sweep``: run a recipe at several values of its parameters."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from neusee.workflows.cli.command_frame import fail, refusing, search_for_garbage, split, the_store
from neusee.workflows.cli.command_options import AsJson, Debug, Device, Out, Quiet, Words, check_device
from neusee.workflows.cli.interruption import kept_in, resumable


def sweep(
    words: Words = None,
    paired: Annotated[
        bool, typer.Option("--zip", help="Pair the values of the axes instead of combining them.")
    ] = False,
    on_error: Annotated[
        str, typer.Option("--on-error", help="After a failed point: stop, or continue with the next.")
    ] = "stop",
    workers: Annotated[
        int,
        typer.Option(
            "--workers", min=0, max=10_000, help="Number of points that run at the same time; 0: by free processors."
        ),
    ] = 0,
    netcdf: Annotated[bool, typer.Option("--netcdf", help="Write sweep.nc too (needs neusee[xarray]).")] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
    device: Device = "cpu",
    out: Out = Path("runs"),
) -> None:
    """Run a recipe at several values of its parameters.

    Write values as a=1,2,3 or b='linspace(450 nm, 650 nm, 5)'. All combinations run unless --zip pairs them.
    Run the same command again to continue a sweep that was stopped.
    """
    name, words, first = split(words)
    if on_error not in ("stop", "continue"):
        fail(f"--on-error {on_error}: write stop or continue")
    check_device(device)
    store = the_store()
    from neusee.workflows.cli.sweep_screen import run_sweep

    with refusing(), resumable(lambda: kept_in(store, "the points that are finished are")):
        search_for_garbage()
        code = run_sweep(
            name, words, first=first, zip=paired, on_error="continue" if on_error == "continue" else "stop",
            netcdf=netcdf, device=device, out=out, store=store, quiet=quiet, as_json=as_json, workers=workers,
        )  # fmt: skip
    if code:
        raise typer.Exit(code)
