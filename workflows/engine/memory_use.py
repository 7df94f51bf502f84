"""How much memory a step took, and how much there is."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Self

import torch

_CGROUPS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")


class PeakMemory:
    """Bytes that a block of code took at most, beside what was there before it.

    Of the CPU it is the resident memory of the whole process, so that steps side by side
    count for each other; ``bytes`` is None where the system does not tell.
    """

    def __init__(self, device: str, watched: bool = True) -> None:
        self.device, self.watched = device, watched
        self.bytes: int | None = None
        self._before: int | None = None

    def __enter__(self) -> Self:
        if not self.watched:
            return self
        if self.device.startswith("cuda"):
            torch.cuda.reset_peak_memory_stats(self.device)
            self._before = torch.cuda.memory_allocated(self.device)
        elif self.device.startswith("cpu"):
            self._before = _resident("VmRSS:") if _forgotten() else None
        return self

    def __exit__(self, *error: object) -> None:
        if self._before is None:
            return
        on_cpu = self.device.startswith("cpu")
        highest = _resident("VmHWM:") if on_cpu else torch.cuda.max_memory_allocated(self.device)
        if highest is not None:
            self.bytes = max(0, highest - self._before)


def pool_of(device: str) -> str:
    """The memory that a device uses: all lanes of the CPU have one."""
    return "cpu" if device.startswith("cpu") else device


def _forgotten() -> bool:
    """Let the system forget the highest mark so far."""
    try:
        with open("/proc/self/clear_refs", "w") as file:
            file.write("5")
    except OSError:
        return False
    return True


def _resident(field: str) -> int | None:
    with suppress(OSError), open("/proc/self/status") as file:
        for line in file:
            if line.startswith(field):
                return int(line.split()[1]) * 1024
    return None


def there_is(device: str) -> int:
    """Bytes of memory of a device; of the CPU what this process may have of it."""
    if device.startswith("cuda"):
        return int(torch.cuda.get_device_properties(device).total_memory)
    found = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    for path in _CGROUPS:
        with suppress(OSError, ValueError):
            found = min(found, int(Path(path).read_text()))
    return found
