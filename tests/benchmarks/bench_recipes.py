"""Whole runs as a user starts them: time, memory, and the second run against a bare import of
torch.

    python tests/benchmarks/bench_recipes.py [RECIPE ...]

Without a name: first_light, cold and again; paper_table1, cold and after one change; each in a
fresh cache.
"""

from __future__ import annotations

import csv
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

NEUSEE = [
    sys.executable,
    "-c",
    "from neusee.workflows.cli.app import main; raise SystemExit(main())",
]


def process(command: list[str], cache: Path) -> tuple[float, float]:
    """Wall seconds and peak memory (GB) of a command, both of that process alone."""
    began = time.perf_counter()
    child = subprocess.Popen(
        command, env=os.environ | {"NEUSEE_CACHE": str(cache)}, stdout=subprocess.DEVNULL
    )
    _, status, usage = os.wait4(child.pid, 0)
    if os.waitstatus_to_exitcode(status):
        raise SystemExit(f"failed: {' '.join(command)}")
    return time.perf_counter() - began, usage.ru_maxrss / 1e6


def steps(folder: Path) -> list[tuple[str, int, float, float]]:
    """Node, number of steps, seconds and megabytes of a run, dearest first."""
    rows: dict[str, list[float]] = defaultdict(lambda: [0, 0.0, 0.0])
    with (folder / "timing.csv").open() as file:
        for row in csv.DictReader(file):
            if row["state"] == "run":
                add = rows[row["node"]]
                add[0] += 1
                add[1] += float(row["seconds"] or 0)
                add[2] += float(row["bytes"] or 0) / 1e6
    return sorted(((n, int(c), s, b) for n, (c, s, b) in rows.items()), key=lambda r: -r[2])


def cold(recipe: str, place: Path) -> None:
    runs, cache = place / "runs", place / "cache"
    seconds, memory = process([*NEUSEE, "run", recipe, "--out", str(runs), "--quiet"], cache)
    print(f"\n`{recipe}`, cold: {seconds:.1f} s whole process, peak memory {memory:.2f} GB\n")
    print("| node | steps | seconds | results, MB |\n|---|---|---|---|")
    found = steps(runs / "latest")
    for node, count, spent, size in found[:14]:
        print(f"| {node} | {count} | {spent:.2f} | {size:.0f} |")
    rest = found[14:]
    print(
        f"| all others | {sum(r[1] for r in rest)} | {sum(r[2] for r in rest):.2f} |"
        f" {sum(r[3] for r in rest):.0f} |"
    )
    total = sum(r[2] for r in found)
    print(f"| pictures, page, files, store | | {seconds - total:.1f} | |")


def again(recipe: str, place: Path, repeats: int = 7) -> None:
    ours, torch = [], []
    for _ in range(repeats):
        run = [*NEUSEE, "run", recipe, "--out", str(place / "runs"), "--quiet"]
        ours.append(process(run, place / "cache")[0])
        torch.append(process([sys.executable, "-c", "import torch"], place / "cache")[0])
    ratio = statistics.median(a / b for a, b in zip(ours, torch, strict=True))
    medians = f"{statistics.median(ours):.2f} s against {statistics.median(torch):.2f} s"
    print(
        f"\n`{recipe}`, again: {medians} for `import torch`, ratio {ratio:.2f} (median of {repeats}"
        " pairs)"
    )


ENGINE = """
import sys, time
from neusee.workflows import load, run
recipe = load("paper_table1", sys.argv[1:])
outputs = [n for n in recipe.steps if n.partition("[")[0] in ("raw", "lsr", "bsr", "peak", "saturated", "developed")]
began = time.perf_counter()
done = run(recipe, outputs=outputs).done.values()
ran = sum(d.state == "run" for d in done)
print(f"{time.perf_counter() - began:.2f} {ran} {len(done)}")
"""


def engine(cache: Path, *changes: str) -> tuple[float, int, int]:
    """Seconds of the engine alone, from light to developed picture, without restoration; steps
    that ran; all steps.
    """
    command = [sys.executable, "-c", ENGINE, *changes]
    out = subprocess.run(
        command, env=os.environ | {"NEUSEE_CACHE": str(cache)}, capture_output=True, check=True
    )
    seconds, ran, steps = out.stdout.split()
    return float(seconds), int(ran), int(steps)


def changed(place: Path) -> None:
    """paper_table1 after one change: the whole command, and the engine up to the developed
    pictures.
    """
    print(
        "\n| paper_table1, up to the developed pictures | seconds | steps that ran | of cold"
        " |\n|---|---|---|---|"
    )
    cold_seconds, ran, count = engine(place / "engine")
    print(f"| cold | {cold_seconds:.1f} | {ran} of {count} | 1 |")
    for change in (
        "sensor.read_noise=20 e-",
        "lasers.green.wavelength=550 nm",
        "sensor.read_noise=10.5 e-",
    ):
        seconds, ran, count = engine(place / "engine", change)
        print(f"| `{change}` | {seconds:.2f} | {ran} of {count} | 1/{cold_seconds / seconds:.0f} |")
    for change in ("sensor.read_noise=20 e-", "lasers.green.wavelength=550 nm"):
        run = [*NEUSEE, "run", "paper_table1", change, "--out", str(place / "runs"), "--quiet"]
        print(f"\nthe whole command with `{change}`: {process(run, place / 'cache')[0]:.1f} s")


if __name__ == "__main__":
    for name in sys.argv[1:] or ["first_light", "paper_table1"]:
        with tempfile.TemporaryDirectory() as folder:
            cold(name, Path(folder))
            if name == "paper_table1":
                changed(Path(folder))
            else:
                again(name, Path(folder))
    print(f"\nlargest child: {resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e6:.2f} GB")
