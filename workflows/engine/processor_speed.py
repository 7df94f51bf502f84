"""The processor of this machine: its name, a clock of its work, and a probe of its speed."""

from __future__ import annotations

import platform
import resource
import time
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import torch

_PROBE_SECONDS = 0.1  #: processor time (s) after which the probe takes no further turn


#: greatest ratio of two numbers of threads with which steps take about as long
_ALIKE_THREADS = 1.5


class Processor(NamedTuple):
    """A processor on which times were measured."""

    name: str  #: model, and instruction set of torch
    threads: int  #: of torch

    def takes_as_long(self, name: Any, threads: Any) -> bool:
        """Return True if times that were measured on a processor with this name hold here too."""
        if name != self.name or not isinstance(threads, int) or threads < 1:
            return False
        return max(threads, self.threads) <= _ALIKE_THREADS * min(threads, self.threads)


def processor() -> Processor:
    """Return the processor that computes here; the number of threads may change in a process."""
    instructions = torch.backends.cpu.get_cpu_capability()
    return Processor(f"{_model()}, {instructions}", torch.get_num_threads())


@cache
def _model() -> str:
    """Return the model of the processor; on Linux with family, model and stepping, because virtual
    machines hide the name.
    """
    lines = dict[str, str]()
    with suppress(OSError):
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
        # the first paragraph describes the first core
        for line in text.partition("\n\n")[0].splitlines():
            name, _, value = line.partition(":")
            lines[name.strip()] = value.strip()
    model = lines.get("model name") or platform.processor() or platform.machine() or "unknown"
    numbers = [lines[name] for name in ("cpu family", "model", "stepping") if name in lines]
    # a line of the journal takes printable text only
    name = "".join(filter(str.isprintable, model))
    return f"{name} ({'-'.join(numbers)})" if numbers else name


def thread_seconds() -> float:
    """Return the processor time (s) of this thread, and of all child processes that have ended.

    Work of other threads and other programs does not count.
    """
    return time.thread_time() + _children_seconds()


def process_seconds() -> float:
    """Return the processor time (s) of all threads, and of all child processes that have ended."""
    return time.process_time() + _children_seconds()


def _children_seconds() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


@cache
def probed_seconds(threads: int) -> float:
    """Return the processor time (s) of a small fixed computation with a number of threads, once in
    a process.

    It transforms, convolves and evaluates functions, as the steps of a camera do.
    """
    assert threads == torch.get_num_threads()
    began, turns = time.thread_time(), list[float]()
    with torch.no_grad():
        while not turns or time.thread_time() - began < _PROBE_SECONDS:
            turns.append(_probe_turn())
    # the first turn also fills the caches
    return min(turns)


def _probe_turn() -> float:
    generator = torch.Generator().manual_seed(0)
    field = torch.rand(4, 192, 192, generator=generator)
    weights = torch.rand(16, 4, 3, 3, generator=generator)
    began = time.thread_time()
    spectrum = torch.fft.fft2(torch.complex(field, field))
    torch.fft.ifft2(spectrum * spectrum.conj()).abs()
    maps = torch.nn.functional.conv2d(field[None], weights)
    torch.exp(-maps.square()).sqrt().sum()
    return time.thread_time() - began
