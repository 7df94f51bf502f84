"""Memory and processors of this machine: use, free amounts, and the memory limit above which a step
or a report is stopped.
"""

from __future__ import annotations

import ctypes
import functools
import os
import resource
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Self

from neusee.workflows.store.cache_settings import format_size

if TYPE_CHECKING:
    from neusee.nodes.input_files import Room

# --- processors -----------------------------------------------------------------------------------

# The processors that other work leaves free; a command chooses its numbers of threads and of worker
# processes from them.


def free_processors() -> int | None:
    """Return the number of processors that no other work uses, at least 1; None if the system
    reports no load.

    Work that has only begun, or has just ended, does not count: both the mean load of the last
    minute and the present load must be high.
    """
    try:
        own_processors, all_of_them = len(os.sched_getaffinity(0)), os.cpu_count() or 1
        with open("/proc/loadavg", encoding="ascii") as file:
            # such as "0.52 0.58 0.59 2/743 12345": the first field is the mean load of a minute,
            # the fourth the running and all processes
            load_fields = file.read().split()
        # running processes, without this one
        load_of_minute, running_now = (
            float(load_fields[0]),
            int(load_fields[3].partition("/")[0]) - 1,
        )
    except (OSError, AttributeError, ValueError, IndexError):  # not Linux
        return None
    # the load, scaled to the share of the processors that this process may use
    return threads_for(
        own_processors, min(load_of_minute, running_now) * own_processors / all_of_them
    )


def threads_for(processors: int, load: float) -> int:
    """Return the number of threads that fit beside ``load`` busy processes on ``processors``
    processors, at least 1.
    """
    return max(1, min(processors, round(processors - load)))


# --- memory use -----------------------------------------------------------------------------------

# Memory use: the peak memory of a step, and the memory of a device.


_LIMIT_FILES = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
_USAGE_FILES = ("/sys/fs/cgroup/memory.current", "/sys/fs/cgroup/memory/memory.usage_in_bytes")
_PAGE = os.sysconf("SC_PAGE_SIZE")  #: bytes
FRESH_SECONDS = 0.02  #: interval (s) between two reads of the memory in use
# time (s) of the newest reading of the free memory, and its result (bytes)
_newest_free = [-FRESH_SECONDS, 0.0]
_highest = 0  # peak memory (bytes) of this process before the last reset of the system's counter


class PeakMemory:
    """Peak memory of a block of code in bytes, less the memory in use before the block.

    On the CPU this is the resident memory of the whole process, parallel steps included. ``bytes``
    is None if the system gives no numbers.
    """

    def __init__(self, device: str, watched: bool = True) -> None:
        self.device, self.watched = device, watched
        self.bytes: int | None = None
        self._before: int | None = None

    def __enter__(self) -> Self:
        if not self.watched:
            return self
        if self.device.startswith("cuda"):
            # imported here, because a command that computes nothing needs only the free memory
            import torch

            torch.cuda.reset_peak_memory_stats(self.device)
            self._before = torch.cuda.memory_allocated(self.device)
        elif self.device.startswith("cpu"):
            self._before = resident("VmRSS:") if _peak_reset() else None
        return self

    def __exit__(self, *error: object) -> None:
        if self._before is None:
            return
        highest = resident("VmHWM:") if self.device.startswith("cpu") else _highest_on(self.device)
        if highest is not None:
            self.bytes = max(0, highest - self._before)


def _highest_on(device: str) -> int:
    import torch

    return int(torch.cuda.max_memory_allocated(device))


def pool_of(device: str) -> str:
    """Return the name of the memory that a device uses; ``cpu:0`` and ``cpu:1`` use the same
    memory.
    """
    return "cpu" if device.startswith("cpu") else device


def _peak_reset() -> bool:
    """Reset the peak memory of this process; return False if the system does not allow the
    reset.
    """
    global _highest
    _highest = max(_highest, resident("VmHWM:") or 0)
    try:
        with open("/proc/self/clear_refs", "w") as file:
            # 5 means: reset the peak resident memory, see proc(5)
            file.write("5")
    except OSError:
        return False
    return True


def resident(field: str) -> int | None:
    """Return a number of bytes that the system reports for this process, such as ``VmRSS:``, or
    None.
    """
    with suppress(OSError), open("/proc/self/status") as file:
        for line in file:
            if line.startswith(field):
                # the system writes kB
                return int(line.split()[1]) * 1024
    return None


