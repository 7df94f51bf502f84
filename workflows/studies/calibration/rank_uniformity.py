"""Tests of a posterior: uniformity of the ranks of true parameters, and coverage of 90 % intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from neusee.workflows.report.figures.style import BLUE, VERMILION, canvas, drawn
from neusee.workflows.studies.calibration.independent_draws import DRAWS
from neusee.workflows.studies.calibration.simulated_sensors import SensorSimulation

BINS, SHARE = 10, 0.9
_CHANCE = 0.01  #: probability of a false alarm by the ranks, over all parameters together
_DRAWN = 0.99  #: share of the bins of uniform ranks inside the drawn band
_GREY = "#777777"
_CERTAIN = 0.999  #: probability that the coverage of a correct posterior is within its limits
#: limits of the coverage by number of simulations, rounded; the exact limits for 1000 are 0.868 and 0.930
_ROUNDED = {200: (0.825, 0.960), 1000: (0.870, 0.930)}


@dataclass(frozen=True)
class RankTest:
    """The rank test and the coverage test of one parameter over all simulations."""

    name: str
    counts: tuple[int, ...]  #: ranks by bin
    p: float  #: probability that uniform ranks are as uneven as these
    least_p: float
    coverage: float  #: share of the simulations whose central 90 % of draws contain the truth
    bar: tuple[float, float]  #: limits of the coverage
    z_mean: float
    z_sd: float

    @property
    def uniform(self) -> bool:
        return self.p > self.least_p

    @property
    def covered(self) -> bool:
        return self.bar[0] <= self.coverage <= self.bar[1]

    @property
    def failed(self) -> int:
        return (not self.uniform) + (not self.covered)


def rank_tests(simulations: Sequence[SensorSimulation]) -> list[RankTest]:
    """Return the rank test and coverage test of each parameter, from all simulations that have a posterior."""
    sound = [s for s in simulations if not s.refused]
    if not sound:
        raise ValueError(f"no simulation has a posterior; reason of the first simulation: {simulations[0].refused}")
    return [_rank_test(name, sound, len(sound[0].rank)) for name in sound[0].rank]


def _rank_test(name: str, sound: Sequence[SensorSimulation], parameters: int) -> RankTest:
    from scipy.stats import chisquare

    counts, _ = np.histogram([s.rank[name] for s in sound], BINS, (-0.5, DRAWS + 0.5))
    z = np.array([s.z[name] for s in sound])
    return RankTest(
        name,
        tuple(counts.tolist()),
        float(chisquare(counts).pvalue),
        _CHANCE / parameters,
        float(np.mean([s.inside[name] for s in sound])),
        coverage_limits(len(sound)),
        float(z.mean()),
        float(z.std(ddof=1)) if len(z) > 1 else math.nan,
    )


def coverage_limits(count: int) -> tuple[float, float]:
    """Return limits for the coverage of intervals, which a correct posterior exceeds in 1 of 1000 studies."""
    if count in _ROUNDED:
        return _ROUNDED[count]
    low, high = chance_band(count, SHARE, _CERTAIN)
    return low / count, high / count


def chance_band(count: int, share: float, certain: float) -> tuple[float, float]:
    """Return the central interval of a binomial distribution that contains the probability ``certain``."""
    from scipy.stats import binom

    low, high = binom.interval(certain, count, share)
    return float(low), float(high)


@drawn
def ranks(rank_tests: Sequence[RankTest]) -> Any:
    """Draw a histogram of the ranks of each parameter's true values, with the 99 % band of uniform ranks."""
    columns = min(3, len(rank_tests))
    rows = -(-len(rank_tests) // columns)
    figure, axes = canvas(3.4 * columns, 2.4 * rows + 0.4, rows, columns, sharex=True)
    for ax, test in zip(axes.flat, rank_tests, strict=False):
        _histogram(ax, test)
    for ax in list(axes.flat)[len(rank_tests) :]:
        ax.set_axis_off()
    figure.supxlabel(f"draws below the truth, of {DRAWS}", fontsize=10)
    figure.supylabel("simulations", fontsize=10)
    return figure


def _histogram(ax: Any, test: RankTest) -> None:
    total, width = sum(test.counts), (DRAWS + 1) / BINS
    low, high = chance_band(total, 1.0 / BINS, _DRAWN)
    ax.axhspan(low, high, color="#cccccc", alpha=0.6, linewidth=0)
    ax.axhline(total / BINS, color=_GREY, linewidth=0.8)
    colour = BLUE if test.uniform else VERMILION
    ax.bar([(i + 0.5) * width for i in range(BINS)], test.counts, 0.92 * width, color=colour, alpha=0.85)
    ax.set_title(f"{test.name.replace('_', ' ')}: p = {test.p:.2g}")
    ax.set_ylim(0, 1.15 * max(high, *test.counts))
    ax.grid(False, axis="x")
    ax.set_axisbelow(True)
