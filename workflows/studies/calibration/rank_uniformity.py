"""Whether ranks are uniform and intervals hold what they say, and what chance alone would still do."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from neusee.workflows.studies.calibration.independent_draws import DRAWS
from neusee.workflows.studies.calibration.simulated_sensors import Simulation

BINS, SHARE = 10, 0.9
_CHANCE = 0.01  #: of a false alarm by the ranks, over all parameters together
_CERTAIN = 0.999  #: of one parameter's coverage, that a right posterior keeps to its bar
#: exact but for the last digit; of 1000 it is .868 to .930
_ROUNDED = {200: (0.825, 0.960), 1000: (0.870, 0.930)}


@dataclass(frozen=True)
class Verdict:
    """What all simulations together say of one parameter."""

    name: str
    counts: tuple[int, ...]  #: ranks by bin
    p: float  #: of ranks no less uneven, were they uniform
    least_p: float
    coverage: float  #: share of the simulations whose central 90 % hold the truth
    bar: tuple[float, float]  #: that it must lie in
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


def verdicts(simulations: Sequence[Simulation]) -> list[Verdict]:
    """One a parameter, of the simulations that gave a posterior."""
    sound = [s for s in simulations if not s.refused]
    if not sound:
        raise ValueError(f"no simulation has a posterior; the first: {simulations[0].refused}")
    return [_verdict(name, sound, len(sound[0].rank)) for name in sound[0].rank]


def _verdict(name: str, sound: Sequence[Simulation], parameters: int) -> Verdict:
    from scipy.stats import chisquare

    counts, _ = np.histogram([s.rank[name] for s in sound], BINS, (-0.5, DRAWS + 0.5))
    z = np.array([s.z[name] for s in sound])
    return Verdict(
        name,
        tuple(counts.tolist()),
        float(chisquare(counts).pvalue),
        _CHANCE / parameters,
        float(np.mean([s.inside[name] for s in sound])),
        bar(len(sound)),
        float(z.mean()),
        float(z.std(ddof=1)) if len(z) > 1 else math.nan,
    )


def bar(count: int) -> tuple[float, float]:
    """Between what the coverage of ``count`` simulations must lie: in 999 of 1000 cases it does."""
    if count in _ROUNDED:
        return _ROUNDED[count]
    low, high = band(count, SHARE, _CERTAIN)
    return low / count, high / count


def band(count: int, share: float, certain: float) -> tuple[float, float]:
    """Between how many of ``count`` a share lies by chance."""
    from scipy.stats import binom

    low, high = binom.interval(certain, count, share)
    return float(low), float(high)
