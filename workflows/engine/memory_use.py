"""Memory use: the peak memory of a step, and the memory of a device."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Self

import torch

_CGROUPS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")


class PeakMemory:
    """Peak memory of a block of code in bytes, less the memory in use before the block.

    On the CPU this is the resident memory of the whole process, parallel steps included. ``bytes`` is
    None if the system gives no numbers.
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
            self._before = _resident("VmRSS:") if _peak_reset() else None
        return self

    def __exit__(self, *error: object) -> None:
        if self._before is None:
            return
        on_cpu = self.device.startswith("cpu")
        highest = _resident("VmHWM:") if on_cpu else torch.cuda.max_memory_allocated(self.device)
        if highest is not None:
            self.bytes = max(0, highest - self._before)


def pool_of(device: str) -> str:
    """Return the name of the memory that a device uses; ``cpu:0`` and ``cpu:1`` use the same memory."""
    return "cpu" if device.startswith("cpu") else device


def _peak_reset() -> bool:
    """Reset the peak memory of this process; return False if the system does not allow the reset."""
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
    """Return the memory of a GPU in bytes, or for the CPU the memory that this process may use."""
    if device.startswith("cuda"):
        return int(torch.cuda.get_device_properties(device).total_memory)
    found = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    for path in _CGROUPS:
        with suppress(OSError, ValueError):
            found = min(found, int(Path(path).read_text()))
    return found
