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
from pathlib import Path
from typing import TYPE_CHECKING

from neusee.workflows.contract.surroundings import FOLDER, Others, Surrounding, others

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

    def __init__(self, others: Others, changes: frozenset[Surrounding] = frozenset()) -> None:
        self.others, self.changes = others, changes
        self._folder = tempfile.TemporaryDirectory(prefix="neusee-check-")
        try:
            self._start()
        except OSError as error:
            self._folder.cleanup()
            raise NotStartedError(f"a process of Python does not start: {error}") from None

    def outcomes(self, asked: Asked) -> list[Outcome]:
        """Return the outcome of each call; a call that ends the process, or has no end, costs another process.

        Raises `NotStartedError`.
        """
        found = self._up_to_an_end(asked)
        while len(found) < len(asked.calls):
            self._end()
            self._start()
            found += self._up_to_an_end(replace(asked, calls=asked.calls[len(found) :]))
        return found

    def close(self) -> None:
        """End the process and remove its folder."""
        self._end()
        self._folder.cleanup()

    def _start(self) -> None:
        """Start the process, beside this one: in its group, so that the end of a terminal ends it too."""
        folder = Path(self._folder.name)
        self._pipe, theirs = Pipe()
        path = [os.path.abspath(entry) for entry in sys.path]
        optimized = ["-O"] * sys.flags.optimize
        quiet = subprocess.DEVNULL
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", *optimized, "-c", _SCRIPT, str(theirs.fileno()), *path],
                stdin=quiet,
                stdout=quiet,
                stderr=quiet,
                cwd=folder if FOLDER in self.changes else None,
                env=self.others.environment(self.changes, folder, os.environ),
                pass_fds=[theirs.fileno()],
            )

    def _end(self) -> None:
        """End the process if it runs still."""
        self._process.kill()
        self._process.wait()
        self._pipe.close()

    def _up_to_an_end(self, asked: Asked) -> list[Outcome]:
        """Return the outcomes of the calls up to the first that ends the process or has no end."""
        found: list[Outcome] = []
        try:
            self._pipe.recv_bytes()  # it is ready
        except EOFError:
            raise NotStartedError(f"a process of Python ended at its start, {_words(self._process.wait())}") from None
        try:
            self._pipe.send_bytes(pickle.dumps(asked))  # a tensor of `send` would share its memory
            for _ in asked.calls:
                if not self._pipe.poll(LONGEST):
                    return [*found, _ended(f"does not end within {LONGEST:.0f} s")]
                found.append(pickle.loads(self._pipe.recv_bytes()))
        except (EOFError, OSError):
            return [*found, _ended(f"ends the process, {_words(self._process.wait())}")]
        return found


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
