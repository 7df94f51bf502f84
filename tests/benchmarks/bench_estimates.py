"""Random cameras with PSFs of few bands, against the run in full: `bench_estimates.py [small]
[COUNT [SEED [FILE]]]`.

Each of COUNT (100) recipes, drawn as the tests draw them, has a pupil of 256 samples, PSFs and a
scene of 256 pixels, and a sensor of 200 pixels: large enough for an estimate. With `small` the
recipes keep their 48 to 97 pixels, and a thumbnail has 20 cells along each side in place of 120, so
that estimates are used there too.

Outputs are the raw and the developed pictures, and the tolerance is between 1e-4 and 3e-2. The
error is the largest over these pictures against the run in full; the stated error counts the
rounding to digital numbers. The cost is processor time of a cold run, choice, proof and second
attempts included, in one process beside the run in full. FILE keeps each line, so that a run goes
on where it was stopped.

One line a recipe on the standard error; a table in Markdown, by tolerance, at the end.
"""

import json
import statistics
import sys
import tempfile
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "workflows"))
import random_recipes

from neusee.nodes.optics import _few_bands
from neusee.workflows.engine.runner import run
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.run_study import cold
from neusee.workflows.tolerance.error_norm import error_of

ENDS = (1e-4, 1e-3, 1e-2, 3e-2)


def timed(recipe, memo):
    with cold(memo) as store:
        began = time.process_time()
        result = run(recipe, store)
        seconds = time.process_time() - began
        few = [name for name in result.done if name.endswith(".choice")]
        used = {name.removesuffix(".choice"): list(result[name].share.shape) for name in few}
        return seconds, result, used


def line(seed, memo, size):
    recipe = random_recipes.draw_large(seed, size)
    full, truth, _ = timed(replace(recipe, exact=True), memo)
    ours, result, used = timed(recipe, memo)
    errors = {name: error_of(result[name], value) for name, value in truth.values.items()}
    held = {name: result.proof.stated.get(name) for name in errors}
    return {
        "seed": seed,
        "tolerance": recipe.tolerance,
        "error": max(errors.values()),
        "over_bound": max((errors[n] / max(b, 1e-6) for n, b in held.items() if b), default=0.0),
        "used": used,
        "scale": result.recipe.tolerance_scale,
        "exact": result.recipe.exact,
        "attempts": result.attempts,
        "full": full,
        "ours": ours,
    }


def main(count, start, file, small):
    known, size = {}, () if small else random_recipes.LARGE
    if small:
        _few_bands.CELLS_ACROSS = 20
        _few_bands._PART_CELLS, _few_bands._TILE_CELLS = 40, 8
    if file and Path(file).exists():
        known = {
            each["seed"]: each for each in map(json.loads, Path(file).read_text().splitlines())
        }
    with tempfile.TemporaryDirectory() as folder:
        memo = Store(Path(folder))
        for seed in range(start, start + count):
            if seed not in known:
                known[seed] = line(seed, memo, size)
                if file:
                    with Path(file).open("a") as out:
                        out.write(json.dumps(known[seed]) + "\n")
            print(json.dumps(known[seed]), file=sys.stderr, flush=True)
    table(list(known.values()))


def table(lines):
    print(
        "| tolerance | recipes | within | error / tolerance: median, most | error / stated error,"
        " most | ",
        end="",
    )
    print("fewer bands | second attempts | of in full |\n|---|---|---|---|---|---|---|---|")
    for low, high in pairwise(ENDS):
        row(f"{low:g} to {high:g}", [x for x in lines if low <= x["tolerance"] < high])
    row("all", lines)


def row(name, lines):
    if not lines:
        return
    shares = [x["error"] / x["tolerance"] for x in lines]
    within = sum(share <= 1 for share in shares)
    fewer = sum(any(few < bands for bands, few in x["used"].values()) for x in lines)
    again = sum(x["attempts"] > 1 for x in lines)
    costs = statistics.median(x["ours"] / x["full"] for x in lines)
    print(
        f"| {name} | {len(lines)} | {within} | {statistics.median(shares):.1e}, {max(shares):.2f} "
        f"| {max(x['over_bound'] for x in lines):.2f} | {fewer} | {again} | {costs:.2f} |"
    )


if __name__ == "__main__":
    words = [word for word in sys.argv[1:] if word != "small"]
    count, start = (int(word) for word in (*words[:2], *("100", "0")[len(words[:2]) :]))
    main(count, start, words[2] if len(words) > 2 else None, "small" in sys.argv)
