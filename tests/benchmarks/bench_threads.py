"""Time the same small work of torch on one and on two threads, with and without two busy processes
beside it.

    python tests/benchmarks/bench_threads.py [ROUNDS]

The ways take turns, so that other work on the machine meets all alike. *As neusee sets it* is what
a command of neusee decides before it imports torch.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import time

_WORK = """
import time, torch
torch.manual_seed(0)
x, k, a = torch.rand(640, 640), torch.rand(8, 512, 512), torch.rand(500, 500)
def work():
    for _ in range(60):
        (x * 1.5 + 0.3).clamp(0, 1).sqrt().sum()
    for _ in range(2):
        torch.fft.rfft2(k)
    for _ in range(4):
        a @ a
work()
cpu, wall = time.process_time(), time.perf_counter()
for _ in range(3):
    work()
print(time.process_time() - cpu, time.perf_counter() - wall, torch.get_num_threads())
"""
_SETTLED = "from neusee.workflows.cli.app import settle_threads; settle_threads('run')\n"
_WAYS = {
    "one thread": (_WORK, {"OMP_NUM_THREADS": "1"}),
    "two threads, torch's own waiting": (_WORK, {"OMP_NUM_THREADS": "2"}),
    "two threads, waiting threads sleep": (
        _WORK,
        {"OMP_NUM_THREADS": "2", "OMP_WAIT_POLICY": "PASSIVE"},
    ),
    "as neusee sets it": (_SETTLED + _WORK, {}),
}


def once(code: str, more: dict[str, str]) -> list[float]:
    """Return processor seconds, seconds by the clock and threads of one run of the work in a
    fresh process.
    """
    free = {k: v for k, v in os.environ.items() if not k.startswith(("OMP", "GOMP", "KMP", "MKL"))}
    done = subprocess.run(
        [sys.executable, "-c", code], env=free | more, capture_output=True, text=True, check=True
    )
    return [float(word) for word in done.stdout.split()]


def table(beside: int, rounds: int) -> None:
    """Print a row for each way, with ``beside`` busy processes beside it."""
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(beside)]
    try:
        time.sleep(5.0 if beside else 0.0)
        found = {name: [] for name in _WAYS}
        for _ in range(rounds):
            for name, (code, more) in _WAYS.items():
                found[name].append(once(code, more))
    finally:
        for process in busy:
            process.kill()
    print(
        f"\n{beside} busy processes beside; load {os.getloadavg()[0]:.1f} on {os.cpu_count()}"
        " processors"
    )
    print(
        "| way | processor s (least to most) | s by the clock (least to most) | threads"
        " |\n|---|---|---|---|"
    )
    for name, rows in found.items():
        cpu, wall, threads = zip(*rows, strict=True)
        texts = [f"{statistics.median(x):.2f} ({min(x):.2f} to {max(x):.2f})" for x in (cpu, wall)]
        print(
            f"| {name} | {' | '.join(texts)} |"
            f" {', '.join(sorted({f'{n:.0f}' for n in threads}))} |",
            flush=True,
        )


if __name__ == "__main__":
    for count in (0, 2):
        table(count, int(sys.argv[1]) if len(sys.argv) > 1 else 3)
