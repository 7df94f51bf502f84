"""The selective scan beside mambapy's and the plain loop: `python tests/benchmarks/bench_scan.py
[REPEATS]`.

All get u, dt, A, B and C and return y; forward and backward, the decays and the reading by C
included, batch 1, d 96, n 16, float32. With one thread, in turns within one process, so that a
loaded machine slows all alike; with two after that. Beside the wall clock stands the processor's
own time, which other work does not lengthen. Memory: what the peak of a process of its own rises by
during its first call. The error is of y against a loop in float64. Prints tables in Markdown. With
the word `operations` it counts the operations of torch on a GPU, in pairs of steps and in chunks as
they were before; for this it needs no GPU.
"""

import os
import statistics
import subprocess
import sys
import time
import warnings
from functools import partial
from itertools import pairwise
from pathlib import Path

import torch
from torch.utils._python_dispatch import TorchDispatchMode

warnings.simplefilter("ignore")

from neusee.nodes.restore.networks import (  # noqa: E402
    ScanPlan,
    _selective_scan,
    reference,
    selective_scan,
)

D, N, LENGTHS = 96, 16, (4096, 65_536)
LOOP = 4096  #: steps beyond which the loop is not worth waiting for


def draw(length):
    """Values as a network starts with: A from -1 to -n, dt by logarithms from 1e-3 to 0.1."""
    rng = torch.Generator().manual_seed(0)
    u, B, C = (torch.randn(1, length, m, generator=rng) for m in (D, N, N))
    dt = 1e-3 * 100 ** torch.rand(1, length, D, generator=rng)
    A = -torch.arange(1.0, N + 1).expand(D, N).contiguous()
    return [x.requires_grad_() for x in (u, dt, A, B, C)]


def mambapy(u, dt, A, B, C):
    from mambapy.pscan import pscan

    states = pscan(torch.exp(dt[..., None] * A), (dt * u)[..., None] * B[:, :, None])
    return (states @ C[..., None])[..., 0]


def loop(u, dt, A, B, C):
    """The plain loop, in float32."""
    h, rows = torch.zeros(len(u), D, N), []
    for push, step, into, out in zip(
        (dt * u).unbind(1), dt.unbind(1), B.unbind(1), C.unbind(1), strict=True
    ):
        h = torch.exp(step[..., None] * A) * h + push[..., None] * into[:, None]
        rows.append((h @ out[..., None])[..., 0])
    return torch.stack(rows, 1)


def scan_by(backend, *values):
    """The scan by one of the two backends, as the environment selects it."""
    os.environ["NEUSEE_SCAN"] = backend
    return selective_scan(*values)


SCANS = {
    "neusee, C++": partial(scan_by, "cpp"),
    "neusee, torch": partial(scan_by, "torch"),
    "mambapy pscan": mambapy,
    "plain loop": loop,
}


def once(scan, values):
    """Wall and processor seconds of a forward and of a backward: (forward, backward), (forward,
    backward).
    """
    for x in values:
        x.grad = None
    marks = [(time.perf_counter(), time.process_time())]
    y = scan(*values)
    marks.append((time.perf_counter(), time.process_time()))
    y.sum().backward()
    marks.append((time.perf_counter(), time.process_time()))
    return [[after[i] - before[i] for before, after in pairwise(marks)] for i in (0, 1)]


def interleaved(names, values, repeats):
    """Median of wall and processor time of each, taken in turns after a call that does not
    count.
    """
    taken = {name: [] for name in names}
    for turn in range(repeats + 1):
        for name in names:
            time.sleep(0.05)
            found = once(SCANS[name], values)
            taken[name] += [found] if turn else []
    return {
        n: [[statistics.median(x[i][j] for x in t) for j in (0, 1)] for i in (0, 1)]
        for n, t in taken.items()
    }


def peak():
    """Largest resident size of this process since its peak was last cleared, in kB."""
    (line,) = (
        x for x in Path("/proc/self/status").read_text().splitlines() if x.startswith("VmHWM")
    )
    return int(line.split()[1])


def megabytes(name, length):
    """Rise of the peak in a process of its own."""
    command = [sys.executable, __file__, "--memory", name, str(length)]
    return float(
        subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()[-1]
    )


def memory(name, length):
    torch.set_num_threads(1)
    once(SCANS[name], draw(64))  # what is imported and compiled does not count
    values = draw(length)
    Path("/proc/self/clear_refs").write_text("5")  # the peak so far no longer counts
    before = peak()
    once(SCANS[name], values)
    print((peak() - before) / 1024)


def table(length, threads, repeats):
    torch.set_num_threads(threads)
    values = draw(length)
    names = [n for n in SCANS if length <= LOOP or n != "plain loop"]
    times = interleaved(names, values, repeats)
    truth = reference(*(x.detach() for x in values))
    errors = {
        n: float((SCANS[n](*values).detach() - truth).abs().max() / truth.abs().max())
        for n in names
    }
    best = sum(times["neusee, C++"][1])
    for name in names:
        (forward, backward), cpu = times[name]
        used = f"{megabytes(name, length):.0f}" if threads == 1 else ""
        print(f"| {length} | {threads} | {name} | {1e3 * forward:.1f} | {1e3 * backward:.1f} | {1e3 * sum(cpu):.1f} | "
              f"{sum(cpu) / best:.1f} | {used} | {errors[name]:.0e} |", flush=True)  # fmt: skip


class Operations(TorchDispatchMode):
    """Counts the operations that compute something; a view does not."""

    count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.count += not func.is_view
        return func(*args, **(kwargs or {}))


#: how a GPU divided sequences of 1536 numbers a step before it scanned them in pairs
CHUNKS = {4096: ScanPlan(64, 64), 65_536: ScanPlan(75, 73)}


def operations():
    """Count the operations of a forward and backward scan, for 1536 numbers a step; the lines
    themselves are narrow, which changes no count.
    """
    plan_scan = _selective_scan.plan_scan
    os.environ["NEUSEE_SCAN"] = "torch"
    print("| length | scan | operations |\n|---|---|---|")
    for length in LENGTHS:
        in_pairs = plan_scan(length, D * N, cuda=True)
        for name, plan in (("chunks", CHUNKS[length]), ("pairs", in_pairs)):
            _selective_scan.plan_scan = lambda *sizes, plan=plan: plan
            u, B, C = (torch.randn(1, length, 1, requires_grad=True) for _ in range(3))
            dt, A = torch.rand(1, length, 1, requires_grad=True), -torch.rand(1, 1)
            with Operations() as counted:
                selective_scan(u, dt, A.requires_grad_(), B, C).sum().backward()
            print(f"| {length} | {name} | {counted.count} |", flush=True)


if __name__ == "__main__":
    if "operations" in sys.argv:
        operations()
    elif "--memory" in sys.argv:
        memory(sys.argv[-2], int(sys.argv[-1]))
    else:
        repeats = int(sys.argv[1]) if len(sys.argv) > 1 else 9
        print(
            f"load {os.getloadavg()[0]:.1f} at the start, torch {torch.__version__}, {repeats}"
            " repeats\n"
        )
        print(
            "| length | threads | who | forward ms | backward ms | both, processor ms | of C++ |"
            " peak MB | error |"
        )
        print("|---|---|---|---|---|---|---|---|---|")
        for length in LENGTHS:
            table(length, 1, repeats if length <= LOOP else max(1, repeats // 3))
        table(LENGTHS[0], 2, repeats)
        print(f"\nload {os.getloadavg()[0]:.1f} at the end")
