"""Call of the user's code in a forked process: all changes that it makes in Python or in a library
end with the call.

Code of a user may set an option of a library, fill a table, patch a function or move the working
folder. No list of such changes is complete, so a step whose code may make one is computed in a
fork of this process. The fork has the inputs in memory, sends the value back, and ends. The next
step, of the user or of neusee, finds this process unchanged.
"""

from __future__ import annotations

import io
import os
import select
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from typing import Any, Generic, NamedTuple, TypeVar

import torch

from neusee.workflows.engine.machine_resources import (
    guarded,
    limit_now,
    limited,
    refusing_allocations,
    resident,
)
from neusee.workflows.engine.worker_processes import deaf_fork, end_with, ignore_interrupts
from neusee.workflows.observation.environment_variables import Asked, hide_for_good
from neusee.workflows.observation.observed_call import one_at_a_time, watched_in_fork
from neusee.workflows.observation.step_thread import is_alone

T = TypeVar("T")
#: interval (s) at which the caller checks for an exception that another thread raised in it
_LOOK = 0.05
_BESIDE_TABLE = "rich_proxied_file"  #: attribute of a stream of rich beside a live table
_UNSENT = 3  #: exit code of a fork whose value cannot be sent


class ProcessEnded(RuntimeError):
    """Error of a call whose process ended before the call did: killed, or crashed by a library."""


class Returned(NamedTuple, Generic[T]):
    """The result of a call in a forked process."""

    value: T
    peak: int | None  #: peak memory (bytes) of the forked process, beyond its memory at the start
    asked: Asked  #: environment variables that the code read but that were hidden or not declared


class _Sent(NamedTuple):
    """The content of the file that the forked process sends."""

    returned: Returned[Any] | None
    error: BaseException | None
    said: list[warnings.WarningMessage]
    printed: dict[str, str]  #: text for each stream that is shown beside a table: see `_collected`


def may_fork() -> bool:
    """Return True if a fork is safe, and if the output of the call goes to the same place as that
    of this process.

    A lock that a thread of another library holds would stay locked in a fork, as in a notebook.
    """
    return (
        sys.platform == "linux"
        and is_alone()
        and all(_is_a_file(stream) for stream in (sys.stdout, sys.stderr))
    )


def call_in_fork(function: Callable[[], T], variables: frozenset[str]) -> Returned[T] | None:
    """Return the result of a function in a fork of this process; None if its value cannot be sent,
    or if the fork fails.

    ``variables``: environment variables that the code declares. Raises the errors of the function,
    with their text and without their traceback, and `ProcessEnded`.
    """
    with one_at_a_time():
        return _called(function, variables)


def _called(function: Callable[[], T], variables: frozenset[str]) -> Returned[T] | None:
    """Implement `call_in_fork`, while no other step runs."""
    limit, parent = limit_now(), os.getpid()
    with open(os.memfd_create("neusee step"), "rb") as file, watched_in_fork() as begin_watch:
        try:
            child = _forked()
        except OSError:  # no memory or no permission for one more process
            return None
        # this branch runs in the fork, which ends inside `_answer`
        if not child:
            _answer(begin_watch, partial(_sent, function, variables, limit), file.fileno(), parent)
        exit_code = _waited(child)
        if exit_code == _UNSENT:
            return None
        if exit_code:
            raise ProcessEnded(_reason(exit_code))
        # the file is in memory and has only this path
        answer: _Sent = torch.load(f"/proc/self/fd/{file.fileno()}", mmap=True, weights_only=False)
    for name, text in answer.printed.items():
        getattr(sys, name).write(text)
    for warning in answer.said:
        warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
    if answer.error is not None:
        raise answer.error
    return answer.returned


def _is_a_file(stream: Any) -> bool:
    """Return True for a stream with a file descriptor, or for None."""
    try:
        return stream is None or stream.fileno() >= 0
    except (OSError, ValueError, AttributeError):
        return False


# --- in the process that waits --------------------------------------------------------------------


def _forked() -> int:
    """Fork this process; return the process number of the child, or 0 in the child."""
    # otherwise the fork would print the buffered text a second time
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            stream.flush()
    with warnings.catch_warnings(), deaf_fork():  # Python 3.12 warns of every fork beside a thread
        warnings.simplefilter("ignore", DeprecationWarning)
        return os.fork()


