"""The Pareto line of points, and the engine's choice against the cheapest point within a tolerance."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import median

from neusee.workflows.studies.accuracy.work_precision_points import WorkPrecisionPoint

Points = Sequence[WorkPrecisionPoint]


@dataclass(frozen=True)
class ToleranceChoice:
    """The engine's choice for a tolerance, and the cheapest point within the tolerance."""

    tolerance: float
    chosen: WorkPrecisionPoint
    cheapest: WorkPrecisionPoint | None  #: None where no point is within the tolerance

    @property
    def held(self) -> bool:
        """Return True if the error of the chosen point is within the tolerance."""
        return self.chosen.most <= self.tolerance

    @property
    def ratio(self) -> float | None:
        """Return the run time of the chosen point over that of the cheapest point."""
        return None if self.cheapest is None else self.chosen.seconds / self.cheapest.seconds


def pareto_front(points: Points) -> list[WorkPrecisionPoint]:
    """Return the points that no other point beats in both time and error, the quickest first."""
    line: list[WorkPrecisionPoint] = []
    for point in sorted(points, key=lambda p: (p.seconds, p.most)):
        if not line or point.most < line[-1].most:
            line.append(point)
    return line


def cheapest(points: Points, tolerance: float) -> WorkPrecisionPoint | None:
    """Return the quickest point with no error above ``tolerance``."""
    return min((p for p in points if p.most <= tolerance), key=lambda p: p.seconds, default=None)


def median_ratio(choices: Iterable[ToleranceChoice]) -> float | None:
    """Return the median ratio of the chosen run time to the cheapest run time, over all possible tolerances."""
    ratios = [c.ratio for c in choices if c.ratio is not None]
    return median(ratios) if ratios else None
