"""Faults that change the variance of noise in proportion: what frames say of them, whether a test finds them or not."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

_POINTS, _REACH = 2001, 8.0  #: points of a posterior, and standard errors beyond estimate and zero
_LINEAR = 0.2  #: share of a correction that is not known, because no fault is exactly linear


@dataclass(frozen=True)
class Hidden:
    """A fault that changes the measured variance, and its posterior from the frames.

    The logarithm of the true over the measured variance has a normal likelihood about `estimate`, and a Cauchy prior
    about 0, which leaves large values to the frames. Where only a `positive` logarithm is possible, half of the prior
    is at 0 and half a Cauchy distribution above it. Gain and noise follow by their factors.
    """

    fault: str  #: "mixing", "lag" or "pattern"
    estimate: float
    error: float  #: standard error of `estimate`
    scale: float  #: of the prior
    gain: float = 0.0  #: change of the logarithm of the gain for 1
    noise: float = 0.0  #: change of the logarithm of the dark noise in DN for 1
    partly: bool = False  #: True if the share of the fault that reaches the dark noise is unknown
    positive: bool = False  #: True if the logarithm cannot be negative

    def law(self) -> tuple[Tensor, Tensor]:
        """Return points of the logarithm and their probabilities, both (point,)."""
        low, high = (sign * max(0.0, sign * self.estimate) + sign * _REACH * self.error for sign in (-1, 1))
        at = torch.linspace(0.0 if self.positive else low, high, _POINTS, dtype=torch.float64)
        log = -0.5 * ((at - self.estimate) / self.error).square()
        likelihood = (log - log.max()).exp()
        density = (1 + self.positive) / (math.pi * self.scale * (1 + (at / self.scale).square()))
        weight = likelihood * density * (at[1] - at[0])
        if self.positive:
            weight[0] += likelihood[0]
        return at, weight / weight.sum()

    def draw(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw changes of the logarithms of gain and of dark noise in DN, both (count,)."""
        at, weight = self.law()
        uniform, part = torch.rand(2, count, generator=generator, dtype=torch.float64)
        values = at[torch.searchsorted(weight.cumsum(0), uniform).clamp_max(_POINTS - 1)]
        values = values * (1 + _LINEAR * torch.randn(count, generator=generator, dtype=torch.float64))
        return self.gain * values, self.noise * values * (part if self.partly else 1.0)

    def moments(self) -> dict[str, tuple[float, float]]:
        """Return mean and standard deviation of what `draw` draws, by the names "gain" and "noise"."""
        at, weight = self.law()
        mean, square = float(weight @ at), float(weight @ at.square()) * (1 + _LINEAR**2)
        parts = {"gain": (self.gain, 1.0, 1.0), "noise": (self.noise, *((0.5, 1 / 3) if self.partly else (1.0, 1.0)))}
        return {
            name: (factor * half * mean, abs(factor) * math.sqrt(max(0.0, third * square - (half * mean) ** 2)))
            for name, (factor, half, third) in parts.items()
        }


class Correction(NamedTuple):
    """Change of a logarithm by faults, and the standard deviation of this change."""

    mean: float
    sd: float


def corrections(hidden: Sequence[Hidden]) -> dict[str, Correction]:
    """Return the changes of the logarithms of gain and of dark noise in DN by several independent faults."""
    found = [each.moments() for each in hidden]
    return {
        name: Correction(sum(x[name][0] for x in found), math.hypot(*(x[name][1] for x in found), 0.0))
        for name in ("gain", "noise")
    }
