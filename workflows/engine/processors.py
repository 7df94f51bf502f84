"""The processors that other work leaves free, by which a command chooses its threads and its worker processes."""

from __future__ import annotations

import os


def free_processors() -> int | None:
    """Return the number of processors that no other work needs, at least one; None where the system tells no load.

    Work that has only begun, or that has just ended, does not count: both the last minute and this moment must be busy.
    """
    try:
        mine, all_of_them = len(os.sched_getaffinity(0)), os.cpu_count() or 1
        with open("/proc/loadavg", encoding="ascii") as file:
            words = file.read().split()
        minute, now = float(words[0]), int(words[3].partition("/")[0]) - 1  # less this process
    except (OSError, AttributeError, ValueError, IndexError):  # not Linux
        return None
    return threads_for(mine, min(minute, now) * mine / all_of_them)


def threads_for(processors: int, load: float) -> int:
    """Return the number of threads that fit beside ``load`` busy processes on a number of processors, at least one."""
    return max(1, min(processors, round(processors - load)))
