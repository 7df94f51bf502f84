"""Errors that runs state, against runs in full: `bench_stated_errors.py FILE [COUNT [FIRST SEED]]`.

Each of COUNT (1000) recipes is drawn by `random_recipes.draw_any` over all shipped scenes, masks,
filters, sensors, lasers, dirt, stray light, borders and sizes, with a tolerance between 1e-5 and
1e-1. It is run as it chooses, and in full (`--exact`). For each output there is the error that the
run states with its kind, proved or estimated, and the true error.

FILE has one line of JSON for each recipe, so that a bench that was stopped continues. A recipe that
the program refuses has a line with its message. A table in Markdown at the end counts the bounds
and estimates that are too small.
"""

import json
import statistics
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "workflows"))
import random_recipes

from neusee.workflows.engine.runner import run
from neusee.workflows.graph.errors import RecipeError, RunError
from neusee.workflows.store.result_store import Store
from neusee.workflows.tolerance.error_norm import error_of

FLOOR = 1e-6  #: relative error that round-off alone may make, of both runs


def line(seed):
    """Return what was stated and what is true for the outputs of the recipe of a seed, as JSON
    values.
    """
    began = time.process_time()
    found = {"seed": seed}
    try:
        recipe = random_recipes.draw_any(seed)
        with tempfile.TemporaryDirectory() as folder:
            store = Store(Path(folder))
            result, truth = run(recipe, store), run(replace(recipe, exact=True), store)
    except (RecipeError, RunError, ValueError) as error:
        return found | {"refused": " ".join(str(error).split())[-200:]}
    found |= {
        "tolerance": recipe.tolerance,
        "attempts": result.attempts,
        "exact": result.recipe.exact,
    }
    rows = [row(name, result, truth, recipe.tolerance) for name in recipe.outputs]
    return found | {"outputs": rows, "seconds": round(time.process_time() - began, 2)}


def row(name, result, truth, tolerance):
    """Return the error of one output, stated and true, and their ratio; both count at least as
    much as round-off.
    """
    stated, error = result.proof.stated_of(name), error_of(result[name], truth[name])
    kind = result.proof.kind_of(name)
    ratio = (
        None
        if stated is None
        else max(error - FLOOR, 0.0) / stated
        if stated
        else float(error > FLOOR)
    )
    held = result.proof.held.get(name)
    return {
        "output": name,
        "kind": kind,
        "stated": stated,
        "held": held,
        "error": error,
        "ratio": ratio,
    }


def main(file, count=1000, start=0):
    torch.set_num_threads(1)
    known = {}
    if file.exists():
        known = {one["seed"]: one for one in map(json.loads, file.read_text().splitlines())}
    for seed in range(start, start + count):
        if seed not in known:
            known[seed] = line(seed)
            with file.open("a") as out:
                out.write(json.dumps(known[seed]) + "\n")
    table([known[seed] for seed in range(start, start + count)])


def table(lines):
    """Print how many errors are above what was stated, by kind."""
    ran = [one for one in lines if "outputs" in one]
    rows = [row for one in ran for row in one["outputs"]]
    print(
        f"{len(lines)} recipes, {len(lines) - len(ran)} refused before or in the run, {len(rows)}"
        " outputs\n"
    )
    print(
        "| kind | outputs | error above what is stated | share not above | largest ratio | median"
        " ratio |"
    )
    print("|---|---|---|---|---|---|")
    for kind in ("exact", "proved", "estimated"):
        ratios = [row["ratio"] for row in rows if row["kind"] == kind]
        if ratios:
            above = sum(ratio > 1.0 for ratio in ratios)
            share, middle = 1 - above / len(ratios), statistics.median(ratios)
            print(
                f"| {kind} | {len(ratios)} | {above} | {share:.2%} | {max(ratios):.3f} |"
                f" {middle:.1e} |"
            )
    unknown = sum(row["kind"] == "unknown" for row in rows)
    print(f"| unknown | {unknown} | | | | |")


if __name__ == "__main__":
    main(Path(sys.argv[1]), *(int(word) for word in sys.argv[2:]))
