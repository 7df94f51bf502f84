"""Probability distributions of a number: quantiles, measures, and draws of a value."""

from __future__ import annotations

import hashlib
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

# --- shapes ---------------------------------------------------------------------------------------

# Probability distributions of a number: quantiles at standard normal numbers, and measures for
# integrals.
#
# Every quantile is a function of a standard normal number ``z``, whose cumulative probability is
# that of the value. Two tails are then equally accurate, and a draw needs one normal number,
# whatever the distribution is.


FloatArray = NDArray[np.float64]

_REACH = 11.0  #: standard deviations beyond which a normal density is negligible, even times z**20
_NODES = 4097  #: points of the measure of a continuous distribution
_ROUNDING = 1e-12  #: rounding error that is allowed in a cumulative sum of weights
_SMALLEST_SHARE = 1e-9  #: smallest probability between the bounds of a truncated distribution


class Shape(ABC):
    """Probability distribution of a number."""

    @abstractmethod
    def at(self, z: FloatArray) -> FloatArray:
        """Return the values of the distribution at the cumulative probabilities of standard
        normal numbers ``z``.
        """

    @abstractmethod
    def score(self, x: float) -> float:
        """Return the standard normal number at which the distribution has the value ``x``."""

    def coordinate(self, z: FloatArray) -> FloatArray:
        """Return the coordinate in which outputs are expected to be smooth; here the value
        itself.
        """
        return self.at(z)

    def measure(self) -> tuple[FloatArray, FloatArray]:
        """Return points of `coordinate` and their probabilities, for means of functions of the
        coordinate.
        """
        z, weights = _normal_measure()
        return self.coordinate(z), weights

    def moments(self) -> tuple[float, float]:
        """Return mean and standard deviation."""
        z, weights = _normal_measure()
        values = self.at(z)
        mean = float(weights @ values)
        return mean, math.sqrt(float(weights @ (values - mean) ** 2))

    def truncated(self, low: float, high: float) -> Shape:
        """Return the distribution under the condition that the value is between ``low`` and
        ``high``.

        Raises ValueError if less than 1e-9 of the distribution lies there.
        """
        if not low < high:
            raise ValueError(
                f"the lower bound {low:g} must be smaller than the upper bound {high:g}"
            )
        cut = Truncated(self, low, high)
        if not cut.share > _SMALLEST_SHARE:
            raise ValueError("less than 1e-9 of the distribution lies between the two bounds")
        return cut


@dataclass(frozen=True)
class Normal(Shape):
    """Normal distribution; a standard deviation of 0 is a single value."""

    mean: float = 0.0
    sd: float = 1.0

    def at(self, z: FloatArray) -> FloatArray:
        return self.mean + self.sd * z

    def score(self, x: float) -> float:
        return (x - self.mean) / self.sd

    def coordinate(self, z: FloatArray) -> FloatArray:
        return z

    def moments(self) -> tuple[float, float]:
        return self.mean, self.sd


@dataclass(frozen=True)
class LogNormal(Shape):
    """Lognormal distribution with its median and the factor of one standard deviation."""

    median: float
    factor: float

    def at(self, z: FloatArray) -> FloatArray:
        with np.errstate(over="ignore"):
            return np.asarray(self.median * np.exp(np.log(self.factor) * z), np.float64)

    def score(self, x: float) -> float:
        return math.log(x / self.median) / math.log(self.factor) if x > 0 else -math.inf

    def coordinate(self, z: FloatArray) -> FloatArray:
        return z


@dataclass(frozen=True)
class Uniform(Shape):
    """Uniform distribution between two values."""

    low: float
    high: float

    def at(self, z: FloatArray) -> FloatArray:
        from scipy.special import ndtr

        return np.asarray(self.low + (self.high - self.low) * ndtr(z), np.float64)

    def score(self, x: float) -> float:
        return _score((x - self.low) / (self.high - self.low))


@dataclass(frozen=True)
class LogUniform(Shape):
    """Distribution between two values whose logarithm is uniform."""

    low: float
    high: float

    def at(self, z: FloatArray) -> FloatArray:
        from scipy.special import ndtr

        return np.asarray(self.low * np.exp(np.log(self.high / self.low) * ndtr(z)), np.float64)

    def score(self, x: float) -> float:
        return (
            _score(math.log(x / self.low) / math.log(self.high / self.low)) if x > 0 else -math.inf
        )

    def coordinate(self, z: FloatArray) -> FloatArray:
        from scipy.special import ndtr

        return np.asarray(ndtr(z), np.float64)


@dataclass(frozen=True)
class Triangular(Shape):
    """Triangular distribution with its least, most probable and largest value."""

    low: float
    mode: float
    high: float

    def at(self, z: FloatArray) -> FloatArray:
        from scipy.special import ndtr

        width = self.high - self.low
        share_below, share_above = ndtr(z), ndtr(-z)
        left_of_mode = self.low + np.sqrt(share_below * width * (self.mode - self.low))
        right_of_mode = self.high - np.sqrt(share_above * width * (self.high - self.mode))
        return np.asarray(
            np.where(share_below * width < self.mode - self.low, left_of_mode, right_of_mode),
            np.float64,
        )

    def score(self, x: float) -> float:
        x, width = min(max(x, self.low), self.high), self.high - self.low
        if x < self.mode:
            return _score((x - self.low) ** 2 / (width * (self.mode - self.low)))
        if x == self.high:
            return math.inf
        return -_score((self.high - x) ** 2 / (width * (self.high - self.mode)))


