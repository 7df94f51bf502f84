"""The uncertainty budget of one quantity: its sources, combined and expanded."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal

COVERAGE = 0.95  #: probability with which the expanded uncertainty holds the value
NOT_STATED, NOT_INVOLVED = "not stated", "does not enter"


@dataclass(frozen=True)
class Contribution:
    """One source of uncertainty of a quantity: a line of its budget.

    Without an ``uncertainty``, ``reason`` says why: the source is not stated, or does not enter the
    quantity.
    """

    source: str
    kind: Literal["A", "B"]  #: evaluated from a series of observations, or by other means
    distribution: str = "normal"
    uncertainty: float | None = None  #: u(x), standard uncertainty of the input
    unit: str = ""  #: of the input
    sensitivity: float = 1.0  #: c = dy/dx, in units of the quantity for a unit of the input
    freedom: float = math.inf  #: nu, degrees of freedom of u(x)
    reason: str = ""

    @property
    def share(self) -> float | None:
        """Return u(y) = |c| u(x) in the unit of the quantity, or None for a source without an
        uncertainty.
        """
        return None if self.uncertainty is None else abs(self.sensitivity) * self.uncertainty


@dataclass(frozen=True)
class Budget:
    """The uncertainty budget of a quantity, whose sources are independent of each other."""

    key: str
    name: str
    symbol: str
    unit: str
    value: float
    contributions: tuple[Contribution, ...] = field(default_factory=tuple)

    @property
    def combined(self) -> float:
        """Return the combined standard uncertainty u_c(y) (GUM, equation 10)."""
        return math.hypot(*_shares(self.contributions), 0.0)

    @property
    def freedom(self) -> float:
        """Return the effective degrees of freedom of the combined uncertainty (GUM, equation
        G.2b).
        """
        return welch_satterthwaite(self.contributions)

    @property
    def factor(self) -> float:
        """Return the coverage factor k of Student's t distribution for `COVERAGE` (GUM, G.3)."""
        return coverage_factor(self.freedom)

    @property
    def expanded(self) -> float:
        """Return the expanded uncertainty U = k u_c(y)."""
        return self.factor * self.combined

    @property
    def missing(self) -> tuple[str, ...]:
        """Return the sources that are not stated, so that the combined uncertainty lacks them."""
        return tuple(
            c.source
            for c in self.contributions
            if c.uncertainty is None and c.reason != NOT_INVOLVED
        )


def welch_satterthwaite(contributions: Iterable[Contribution]) -> float:
    """Return the effective degrees of freedom of the sum of independent contributions, infinite
    without a finite one.

    Shapes: scalars.
    Units:  those of the quantity.
    Source: JCGM 100:2008 (GUM), equation G.2b.
    """
    shares = [(c.share, c.freedom) for c in contributions if c.share]
    total = math.hypot(*(share for share, _ in shares), 0.0)
    quotient = math.fsum((share / total) ** 4 / freedom for share, freedom in shares)
    return 1.0 / quotient if quotient > 0 else math.inf


def coverage_factor(freedom: float, probability: float = COVERAGE) -> float:
    """Return the factor k with which k standard uncertainties hold the value with a probability.

    Shapes: scalars.
    Units:  none.
    Source: JCGM 100:2008 (GUM), G.3 and G.6.4: whole degrees of freedom, rounded down.
    """
    from scipy.stats import norm, t

    quantile = (1 + probability) / 2
    return float(
        t.ppf(quantile, max(1, math.floor(freedom)))
        if math.isfinite(freedom)
        else norm.ppf(quantile)
    )


def _shares(contributions: Iterable[Contribution]) -> list[float]:
    return [c.share for c in contributions if c.share is not None]
