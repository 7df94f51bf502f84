"""The command ``neusee handbook``: build the handbook and open it."""

from __future__ import annotations

import os
import sys
import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from neusee.workflows.cli import lazy_imports as lazy
from neusee.workflows.cli.command_frame import Debug, Quiet, failing, progress_lines, say
from neusee.workflows.cli.commands_and_exit_codes import FAILED
from neusee.workflows.handbook import site_build
from neusee.workflows.handbook.site_build import NoPicture


def handbook(
    opens: Annotated[
        bool, typer.Option("--open/--no-open", help="Open the first page in the browser.")
    ] = True,
    pictures: Annotated[
        bool,
        typer.Option(
            "--pictures/--no-pictures", help="Run the commands of the pages for their pictures."
        ),
    ] = True,
    out: Annotated[Path, typer.Option("--out", help="Folder of the handbook.")] = Path(
        "runs/handbook"
    ),
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Build the handbook with its pictures and open it.

    Tutorial, how-tos, ideas, gallery and reference as pages that a browser shows without a network.
    The first build takes minutes, because it runs the commands of the pages; a later one takes
    their results from the cache. Needs `pip install "neusee[docs]"`.
    """
    # mistakes of the call, found before any work
    with failing(site_build.HandbookError, before="neusee handbook: "):
        site_build.check_modules()
        site_build.check_folder(out)

    # errors of the build itself
    with failing(
        site_build.HandbookError, NoPicture, OSError, code=FAILED, before="neusee handbook: "
    ):
        # the guide is a folder of the packaged recipes
        reference = lazy.handbook_reference.reference_pages(site_build.GUIDE.parent)
        page = site_build.build_handbook(out, reference, pictures, progress_lines(quiet))
    say([str(page)])
    if opens and not (_has_display() and webbrowser.open(page.absolute().as_uri())) and not quiet:
        say(["no browser could be opened: open this file in a browser of yours"])


def _has_display() -> bool:
    """Return True if a browser with windows could be opened; a browser on the terminal would
    take the terminal.
    """
    return not sys.platform.startswith("linux") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )
