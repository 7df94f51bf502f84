"""Which points are worth their time: the Pareto line, and the engine's choice against the cheapest that does."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from statistics import median
from typing import Protocol, TypeVar


class Priced(Protocol):
    """Something with a price and an error."""

    @property
    def seconds(self) -> float: ...

    @property
    def most(self) -> float: ...


P = TypeVar("P", bound=Priced)


@dataclass(frozen=True)
class Choice:
    """The engine's choice for a tolerance, and the cheapest point that holds it."""

    tolerance: float
    chosen: Priced
    cheapest: Priced | None  #: None where no point holds it

    @property
    def held(self) -> bool:
        """Whether what was chosen is within the tolerance."""
        return self.chosen.most <= self.tolerance

    @property
    def ratio(self) -> float | None:
        """What the choice costs over what the cheapest costs."""
        return None if self.cheapest is None else self.chosen.seconds / self.cheapest.seconds


def front(points: Iterable[P]) -> list[P]:
    """The points that none other beats in both time and error, the quickest first."""
    line: list[P] = []
    for point in sorted(points, key=lambda p: (p.seconds, p.most)):
        if not line or point.most < line[-1].most:
            line.append(point)
    return line


def cheapest(points: Iterable[P], tolerance: float) -> P | None:
    """The quickest point with no error above ``tolerance``."""
    return min((p for p in points if p.most <= tolerance), key=lambda p: p.seconds, default=None)


def median_ratio(choices: Iterable[Choice]) -> float | None:
    """Of the choices that some point holds, the median price over the cheapest."""
    ratios = [c.ratio for c in choices if c.ratio is not None]
    return median(ratios) if ratios else None
