"""Coefficients of the cost laws: runs of shipped recipes at several sizes, and a fit of seconds and memory by node.

    python tests/benchmarks/fit_costs.py            # runs (half an hour on two cores, up to 6 GB), fits and writes
    python tests/benchmarks/fit_costs.py JOURNALS   # fits to the journals (*.jsonl) in this folder

Each run has an empty cache and its own process. For each node and size the largest peak and the median time count. The
fit is least squares of the relative error with coefficients that are not negative (Lawson and Hanson 1974, ch. 23).
"""

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from statistics import median

import numpy as np
from scipy.optimize import nnls

from neusee.workflows.engine.cost_laws import sizes_of
from neusee.workflows.recipe.loading import load
from neusee.workflows.report.contents import steps_of, wanted
from neusee.workflows.tolerance.cheaper_steps import with_substitutions

TARGET = Path(__file__).parents[2] / "workflows" / "engine" / "node_costs.json"
SMALLEST = 16e6  #: B; below, memory that earlier steps freed hides what a step needs
SMALL_PART = 1e6  #: B of the inputs, the result or the work; below, they cannot be what takes the memory
MEMORY_FLOOR, TIME_FLOOR = 32e6, 5e-3  #: B and s to which an error is relative at least: below is noise
LARGE, LONG = 32e6, 10e-3  #: B and s from which a run counts for the spread


def at(scene, sensor, samples, window):
    """Changes of a recipe to a scene, sensor, pupil and window of other sizes; the pupil keeps its width."""
    sizes = {"scene.shape": [scene] * 2, "sensor.shape": [sensor] * 2, "optics.samples": samples}
    sizes |= {"optics.pitch": f"{8.0784 / samples * 1e3:.4f} um", "optics.window": [window] * 2}
    return [f"{name}={value}" for name, value in sizes.items()]


SMALL, MIDDLE, LARGER = at(288, 240, 270, 256), [], at(1280, 1024, 1080, 1024)
RUNS = {
    "tiny": ["first_light", *at(96, 64, 128, 96)],
    "small": ["first_light", *SMALL],
    "middle": ["first_light"],
    "large": ["first_light", *LARGER],
    "full": ["first_light", "scene.shape=[512,512]", "sensor.shape=[448,448]", "--exact"],
    "full2": ["first_light", "scene.shape=[1024,1024]", "--exact"],
    "dirty": ["dirty_windshield"],
    "dirty2": ["dirty_windshield", *SMALL],
    "six": ["six_lasers"],
    "paper": ["paper_table1"],
    "network": ["demonstration"],
    "night": ["hdr_night"],
    "axicon": ["axicon"],
    "learnt": ["train_small"],
    "calibrate": ["calibrate"],
}


def collect(folder):
    """Run every recipe with an empty cache and keep its journal."""
    for name, words in RUNS.items():
        with tempfile.TemporaryDirectory() as place:
            env = {**os.environ, "NEUSEE_CACHE": f"{place}/cache", "OMP_NUM_THREADS": "1"}
            command = [sys.executable, "-m", "neusee", "run", *words, "--quiet", "--out", f"{place}/runs"]
            subprocess.run(command, env=env, check=False)
            (folder / f"{name}.jsonl").write_text(Path(f"{place}/cache/journal.jsonl").read_text())


def sizes_in(words):
    """The sizes of the steps of a run, by step, from the rules of the nodes as they are now."""
    name, *changes = [word for word in words if word != "--exact"]
    recipe = replace(load(name, changes), exact="--exact" in words)
    recipe = with_substitutions(recipe, wanted(recipe))
    return {step: size for step, size in sizes_of(recipe, steps_of(recipe)).items() if size.known}


def grouped(folder):
    """By node: (size, largest peak, median seconds) of each size that ran."""
    found = {}
    for path in sorted(Path(folder).glob("*.jsonl")):
        here, sizes = {}, sizes_in(RUNS[path.stem])
        for line in path.read_text().splitlines()[1:]:
            row = json.loads(line) if line else {}
            if row.get("step") in sizes and row.get("device") == "cpu":
                here.setdefault((row["node"], tuple(sizes[row["step"]][:4])), []).append(row)
        for (node, size), rows in here.items():
            peaks = [row["peak"] for row in rows if row["peak"] is not None]
            most = max(max(peaks), size[1]) if peaks else None
            found.setdefault(node, []).append((size, most, median(row["seconds"] for row in rows)))
    return found


def fitted(columns, values, floor):
    """Coefficients, none negative, for the least sum of squared relative errors."""
    weight = 1 / (np.asarray(values) + floor)
    matrix = np.asarray(columns, dtype=float) * weight[:, None]
    unit = np.abs(matrix).max(0)
    unit[unit == 0] = 1
    return nnls(matrix / unit, values * weight)[0] / unit


def law(rows):
    """The law of one node: coefficients and spreads."""
    known = [(size, peak) for size, peak, _ in rows if peak is not None]
    known = [(size, peak) for size, peak in known if peak > SMALLEST] or known
    totals = [sum(size[:2]) for size, _ in known]
    constant = float(max(totals, default=1) > 3 * min(totals, default=1))  # sizes too alike cannot tell it from a slope
    used = [max((size[i] for size, _ in known), default=0) > SMALL_PART for i in range(3)]
    columns = [(constant, *(x * use for x, use in zip(size[:3], used, strict=True))) for size, _ in known]
    peaks = np.array([peak for _, peak in known])
    memory = fitted(columns, peaks, MEMORY_FLOOR) if known else np.array([0.0, 0.0, 1.0, 0.0])
    steps = [(1.0, size[3]) for size, _, _ in rows]
    times = np.array([seconds for *_, seconds in rows])
    seconds = fitted(steps, times, TIME_FLOOR)
    over = [
        p / max(float(np.dot(c, memory)), s[1], 1)
        for c, p, (s, _) in zip(columns, peaks, known, strict=True)
        if p > LARGE
    ]
    late = [t / max(float(np.dot(c, seconds)), 1e-9) for c, t in zip(steps, times, strict=True) if t > LONG]
    spread = [float(f"{max(1.0, *over):.3g}") if over else 1.0, float(f"{max(1.0, *late):.3g}") if late else 1.0]
    return {"memory": [float(f"{x:.4g}") for x in memory], "seconds": [float(f"{x:.4g}") for x in seconds]} | {
        "spread": spread
    }


def main():
    """Collect the journals, fit the laws and write them."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(sys.argv[1] if len(sys.argv) > 1 else place)
        if len(sys.argv) == 1:
            collect(folder)
        laws = {node: law(rows) for node, rows in sorted(grouped(folder).items())}
    lines = ",\n".join(f'  "{node}": {json.dumps(each)}' for node, each in laws.items())
    TARGET.write_text(f'{{"nodes": {{\n{lines}\n}}}}\n')
    for node, each in laws.items():
        print(f"{node:32} {each}")


if __name__ == "__main__":
    main()
