"""A process with other surroundings, seen from the process that asks it for outcomes."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from multiprocessing.connection import Pipe
from typing import TYPE_CHECKING

from neusee.workflows.contract.surroundings import FRESH, Others, Surrounding, others

if TYPE_CHECKING:  # they import torch
    from neusee.workflows.contract.elsewhere_process import Asked
    from neusee.workflows.contract.outcomes import Outcome

LONGEST = 300.0  #: s of one call
_SCRIPT = """
import sys
sys.path[:] = sys.argv[2:]
from neusee.workflows.contract.elsewhere_process import serve
pipe, sys.argv[1:] = int(sys.argv[1]), []
serve(pipe)
"""


class NotStartedError(RuntimeError):
    """Error for a process that ends before it is asked anything."""


class Elsewhere:
    """A process with some of the other surroundings; it imports torch while the caller does other things."""

    def __init__(self, others: Others, changes: frozenset[Surrounding]) -> None:
        self.others, self._fresh = others, changes & FRESH
        self.folder = tempfile.TemporaryDirectory(prefix="neusee-check-")
        try:
            self._start()
        except OSError as error:
            self.folder.cleanup()
            raise NotStartedError(f"a process of Python does not start: {error}") from None

    def outcomes(self, asked: Asked) -> list[Outcome]:
        """Return the outcome of each call, made in a fork of the process; raise `NotStartedError`.

        After a call that ends its fork, or that does not end, the other calls are made in another one.
        """
        found: list[Outcome] = []
        while len(found) < len(asked.calls):
            found += self._up_to_an_end(replace(asked, calls=asked.calls[len(found) :]))
        return found

    def close(self) -> None:
        """End the process and remove its folder."""
        self._end()
        self.folder.cleanup()

    def _start(self) -> None:
        """Start the process in a group of its own, with which its forks end."""
        self._pipe, theirs = Pipe()
        self._is_ready = False
        path = [os.path.abspath(entry) for entry in sys.path]
        quiet = subprocess.DEVNULL
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", *["-O"] * sys.flags.optimize, "-c", _SCRIPT, str(theirs.fileno()), *path],
                stdin=quiet,
                stdout=quiet,
                stderr=quiet,
                env=self.others.environment(self._fresh, os.environ),
                pass_fds=[theirs.fileno()],
                process_group=0,
            )

    def _end(self) -> None:
        """End the process and its forks, if they run still."""
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._pipe.close()

    def _up_to_an_end(self, asked: Asked) -> list[Outcome]:
        """Return the outcomes of the calls up to the first that ends its process or has no end."""
        try:
            if not self._is_ready:
                self._pipe.recv_bytes()
                self._is_ready = True
            self._pipe.send_bytes(pickle.dumps(asked))  # `send` would share the memory of a tensor
            return self._received(asked)
        except (EOFError, OSError):
            code = self._process.wait()
            raise NotStartedError(f"a process of Python ended, {_words(code)}") from None

    def _received(self, asked: Asked) -> list[Outcome]:
        found: list[Outcome] = []
        while True:
            if not self._pipe.poll(LONGEST):
                self._end()
                self._start()
                return [*found, _ended(f"does not end within {LONGEST:.0f} s")]
            answer = pickle.loads(self._pipe.recv_bytes())
            if isinstance(answer, int):
                has_all = len(found) == len(asked.calls)
                return found if has_all else [*found, _ended(f"ends the process, {_words(answer)}")]
            found.append(answer)


@contextmanager
def elsewhere(early: bool = True) -> Iterator[Callable[[], Elsewhere]]:
    """Give a function that returns a process in which all surroundings are changed, and end the process at last.

    The process starts with the ``with`` block if ``early``, so that it imports torch beside this process.
    """
    begun = list[Elsewhere]()

    def process() -> Elsewhere:
        if not begun:
            given = others(os.environ)
            begun.append(Elsewhere(given, frozenset(given.changed())))
        return begun[0]

    try:
        if early:
            with suppress(NotStartedError):  # said where it is needed
                process()
        yield process
    finally:
        for each in begun:
            each.close()


def _ended(failure: str) -> Outcome:
    from neusee.workflows.contract.outcomes import Outcome

    return Outcome(failure=failure, is_end=True)


def _words(code: int) -> str:
    """Return an exit code of a process in words."""
    return f"with {signal.Signals(-code).name}" if code < 0 else f"with exit code {code}"
