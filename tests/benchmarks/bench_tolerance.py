"""Random recipes and tolerances, against every setting of a small grid: `bench_tolerance.py [COUNT]
[FIRST SEED]`.

Each of COUNT (100) recipes, drawn as the tests draw them, is run as it chooses and in full; then
with every combination of its cheaper settings (a third of the bands, three quarters of the pupil's
samples, of the PSF's window, both with and without `--exact`). The error is that of both raw
pictures against the full run; the cost is the wall time of a whole cold run, choice, proof and
second attempts included. The three cheapest settings within the tolerance, and the recipe as it
chooses, are run three times more in turn, and their medians compared.

One line a recipe on the standard error; a table in Markdown, by tolerance, at the end.
"""

import itertools
import statistics
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "workflows"))
import random_recipes

from neusee.workflows.engine.runner import run
from neusee.workflows.graph.errors import RecipeError, RunError
from neusee.workflows.recipe.loading import changed
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.recipe_knobs import knobs
from neusee.workflows.studies.run_study import cold
from neusee.workflows.tolerance.error_norm import error_of

OUTPUTS = ("raw[plain]", "raw[mask]")
AGAIN = 3  #: runs of those that might be the cheapest, of which the median counts


@dataclass
class Setting:
    label: str
    recipe: object
    error: float = float("inf")
    seconds: list = field(default_factory=list)

    @property
    def median(self):
        return statistics.median(self.seconds)


@dataclass
class Line:
    seed: int
    tolerance: float
    error: float
    bound: float
    attempts: int
    full: float  #: s, in full
    ours: float  #: s, as the recipe chooses
    best: float  #: s, of the cheapest setting within the tolerance
    label: str


def settings(recipe):
    """Every combination of settings no dearer than the recipe's own; the first is the recipe as
    it chooses.
    """
    turned = [knob for knob in knobs(recipe, quick=True).found if knob.what != "precision"]
    choices = [dict.fromkeys([(), knob.changes[0].overrides]) for knob in turned]
    for whole, words in itertools.product((False, True), itertools.product(*choices)):
        label = [knob.what for knob, word in zip(turned, words, strict=True) if word]
        label = f"fewer {' and '.join(label)}" if label else "nothing changed"
        with suppress(RecipeError):
            other = changed(recipe, [word for each in words for word in each])
            yield Setting(f"{label}, in full" if whole else label, replace(other, exact=whole))


def timed(recipe, memo):
    """Seconds of a cold run, the codes of nodes known, and what came of it."""
    with cold(memo) as store:
        began = time.perf_counter()
        result = run(recipe, store)
        return time.perf_counter() - began, result


def error(result, truth):
    return max(error_of(result[name], truth[name]) for name in OUTPUTS)


def line(seed, memo):
    recipe, _ = random_recipes.draw(seed, outputs="[raw]")
    run(recipe, memo)  # code is read before the clock starts
    _, truth = timed(replace(recipe, exact=True), memo)
    tried = list(settings(recipe))
    first = []
    ours, whole = tried[0], next(s for s in tried if s.label == "nothing changed, in full")
    for setting in tried:
        with suppress(RunError):
            seconds, result = timed(setting.recipe, memo)
            setting.seconds.append(seconds)
            first.append((result.proof.worst, result.attempts))
            setting.error = max(error_of(result[name], truth[name]) for name in OUTPUTS)
    good = [s for s in tried if s.error <= recipe.tolerance]
    near = sorted(good, key=lambda s: s.median)[:AGAIN]
    again = [s for s in tried if s in (ours, whole, *near)]
    for _ in range(AGAIN):
        for setting in again:
            setting.seconds.append(timed(setting.recipe, memo)[0])
    best = min((s for s in again if s in good), key=lambda s: s.median)
    bound, attempts = first[0]  # as it chooses
    seconds = (whole.median, ours.median, best.median)
    return Line(seed, recipe.tolerance, ours.error, bound, attempts, *seconds, best.label)


def main(count, start):
    torch.manual_seed(0)
    lines = []
    with tempfile.TemporaryDirectory() as folder:
        memo = Store(Path(folder))
        for seed in range(start, start + count):
            lines.append(found := line(seed, memo))
            print(
                f"{seed:4d}  tolerance {found.tolerance:.1e}  error {found.error:.1e}  bound"
                f" {found.bound:.1e}  attempts {found.attempts}  {found.ours:.3f} s, in full"
                f" {found.full:.3f} s, {found.best:.3f} s with {found.label}",
                file=sys.stderr,
                flush=True,
            )
    table(lines)


def table(lines):
    print(
        "| tolerance | recipes | within | error / tolerance, median, most | s | of in full | ",
        end="",
    )
    print("of the cheapest, median, most |\n|---|---|---|---|---|---|---|")
    for low in range(-5, -1):
        row(
            f"1e{low} to 1e{low + 1}",
            [x for x in lines if 10.0**low <= x.tolerance < 10.0 ** (low + 1)],
        )
    row("all", lines)
    for what, name in (("Attempts", "attempts"), ("The cheapest within the tolerance", "label")):
        counts = Counter(str(getattr(x, name)) for x in lines).most_common()
        print(f"\n{what}: {', '.join(f'{word} ({count})' for word, count in counts)}.")


def row(name, lines):
    if not lines:
        return
    shares = [x.error / x.tolerance for x in lines]
    costs, whole = [x.ours / x.best for x in lines], [x.ours / x.full for x in lines]
    within = sum(x.error <= x.tolerance for x in lines)
    middle = statistics.median
    print(
        f"| {name} | {len(lines)} | {within} | {middle(shares):.1e}, {max(shares):.2f} |"
        f" {middle(x.ours for x in lines):.2f} | {middle(whole):.2f} | {middle(costs):.2f},"
        f" {max(costs):.2f} |"
    )


if __name__ == "__main__":
    main(*(int(word) for word in (*sys.argv[1:], *("100", "0")[len(sys.argv) - 1 :])))
