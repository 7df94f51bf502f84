"""Peak memory of runs: predicted before the run, limit, and measured from outside while the run goes on.

    python tests/benchmarks/bench_memory.py             # every row; up to 5 GB and ten minutes on two cores
    python tests/benchmarks/bench_memory.py small       # rows whose name holds this word

Each run has an empty cache and its own process, whose resident memory is read every 5 ms. The limit is a tenth above
the prediction. The last column is the outcome of the same run with a limit of 9/10 of the prediction.
"""

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from fit_costs import at

FIRST, PAPER = "first_light", "paper_table1"
ROWS = {
    "first_light, 384 px": [FIRST, *at(384, 320, 360, 320)],
    "first_light, 768 px (as shipped)": [FIRST],
    "first_light, 1152 px": [FIRST, *at(1152, 960, 900, 896)],
    "paper_table1, 1024 px": [PAPER, *at(1024, 1024, 1080, 1024)],
    "paper_table1, 2048 px (as shipped)": [PAPER],
}
UNITS = {"B": 1, "kB": 1e3, "MB": 1e6, "GB": 1e9, "TB": 1e12}


def neusee(place, *words):
    """Start the program with an empty cache below ``place``."""
    env = {**os.environ, "NEUSEE_CACHE": f"{place}/cache", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "neusee", *words]
    return subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def watched(process):
    """Exit status, and the largest resident memory in bytes that was seen."""
    most = 0
    while process.poll() is None:
        try:
            with open(f"/proc/{process.pid}/status") as file:
                now = [int(line.split()[1]) * 1024 for line in file if line.startswith("VmRSS:")]
            most = max([most, *now])
        except (OSError, ValueError, TypeError):
            pass
        time.sleep(0.005)
    return process.returncode, most


def predicted(words):
    """The predicted peak memory of a run with an empty cache in bytes: of its steps, and of its report."""
    with tempfile.TemporaryDirectory() as place:
        out, err = neusee(place, "plan", *words).communicate()
    line = next((line for line in out.splitlines() if line.startswith("memory  process:")), "")
    parts = re.findall(r"([\d.]+) ([kMGT]?B)", line)
    assert len(parts) == 3, out + err
    running, _, reporting = (float(number) * UNITS[unit] for number, unit in parts)
    return running, reporting


def main():
    """Print one line of a table for each run."""
    head = "run", "predicted: steps, report", "limit", "measured", "measured / predicted", "worst step", "limit of 9/10"
    print(f"| {' | '.join(head)} |\n|{'---|' * len(head)}")
    for name, words in ROWS.items():
        if sys.argv[1:] and sys.argv[1] not in name:
            continue
        parts = predicted(words)
        most = max(parts)
        limit = int(1.1 * most)
        with tempfile.TemporaryDirectory() as place:
            common = ["run", *words, "--quiet", "--out", f"{place}/runs", "--memory"]
            code, found = watched(neusee(place, *common, f"{limit} B"))
            page = next(iter(Path(place, "runs").glob("*/provenance.json")), None)
            steps = json.loads(page.read_text())["steps"] if page else []
        with tempfile.TemporaryDirectory() as place:
            less = neusee(place, *common[:-3], "--out", f"{place}/runs", "--memory", f"{int(0.9 * most)} B")
            again, seen = watched(less)
        outcome = {0: "ran", 2: "refused", 1: "stopped"}[again] + ("" if again == 2 else f", {seen / 1e6:.0f} MB")
        ran = f"{found / 1e6:.0f} MB" + ("" if code == 0 else f" (exit {code})")
        both = ", ".join(f"{part / 1e6:.0f}" for part in parts)
        row = name, f"{both} MB", f"{limit / 1e6:.0f} MB", ran, f"{found / most:.2f}", worst(steps), outcome
        print(f"| {' | '.join(row)} |", flush=True)


def worst(steps):
    """Largest deviation of the predicted peak of a step from the measured peak, of steps above 64 MB."""
    large = [s for s in steps if s.get("peak") and s.get("predicted_peak") and s["peak"] > 64e6]
    if not large:
        return "-"
    off = max(large, key=lambda s: abs(s["predicted_peak"] / s["peak"] - 1))
    return f"{off['step']} {off['predicted_peak'] / 1e6:.0f} against {off['peak'] / 1e6:.0f} MB"


if __name__ == "__main__":
    main()
