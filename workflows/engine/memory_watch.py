"""Watch over the memory of this process: a step or a report that takes the process above its limit is stopped.

A thread reads the resident memory some fifty times a second and raises `MemoryLimit` in its thread, which
stops when its current call of a library returns. A single call that allocates too much is covered by the prediction
before the run, and where it reads a file by the size that the header of the file states.
"""

from __future__ import annotations

import ctypes
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from neusee.nodes.input_size import Room, measured_by
from neusee.nodes.input_size import free_memory as free_anywhere
from neusee.workflows.engine.memory_use import give_back, process_memory
from neusee.workflows.store.byte_sizes import format_size

_PAUSE = 0.02  #: s between two looks
_NEAR = 0.9  #: share of the limit from which memory that was freed is given back to the system
_ADVICE = (
    "give more memory, or choose a smaller picture, pupil or number of bands; the steps that are finished stay in the "
    "cache"
)
_raise_in = ctypes.pythonapi.PyThreadState_SetAsyncExc


class MemoryLimit(Exception):
    """Error of a step or a report during which the memory of the process exceeded the limit of the run."""

    def __str__(self) -> str:
        return f"{self._what()}: {_ADVICE}"

    def __reduce__(self) -> tuple[type[MemoryLimit], tuple[str]]:
        return MemoryLimit, (self._what(),)

    def _what(self) -> str:
        if self.args:
            return str(self.args[0])
        limits = f", the limit is {format_size(int(_last[1]))}" if _last[1] else ""
        return f"the process holds {format_size(int(_last[0]))}{limits}"


_last = [0.0, 0.0]  # bytes of the process and the limit when a step was last stopped
_limits: list[float] = []
_inside: dict[int, bool] = {}  # threads that are watched; True if told to stop
_guard = threading.RLock()
_wake = threading.Event()
_thread: list[threading.Thread] = []


@contextmanager
def limited(limit: float) -> Iterator[None]:
    """Limit the memory of this process to ``limit`` bytes while the ``with`` block runs."""
    with _guard:
        _limits.append(limit)
    try:
        yield
    finally:
        with _guard:
            _limits.remove(limit)


def limit_now() -> float | None:
    """Return the limit of the memory of this process in bytes, or None where none is set."""
    return min(_limits, default=None)


def _room() -> Room:
    """Return the memory that the readers of input files may still use: what the limits leave, or what is free."""
    found = free_anywhere()
    if not _limits:
        return found
    limit = min(_limits)
    return Room(min(limit - process_memory(), found.free), limit)


measured_by(_room)


@contextmanager
def guarded() -> Iterator[None]:
    """Raise `MemoryLimit` in the ``with`` block when the process exceeds its limit; do nothing without a limit."""
    here = threading.get_ident()
    if not _limits or here in _inside:  # the block outside is told
        yield
        return
    with _guard:
        _inside[here] = False
        if not _thread:
            _thread.append(threading.Thread(target=_look, name="neusee memory", daemon=True))
            _thread[0].start()
        _wake.set()
    try:
        yield
    finally:
        try:
            told = _leave(here)
        except MemoryLimit:  # told at the last moment, and delivered only now
            told = _leave(here)
    if told:
        raise MemoryLimit


def _leave(here: int) -> bool:
    """Watch a thread no longer; return True if it was told to stop, with no exception left to be delivered."""
    with _guard:
        told = _inside.pop(here, True)
        if told:
            _deliver(here)
    return told


def _deliver(here: int) -> None:
    """Let the exception that this thread was told arrive here.

    To withdraw it is not enough: CPython 3.11 and 3.12 would go on to look for it at every call, and hang if traced.
    """
    try:
        _raise_in(ctypes.c_ulong(here), ctypes.py_object(MemoryLimit))  # in the place of one that is on its way
        while True:
            pass
    except MemoryLimit:
        return


def _look() -> None:
    while True:
        _wake.wait()
        with _guard:
            if not _inside:
                _wake.clear()
            limit = min(_limits, default=float("inf"))
            if process_memory() > _NEAR * limit:
                give_back()
            if (now := process_memory()) > limit:
                _stop(now, limit)
        threading.Event().wait(_PAUSE)


def _stop(now: float, limit: float) -> None:
    for thread, told in _inside.items():
        if not told:
            _last[:] = [now, limit]
            _inside[thread] = True
            _raise_in(ctypes.c_ulong(thread), ctypes.py_object(MemoryLimit))


def _forked() -> None:
    """Begin anew in a forked child process, which has neither the thread that looks nor threads that are watched."""
    global _guard, _wake
    _guard, _wake = threading.RLock(), threading.Event()
    _limits.clear()
    _inside.clear()
    _thread.clear()


os.register_at_fork(after_in_child=_forked)