def _waited(child: int) -> int:
    """Wait until a process ends and return its exit code, negative for a signal. Kill the process
    if an exception interrupts the wait.
    """
    try:
        with _descriptor(child) as descriptors:
            while True:
                ended_process, status = os.waitpid(child, os.WNOHANG)
                if ended_process:
                    return os.waitstatus_to_exitcode(status)
                # returns when the child ends, or after the given time
                select.select(descriptors, [], [], _LOOK if descriptors else _LOOK / 50)
    except BaseException:
        with suppress(ProcessLookupError, ChildProcessError):
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
        raise


@contextmanager
def _descriptor(child: int) -> Iterator[list[int]]:
    """Yield a list with a file descriptor that becomes ready when the process ends; an empty list
    if the system has none.
    """
    try:
        descriptor = os.pidfd_open(child)
    except (OSError, AttributeError):
        yield []
        return
    try:
        yield [descriptor]
    finally:
        os.close(descriptor)


def _reason(code: int) -> str:
    """Return why a process ended, from its exit code, which is negative for a signal."""
    if code > 0:
        return f"the process of the step ended with the exit code {code}"
    name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
    known_causes = {
        "SIGKILL": "killed, as by a system that has too little memory",
        "SIGSEGV": "a library crashed",
    }
    return f"the process of the step was ended by {name}" + (
        f": {known_causes[name]}" if name in known_causes else ""
    )


# --- in the fork ----------------------------------------------------------------------------------


def _answer(
    begin_watch: Callable[[], None], work: Callable[[], _Sent], file: int, parent: int
) -> None:
    """Run the work in the fork, write its result to a file, and end this process in every case."""
    exit_code, texts_by_stream = 1, _collected()
    try:
        ignore_interrupts()
        # False: the parent has already ended, and no process waits
        if end_with(parent):
            begin_watch()
            _print_as_parent()
            answer = work()
            exit_code = _write(
                answer._replace(
                    printed={name: text.getvalue() for name, text in texts_by_stream.items()}
                ),
                file,
            )
    finally:
        for stream in (sys.stdout, sys.stderr):
            with suppress(Exception):
                stream.flush()
        os._exit(exit_code)


def _collected() -> dict[str, io.StringIO]:
    """Collect the text that is printed to streams beside a live table: a thread of the parent may
    hold the lock of the table.
    """
    collected = {
        name: io.StringIO()
        for name in ("stdout", "stderr")
        if hasattr(getattr(sys, name), _BESIDE_TABLE)
    }
    for name, text in collected.items():
        setattr(sys, name, text)
    return collected


def _print_as_parent() -> None:
    """Let C libraries print to stderr if Python does so, since stdout is reserved for the result of
    the command.
    """
    if (
        sys.stdout is not None
        and not isinstance(sys.stdout, io.StringIO)
        and sys.stdout.fileno() == 2
    ):
        # descriptor 1 is stdout of C libraries, 2 is stderr
        os.dup2(2, 1)


def _sent(function: Callable[[], Any], variables: frozenset[str], limit: float | None) -> _Sent:
    """Return the result or the error of the function in the fork, with its warnings."""
    with warnings.catch_warnings(record=True) as caught_warnings:
        try:
            return _Sent(_returned(function, variables, limit), None, caught_warnings, {})
        except BaseException as error:
            return _Sent(None, error, caught_warnings, {})


def _returned(
    function: Callable[[], Any], variables: frozenset[str], limit: float | None
) -> Returned[Any]:
    """Call the function under the memory limits; return its value, its peak memory in bytes, and
    the hidden variables that it read.
    """
    with ExitStack() as stack:
        if limit is not None:
            stack.enter_context(limited(limit))
        stack.enter_context(guarded())
        stack.enter_context(refusing_allocations(True))
        asked_variables = hide_for_good(variables)
        bytes_before = resident("VmRSS:")
        value = function()
        peak_bytes = resident("VmHWM:")  # the system counts the peak of a fork from its start
    peak = None if bytes_before is None or peak_bytes is None else max(0, peak_bytes - bytes_before)
    return Returned(value, peak, asked_variables)


def _write(sent: _Sent, file: int) -> int:
    """Write the content that the parent reads; return the exit code of the fork."""
    plain_warnings = [_plain_warning(warning) for warning in sent.said]
    try:
        with open(file, "wb", closefd=False) as binary:
            torch.save(sent._replace(said=plain_warnings), binary)
    except (
        Exception
    ):  # of the class of any value: it cannot be pickled, or does not fit into memory once more
        return _UNSENT
    return 0


def _plain_warning(warning: warnings.WarningMessage) -> warnings.WarningMessage:
    return warnings.WarningMessage(
        str(warning.message), warning.category, warning.filename, warning.lineno
    )
