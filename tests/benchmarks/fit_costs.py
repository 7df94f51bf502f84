"""Coefficients of the cost laws: a fit of seconds and memory by node to measured runs of shipped
recipes.

    python tests/benchmarks/measured_runs.py FOLDER   # the runs
    python tests/benchmarks/fit_costs.py FOLDER       # fits to the runs in FIT and writes node_costs.json
    python tests/benchmarks/bench_costs.py FOLDER     # compares with all runs, those that were held out apart

For each node and size the largest peak and the median processor time count. The fit is least
squares of the relative error with coefficients that are not negative (Lawson and Hanson 1974, ch.
23). The range of a law is that of runs about laws that were fitted without their size.
"""

import json
import sys
from collections import Counter
from dataclasses import replace
from functools import cache
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np
import torch
from measured_runs import FIT, file_of
from scipy.optimize import nnls

from neusee.nodes import registered_nodes
from neusee.workflows.engine import cost_model as cost_laws
from neusee.workflows.engine.processor_speed import probed_seconds, processor
from neusee.workflows.engine.wanted_steps import steps_of, wanted
from neusee.workflows.recipe.loading import load
from neusee.workflows.tolerance.cheaper_steps import with_substitutions

TARGET = Path(__file__).parents[2] / "workflows" / "engine" / "node_costs.json"
LIBRARIES = "colour", "kornia"  #: that take long to load
#: entries of the file that the fit writes
OWN = "processor", "threads", "probe", "guess", "nodes"
SMALLEST = 16e6  #: B; below, memory that earlier steps freed hides what a step needs
#: B of the inputs, the result or the work; below, they cannot be what takes the memory
SMALL_PART = 1e6
#: B and s to which an error is relative at least: below is noise
MEMORY_FLOOR, TIME_FLOOR = 32e6, 20e-3
SOME = 50e-3  #: s from which a step tells the pace of the machine
LARGE, LONG = 64e6, 0.1  #: B and s from which a step counts for a comparison


class Seen(NamedTuple):
    """What a node took at one size."""

    size: tuple
    loads: bool  #: True if the step also loaded the library of its node
    peak: float | None  #: B, the largest
    seconds: float  #: the median


def read(folder, names):
    """Return the runs of these names that are in the folder."""
    paths = (Path(folder, file_of(name)) for name in names)
    return [json.loads(path.read_text()) for path in paths if path.exists()]


@cache
def sizes_in(*words):
    """The sizes of the steps of a run, by step, from the rules of the nodes as they are now."""
    name, *changes = [word for word in words if word != "--exact"]
    recipe = replace(load(name, changes), exact="--exact" in words)
    recipe = with_substitutions(recipe, wanted(recipe))
    return {
        step: size
        for step, size in cost_laws.sizes_of(recipe, steps_of(recipe)).items()
        if size.known
    }


def loaders(runs):
    """The libraries that each node was seen to load, and their bytes."""
    found = {}
    for run in runs:
        for _, node, grown, new in run["grown"]:
            loaded = [library for library in LIBRARIES if library in new]
            if loaded:
                libraries, sizes = found.setdefault(node, (set(), []))
                libraries.update(loaded)
                sizes.append(grown)
    return {node: (sorted(libraries), median(sizes)) for node, (libraries, sizes) in found.items()}


def grouped(runs, loading, paces=None):
    """By node: what was seen at each size, with times divided by the pace of the machine in each
    run.
    """
    found = {}
    for run in runs:
        sizes, there, pace = sizes_in(*run["words"]), set(), (paces or {}).get(run["name"], 1.0)
        # a journal may repeat a line
        for row in {json.dumps(row): row for row in run["steps"]}.values():
            libraries = set(loading.get(row["node"], ((), 0))[0])
            first = not libraries <= there
            there |= libraries
            if row["step"] in sizes and row["device"] == "cpu":
                size = tuple(sizes[row["step"]][:4])
                even = row | {"seconds": row["seconds"] / pace}
                found.setdefault(row["node"], {}).setdefault((size, first), []).append(even)
    return {
        node: [seen(*key, rows) for key, rows in sizes.items()] for node, sizes in found.items()
    }


