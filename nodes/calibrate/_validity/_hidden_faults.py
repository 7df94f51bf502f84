"""Faults that change the variance of noise in proportion: the error that frames leave open, found by a test or not."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

_POINTS, _REACH = 2001, 8.0  #: points of a posterior, and standard errors beyond estimate and zero
_SOUND = 9.0  #: odds of no fault at all, before frames of at least `CLEAN_PAIRS` are seen
#: pairs of pixels in the lit levels of the fit from which frames that show no fault hide little
CLEAN_PAIRS = 4e6


@dataclass(frozen=True)
class Hidden:
    """A fault that changes the measured variance, and what the frames say of its size.

    The logarithm of the true over the measured variance has a normal likelihood about `estimate`. Before the frames
    are seen it is 0 with the probability `sound`, and else has a Cauchy distribution about 0, which leaves large values
    to the frames. Nothing is corrected by it: its root mean square is an error that gain and noise may have, so that a
    fault that is found widens by its whole size. Frames of many pixels that show nothing leave almost nothing open;
    with few pixels `sound` is small, and the whole standard error counts.
    """

    fault: str  #: "mixing", "lag" or "pattern"
    estimate: float
    error: float  #: standard error of `estimate`
    scale: float  #: of the Cauchy distribution
    gain: float = 0.0  #: change of the logarithm of the gain for 1
    noise: float = 0.0  #: change of the logarithm of the dark noise in DN for 1
    positive: bool = False  #: True if the logarithm cannot be negative
    sound: float = 0.0  #: probability of no fault, from `probably_sound`

    def posterior(self) -> tuple[Tensor, Tensor]:
        """Return points of the logarithm and their probabilities, both (point,)."""
        low = min(0.0, self.estimate) - _REACH * self.error
        high = max(0.0, self.estimate) + _REACH * self.error
        points = torch.linspace(0.0 if self.positive else low, high, _POINTS, dtype=torch.float64)
        density = 1 / (math.pi * self.scale * (1 + (points / self.scale).square()))
        if self.positive:
            density = 2 * density
        weight = self._likelihood(points) * density * (points[1] - points[0]) * (1 - self.sound)
        points = torch.cat([points, points.new_zeros(1)])
        weight = torch.cat([weight, self.sound * self._likelihood(points[-1:])])
        return points, weight / weight.sum()

    def size(self) -> float:
        """Return the root mean square of the logarithm."""
        points, weight = self.posterior()
        return math.sqrt(float(weight @ points.square()))

    def _likelihood(self, points: Tensor) -> Tensor:
        """Return the likelihood of points relative to that of the likeliest value that is possible."""
        best = max(0.0, self.estimate) if self.positive else self.estimate
        offset = ((best - self.estimate) / self.error) ** 2
        return (-0.5 * (((points - self.estimate) / self.error).square() - offset)).exp()


def probably_sound(pairs: float) -> float:
    """Return the probability of no fault before frames are seen, for a number of pairs of pixels in lit levels.

    Frames of few pixels cannot show a fault that would matter: then nobody should believe that there is none. The odds
    rise with the square of the pairs, up to 9 at `CLEAN_PAIRS`.
    """
    odds = _SOUND * min(1.0, pairs / CLEAN_PAIRS) ** 2
    return odds / (1 + odds)


def open_errors(hidden: Sequence[Hidden]) -> dict[str, float]:
    """Return the relative errors that independent faults leave open, by the names "gain" and "noise" (in DN)."""
    sizes = [fault.size() for fault in hidden]
    gain = math.hypot(*(fault.gain * size for fault, size in zip(hidden, sizes, strict=True)), 0.0)
    noise = math.hypot(*(fault.noise * size for fault, size in zip(hidden, sizes, strict=True)), 0.0)
    return {"gain": gain, "noise": noise}
