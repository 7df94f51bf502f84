"""Ctrl-C: the signal becomes one `KeyboardInterrupt`, which no library swallows, and a second
one ends at once.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from typing import TYPE_CHECKING

from neusee.workflows.cli.commands_and_exit_codes import INTERRUPTED

if TYPE_CHECKING:
    from sys import UnraisableHookArgs
    from types import FrameType

STOPPED = "stopped; finished results are kept, and the same command goes on from there"
#: the sentences that this command has printed because it was stopped
printed_sentences: list[str] = []
#: seconds in which several signals are one press of the keys: a shell and its terminal may both
#: send
_ONE_PRESS = 1.0


def say_stopped(sentence: str = STOPPED) -> None:
    """Print why a command ends early, unless this was printed before."""
    if not printed_sentences:
        printed_sentences.append(sentence)
        print(sentence, file=sys.stderr, flush=True)


class Interrupts:
    """Handler of the interrupts (Ctrl-C) of one command."""

    def __init__(self) -> None:
        self._first = 0.0  # time of the first interrupt; 0 before
        self._was_swallowed = False  # True if the interrupt could not be raised where it came

    @property
    def came(self) -> bool:
        """Return True if the user has pressed Ctrl-C."""
        return self._first > 0

    def watch(self) -> None:
        """Install the handler, unless the signal is ignored, as in a script that runs the program
        in the background.
        """
        if threading.current_thread() is not threading.main_thread():
            return
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, self._interrupt)
            sys.unraisablehook = self._swallowed

    def end(self) -> None:
        """Let a later interrupt end the process at once, while Python closes open files."""
        if signal.getsignal(signal.SIGINT) == self._interrupt:
            signal.signal(signal.SIGINT, lambda *_: os._exit(INTERRUPTED))

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        """Raise KeyboardInterrupt at the first interrupt, and end the process at a later one."""
        present_time = time.monotonic()
        if self.came and not self._was_swallowed:
            if present_time - self._first > _ONE_PRESS:
                stderr = sys.__stderr__.fileno() if sys.__stderr__ else 2
                os.write(stderr, b"stopped at once\n")
                os._exit(INTERRUPTED)
            return  # the second signal of the same press would interrupt what ends the command
        self._first, self._was_swallowed = present_time, False
        raise KeyboardInterrupt

    def _swallowed(self, problem: UnraisableHookArgs) -> None:
        """Raise an interrupt again that came while Python could not raise it, such as in a
        callback of a library.
        """
        if problem.exc_type is KeyboardInterrupt:
            self._was_swallowed = True
            signal.raise_signal(signal.SIGINT)
            return
        sys.__unraisablehook__(problem)
