"""Print what it costs to observe a call of an own node, here or in a process of its own, beside
plain calls in turns.

    python tests/benchmarks/bench_observation.py [CALLS]

Each turn is one plain call and one of each other kind, so that other work on the machine meets all.
The parts say what an observed call that does nothing spends its time on. That the steps of a
packaged recipe are not observed at all is a test
(`tests/workflows/observation/test_shipped_nodes.py`).
"""

from __future__ import annotations

import os
import platform
import sys
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import torch

from neusee.workflows.engine.machine_resources import process_memory
from neusee.workflows.engine.step_process import call_in_fork
from neusee.workflows.observation import kernel_layer
from neusee.workflows.observation.observed_call import observed
from neusee.workflows.observation.random_generators import SharedGenerators
from neusee.workflows.observation.taints import Covered

COVERED = Covered(frozenset(), lambda name: True)
AIM, SHARE = 3e-3, 0.05  #: s of a call, or this share of it


def node(seconds: float) -> Callable[[], object]:
    """Return a function that computes for about as long, with torch."""
    picture = torch.rand(128, 128, generator=torch.Generator().manual_seed(0))
    began = time.process_time()
    for _ in range(200):
        picture.sin()
    count = round(seconds / ((time.process_time() - began) / 200))

    def compute() -> object:
        found = picture
        for _ in range(count):
            found = found.sin()
        return found

    return compute


def apart(compute: Callable[[], object]) -> object:
    """Return what a function computes in a process of its own."""
    returned = call_in_fork(partial(observed, compute, COVERED), frozenset())
    assert returned is not None
    return returned.value


def timed(call: Callable[[], object]) -> float:
    """Return the seconds of a call."""
    began = time.perf_counter()
    call()
    return time.perf_counter() - began


def quantiles(seconds: Sequence[float]) -> str:
    """Return median and 95 % quantile in ms, with the interquartile range of the first."""
    low, middle, high, most = np.percentile(np.array(seconds) * 1e3, [25, 50, 75, 95])
    return f"p50 {middle:.2f} [{low:.2f}, {high:.2f}] p95 {most:.2f}"


def threads() -> None:
    """Start a thread and wait for its end."""
    thread = threading.Thread(target=int)
    thread.start()
    thread.join()


def filtered() -> None:
    """Start a thread that the kernel stops, hand its listener over, and ask for the records."""
    client = kernel_layer.client()
    thread = threading.Thread(target=kernel_layer.stop_here, args=(client,))
    thread.start()
    thread.join()
    client.records()


def processor_time() -> float:
    """Return the processor time in s of this process and of the one that answers, which others
    on the machine spare.
    """
    with open(f"/proc/{kernel_layer.client().server()}/stat", encoding="ascii") as file:
        ticks = file.read().rpartition(")")[2].split()[11:13]
    return time.process_time() + sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")


PARTS: dict[str, Callable[[], object]] = {
    "a thread": threads,
    "a thread with filter, listener and records": filtered,
    "states of generators, twice": lambda: SharedGenerators().drawn(),
    "all": lambda: observed(int, COVERED),
}


def main(calls: int) -> None:
    """Print the table of nodes of 0, 1, 10 and 100 ms, and the parts."""
    torch.set_num_threads(1)
    observed(int, COVERED)  # starts the process that answers
    print(
        f"{platform.processor() or platform.machine()}, {os.cpu_count()} processors, load"
        f" {os.getloadavg()[0]:.1f}"
    )
    print(f"this process holds {process_memory() / 1e6:.0f} MB")
    for seconds in (0.0, 1e-3, 1e-2, 1e-1, 1.0):
        compute = node(seconds) if seconds else int
        ways = {
            "observed": partial(observed, compute, COVERED),
            "in a process of its own": partial(apart, compute),
        }
        # one after the other: memory that a fork has shared is slow at its next use
        for name, way in ways.items():
            count = calls // (1 if seconds < 0.05 else round(40 * seconds))
            plain, seen = zip(*((timed(compute), timed(way)) for _ in range(count)), strict=True)
            print(f"{seconds * 1e3:3.0f} ms: plain {quantiles(plain)} ms")
            more = [late - early for late, early in zip(seen, plain, strict=True)]
            within = np.mean(
                [late <= max(AIM, SHARE * early) for late, early in zip(more, plain, strict=True)]
            )
            ratio = np.median(seen) / max(float(np.median(plain)), 1e-9)
            print(
                f"        {name}: more {quantiles(more)} ms; ratio of medians {ratio:.2f};"
                f" {within:.0%} within the aim"
            )
    began = processor_time()
    for _ in range(10 * calls):
        observed(int, COVERED)
    print(
        "processor time of an observed call of nothing:"
        f" {(processor_time() - began) / (10 * calls) * 1e3:.2f} ms"
    )
    for name, part in PARTS.items():
        print(f"{name}: {quantiles([timed(part) for _ in range(calls)])} ms")
    print(f"load {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