def process_memory() -> int:
    """Return the memory of this process in bytes: code, libraries and data that are resident
    now.
    """
    # takes a fifth of the time of /proc/self/status
    with suppress(OSError), open("/proc/self/statm") as file:
        # the second number of statm is the resident memory in pages
        return int(file.read().split()[1]) * _PAGE
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def process_peak() -> int:
    """Return the peak memory of this process in bytes since it started, regardless of resets by
    `PeakMemory`.
    """
    return max(
        _highest, resident("VmHWM:") or resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    )


def give_back() -> None:
    """Return freed memory to the system; otherwise glibc keeps blocks below 32 MB in a busy
    process.
    """
    with suppress(OSError, AttributeError):  # another C library has no such function
        _libc().malloc_trim(0)


@functools.cache
def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None)


def free_memory() -> int:
    """Return the bytes that this process can still use: free memory of the machine, or of its
    control group.

    A value younger than `FRESH_SECONDS` is used again, because short runs call this more often
    than it changes.
    """
    present_time = time.monotonic()
    if not _newest_free[0] <= present_time < _newest_free[0] + FRESH_SECONDS:
        _newest_free[:] = [present_time, _free_memory()]
    return int(_newest_free[1])


def _free_memory() -> int:
    """Return the bytes that this process can still use: the minimum over the machine, its control
    group and the limits; at least 0.
    """
    free = there_is("cpu") - process_memory()
    with suppress(OSError, ValueError, StopIteration), open("/proc/meminfo") as file:
        free = min(
            free,
            next(int(line.split()[1]) * 1024 for line in file if line.startswith("MemAvailable:")),
        )
    for limit, usage_file in zip(_LIMIT_FILES, _USAGE_FILES, strict=True):
        with suppress(OSError, ValueError):
            used_bytes = int(Path(usage_file).read_text()) - _reclaimable(Path(usage_file).parent)
            free = min(free, int(Path(limit).read_text()) - used_bytes)
    return max(free, 0)


def _reclaimable(group: Path) -> int:
    """Return the bytes of files that a control group caches in memory and releases when memory is
    short.
    """
    for line in (group / "memory.stat").read_text().splitlines():
        if line.startswith(("inactive_file ", "total_inactive_file ")):
            return int(line.split()[1])
    return 0


def there_is(device: str) -> int:
    """Return the memory of a GPU in bytes, or for the CPU the memory that this process may use."""
    if device.startswith("cuda"):
        import torch

        return int(torch.cuda.get_device_properties(device).total_memory)
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    for path in _LIMIT_FILES:
        with suppress(OSError, ValueError):
            memory = min(memory, int(Path(path).read_text()))
    return memory


# --- memory watch ---------------------------------------------------------------------------------

# Watch over the memory of this process: a step or a report that raises the memory above the limit
# is stopped.
#
# A thread reads the resident memory about fifty times a second and raises `MemoryLimit` in the
# watched thread, which stops when its current library call returns. A single call that allocates
# too much is covered by the prediction before the run, and, if it reads a file, by the size that
# the header of the file states.


_SECONDS_BETWEEN_LOOKS = 0.02  #: interval (s) between two readings
_SHARE_TO_GIVE_BACK = 0.9  #: share of the limit above which freed memory is returned to the system
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
        limits = f", the limit is {format_size(int(_at_last_stop[1]))}" if _at_last_stop[1] else ""
        return f"the process holds {format_size(int(_at_last_stop[0]))}{limits}"


# memory of the process and its limit (bytes) when a step was last stopped
_at_last_stop = [0.0, 0.0]
_limits: list[float] = []
# watched threads; True after `MemoryLimit` was raised in the thread
_watched_threads: dict[int, bool] = {}
_guard = threading.RLock()
_wake = threading.Event()
_thread: list[threading.Thread] = []


@contextmanager
def limited(limit: float) -> Iterator[None]:
    """Limit the memory of this process to ``limit`` bytes while the ``with`` block runs."""
    # imported here, because nodes import slowly, and `neusee --help` needs only the free processors
    from neusee.nodes import input_files

    input_files.measured_by(_room)
    with _guard:
        _limits.append(limit)
    try:
        yield
    finally:
        with _guard:
            _limits.remove(limit)


def limit_now() -> float | None:
    """Return the memory limit of this process in bytes, or None if none is set."""
    return min(_limits, default=None)


def _room() -> Room:
    """Return the memory that readers of input files may still use: the rest up to the limit, or the
    free memory.
    """
    from neusee.nodes import input_files

    room = input_files.free_memory()
    if not _limits:
        return room
    limit = min(_limits)
    return input_files.Room(min(limit - process_memory(), room.free), limit)


