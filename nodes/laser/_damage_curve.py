"""Threshold of the first damage over the duration of the light, between pulses of nanoseconds and continuous light.

Two published ends hold the curve: a fluence for pulses of 10 ns and an irradiance for continuous light. Between 10 ns
and 10 us the fluence is interpolated in logarithms; beyond, the continuous law counts as an irradiance. A longer pulse
never needs less fluence, and a shorter one never needs less irradiance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from neusee.nodes.laser._damage_laws import DamageLaw, Number, double, spot_factor

PULSE_END = 10e-9  #: s, duration of the published fluence
CONTINUOUS_FROM = 10e-6  #: s, duration from which the continuous law counts
SHORTEST = 1e-9  #: s; below, no threshold is known from below
SPREAD = math.sqrt(40.0)  #: factor to each end of the bracket: by equal heat the two published ends disagree 40 times


@dataclass(frozen=True)
class Bracket:
    """A threshold with the ends of its bracket, in J/m2 or W/m2; tensors that broadcast against each other."""

    low: Tensor  #: 0 where no lower end is known
    middle: Tensor  #: the threshold that a ratio is stated for
    high: Tensor

    def times(self, factor: Number | tuple[float, float]) -> Bracket:
        """Return the bracket times a factor, or with its ends times a least and a largest factor."""
        if isinstance(factor, tuple):
            return Bracket(self.low * factor[0], self.middle, self.high * factor[1])
        return Bracket(self.low * factor, self.middle * factor, self.high * factor)


@dataclass(frozen=True)
class CurveEnds:
    """The published ends of the curve of one class of sensors."""

    pulse: DamageLaw  #: fluence of the first damage by pulses of 10 ns
    continuous: DamageLaw  #: irradiance of the first damage by continuous light, with its bracket and its spot


def first_damage(
    ends: CurveEnds, duration: Number, spot: Number | None = None, small_spot_exponent: Number = 0.0
) -> Bracket:
    """Return the fluence in J/m2 of the first damage by light of a duration in s on a spot of a 1/e2 diameter in m.

    From 1 to 10 ns the fluence is that of 10 ns, because heat stays within the depth in which silicon absorbs. Below
    1 ns the lower end is 0: pulses of picoseconds are reported to damage at less fluence than those of nanoseconds, and
    no figure was found; the upper end still holds. The upper and the lower end are `SPREAD` away from the curve up to
    `CONTINUOUS_FROM`, and those of the continuous law where these are higher.

    Shapes: duration and spot broadcast.
    Units:  s, m -> J/m2.
    Error:  an interpolation between two published figures, which nobody measured.
    Source: the sources of both laws.
    """
    time = double(duration)
    steady = _steady(ends.continuous, time, spot, small_spot_exponent)
    join = torch.full_like(time, CONTINUOUS_FROM)
    at_join = _steady(ends.continuous, join, spot, small_spot_exponent) * ends.continuous.median * CONTINUOUS_FROM
    start = at_join.clamp_max(ends.pulse.median)
    decades = math.log10(CONTINUOUS_FROM / PULSE_END)
    slope = torch.log10(at_join / start) / decades
    interpolated = start * (time.clamp(PULSE_END, CONTINUOUS_FROM) / PULSE_END) ** slope
    low, high = (end or ends.continuous.median for end in (ends.continuous.low, ends.continuous.high))
    middle = torch.maximum(interpolated, steady * ends.continuous.median * time)
    lower = torch.maximum(interpolated / SPREAD, steady * low * time)
    return Bracket(
        low=torch.where(time < SHORTEST, 0.0, lower),
        middle=middle,
        high=torch.maximum(interpolated * SPREAD, steady * high * time),
    )


def _steady(law: DamageLaw, duration: Tensor, spot: Number | None, small_spot_exponent: Number) -> Tensor:
    """Return the factor on the continuous law for a spot; 1 without a spot."""
    if spot is None or law.spot is None:
        return torch.ones_like(duration)
    return spot_factor(law.spot, spot, duration, small_spot_exponent)
