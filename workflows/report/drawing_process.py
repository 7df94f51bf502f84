"""A process beside that of the run, which draws pictures and encodes images while the steps of the run compute.

matplotlib holds the lock of the interpreter, so that a thread that draws would stop the steps. The process is a fork of
the run at its start, with one thread, so that it imports nothing again; it reads its jobs from a pipe, and ends when
the run does. Where a fork is not safe, or for another reason no process answers, the run draws its pictures itself.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torch

from neusee.workflows.engine.worker_processes import deaf_fork, ignore_interrupts
from neusee.workflows.report.figures import style
from neusee.workflows.store.serialization import pack, tensors_in, unpack

MOST = 1 << 27  #: bytes of the arguments of a picture that go through the pipe
_PATIENCE = 120.0  #: s for one picture, after which the process counts as lost
_WORDS = (str, int, float, Path, type(None))


class NotDrawn(RuntimeError):
    """Error for a picture that the process did not draw; the run then draws the picture itself."""


def possible() -> bool:
    """Return True if this process may fork, and has a second processor for the fork."""
    return sys.platform == "linux" and len(os.sched_getaffinity(0)) > 1


class DrawingProcess:
    """A forked process that writes one picture at a time; `close` ends the process."""

    def __init__(self) -> None:
        self._turn = threading.Lock()  # a second thread waits until the file of the first is written
        self._next = threading.Lock()  # and is the next then, before the first thread asks again
        context = multiprocessing.get_context("fork")
        self._pipe, there = context.Pipe()
        with warnings.catch_warnings(), deaf_fork():  # Python 3.12 warns of every fork beside a thread
            warnings.simplefilter("ignore", DeprecationWarning)
            self._process = context.Process(target=_serve, args=(there, self._pipe), name="neusee draws", daemon=True)
            self._process.start()
        there.close()

    def make(self, path: Path, make: Callable[..., None], arguments: Mapping[str, Any]) -> None:
        """Let the process call ``make(path, **arguments)``; raise `NotDrawn` if the call failed or was not made."""
        with self._next:
            self._turn.acquire()
        try:
            self._ask(_sent(path, make, arguments))
        finally:
            self._turn.release()

    def _ask(self, job: bytes) -> None:
        """Send a job and wait until it is done."""
        try:
            self._pipe.send_bytes(job)
            if not self._pipe.poll(_PATIENCE):
                self.close()
                raise NotDrawn(f"no answer within {_PATIENCE:.0f} s")
            failed = self._pipe.recv_bytes().decode()
        except (OSError, EOFError) as error:
            self.close()
            raise NotDrawn(f"the process that draws has ended: {error}") from error
        if failed:
            raise NotDrawn(failed)

    def close(self) -> None:
        """End the process, at once if it does not end when its pipe closes."""
        self._pipe.close()
        self._process.join(0.5)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def _sent(path: Path, make: Callable[..., None], arguments: Mapping[str, Any]) -> bytes:
    """Return a job as bytes; raise `NotDrawn` for arguments that are large or that are no data."""
    if sum(x.nbytes for x in tensors_in(list(arguments.values()))) > MOST:
        raise NotDrawn("the arguments are large")
    try:
        packed = {name: _packed(value) for name, value in arguments.items()}
        return pickle.dumps((path, make, packed), protocol=5)
    except (TypeError, pickle.PicklingError, AttributeError) as error:
        raise NotDrawn(str(error)) from error


def _packed(value: Any) -> tuple[Any, list[Any], Any]:
    """Return the layout and the arrays of a value, and None; or a value without tensors at the end, as it is.

    A function that applies the node of a step is such a value; the process that draws has all modules of the run.
    """
    if not isinstance(value, _WORDS):
        try:
            layout, tensors = pack(value)
            return layout, [x.cpu().numpy() for x in tensors], None
        except TypeError:
            if tensors_in(value):
                raise
    return pack(None)[0], [], value


def _serve(pipe: Connection, other_end: Connection) -> None:
    """Make the files that the pipe asks for, until its other end closes."""
    other_end.close()  # else the pipe stays open when the run is killed
    _close_all_but(pipe.fileno())
    gc.freeze()  # a search for garbage among the objects of the run would copy their memory
    ignore_interrupts()
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    torch.set_num_threads(1)  # the threads of the run are not in a fork of it
    with suppress(Exception):  # the first picture meets the error again
        style.warm()
    with suppress(EOFError, OSError), torch.no_grad():
        while True:
            job = pipe.recv_bytes()
            pipe.send_bytes(_made(job).encode())


def _close_all_but(mine: int) -> None:
    """Close every file but those of the terminal and ``mine``: a lock of the store ends when its last copy closes."""
    for name in os.listdir("/proc/self/fd"):
        if int(name) > 2 and int(name) != mine:
            with suppress(OSError):
                os.close(int(name))


def _made(job: bytes) -> str:
    """Write the file of a job; return an empty text, or why this failed."""
    try:
        path, make, packed = pickle.loads(job)
        values = {
            name: unpack(layout, [torch.from_numpy(x) for x in arrays]) if word is None else word
            for name, (layout, arrays, word) in packed.items()
        }
        make(path, **values)
    except Exception as error:  # the run meets the error again when it draws the picture itself
        return f"{type(error).__name__}: {error}"
    return ""
