"""Peak memory of runs: predicted before the run, and measured; and what a limit of the memory does.

    python tests/benchmarks/measured_runs.py FOLDER     # the runs
    python tests/benchmarks/bench_memory.py FOLDER      # predicted against measured, as a table for RESULTS.md
    python tests/benchmarks/bench_memory.py limits small    # runs with limits whose name holds this word, up to 5 GB

A prediction starts from the memory that the program of that run held before its first step, as
``neusee run`` does itself. The numbers of `workflows.explain.report_memory` are fitted to the runs
that are not held out.

With limits, each run has an empty cache and its own process, whose resident memory is read every 5
ms. The limit is a tenth above the prediction. The last column is the outcome of the same run with a
limit of 9/10 of the prediction.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import numpy as np
from fit_costs import read
from measured_runs import FIT, HELD_OUT, at
from scipy.optimize import nnls

from neusee.workflows.explain import run_forecast as report_memory
from neusee.workflows.explain.run_forecast import lanes_for, planned
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.result_store import Store

FIRST, PAPER = "first_light", "paper_table1"
ROWS = {
    "first_light, 384 px": [FIRST, *at(384, 320, 360, 320)],
    "first_light, 768 px (as shipped)": [FIRST],
    "first_light, 1152 px": [FIRST, *at(1152, 960, 900, 896)],
    "paper_table1, 1024 px": [PAPER, *at(1024, 1024, 1080, 1024)],
    "paper_table1, 2048 px (as shipped)": [PAPER],
}


def neusee(place, *words):
    """Start the program with an empty cache below ``place``."""
    env = {**os.environ, "NEUSEE_CACHE": f"{place}/cache", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "neusee", *words]
    return subprocess.Popen(
        command, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


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
    """The predicted peak memory of a run with an empty cache in bytes: of its steps, and of its
    report.
    """
    with tempfile.TemporaryDirectory() as place:
        out, err = neusee(place, "plan", *words, "--json").communicate()
    assert out, err
    totals = json.loads(out)["totals"]
    return totals["memory_of_steps"], totals["memory_of_report"]


def forecast(run):
    """Predicted memory of a measured run in bytes: the program, with its steps, its report, and
    what it shows.
    """
    name, *changes = [word for word in run["words"] if word != "--exact"]
    recipe, shown = replace(load(name, changes), exact="--exact" in run["words"]), []

    def watched(works, known, keys, costs, *others):
        shown.append(report_memory.shown_at_once(known, costs))
        return report_memory.report_peak(works, known, keys, costs, *others)

    engine, none = "neusee.workflows.engine", SimpleNamespace(modules={})
    with tempfile.TemporaryDirectory() as place, ExitStack() as stack:
        for target, value in (
            (f"{engine}.local_executor.process_memory", lambda: run["before"]),
            (f"{engine}.cost_laws.sys", none),
            (f"{engine}.cost_model.sys", none),
            ("neusee.workflows.explain.run_forecast.report_peak", watched),
        ):
            stack.enter_context(mock.patch(target, value))
        lanes = lanes_for(recipe, "cpu", 10**12)
        plan = planned(recipe, Store(Path(place)), lanes, 10**12)
    return lanes["cpu"].held, plan.running, plan.reporting, shown[0]


def compare(folder):
    """Print predicted and measured memory of all runs, and the numbers of the report that fit
    best.
    """
    head = "run", "", "predicted: steps, report", "measured: steps, report", "measured / predicted"
    print(f"| {' | '.join(head)} |\n|{'---|' * len(head)}")
    ratios, rows = {}, []
    for kind, names in (("fitted", FIT), ("held out", HELD_OUT)):
        for run in read(folder, names):
            held, running, reporting, shown = forecast(run)
            ratio = max(run["running"], run["reporting"]) / max(running, reporting)
            ratios.setdefault(kind, []).append(ratio)
            if kind == "fitted":
                rows.append((1e6, running - held, shown, run["reporting"] - held, run["reporting"]))
            both = (
                f"{one / 1e6:.0f}, {two / 1e6:.0f}"
                for one, two in ((running, reporting), _ends(run))
            )
            print(f"| {' | '.join((run['name'], kind, *both, f'{ratio:.2f}'))} |")
    for kind, found in ratios.items():
        close = sum(abs(ratio - 1) <= 0.2 for ratio in found)
        print(
            f"{kind}: peak of the process within 20 %: {close} of {len(found)}, {min(found):.2f} to"
            f" {max(found):.2f}"
        )
    table = np.array(rows)
    best = nnls(table[:, :3] / table[:, 4:], table[:, 3] / table[:, 4])[0]
    print("report: MB for drawing, share held back, copies:", ", ".join(f"{x:.3g}" for x in best))
    before = [run["before"] / 1e6 for run in read(folder, FIT | HELD_OUT)]
    print(f"memory before the first step: {min(before):.0f} to {max(before):.0f} MB")


def _ends(run):
    return run["running"], run["reporting"]


def limits(word, *_):
    """Print one line of a table for each run with limits whose name holds the word."""
    head = (
        "run",
        "predicted: steps, report",
        "limit",
        "measured",
        "measured / predicted",
        "worst step",
        "limit of 9/10",
    )
    print(f"| {' | '.join(head)} |\n|{'---|' * len(head)}")
    for name, words in ROWS.items():
        if word not in name:
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
            less = neusee(
                place, *common[:-3], "--out", f"{place}/runs", "--memory", f"{int(0.9 * most)} B"
            )
            again, seen = watched(less)
        outcome = {0: "ran", 2: "refused", 1: "stopped"}[again] + (
            "" if again == 2 else f", {seen / 1e6:.0f} MB"
        )
        ran = f"{found / 1e6:.0f} MB" + ("" if code == 0 else f" (exit {code})")
        both = ", ".join(f"{part / 1e6:.0f}" for part in parts)
        row = (
            name,
            f"{both} MB",
            f"{limit / 1e6:.0f} MB",
            ran,
            f"{found / most:.2f}",
            worst(steps),
            outcome,
        )
        print(f"| {' | '.join(row)} |", flush=True)


def worst(steps):
    """Largest deviation of the predicted peak of a step from the measured peak, of steps above
    64 MB.
    """
    large = [s for s in steps if s.get("peak") and s.get("predicted_peak") and s["peak"] > 64e6]
    if not large:
        return "-"
    off = max(large, key=lambda s: abs(s["predicted_peak"] / s["peak"] - 1))
    return f"{off['step']} {off['predicted_peak'] / 1e6:.0f} against {off['peak'] / 1e6:.0f} MB"


if __name__ == "__main__":
    limits(*sys.argv[2:], "") if sys.argv[1] == "limits" else compare(sys.argv[1])
