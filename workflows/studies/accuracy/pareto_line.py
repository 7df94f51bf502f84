"""The Pareto front of error and run time, and the engine's choices compared with the quickest settings."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import median

from neusee.workflows.studies.accuracy.work_precision_points import WorkPrecisionPoint

Points = Sequence[WorkPrecisionPoint]


@dataclass(frozen=True)
class ToleranceChoice:
    """The engine's choice for a tolerance, and the quickest measured setting within the tolerance."""

    tolerance: float
    chosen: WorkPrecisionPoint
    cheapest: WorkPrecisionPoint | None  #: None where no point is within the tolerance

    @property
    def held(self) -> bool:
        """Return True if the error of the engine's choice is within the tolerance."""
        return self.chosen.most <= self.tolerance

    @property
    def ratio(self) -> float | None:
        """Return the run time of the engine's choice divided by the run time of the quickest setting."""
        return None if self.cheapest is None else self.chosen.seconds / self.cheapest.seconds


def pareto_front(points: Points) -> list[WorkPrecisionPoint]:
    """Return the Pareto front: settings that no other setting beats in both run time and error, the quickest first."""
    line: list[WorkPrecisionPoint] = []
    for point in sorted(points, key=lambda p: (p.seconds, p.most)):
        if not line or point.most < line[-1].most:
            line.append(point)
    return line


def cheapest(points: Points, tolerance: float) -> WorkPrecisionPoint | None:
    """Return the quickest setting whose largest error is within ``tolerance``, or None if there is no such setting."""
    return min((p for p in points if p.most <= tolerance), key=lambda p: p.seconds, default=None)


def median_ratio(choices: Iterable[ToleranceChoice]) -> float | None:
    """Return the median over all tolerances of the engine's run time divided by the quickest run time."""
    ratios = [c.ratio for c in choices if c.ratio is not None]
    return median(ratios) if ratios else None