@dataclass(frozen=True)
class Beta(Shape):
    """Beta distribution with two shape parameters, between two values."""

    a: float
    b: float
    low: float = 0.0
    high: float = 1.0

    def at(self, z: FloatArray) -> FloatArray:
        from scipy.special import betaincinv, ndtr

        width = self.high - self.low
        lower_half = self.low + width * betaincinv(self.a, self.b, ndtr(np.minimum(z, 0.0)))
        # B(a, b) seen from its other end is B(b, a): both tails keep their digits
        upper_half = self.high - width * betaincinv(self.b, self.a, ndtr(-np.maximum(z, 0.0)))
        return np.asarray(np.where(z < 0, lower_half, upper_half), np.float64)

    def score(self, x: float) -> float:
        from scipy.special import betainc

        share = min(max((x - self.low) / (self.high - self.low), 0.0), 1.0)
        share_below = float(betainc(self.a, self.b, share))
        return (
            _score(share_below)
            if share_below < 0.5
            else -_score(float(betainc(self.b, self.a, 1.0 - share)))
        )


@dataclass(frozen=True)
class Discrete(Shape):
    """Distribution of a few values with weights, or of the samples of a file with equal weights."""

    values: FloatArray = field(compare=False)  #: sorted
    weights: FloatArray = field(compare=False)
    identity: str = ""  #: digest of values and weights, by which two distributions are compared

    @classmethod
    def of(cls, values: FloatArray, weights: FloatArray) -> Discrete:
        """Return the distribution of ``values`` with ``weights``; equal values become one value."""
        distinct, number_of_value = np.unique(values, return_inverse=True)
        total_weights = np.bincount(number_of_value.reshape(-1), weights=weights)
        total_weights = total_weights / total_weights.sum()
        identity = hashlib.sha256(distinct.tobytes() + total_weights.tobytes()).hexdigest()
        return cls(distinct, total_weights, identity)

    def at(self, z: FloatArray) -> FloatArray:
        from scipy.special import ndtr

        cumulative = np.cumsum(self.weights)[:-1]
        return np.asarray(self.values[np.searchsorted(cumulative + _ROUNDING, ndtr(z))], np.float64)

    def score(self, x: float) -> float:
        return _score(float(self.weights[self.values <= x].sum()))

    def measure(self) -> tuple[FloatArray, FloatArray]:
        return self.values, self.weights

    def moments(self) -> tuple[float, float]:
        mean = float(self.weights @ self.values)
        return mean, math.sqrt(float(self.weights @ (self.values - mean) ** 2))

    def truncated(self, low: float, high: float) -> Shape:
        if not low < high:
            raise ValueError(
                f"the lower bound {low:g} must be smaller than the upper bound {high:g}"
            )
        inside = (self.values >= low) & (self.values <= high)
        if inside.sum() < 2:
            raise ValueError("fewer than two values of the distribution lie between the two bounds")
        return Discrete.of(self.values[inside], self.weights[inside])


@dataclass(frozen=True)
class Truncated(Shape):
    """Continuous distribution under the condition that the value is between two bounds."""

    shape: Shape
    low: float
    high: float

    @property
    def scores(self) -> tuple[float, float]:
        """Return the standard normal numbers of both bounds in the distribution without bounds."""
        return (
            -math.inf if self.low == -math.inf else self.shape.score(self.low),
            math.inf if self.high == math.inf else self.shape.score(self.high),
        )

    @property
    def share(self) -> float:
        """Return the probability between the bounds in the distribution without bounds."""
        return share_between(*self.scores)

    def at(self, z: FloatArray) -> FloatArray:
        x = self.shape.at(scores_between(z, *self.scores))
        return np.asarray(np.clip(x, self.low, self.high), np.float64)

    def score(self, x: float) -> float:
        low_score, high_score = self.scores
        z = min(max(self.shape.score(x), low_score), high_score)
        # from the nearer end, so that the tails keep their digits
        share_below, share_above = (
            share_between(low_score, z) / self.share,
            share_between(z, high_score) / self.share,
        )
        return _score(share_below) if share_below < share_above else -_score(share_above)

    def coordinate(self, z: FloatArray) -> FloatArray:
        return self.shape.coordinate(scores_between(z, *self.scores))


@dataclass(frozen=True)
class Moved(Shape):
    """Distribution of a value that is multiplied by a factor, and to which an offset is added."""

    shape: Shape
    factor: float = 1.0  #: not 0
    offset: float = 0.0

    def at(self, z: FloatArray) -> FloatArray:
        return self.offset + self.factor * self.shape.at(z if self.factor > 0 else -z)

    def score(self, x: float) -> float:
        score = self.shape.score((x - self.offset) / self.factor)
        return score if self.factor > 0 else -score


