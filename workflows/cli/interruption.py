"""What a command prints if it is stopped, or if its results cannot be written: what is kept, and how to go on."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from neusee.workflows.cli.command_frame import fail, say
from neusee.workflows.cli.command_list import FAILED, INTERRUPTED, TYPED
from neusee.workflows.cli.interrupt_signal import say_stopped
from neusee.workflows.keys.regular_file import text_of
from neusee.workflows.report.json_output import json_line

if TYPE_CHECKING:
    from neusee.workflows.store.result_store import Store


def typed_command() -> str:
    """Return the command that runs, as the user typed it, quoted for a shell."""
    return shlex.join(["neusee", *TYPED])


@contextmanager
def resumable(kept: Callable[[], str]) -> Iterator[None]:
    """If the ``with`` block is stopped by Ctrl-C or by an error of a file, say what is ``kept`` and how to go on.

    The exit code is 130 after Ctrl-C, and 1 after an error of a file.
    """
    try:
        yield
    except KeyboardInterrupt:
        say_stopped(f"stopped: {kept()}; to go on: {typed_command()}")
        raise typer.Exit(INTERRUPTED) from None
    except OSError as error:
        if isinstance(error, BrokenPipeError) or "--debug" in TYPED:
            raise
        fail(f"{error}\nfailed: {kept()}; to go on: {typed_command()}", FAILED)


def kept_in(store: Store, what: str) -> str:
    """Return a clause that says that ``what`` is kept in the cache, or why the cache keeps nothing."""
    if store.failure:
        return f"nothing is kept, because the cache {store.root} cannot be written"
    return f"{what} kept in the cache {store.root}"


def kept_training(out: Path, recipe: str) -> str:
    """Return a clause that says up to which iteration the newest checkpoint keeps a training of ``recipe``."""
    from neusee.workflows.training.loop.checkpoint import StateFile

    states = [*out.glob(f"{recipe}_*/state.pt"), *out.glob(f"{recipe}_*/mask.state")]
    if not states:
        return "no checkpoint is written yet, so nothing is kept"
    newest = max(states, key=lambda path: path.stat().st_mtime)
    state: dict[str, Any] = {}
    with suppress(ValueError):
        state = StateFile(newest).read(strict=False)
    stage = f" of stage {state['stage']}" if state.get("stage") else ""
    upto = f" up to iteration {state['iteration']}{stage}" if "iteration" in state else ""
    return f"the training{upto} is kept in {newest.parent}"


def say_json(document: dict[str, Any]) -> None:
    """Print the result of a command as one JSON object on one line of stdout; a number that is not finite is null."""
    say([json_line(document)])


def say_folder(folder: Path, as_json: bool, *more: str) -> None:
    """Print the path of the page in a folder of results, or the page's document and the files ``more`` as JSON."""
    page = str(folder / "report.html")
    if not as_json:
        return say([page])
    files = ("provenance.json", *more)
    found = [json.loads(text_of(folder / name)) for name in files]
    say_json({"report": page, **{name: value for document in found for name, value in document.items()}})


def print_warning(message: Warning | str, *where: object, **more: object) -> None:
    """Print a warning as one line on stderr, in place of Python's form, which shows a line of source code."""
    from neusee.workflows.cli.repetition import doubt_answer
    from neusee.workflows.graph.diagnostics import visible

    doubt_answer()
    print(f"warning: {visible(str(message))}", file=sys.stderr, flush=True)