def seen(size, first, rows):
    """The largest peak and the median time of the steps of one size."""
    peaks = [row["peak"] for row in rows if row["peak"] is not None]
    return Seen(
        size,
        first,
        max(max(peaks), size[1]) if peaks else None,
        median(row["seconds"] for row in rows),
    )


def fitted(columns, values, floor):
    """Coefficients, none negative, for the least sum of squared relative errors."""
    weight = 1 / (np.asarray(values) + floor)
    matrix = np.asarray(columns, dtype=float) * weight[:, None]
    unit = np.abs(matrix).max(0)
    unit[unit == 0] = 1
    return nnls(matrix / unit, values * weight)[0] / unit


def memory_law(rows, grown):
    """Bytes, and the factors of inputs, result and work; the ``grown`` bytes of a library are
    known.
    """
    known = [row for row in rows if row.peak is not None]
    known = [row for row in known if row.peak > SMALLEST] or known
    if not known:
        return np.array([0.0, 0.0, 1.0, 0.0])
    totals = [sum(row.size[:2]) for row in known]
    # sizes too alike cannot tell the constant from a slope
    constant = float(max(totals) > 3 * min(totals))
    used = [max(row.size[i] for row in known) > SMALL_PART for i in range(3)]
    columns = [
        (constant, *(x * use for x, use in zip(row.size, used, strict=False))) for row in known
    ]
    peaks = np.array([max(row.peak - row.loads * grown, row.size[1]) for row in known])
    return fitted(columns, peaks, MEMORY_FLOOR + grown)


def time_law(rows):
    """Seconds, seconds for each operation, and the seconds of the library."""
    constant = not all(row.loads for row in rows) or not any(row.loads for row in rows)
    columns = [(float(constant), row.size[3], row.loads) for row in rows]
    return fitted(columns, np.array([row.seconds for row in rows]), TIME_FLOOR)


def paced(runs, loading):
    """How much longer than usual the steps of each run took, as a median: a busy machine has
    slower caches too.
    """
    paces = {run["name"]: 1.0 for run in runs}
    alone = {run["name"]: grouped([run], loading) for run in runs}
    for _ in range(4):
        laws = {node: time_law(rows) for node, rows in grouped(runs, loading, paces).items()}
        for name, groups in alone.items():
            ratios = [
                r.seconds / time_of(laws[n], r)
                for n, rows in groups.items()
                for r in rows
                if r.seconds > SOME
            ]
            paces[name] = median(ratios) if len(ratios) > 2 else 1.0
        usual = median(paces.values())
        paces = {name: pace / usual for name, pace in paces.items()}
    return paces


def peak_of(law, row, grown):
    """The peak of a step by a fit in bytes, at least its result."""
    return max(float(np.dot(law, (1.0, *row.size[:3]))), row.size[1], 1.0) + row.loads * grown


def time_of(law, row):
    """The seconds of a step by a fit."""
    return max(float(np.dot(law, (1.0, row.size[3], row.loads))), 1e-6)


def left_out(rows, grown):
    """Measured over predicted, of peaks and of times, where the law was fitted without the size;
    None for few sizes.
    """
    over, late = [], []
    sizes = {row.size for row in rows}
    for row in rows:
        rest = [other for other in rows if other.size != row.size]
        if len(sizes) > 2 and row.peak is not None and row.peak > LARGE / 2:
            over.append(row.peak / peak_of(memory_law(rest, grown), row, grown))
        told = any(other.loads for other in rest) or not row.loads
        if len(sizes) > 2 and told and row.seconds > LONG / 5:
            late.append(row.seconds / time_of(time_law(rest), row))
    return over, late


def ranges(groups, loading, paces):
    """Ranges of peaks and times about each law; of all laws together for a node that was measured
    at few sizes.

    The range of a time is widened by the range of the pace of the machine.
    """
    found = {node: left_out(rows, loading.get(node, ((), 0.0))[1]) for node, rows in groups.items()}
    every = [np.concatenate([np.array(each[i]) for each in found.values()]) for i in (0, 1)]
    usual = [np.quantile(ratios, (0.05, 0.95)) for ratios in every]
    pace = ((1.0, 1.0), (min(paces.values()), max(paces.values())))
    return {
        node: [
            [
                short(min(1.0, *(own or usual[i])) * pace[i][0]),
                short(max(1.0, *(own or usual[i])) * pace[i][1]),
            ]
            for i, own in enumerate(each)
        ]
        for node, each in found.items()
    }


