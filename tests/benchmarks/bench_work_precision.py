"""Error and processor time of recipes by tolerance: `bench_work_precision.py [RECIPE ...]
[--repeats N]`.

Each recipe (first_light, six_lasers, dirty_windshield, paper_table1) gives its raw and developed
pictures, in full and at tolerances from 1e-4 to 3e-2, in turn and N (1) times, each time with an
empty store in one process. The error is the largest over the pictures against the run in full; the
time is the least processor time of a whole cold run: choice, proof and second attempts included. On
a machine that others use, wall time says little.

One line in Markdown for each recipe and tolerance.
"""

import argparse
import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from neusee.workflows import load
from neusee.workflows.engine.runner import run
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.run_study import cold
from neusee.workflows.tolerance.error_norm import error_of

RECIPES = ("first_light", "six_lasers", "dirty_windshield", "paper_table1")
TOLERANCES = (1e-4, 1e-3, 1e-2, 3e-2)


def timed(recipe, memo):
    with cold(memo) as store:
        began = time.process_time()
        result = run(recipe, store)
        seconds = time.process_time() - began
        chosen = [result[name].share.shape for name in result.done if name.endswith(".choice")]
        return seconds, result, ", ".join(f"{few} of {bands}" for bands, few in chosen)


def rows(name, memo, repeats):
    recipes = {t: load(name, ["outputs=[raw, developed]", f"tolerance={t}"]) for t in TOLERANCES}
    recipes = {0.0: replace(recipes[TOLERANCES[0]], exact=True), **recipes}
    least, said, truth = dict.fromkeys(recipes, float("inf")), {}, {}
    # libraries load once, and not in the time of the first line
    timed(recipes[TOLERANCES[-1]], memo)
    for _ in range(repeats):
        for tolerance, recipe in recipes.items():
            seconds, result, used = timed(recipe, memo)
            least[tolerance] = min(least[tolerance], seconds)
            truth = truth or dict(result.values)
            error = max(error_of(result[step], value) for step, value in truth.items())
            said[tolerance] = (
                f"{error:.1e} | {result.proof.worst:.1e} | {used or '-'} | {result.attempts}"
            )
    for tolerance, rest in said.items():
        ratio = least[0.0] / least[tolerance]
        print(
            f"| {name} | {tolerance or 'in full'} | {least[tolerance]:.2f} | {ratio:.2f} |"
            f" {rest} |",
            flush=True,
        )


def main():
    reading = argparse.ArgumentParser()
    reading.add_argument("recipes", nargs="*", default=RECIPES)
    reading.add_argument("--repeats", type=int, default=1)
    given = reading.parse_args()
    print(f"load {os.getloadavg()[0]:.1f}\n")
    columns = (
        "recipe",
        "tolerance",
        "s",
        "in full over this",
        "error",
        "stated",
        "bands in use",
        "attempts",
    )
    print(f"| {' | '.join(columns)} |")
    print("|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        memo = Store(Path(folder))
        for name in given.recipes:
            rows(name, memo, given.repeats)


if __name__ == "__main__":
    main()
