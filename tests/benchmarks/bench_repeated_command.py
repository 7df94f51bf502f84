"""Repeated commands, with and without the stored answer of each: processor and wall seconds, as a
table in RESULTS.md.

    python tests/benchmarks/bench_repeated_command.py [--times 9]

Each command is a process of its own with one thread. Without the answer: the folder of answers is
removed first, so that the command reads the recipe, takes results from the store and keeps its
answer. The two take turns in one run, beside `neusee --help` and a bare `import torch`, and the
load of the machine is recorded.
"""

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from stored_results import store_rows

DOCUMENT = "repeated_command"  #: in `results/`
RECIPE = ["-m", "neusee", "safety", "safety_pointer", "--quiet"]
VALIDATE = ["-m", "neusee", "validate", "first_light"]
RUN, PLAN = ["-m", "neusee", "run", "first_light"], ["-m", "neusee", "plan", "first_light"]
WHY = ["-m", "neusee", "why", "restored", "first_light"]
TORCH = "`import torch` alone"
COMMANDS = {
    "`neusee safety safety_pointer`, repeated, no stored answer": RECIPE,
    "`neusee safety safety_pointer`, repeated": RECIPE,
    "`neusee validate first_light`, repeated, no stored answer": VALIDATE,
    "`neusee validate first_light`, repeated": VALIDATE,
    "`neusee run first_light`, from the cache, no stored answer": RUN,
    "`neusee run first_light`, repeated": RUN,
    "`neusee plan first_light`, from the cache, no stored answer": PLAN,
    "`neusee plan first_light`, repeated": PLAN,
    "`neusee why restored first_light`, no stored answer": WHY,
    "`neusee why restored first_light`, repeated": WHY,
    "`neusee report latest`": ["-m", "neusee", "report", "latest"],
    "`neusee cache ls`": ["-m", "neusee", "cache", "ls"],
    "`neusee --help`": ["-m", "neusee", "--help"],
    TORCH: ["-c", "import torch"],
}


def measured(words: list[str], place: Path) -> tuple[float, float]:
    """Return the processor and the wall seconds of one process."""
    env = {**os.environ, "NEUSEE_CACHE": str(place / "cache"), "OMP_NUM_THREADS": "1"}
    began = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, *words], env=env, cwd=place, stdout=subprocess.DEVNULL
    )
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(words)} ended with status {status}")
    return used.ru_utime + used.ru_stime, time.perf_counter() - began


def shown(seconds: list[float]) -> str:
    """Return the least and the median of some times."""
    return f"{min(seconds):.2f} ({statistics.median(seconds):.2f})"


def row(name: str, rows: list[tuple[float, float]], alone: float) -> list[str]:
    """Return the row of a command in the table; ``alone``: processor seconds of an import of
    torch, the median.
    """
    processor, wall = map(list, zip(*rows, strict=True))
    times_torch = f"{statistics.median(processor) / alone:.2f}"
    return [name, shown(processor), shown(wall), times_torch]


def main() -> None:
    """Measure the commands in turn, and record them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--times", type=int, default=9)
    times = parser.parse_args().times
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in COMMANDS}
    loads = [os.getloadavg()[0]]
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        for words in (RECIPE, RUN):  # the estimate and the run themselves
            measured(words, place)
        for _ in range(times):
            for name, words in COMMANDS.items():
                if name.endswith("no stored answer"):
                    shutil.rmtree(place / "cache" / "answers", ignore_errors=True)
                found[name].append(measured(words, place))
            loads.append(os.getloadavg()[0])
    alone = statistics.median(processor for processor, _ in found[TORCH])
    rows = [row(name, times_of, alone) for name, times_of in found.items()]
    load = f"load of the machine {min(loads):.1f} to {max(loads):.1f} with {os.cpu_count()} cores"
    store_rows(
        DOCUMENT,
        rows,
        f"Whole processes of one thread, {times} of each in turns: least (median); {load}.",
    )
    print(*rows, load, sep="\n")


if __name__ == "__main__":
    main()
