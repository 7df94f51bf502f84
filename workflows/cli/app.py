"""The entry point of the command line: help without typer, threads, errors as one line."""

from __future__ import annotations

import gc
import os
import sys
import warnings
from collections.abc import MutableMapping
from io import TextIOWrapper
from shutil import get_terminal_size
from typing import TYPE_CHECKING, Any

from neusee.workflows.cli import lazy_imports as lazy
from neusee.workflows.cli.commands_and_exit_codes import (
    BAD,
    COLUMNS,
    DONE,
    FAILED,
    INTERRUPTED,
    REPEATED,
    TYPED,
    help_page,
)
from neusee.workflows.cli.interrupt_signal import Interrupts, printed_sentences, say_stopped

if TYPE_CHECKING:
    import typer


# --- thread settings ------------------------------------------------------------------------------

# Threads of torch beside other work, decided before torch is imported, because OpenMP reads its
# settings only then.
#
# A thread of OpenMP that waits for another spins for a thousandth of a second or more. Where the
# processors are busy, the other thread is not running, so that two threads burn ten times the
# processor time of one and take as much longer.


#: environment variables that set how a thread of OpenMP waits
_WAITING = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")
_NUMBER = ("OMP_NUM_THREADS", "MKL_NUM_THREADS")
#: the command during whose steps another process draws pictures, and its forecast
_DRAWN = ("run", "plan")
_TIMED = ("study",)  #: commands whose stored times depend on the number of threads


def settle_threads(command: str, environ: MutableMapping[str, str] = os.environ) -> None:
    """Let waiting threads sleep, and use no more threads than there are free processors; keep the
    user's settings.

    Steps beside which pictures are drawn leave one processor to these: on two processors `neusee
    run first_light` took 10.0 s with two threads and 8.1 s with one. Nothing changes where torch is
    imported already.
    """
    if "torch" in sys.modules:
        return
    if not any(name in environ for name in _WAITING):
        environ["OMP_WAIT_POLICY"] = "PASSIVE"
    threads = lazy.machine_resources.free_processors()
    if (
        command not in _TIMED
        and not any(name in environ for name in _NUMBER)
        and threads is not None
    ):
        environ["OMP_NUM_THREADS"] = str(max(1, threads - (command in _DRAWN)))


# --- app ------------------------------------------------------------------------------------------

# The entry point of the command line: ``neusee --help`` works without typer, and an error is
# printed as one line.


#: for a user of Hydra, whose option for several values is ``-m`` or ``--multirun``
ADVICE_ON_MULTIRUN = "several values are a sweep: write `neusee sweep RECIPE doe=flat,axicon`"

#: the program with the options of all commands, built when a caller first reads the name
app: typer.Typer


def __getattr__(name: str) -> Any:
    if name != "app":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

    return globals().setdefault("app", lazy.program_options.program())


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit; print an error as one line, or with ``--debug`` as a
    traceback.
    """
    interrupts = Interrupts()
    if arguments is None:  # a Python caller handles signals and garbage itself
        interrupts.watch()
        # a search for garbage among imported modules takes a tenth of the start-up time
        gc.disable()
        arguments = sys.argv[1:]
    TYPED[:] = arguments
    printed_sentences.clear()
    _print_any_character()
    try:
        exit_code = _run(arguments)
        # typer, too, ends at an interrupt
        if exit_code == INTERRUPTED or (interrupts.came and exit_code != DONE):
            exit_code = _stopped()
    except BrokenPipeError:
        sys.stderr.close()
        exit_code = DONE
    except KeyboardInterrupt:
        exit_code = _stopped()
    except Exception as error:
        if "--debug" in arguments:
            raise
        exit_code = _stopped() if interrupts.came else _explained(error)
    # from here on an interrupt ends the process at once
    interrupts.end()
    sys.exit(exit_code)


def _print_any_character() -> None:
    """Print characters that the terminal lacks, such as µ on one of ASCII, as escapes in place
    of an error.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _stopped() -> int:
    """Say that the command was stopped, and return its exit code."""
    say_stopped()
    return INTERRUPTED


def _run(arguments: list[str]) -> int:
    """Run the command in the arguments, and return its exit code.

    The help page and a stored answer are printed without an import of the program.
    """
    is_completion = "_NEUSEE_COMPLETE" in os.environ
    if (
        arguments in (["--help"], ["-h"])
        and not is_completion
        # a narrower page is wrapped by typer itself
        and get_terminal_size().columns >= COLUMNS
    ):
        print(help_page())
        return DONE
    # such a command may have a stored answer
    may_repeat = not is_completion and arguments[:1] and arguments[0] in REPEATED
    if may_repeat and lazy.repetition.say_stored_answer(arguments):
        return DONE

    command = arguments[0] if arguments else ""
    settle_threads(command)
    with warnings.catch_warnings():
        warnings.showwarning = lazy.command_frame.print_warning
        return lazy.program_options.run_program(arguments, is_completion)


def _explained(error: Exception) -> int:
    """Print an error as one line; return the exit code for a wrong argument or for a failed run."""
    typer_message = getattr(error, "format_message", None)
    if typer_message is not None:
        is_multirun = getattr(error, "option_name", None) in ("-m", "--multirun")
        advice = ADVICE_ON_MULTIRUN if is_multirun else "try `neusee --help`"
        print(f"{typer_message()} ({advice})", file=sys.stderr)
        return BAD

    error_class = type(error).__name__
    text = (
        str(error) if error_class in ("RunError", "UnfollowedCode") else f"{error_class}: {error}"
    )
    print(lazy.errors.visible(f"{text}   (--debug shows where)"), file=sys.stderr)
    return BAD if error_class == "UnfollowedCode" else FAILED
