"""What choosing costs, of a cold run and of a cached one: `python
tests/benchmarks/bench_choosing.py [RECIPE ...]`.

Choosing is all that a run with `--exact` does not do: the recipe made cheaper, the account of the
tolerance, the proof along the graph, and inside the image of few planes the search for what may be
left away and the bounds. Each is timed where it is called; time in one that another calls counts
once, and steps that it asks for do not count. Beside a cached run stands one with `--exact`, as
long as that is in the store too. The runs are whole, engine and store included, and in one process,
with the code of the nodes read before. While the store writes large results, its threads take the
cores from whatever is computed, and the clock runs on: a cold run whose store takes nothing shows
what choosing takes by itself, and is the shorter run to compare it with. Medians of 3, or of one
where it takes long.
"""

import statistics
import sys
import tempfile
import time
from contextlib import contextmanager
from dataclasses import replace
from functools import wraps
from pathlib import Path
from unittest import mock

from neusee.nodes.optics import _channel_image
from neusee.workflows import load
from neusee.workflows.engine import execution, resolve_keys, runner
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.run_study import cold
from neusee.workflows.tolerance.skip_decision import ErrorBudget

ENGINE = (
    (runner, "economised"),
    (runner, "border"),
    (runner, "proof"),
    (ErrorBudget, "verdict"),
    (ErrorBudget, "pass_on"),
)
NODE = tuple(
    (_channel_image, name)
    for name in (
        "psf_light",
        "with_windows",
        "cheapest_plan",
        "estimated_brightest",
        "fft_round_off",
        "_brightest_pixel_error",
    )
)
LONG = 20.0  #: s, beyond which one run is enough


class Unwritten(Store):
    """Takes no result: all stays in memory."""

    def put(self, key, value, about):
        return False


class Clock:
    """Seconds in the functions that it watches, the outermost alone."""

    def __init__(self):
        self.seconds, self.inside = 0.0, False

    def watched(self, function):
        @wraps(function)
        def timed(*args, **kwargs):
            if self.inside:
                return function(*args, **kwargs)
            self.inside, began = True, time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                self.inside = False
                self.seconds += time.perf_counter() - began

        return timed

    def left_out(self, function):
        """What is computed because a choice asks for it would be computed anyway."""

        @wraps(function)
        def timed(*args, **kwargs):
            inside, self.inside, began = self.inside, False, time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                self.inside = inside
                if inside:
                    self.seconds -= time.perf_counter() - began

        return timed


@contextmanager
def clocks():
    """One of the engine and one of the node."""
    engine, node = Clock(), Clock()
    for clock, places in ((engine, ENGINE), (node, NODE)):
        for place, name in places:
            mock.patch.object(place, name, clock.watched(getattr(place, name))).start()
    make = execution.Execution.make
    mock.patch.object(execution.Execution, "make", engine.left_out(make)).start()
    try:
        yield engine, node
    finally:
        mock.patch.stopall()


def once(recipe, store):
    with clocks() as (engine, node):
        result = runner.run(recipe, store)
    return result.seconds, engine.seconds, node.seconds


def fresh(recipe, memo, kind):
    runs = []
    while len(runs) < 3 and not (runs and runs[0][0] > LONG):
        with cold(memo) as store:
            runs.append(once(recipe, kind(store.root)))
    return runs


def line(name):
    recipe = load(name)
    full = replace(recipe, exact=True)
    with tempfile.TemporaryDirectory() as folder:
        memo = Store(Path(folder))
        for each in (recipe, full):
            once(each, memo)
        cached, whole = (
            [once(each, Store(Path(folder))) for _ in range(9)] for each in (recipe, full)
        )
        colds, unwritten = (fresh(recipe, memo, kind) for kind in (Store, Unwritten))
    rows = {
        "cold": colds,
        "cold, nothing written": unwritten,
        "cached": cached,
        "cached, `--exact`": whole,
    }
    for what, runs in rows.items():
        seconds, engine, node = (statistics.median(column) for column in zip(*runs, strict=True))
        share = (engine + node) / seconds
        print(
            f"| {name} | {what} | {seconds:.4f} | {1e3 * engine:.1f} | {1e3 * node:.1f} |"
            f" {share:.1%} |",
            flush=True,
        )


if __name__ == "__main__":
    assert resolve_keys.ErrorBudget is ErrorBudget is execution.ErrorBudget
    print("| recipe | run | s | engine, ms | node, ms | share |\n|---|---|---|---|---|---|")
    for name in sys.argv[1:] or ("first_light", "dirty_windshield", "paper_table1"):
        line(name)