def short(value):
    """A number of four significant digits."""
    return float(f"{value:.4g}")


def law(node, rows, loading, spread):
    """The law of one node for the file."""
    libraries, grown = loading.get(node, ((), 0.0))
    memory, seconds = memory_law(rows, grown), time_law(rows)
    found = {
        "memory": [short(x) for x in memory],
        "seconds": [short(x) for x in seconds[:2]],
        "spread": spread,
    }
    return found | ({"loads": [libraries, short(grown), short(seconds[2])]} if libraries else {})


def unruled(runs):
    """The largest result of each node that has no rule of the shape of its result."""
    for run in runs:
        sizes_in(*run["words"])  # imports the nodes
    bare = {
        each.path for each in registered_nodes() if each.hooks.shape is None and not each.before_run
    }
    found = Counter()
    for run in runs:
        for row in run["steps"]:
            if row["node"] in bare:
                found[row["node"]] = max(found[row["node"]], row["bytes"])
    return found


def upper(groups):
    """The law of a node that was never measured: the most that a shipped node took for its size,
    by each measure.
    """
    works = {each.path: each.hooks.work is not None for each in registered_nodes()}
    large = [(node, row) for node, rows in groups.items() for row in rows if not row.loads]
    held = [(n, r) for n, r in large if r.peak is not None]
    ratio = max(r.peak / sum(r.size[:2]) for n, r in held if not works[n] and r.peak > LARGE / 2)
    least = max(r.peak for n, r in held if not works[n] and sum(r.size[:2]) < SMALL_PART)
    work = max(
        (r.peak - sum(r.size[:2])) / r.size[2]
        for n, r in held
        if works[n] and r.peak > LARGE / 2 and r.size[2]
    )
    slow = max(
        r.seconds / r.size[3]
        for n, r in large
        if not works[n] and r.seconds > LONG / 5 and r.size[3] > 1e5
    )
    start = max(r.seconds for n, r in large if not works[n] and r.size[3] < 1e5)
    return {
        "memory": [short(x) for x in (least, ratio, ratio, max(work, 0))],
        "seconds": [short(start), short(slow)],
    }


def write(laws, guess):
    """Write the file of the laws, and have it read again."""
    lines = ",\n".join(f'  "{node}": {json.dumps(each)}' for node, each in sorted(laws.items()))
    # the laws of import, report and training are measured by other scripts
    others = {name: x for name, x in json.loads(TARGET.read_text()).items() if name not in OWN}
    here = processor()
    head = {"processor": here.name, "threads": here.threads, "probe": short(probed_seconds(1))}
    parts = [f'"{name}": {json.dumps(x)}' for name, x in (head | others | {"guess": guess}).items()]
    text = ",\n".join([*parts, f'"nodes": {{\n{lines}\n}}'])
    TARGET.write_text(f"{{{text}}}\n")
    for cached in (cost_laws._file, cost_laws.shipped, cost_laws.guess):
        cached.cache_clear()


def fit(folder):
    """Fit the laws to the runs that are not held out, and write them with this processor, which
    must be that of the runs.
    """
    torch.set_num_threads(1)  # as in the runs
    runs = read(folder, FIT)
    most, loading = unruled(runs), loaders([run for run in runs if "grown" in run])
    before = json.loads(TARGET.read_text())
    known = {
        node: {key: value for key, value in each.items() if key != "most"}
        for node, each in before["nodes"].items()
    }
    blank = {"memory": [0.0, 0.0, 1.0, 0.0], "seconds": [0.0, 0.0]}
    told = {node: known.get(node, blank) | {"most": size} for node, size in most.items()}
    write(known | told, before.get("guess", blank))
    paces = paced(runs, loading)
    groups = grouped(runs, loading, paces)
    spreads = ranges(groups, loading, paces)
    laws = {node: law(node, rows, loading, spreads[node]) for node, rows in groups.items()}
    for node, size in most.items():
        laws.setdefault(node, blank)["most"] = size
    write(known | laws, upper(groups))
    for node, each in sorted(laws.items()):
        print(f"{node:32} {each}")
    print("paces:", {name: short(pace) for name, pace in paces.items()})


if __name__ == "__main__":
    fit(sys.argv[1])
