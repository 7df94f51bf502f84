"""Seconds and peak memory of steps: laws of the nodes against measured runs, those that were held
out apart.

python tests/benchmarks/measured_runs.py FOLDER   # the runs
python tests/benchmarks/bench_costs.py FOLDER
"""

import sys
from collections import Counter
from statistics import median

from fit_costs import LARGE, LONG, SOME, grouped, loaders, read
from measured_runs import FIT, HELD_OUT

from neusee.workflows.engine import cost_model as cost_laws

CLOSE = 0.2  #: relative error that counts as met


def show(folder):
    """Compare the laws with the steps of all runs: as measured, and relative to the pace of the
    other nodes of a run.

    The last line tells how well a time can be predicted at all: how often times of the same node
    and size agree.
    """
    loading = loaders([run for run in read(folder, FIT | HELD_OUT) if "grown" in run])
    for title, names in (("fitted", FIT), ("held out", HELD_OUT)):
        met, within = Counter(), Counter()
        for what, node, row, ratio, spread in ratios_of(read(folder, names), loading):
            met[what, abs(ratio - 1) <= CLOSE] += 1
            within[what] += spread.least <= ratio <= spread.most
            if abs(ratio - 1) > CLOSE:
                print(
                    f"  {title}: {what} of {node}: {ratio:.2f} at {[f'{x:.3g}' for x in row.size]}"
                )
        for what in ("seconds", "paced seconds", "peak"):
            total = met[what, True] + met[what, False]
            print(
                f"{title}: {what} within 20 %: {met[what, True]} of {total}; in the range"
                f" {within[what]}"
            )
    again = list(repeated(read(folder, FIT | HELD_OUT), loading))
    close = sum(abs(ratio - 1) <= CLOSE for ratio in again)
    print(f"the same step again: seconds within 20 %: {close} of {len(again)}")


def repeated(runs, loading):
    """Time of a step over the median of the other runs of the same node and size, of steps that
    are long.
    """
    found = {}
    for run in runs:
        for node, rows in grouped([run], loading).items():
            for row in rows:
                if row.seconds > LONG:
                    found.setdefault((node, row.size, row.loads), []).append(row.seconds)
    for times in found.values():
        for i, time in enumerate(times):
            if rest := times[:i] + times[i + 1 :]:
                yield time / median(rest)


def ratios_of(runs, loading):
    """Measured over predicted of the steps that are long or large, by node and size, with the
    range of the law.
    """
    laws, paces = cost_laws.shipped(), {}
    for run in runs:
        alone = grouped([run], loading)
        for left in alone:
            rows = (
                (laws[n], row)
                for n, rows in alone.items()
                for row in rows
                if n != left and row.seconds > SOME
            )
            ratios = [row.seconds / expected(law, row)[0] for law, row in rows]
            paces.setdefault(left, {})[run["name"]] = median(ratios) if len(ratios) > 2 else 1.0
    for node, rows in sorted(grouped(runs, loading).items()):
        law = laws[node]
        for row in rows:
            seconds, peak = expected(law, row)
            if row.seconds > LONG:
                yield "seconds", node, row, row.seconds / seconds, law.spread[1]
            if row.peak is not None and row.peak > LARGE:
                yield "peak", node, row, row.peak / peak, law.spread[0]
    for node, pace in sorted(paces.items()):
        for row in grouped(runs, loading, pace)[node]:
            if row.seconds > LONG:
                yield (
                    "paced seconds",
                    node,
                    row,
                    row.seconds / expected(laws[node], row)[0],
                    laws[node].spread[1],
                )


def expected(law, row):
    """Seconds and peak of a step by its law."""
    size, extra = (
        cost_laws.Size(*row.size),
        law.loads if row.loads and law.loads else cost_laws.Loading((), 0.0, 0.0),
    )
    return law.time(size) + extra.seconds, law.peak(size) + extra.memory


if __name__ == "__main__":
    show(sys.argv[1])
