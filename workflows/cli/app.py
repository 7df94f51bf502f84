"""The entry point of the command line: ``neusee --help`` works without typer, and an error is printed as one line."""

from __future__ import annotations

import gc
import os
import sys
import warnings
from io import TextIOWrapper
from shutil import get_terminal_size
from typing import TYPE_CHECKING, Any

from neusee.workflows.cli.command_list import BAD, COLUMNS, DONE, FAILED, INTERRUPTED, REPEATED, TYPED, help_page
from neusee.workflows.cli.interrupt_signal import Interrupts, said, say_stopped

if TYPE_CHECKING:
    import typer

app: typer.Typer  #: the program with the options of all commands, built when a caller first reads the name


def __getattr__(name: str) -> Any:
    if name != "app":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from neusee.workflows.cli.typer_program import program

    return globals().setdefault("app", program())


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit; print an error as one line, or with ``--debug`` as a traceback."""
    interrupts = Interrupts()
    if arguments is None:  # else a caller inside Python, whose signals and garbage are its own
        interrupts.watch()
        gc.disable()  # a search for garbage among imported modules takes a tenth of the start-up time
    arguments = sys.argv[1:] if arguments is None else arguments
    TYPED[:] = arguments
    said.clear()
    _print_any_character()
    try:
        code = _run(arguments)
        if code == INTERRUPTED or (interrupts.came and code != DONE):  # typer, too, ends at an interrupt
            code = _stopped()
    except BrokenPipeError:
        sys.stderr.close()
        code = DONE
    except KeyboardInterrupt:
        code = _stopped()
    except Exception as error:
        if "--debug" in arguments:
            raise
        code = _stopped() if interrupts.came else _explained(error)
    interrupts.end()
    sys.exit(code)


def _print_any_character() -> None:
    """Print characters that the terminal lacks, such as µ on one of ASCII, as escapes in place of an error."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _stopped() -> int:
    say_stopped()
    return INTERRUPTED


def _run(arguments: list[str]) -> int:
    completes = "_NEUSEE_COMPLETE" in os.environ
    if arguments in (["--help"], ["-h"]) and not completes and get_terminal_size().columns >= COLUMNS:
        print(help_page())
        return DONE
    if not completes and arguments[:1] and arguments[0] in REPEATED:
        from neusee.workflows.cli.repetition import say_stored_answer

        if say_stored_answer(arguments):
            return DONE
    from neusee.workflows.cli.interruption import print_warning
    from neusee.workflows.cli.thread_settings import settle_threads
    from neusee.workflows.cli.typer_program import run_program

    settle_threads(arguments[0] if arguments else "")
    with warnings.catch_warnings():
        warnings.showwarning = print_warning
        return run_program(arguments, completes)


def _explained(error: Exception) -> int:
    """Print an error as one line; return the exit code for a wrong argument or for a failed run."""
    message = getattr(error, "format_message", None)
    if message is not None:
        print(f"{message()} (try `neusee --help`)", file=sys.stderr)
        return BAD
    from neusee.workflows.graph.diagnostics import visible

    cause = type(error).__name__
    text = str(error) if cause in ("RunError", "UnfollowedCode") else f"{cause}: {error}"
    print(visible(f"{text}   (--debug shows where)"), file=sys.stderr)
    return BAD if cause == "UnfollowedCode" else FAILED
