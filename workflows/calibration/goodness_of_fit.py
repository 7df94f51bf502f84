"""Whether levels can be by a law at all: what its best camera leaves unexplained, against chance."""

from __future__ import annotations

from dataclasses import dataclass

from neusee.nodes.calibrate import Likelihood

MISFIT = 1e-3  #: probability below which chance is no excuse


@dataclass(frozen=True)
class Fit:
    """Twice the missing log-likelihood of all levels, and how likely chance alone makes it as large."""

    deviance: float
    freedom: float  #: degrees of freedom
    p: float

    @property
    def good(self) -> bool:
        """No misfit."""
        return self.p >= MISFIT


def fit(likelihood: Likelihood, free: int = 0) -> Fit:
    """Of one sensor, of which ``free`` parameters were fitted to the same levels.

    Raises ValueError for a likelihood without deviances, for many sensors at once, and where nothing is left to test.
    """
    from scipy.special import chdtrc

    if not len(likelihood.degrees_of_freedom):
        raise ValueError("this likelihood has no deviances: take one with told: true")
    if likelihood.deviance.numel() != len(likelihood.degrees_of_freedom):
        raise ValueError(f"deviances {tuple(likelihood.deviance.shape)} are not of one sensor: give one place")
    deviance, freedom = float(likelihood.deviance.sum()), float(likelihood.degrees_of_freedom.sum()) - free
    if freedom <= 0:
        raise ValueError(f"{freedom + free:.0f} numbers are no test of {free} free parameters: give more levels")
    return Fit(deviance, freedom, float(chdtrc(freedom, deviance)))