def share_between(low: float, high: float) -> float:
    """Return the probability of a standard normal number between ``low`` and ``high``."""
    from scipy.special import ndtr

    # by symmetry, because 1 - ndtr has no digits left far above 0
    if low > 0:
        return float(ndtr(-low) - ndtr(-high))
    return float(ndtr(high) - ndtr(low))


def scores_between(z: FloatArray, low: float, high: float) -> FloatArray:
    """Map standard normal numbers to numbers with the normal distribution truncated to ``low`` …
    ``high``.

    The map keeps the order, and both tails keep their accuracy.
    """
    from scipy.special import ndtr, ndtri

    share = share_between(low, high)
    share_below = ndtr(low) + share * ndtr(z)
    share_above = ndtr(-high) + share * ndtr(-np.asarray(z))
    with np.errstate(divide="ignore"):
        score = np.where(
            share_below < share_above,
            ndtri(share_below.clip(0.0, 1.0)),
            -ndtri(share_above.clip(0.0, 1.0)),
        )
    return np.asarray(np.clip(score, low, high), np.float64)


def _score(probability: float) -> float:
    from scipy.special import ndtri

    return float(ndtri(min(max(probability, 0.0), 1.0)))


def _normal_measure() -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights of a quadrature rule for the standard normal distribution; for
    smooth functions it is exact to rounding error.
    """
    z = np.linspace(-_REACH, _REACH, _NODES)
    weights = np.exp(-(z**2) / 2)
    return z, weights / weights.sum()


# --- scalar ---------------------------------------------------------------------------------------

# Probability distribution of one recipe value, such as ``normal(10.5 e-, 0.5 e-)`` in place of
# ``10.5 e-``.


#: normal scores at which `Law.other_than` looks for another value
_PROBES = (0.3, -0.3, 1.0, -1.0, 2.0, -2.0, 3.0, -3.0, 6.0, -6.0)


@dataclass(frozen=True)
class Law:
    """Probability distribution of a recipe value or, for a gain in e-/DN, of its reciprocal."""

    kind: str
    text: str  #: as written in the recipe
    shape: Shape  #: of the number as written, in SI
    unit: str  #: SI unit of a draw; empty for a number without a unit
    reciprocal: bool = False  #: whether a draw is the reciprocal of a number from the distribution
    file: Path | None = None  #: file of the samples of an empirical distribution
    written_path: str = ""  #: of this file, as in the text

    def at(self, z: FloatArray) -> FloatArray:
        """Return the values of the distribution at the cumulative probabilities of standard
        normal numbers ``z``.
        """
        number = self.shape.at(np.asarray(z, np.float64))
        with np.errstate(divide="ignore"):
            return np.asarray(1.0 / number if self.reciprocal else number, np.float64)

    @property
    def median(self) -> float:
        """Return the median of the distribution; a run uses the median unless it samples the
        distribution.
        """
        return float(self.at(np.zeros(())))

    def other_than(self, value: float) -> float:
        """Return a value of the distribution that differs from ``value``, or ``value`` itself if
        all others are rarer than 1e-9.
        """
        values = self.at(np.array(_PROBES))
        return float(next((x for x in values if x != value), value))

    @property
    def multiplies(self) -> bool:
        """Return True if a difference with this distribution is a factor (lognormal and
        loguniform).
        """
        shape = self.shape.shape if isinstance(self.shape, Truncated) else self.shape
        return isinstance(shape, LogNormal | LogUniform)

    @property
    def full_text(self) -> str:
        """Return the text with the absolute path of the file of samples, which is valid in any
        folder.
        """
        if self.file is None:
            return self.text
        return self.text.replace(self.written_path, f'"{self.file.resolve()}"', 1)

    @property
    def identity(self) -> str:
        """Return a text that differs for any two distributions, also for samples of a file whose
        content differs.
        """
        samples = self.shape.identity if isinstance(self.shape, Discrete) else ""
        return f"{self.text} {samples}".strip()

    def truncated(self, low: float, high: float) -> Law:
        """Return the distribution truncated to bounds in SI, which hold for the number as written;
        raise ValueError if almost nothing is left.
        """
        return replace(self, shape=self.shape.truncated(low, high))


def draw_laws(
    laws: Mapping[str, Law], count: int, seed: Sequence[int], first: int = 0
) -> dict[str, list[float]]:
    """Return ``count`` independent draws of each distribution in SI, from draw number ``first`` on,
    by the name of the distribution.
    """
    z = np.random.default_rng(list(seed)).standard_normal((first + count, len(laws)))[first:]
    return {name: law.at(z[:, i]).tolist() for i, (name, law) in enumerate(laws.items())}


def written(value: float, unit: str) -> str | float:
    """Return a value in SI as it is written in a recipe: a number, or a text with the unit."""
    return f"{value!r} {unit}" if unit else value
