"""Linear propagation of uncertain inputs to an output, with an estimate of its own error.

The output is expanded about the medians of the inputs, along each input through three of its
values. The linear terms give the standard deviation, exactly for a linear output whatever the
distributions and their correlation are. Three further quantities say how wrong it may be: the
quadratic terms, what the parabolas miss near the ends of each input, and what they miss at a few
draws of all inputs together. The last two are added to the error as they are, because two standard
deviations never differ by more than the standard deviation of the difference.

Source: linear terms: JCGM 100:2008 (GUM), 5.1.2 and 5.2.2; quadratic terms: its note to 5.1.2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from neusee.workflows.recipe.distributions.joint_distribution import Z_90
from neusee.workflows.recipe.distributions.shapes import FloatArray, Shape

CHECKS = 8  #: draws of all inputs together, which are compared with the expansion
FAR = 3.09  #: normal score of the quantile at 99.9 %
#: 5 % quantile of the chi-squared distribution with `CHECKS` degrees of freedom: the mean square of
#: the misses is with 95 % at most their sum of squares over this number, if they are normal
_CHI_SQUARED = 2.732636793499662
_REACH, _POINTS = 8.0, 4001  #: normal scores of the integrals over an input
#: a standard deviation below this fraction of the largest value counts as 0
_CONSTANT = 1e-12


@dataclass(frozen=True)
class OutputRuns:
    """An output (element,) at the medians, along each input, and at a few draws."""

    at_medians: FloatArray  #: (element,)
    near: FloatArray  #: (input, 2, element), one input at the scores -`Z_90` and `Z_90`
    far: FloatArray  #: (input, 2, element), one input at the scores -`FAR` and `FAR`
    checks: FloatArray  #: (draw, element)


@dataclass(frozen=True)
class LinearEstimate:
    """Mean and standard deviation of an output (element,) from its linear terms, and the parts of
    their errors.
    """

    mean: FloatArray
    sd: FloatArray
    bias: FloatArray  #: what the quadratic terms add to the mean
    second_order: FloatArray  #: what they change of the standard deviation
    ends: FloatArray  #: standard deviation of what the parabolas miss near the ends of the inputs
    missed: FloatArray  #: upper limit (95 %) of that of what they miss at draws of all inputs
    shares: FloatArray  #: (input, element) share of each input in the linear variance

    @property
    def is_constant(self) -> bool:
        """Return True if the output is the same in all runs."""
        return bool(np.isfinite(self.mean).all()) and not float(self.sd.max() + self._off.max()) > 0

    @cached_property
    def _off(self) -> FloatArray:
        """The largest error of the standard deviation (element,)."""
        return np.asarray(np.abs(self.second_order) + self.ends + self.missed, np.float64)

    @property
    def error(self) -> float:
        """Return the error of the standard deviations relative to the largest one; infinite if no
        linear term explains the scatter.
        """
        return 0.0 if self.is_constant else self._relative(self._off)

    @property
    def error_of_mean(self) -> FloatArray:
        """Return the largest error of the mean (element,)."""
        return np.asarray(np.abs(self.bias) + self.ends + self.missed, np.float64)

    @property
    def reason(self) -> str:
        """Return in words what the error consists of, the largest part first."""
        parts = {
            "the second order": self._relative(np.abs(self.second_order)),
            "the ends of the inputs, where the output clips or is not smooth": self._relative(
                self.ends
            ),
            "draws of all inputs together": self._relative(self.missed),
        }
        ordered_parts = sorted(parts.items(), key=lambda part: -part[1])
        return ", ".join(f"{error:.2%} from {name}" for name, error in ordered_parts)

    def _relative(self, part: FloatArray) -> float:
        """Return the largest element of a part of the error, relative to the largest standard
        deviation.
        """
        largest_sd = float(self.sd.max())
        ratio = float(part.max()) / largest_sd if largest_sd > 0 else math.inf
        return ratio if math.isfinite(ratio) else math.inf


def propagate(shapes: Sequence[Shape], z: FloatArray, runs: OutputRuns) -> LinearEstimate:
    """Return the linear estimate of an output from its ``runs``.

    Args: shapes: distribution of each independent input. z: standard normal numbers (draw, input)
            of ``runs.checks``.
    """
    inputs = [_Input.of(shape) for shape in shapes]
    expected = np.repeat(runs.at_medians[None], len(z), 0)
    mean, bias = runs.at_medians.copy(), np.zeros_like(runs.at_medians)
    # by input (element,)
    linear, quadratic, beyond_ends = [], [], []
    for number, one in enumerate(inputs):
        slope, curvature = one.parabola(runs.at_medians, runs.near[number])
        distance = one.distance(z[:, number])[:, None]
        expected += slope * distance + curvature * distance**2
        mean += slope * one.mean
        bias += curvature * one.mean_square
        linear.append(slope**2 * one.covariance[0, 0])
        quadratic.append(_quadratic_variance(slope, curvature, one.covariance))
        far = one.distance(np.array([-FAR, FAR]))[:, None]
        off = runs.far[number] - runs.at_medians - slope * far - curvature * far**2
        beyond_ends.append(one.share_of_ends * (off**2).sum(0))
    variance = np.sum(linear, 0)
    missed = np.sqrt(((runs.checks - expected) ** 2).sum(0) / _CHI_SQUARED)
    largest = np.abs(np.concatenate([runs.at_medians[None], runs.checks])).max(0)
    parts = {
        "sd": np.sqrt(variance),
        "second_order": np.sqrt(np.sum(quadratic, 0)) - np.sqrt(variance),
        "ends": np.sqrt(np.sum(beyond_ends, 0)),
        "missed": missed,
    }
    # rounding is no scatter
    parts = {
        name: np.where(np.abs(part) <= _CONSTANT * largest, 0.0, part)
        for name, part in parts.items()
    }
    shares = np.stack(linear) / np.where(variance > 0, variance, 1.0)
    return LinearEstimate(mean=mean, bias=bias, shares=shares, **parts)


def _quadratic_variance(
    slope: FloatArray, curvature: FloatArray, covariance: FloatArray
) -> FloatArray:
    """Return the variance of slope t + curvature t**2, for the ``covariance`` (2, 2) of t and
    t**2.
    """
    coefficients = np.stack([slope, curvature])
    # a variance is not negative, but for rounding
    return np.asarray((coefficients * (covariance @ coefficients)).sum(0).clip(0.0), np.float64)


@dataclass(frozen=True)
class _Input:
    """The distance t of an input from its median, and means over its distribution."""

    shape: Shape
    median: float
    mean: float  #: of t
    mean_square: float
    covariance: FloatArray  #: (2, 2) of t and t**2
    share_of_ends: float  #: mean square of a line from 0 at the score `Z_90` to 1 at `FAR`

    @classmethod
    def of(cls, shape: Shape) -> _Input:
        """Integrate over the distribution of an input."""
        z = np.linspace(-_REACH, _REACH, _POINTS)
        weights = np.exp(-(z**2) / 2)
        weights /= weights.sum()
        median = float(shape.at(np.zeros(1))[0])
        t = shape.at(z) - median
        powers = np.stack([t, t**2])
        means = powers @ weights
        deviations = powers - means[:, None]
        ramp = ((z - Z_90) / (FAR - Z_90)).clip(0.0)
        share = float(weights @ ramp**2)
        covariance = (deviations * weights) @ deviations.T
        return cls(shape, median, float(means[0]), float(means[1]), covariance, share)

    def distance(self, z: FloatArray) -> FloatArray:
        """Return t at normal scores."""
        return np.asarray(self.shape.at(z) - self.median, np.float64)

    def parabola(self, at_median: FloatArray, near: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the coefficients of t and of t**2 of the parabola through the values at the median
        and ``near`` it (2, element).
        """
        low, high = self.distance(np.array([-Z_90, Z_90]))
        slope_low, slope_high = (near[0] - at_median) / low, (near[1] - at_median) / high
        curvature = (slope_high - slope_low) / (high - low)
        return slope_high - curvature * high, curvature


def without_distance(names: Sequence[str], shapes: Sequence[Shape]) -> list[str]:
    """Return the names of inputs of a few separate values, along which there is no derivative."""
    scores = np.array([-FAR, -Z_90, 0.0, Z_90, FAR])
    return [
        name
        for name, shape in zip(names, shapes, strict=True)
        if not (np.diff(shape.at(scores)) > 0).all()
    ]
