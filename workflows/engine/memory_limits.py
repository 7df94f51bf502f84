"""Memory limits: a step or a report that takes the process above its limit is stopped."""

from __future__ import annotations

import ctypes
import os
import resource
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from neusee.nodes.input_files import Room, measured_by
from neusee.nodes.input_files import free_memory as free_anywhere
from neusee.workflows.engine.machine_resources import give_back, process_memory, resident
from neusee.workflows.store.cache_settings import format_size

# --- memory watch ---------------------------------------------------------------------------------

# Watch over the memory of this process: a step or a report that takes the process above its limit
# is stopped.
#
# A thread reads the resident memory some fifty times a second and raises `MemoryLimit` in its
# thread, which stops when its current call of a library returns. A single call that allocates too
# much is covered by the prediction before the run, and where it reads a file by the size that the
# header of the file states.


_PAUSE = 0.02  #: s between two looks
_NEAR = 0.9  #: share of the limit from which memory that was freed is given back to the system
_ADVICE = (
    "give more memory, or choose a smaller picture, pupil or number of bands; the steps that are"
    " finished stay in the cache"
)
_raise_in = ctypes.pythonapi.PyThreadState_SetAsyncExc


class MemoryLimit(Exception):
    """Error of a step or a report during which the memory of the process exceeded the limit of
    the run.
    """

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
    """Return the memory that the readers of input files may still use: what the limits leave, or
    what is free.
    """
    room = free_anywhere()
    if not _limits:
        return room
    limit = min(_limits)
    return Room(min(limit - process_memory(), room.free), limit)


measured_by(_room)


@contextmanager
def guarded() -> Iterator[None]:
    """Raise `MemoryLimit` in the ``with`` block when the process exceeds its limit; do nothing
    without a limit.
    """
    thread_id = threading.get_ident()
    if not _limits or thread_id in _inside:  # the block outside is told
        yield
        return
    with _guard:
        _inside[thread_id] = False
        if not _thread:
            _thread.append(threading.Thread(target=_look, name="neusee memory", daemon=True))
            _thread[0].start()
        _wake.set()
    try:
        yield
    finally:
        try:
            stopped = _leave(thread_id)
        except MemoryLimit:  # told at the last moment, and delivered only now
            stopped = _leave(thread_id)
    if stopped:
        raise MemoryLimit


def _leave(here: int) -> bool:
    """Watch a thread no longer; return True if it was told to stop, with no exception left to be
    delivered.
    """
    with _guard:
        stopped = _inside.pop(here, True)
        if stopped:
            _deliver(here)
    return stopped


def _deliver(here: int) -> None:
    """Let the exception that this thread was told arrive here.

    To withdraw it is not enough: CPython 3.11 and 3.12 would go on to look for it at every call,
    and hang if traced.
    """
    try:
        # in the place of one that is on its way
        _raise_in(ctypes.c_ulong(here), ctypes.py_object(MemoryLimit))
        # until the exception arrives
        while True:
            pass
    except MemoryLimit:
        return


def _look() -> None:
    """Watch the memory in an endless loop, in a thread of its own; stop the watched threads when
    it exceeds the limit.
    """
    while True:
        _wake.wait()
        with _guard:
            if not _inside:
                _wake.clear()
            limit = min(_limits, default=float("inf"))
            if process_memory() > _NEAR * limit:
                # freed memory that the library of C still holds
                give_back()
            if (held_bytes := process_memory()) > limit:
                _stop(held_bytes, limit)
        threading.Event().wait(_PAUSE)


def _stop(now: float, limit: float) -> None:
    """Raise `MemoryLimit` in each watched thread that was not told yet; ``now`` and ``limit``
    are bytes.
    """
    for thread, stopped in _inside.items():
        if not stopped:
            _last[:] = [now, limit]
            _inside[thread] = True
            _raise_in(ctypes.c_ulong(thread), ctypes.py_object(MemoryLimit))


def _forked() -> None:
    """Begin anew in a forked child process, which has neither the thread that looks nor threads
    that are watched.
    """
    global _guard, _wake
    _guard, _wake = threading.RLock(), threading.Event()
    _limits.clear()
    _inside.clear()
    _thread.clear()


os.register_at_fork(after_in_child=_forked)


# --- allocation limit -----------------------------------------------------------------------------

# A hard limit for own nodes: the system refuses an allocation that would take the process far above
# its limit.
#
# The watch over the memory stops a step between two calls of libraries. One call of an own node may
# allocate all at once, and nothing foretells it. While such a node computes on the CPU, the system
# therefore refuses private memory beyond `SLACK` times the limit of the run, also in libraries and
# threads that the node begins. Python and torch turn this into an error, and the error into a
# sentence.


#: share of the limit from which allocations are refused; the rest to 1.3 is for what is mapped
#: already
SLACK = 1.2
_WORDS = ("can't allocate memory", "cannot allocate memory", "std::bad_alloc", "not enough memory")


@contextmanager
def refusing_allocations(active: bool) -> Iterator[None]:
    """Let the system refuse allocations beyond the limit of the run in the ``with`` block, if
    ``active``.

    Raises `MemoryLimit` in the place of the error that such an allocation gives.
    """
    limit, mapped_bytes = limit_now(), resident("VmData:")
    if not active or limit is None or mapped_bytes is None:
        yield
        return
    old_limits = resource.getrlimit(resource.RLIMIT_DATA)
    # private memory that is mapped now, and what the process may grow by
    allowed_bytes = int(mapped_bytes + max(0.0, SLACK * limit - process_memory()))
    # the limit that holds already is as strict:
    # of the user, or of an own node beside this one
    if old_limits[0] != resource.RLIM_INFINITY and old_limits[0] <= allowed_bytes:
        yield
        return
    resource.setrlimit(resource.RLIMIT_DATA, (allowed_bytes, old_limits[1]))
    try:
        yield
    except Exception as error:
        if not _is_refused(getattr(error, "cause", error)):
            raise
        text = (
            f"an allocation beside the {format_size(process_memory())} that the process holds was"
            " refused"
        )
        raise MemoryLimit(f"{text}, the limit is {format_size(int(limit))}") from error
    finally:
        with suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_DATA, old_limits)


def _is_refused(error: BaseException) -> bool:
    """Return True for the error of an allocation that the system refused."""
    return isinstance(error, MemoryError) or any(word in str(error).lower() for word in _WORDS)