@contextmanager
def guarded() -> Iterator[None]:
    """Raise `MemoryLimit` in the ``with`` block when the process exceeds its limit; do nothing
    without a limit.
    """
    thread_id = threading.get_ident()
    # an outer block of this thread is watched already
    if not _limits or thread_id in _watched_threads:
        yield
        return
    with _guard:
        _watched_threads[thread_id] = False
        if not _thread:
            _thread.append(
                threading.Thread(target=_watch_memory, name="neusee memory", daemon=True)
            )
            _thread[0].start()
        _wake.set()
    try:
        yield
    finally:
        try:
            stopped = _stop_watching(thread_id)
        except MemoryLimit:  # the exception was raised at the last moment, and arrives only now
            stopped = _stop_watching(thread_id)
    if stopped:
        raise MemoryLimit


def _stop_watching(here: int) -> bool:
    """Stop watching a thread; return True if `MemoryLimit` was raised in it. No exception is left
    pending.
    """
    with _guard:
        stopped = _watched_threads.pop(here, True)
        if stopped:
            _await_exception(here)
    return stopped


def _await_exception(here: int) -> None:
    """Wait until the exception that was raised in this thread arrives here.

    It is not enough to withdraw it: CPython 3.11 and 3.12 would still check for it at every call,
    and hang if traced.
    """
    try:
        # replaces an exception that is pending
        _raise_in(ctypes.c_ulong(here), ctypes.py_object(MemoryLimit))
        # loop until the exception arrives
        while True:
            pass
    except MemoryLimit:
        return


def _watch_memory() -> None:
    """Watch the memory in an endless loop, in a separate thread; stop the watched threads when the
    memory exceeds the limit.
    """
    while True:
        _wake.wait()
        with _guard:
            if not _watched_threads:
                _wake.clear()
            limit = min(_limits, default=float("inf"))
            if process_memory() > _SHARE_TO_GIVE_BACK * limit:
                # freed memory that the C library still holds
                give_back()
            if (held_bytes := process_memory()) > limit:
                _stop(held_bytes, limit)
        threading.Event().wait(_SECONDS_BETWEEN_LOOKS)


def _stop(now: float, limit: float) -> None:
    """Raise `MemoryLimit` in each watched thread that was not stopped yet; ``now`` and ``limit``
    are bytes.
    """
    for thread, stopped in _watched_threads.items():
        if not stopped:
            _at_last_stop[:] = [now, limit]
            _watched_threads[thread] = True
            _raise_in(ctypes.c_ulong(thread), ctypes.py_object(MemoryLimit))


def _forked() -> None:
    """Reset the state in a forked child process, which has no watching thread and no watched
    threads.
    """
    global _guard, _wake
    _guard, _wake = threading.RLock(), threading.Event()
    _limits.clear()
    _watched_threads.clear()
    _thread.clear()


os.register_at_fork(after_in_child=_forked)


# --- allocation limit -----------------------------------------------------------------------------

# A hard limit for nodes of the user: the system refuses an allocation that would take the process
# far above its limit.
#
# The watch over the memory stops a step only between two library calls. One call of a node of the
# user may allocate everything at once, and nothing predicts it. While such a node computes on the
# CPU, the system therefore refuses private memory beyond `SLACK` times the limit of the run, also
# in libraries and threads that the node starts. Python and torch turn this into an error, and
# neusee turns the error into a sentence.


#: multiple of the limit above which allocations are refused; the rest up to 1.3 is for memory that
#: is already mapped
SLACK = 1.2
_REFUSED_ALLOCATION_TEXTS = (
    "can't allocate memory",
    "cannot allocate memory",
    "std::bad_alloc",
    "not enough memory",
)


@contextmanager
def refusing_allocations(active: bool) -> Iterator[None]:
    """If ``active``, let the system refuse allocations beyond the limit of the run in the ``with``
    block.

    Raises `MemoryLimit` instead of the error of such an allocation.
    """
    limit, mapped_bytes = limit_now(), resident("VmData:")
    if not active or limit is None or mapped_bytes is None:
        yield
        return
    old_limits = resource.getrlimit(resource.RLIMIT_DATA)
    # private memory that is mapped now, plus the allowed growth
    allowed_bytes = int(mapped_bytes + max(0.0, SLACK * limit - process_memory()))
    # the present limit, set by the user or for another node of the user, is as strict
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
    return isinstance(error, MemoryError) or any(
        word in str(error).lower() for word in _REFUSED_ALLOCATION_TEXTS
    )
