"""Memory and processors of this machine: what is in use, and what is free."""

from __future__ import annotations

import ctypes
import functools
import os
import resource
import time
from contextlib import suppress
from pathlib import Path
from typing import Self

# --- processors -----------------------------------------------------------------------------------

# The processors that other work leaves free, by which a command chooses its threads and its worker
# processes.


def free_processors() -> int | None:
    """Return the number of processors that no other work needs, at least one; None where the system
    tells no load.

    Work that has only begun, or that has just ended, does not count: both the last minute and this
    moment must be busy.
    """
    try:
        own_processors, all_of_them = len(os.sched_getaffinity(0)), os.cpu_count() or 1
        with open("/proc/loadavg", encoding="ascii") as file:
            # such as "0.52 0.58 0.59 2/743 12345": load of a minute first, running/all processes
            # fourth
            load_fields = file.read().split()
        # running processes of all, less this one
        load_of_minute, running_now = (
            float(load_fields[0]),
            int(load_fields[3].partition("/")[0]) - 1,
        )
    except (OSError, AttributeError, ValueError, IndexError):  # not Linux
        return None
    # the load of the machine, in the share of its processors that this process may use
    return threads_for(
        own_processors, min(load_of_minute, running_now) * own_processors / all_of_them
    )


def threads_for(processors: int, load: float) -> int:
    """Return the number of threads that fit beside ``load`` busy processes on a number of
    processors, at least one.
    """
    return max(1, min(processors, round(processors - load)))


# --- memory use -----------------------------------------------------------------------------------

# Memory use: the peak memory of a step, and the memory of a device.


_CGROUPS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
_USED = ("/sys/fs/cgroup/memory.current", "/sys/fs/cgroup/memory/memory.usage_in_bytes")
_PAGE = os.sysconf("SC_PAGE_SIZE")  #: bytes
FRESH = 0.02  #: s, the time between two looks of the watch over the memory
_told = [-FRESH, 0.0]  # time of the newest look at the free memory in s, and what it found in bytes
_highest = 0  # peak memory of this process before the last reset of the counter of the system


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
            # here, because a command that computes nothing asks for the free memory alone
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
            # 5: reset the peak resident memory, by proc(5)
            file.write("5")
    except OSError:
        return False
    return True


def resident(field: str) -> int | None:
    """Return a number of bytes that the system tells of this process, such as ``VmRSS:``, or
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
    # a fifth of the time of /proc/self/status
    with suppress(OSError), open("/proc/self/statm") as file:
        # the second number of statm is the resident memory in pages
        return int(file.read().split()[1]) * _PAGE
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def process_peak() -> int:
    """Return the peak memory of this process in bytes since it started, whatever `PeakMemory`
    measured since then.
    """
    return max(
        _highest, resident("VmHWM:") or resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    )


def give_back() -> None:
    """Give the memory that was freed back to the system; glibc keeps blocks below 32 MB of a
    busy process otherwise.
    """
    with suppress(OSError, AttributeError):  # another C library
        _libc().malloc_trim(0)


@functools.cache
def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None)


def free_memory() -> int:
    """Return the bytes that this process can still use: free memory of the machine, or of its
    control group.

    A number that is younger than `FRESH` seconds is told again, because short runs ask more often
    than it changes.
    """
    present_time = time.monotonic()
    if not _told[0] <= present_time < _told[0] + FRESH:
        _told[:] = [present_time, _free_memory()]
    return int(_told[1])


def _free_memory() -> int:
    """Return the bytes that this process can still use: the least of what the machine, its
    control group and the limits leave; at least 0.
    """
    free = there_is("cpu") - process_memory()
    with suppress(OSError, ValueError, StopIteration), open("/proc/meminfo") as file:
        free = min(
            free,
            next(int(line.split()[1]) * 1024 for line in file if line.startswith("MemAvailable:")),
        )
    for limit, usage_file in zip(_CGROUPS, _USED, strict=True):
        with suppress(OSError, ValueError):
            used_bytes = int(Path(usage_file).read_text()) - _reclaimable(Path(usage_file).parent)
            free = min(free, int(Path(limit).read_text()) - used_bytes)
    return max(free, 0)


def _reclaimable(group: Path) -> int:
    """Return the bytes of files that a control group keeps in memory and gives back when memory
    is short.
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
    for path in _CGROUPS:
        with suppress(OSError, ValueError):
            memory = min(memory, int(Path(path).read_text()))
    return memory
