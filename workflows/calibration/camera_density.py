"""A density like the posterior of a camera: widths of noise, and values near zero."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from neusee.workflows.calibration.posterior_mixture import (
    Density,
    Mixture,
    Random,
    firm,
    log_sum,
    uniform,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from neusee.workflows.calibration.log_posterior import FloatArray, LaplaceFit, SensorPosterior

    #: the numbers of a distribution, each for every set of widths (draw, ...)
    Law = tuple[FloatArray, ...]


# --- camera density -------------------------------------------------------------------------------

# A density of all parameters of a camera: a mixture of the widths of its noise, and of all others
# given the widths.


class Others(Protocol):
    """The distribution of all other parameters given the widths."""

    at: NDArray[np.bool_]  #: (free,) True for a width

    def law(self, widths: FloatArray) -> Law:
        """Return the distribution for each set of ``widths`` (draw, width)."""

    def draw(self, widths: FloatArray, law: Law, rng: Random) -> FloatArray:
        """Return samples (draw, free) with the given ``widths`` and their ``law``."""

    def log_density(self, samples: FloatArray, law: Law) -> FloatArray:
        """Return the log density of the other parameters at ``samples`` given the widths, up to
        a constant.
        """


@dataclass(frozen=True)
class CameraDensity:
    """A density of all parameters: a mixture of the widths, and the distribution of all others
    given the widths.
    """

    widths: Density
    others: Others

    def draw(self, count: int, rng: Random) -> FloatArray:
        """Draw samples (count, free)."""
        widths = self.widths.draw(count, rng)
        return self.others.draw(widths, self.others.law(widths), rng)

    def log_density(self, samples: FloatArray) -> FloatArray:
        """Return the logarithm of the density at samples (draw, free), up to a constant."""
        widths = samples[:, self.others.at]
        return self.widths.log_density(widths) + self.others.log_density(
            samples, self.others.law(widths)
        )

    def propose(self, own: FloatArray, rng: Random) -> tuple[FloatArray, FloatArray]:
        """Return new samples like ``own`` (draw, free), and the logarithm of the density at
        ``own`` over that there.
        """
        widths = np.concatenate([own[:, self.others.at], self.widths.draw(len(own), rng)])
        law, here, added = self.others.law(widths), slice(None, len(own)), slice(len(own), None)
        drawn = self.others.draw(widths[added], tuple(array[added] for array in law), rng)
        log = self.widths.log_density(widths) + self.others.log_density(
            np.concatenate([own, drawn]), law
        )
        return drawn, log[here] - log[added]


# --- given widths ---------------------------------------------------------------------------------

# A density like the posterior of a real camera, whose noise has widths that are parameters
# themselves.
#
# The widths come from a mixture. Given the widths, the model is nearly a weighted least-squares
# fit, so that all other parameters are nearly normal, with a mean and a covariance that follow from
# the widths. A normal density or a mixture of all parameters together cannot follow how a wide
# drift makes the dark signal uncertain.


_TAIL = 20.0  #: degrees of freedom of the other parameters, given the widths
#: changes of the logarithm of a width, so that it counts for nothing, or for all
_NONE, _MORE = -20.0, 5.0
_FARTHEST = 60.0  #: largest logarithm of a ratio of variances, so that a precision stays a number


class GivenWidths:
    """The distribution of all other parameters of a camera given the widths of its noise, linear
    about the mode.
    """

    def __init__(self, problem: SensorPosterior, mode: LaplaceFit) -> None:
        self.theta = mode.theta
        #: (free,) True for a width
        self.at = np.array([name in problem.coordinates.widths for name in problem.names])
        middle = problem.whitened(mode.theta[None])[0]
        steps = problem.whitened(mode.theta + np.eye(len(mode.theta))) - middle
        #: (other,) the mode in standard deviations of the prior, from its middle
        self.middle = middle[~self.at]
        #: (other,) coordinates of one standard deviation of the prior
        self.unit = 1 / steps.diagonal()[~self.at]
        away, _ = _parts(problem.likelihood(mode.theta[None]).scaled.numpy())
        slopes = _parts(mode.scaled_slopes.T)[0].T[:, ~self.at]
        self._pull = slopes * away[0][:, None]
        self._noise, self._shares = self._variances(problem)
        self._squares = (slopes[:, :, None] * slopes[:, None]).reshape(len(slopes), -1)

    def law(self, widths: FloatArray) -> Law:
        """Return mean (draw, other) and root of the precision (draw, other, other), in units of
        the prior.
        """
        slope, precision = self.information(widths)
        step: FloatArray = np.linalg.solve(precision, slope[..., None])[..., 0].astype(np.float64)
        return step, np.linalg.cholesky(precision).astype(np.float64)

    def information(self, widths: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return slope (draw, other) of the log density at the mode, and precision (draw, other,
        other).
        """
        squares = np.exp((2 * (widths - self.theta[self.at])).clip(-_FARTHEST, _FARTHEST))
        weight = 1 / (self._noise + squares @ self._shares)
        others = self._pull.shape[1]
        precision = (weight @ self._squares).reshape(-1, others, others) + np.eye(others)
        return -(weight @ self._pull + self.middle), precision

    def _variances(self, problem: SensorPosterior) -> tuple[FloatArray, FloatArray]:
        """Return the part of the variance of each residual that no width adds, and the part (width,
        residual) of each.

        The variance is that at the mode, 1, and is linear in the square of each width.
        """
        change = np.full((2 + self.at.sum(), self.at.sum()), _NONE)
        change[0] = 0.0
        np.fill_diagonal(change[2:], _MORE)
        places = np.repeat(self.theta[None], len(change), 0)
        places[:, self.at] += change
        log = _parts(problem.likelihood(places).scaled.numpy())[1]
        variance = np.exp(2 * (log - log[0]))
        return variance[1], (variance[2:] - variance[1]).clip(0) * np.exp(-2 * _MORE)

    def draw(self, widths: FloatArray, law: Law, rng: Random) -> FloatArray:
        """Return samples (draw, free) with the given ``widths`` and their ``law``."""
        step, root = law
        samples = np.empty((len(step), len(self.at)))
        samples[:, self.at] = widths
        samples[:, ~self.at] = self.theta[~self.at] + (step + draw_student(root, rng)) * self.unit
        return samples

    def log_density(self, samples: FloatArray, law: Law) -> FloatArray:
        """Return the log density of the other parameters at ``samples`` given the widths, up to
        a constant.
        """
        step, root = law
        away = (samples[:, ~self.at] - self.theta[~self.at]) / self.unit - step
        return student_density(away, root) - float(np.log(np.abs(self.unit)).sum())


def draw_student(root: FloatArray, rng: Random) -> FloatArray:
    """Return distances (draw, other) from the mean, with the ``root`` (draw, other, other) of
    their precision.
    """
    normal = rng.standard_normal(root.shape[:2]) / np.sqrt(
        rng.chisquare(_TAIL, (len(root), 1)) / _TAIL
    )
    away: FloatArray = np.linalg.solve(np.swapaxes(root, 1, 2), normal[..., None])[..., 0].astype(
        np.float64
    )
    return away


def student_density(away: FloatArray, root: FloatArray) -> FloatArray:
    """Return the log density at distances from the mean, up to the constant that `Mixture`
    leaves out too.
    """
    half, others = 0.5 * _TAIL, away.shape[1]
    square = (np.einsum("nij,ni->nj", root, away) ** 2).sum(1)
    level = math.lgamma(half + 0.5 * others) - math.lgamma(half) - 0.5 * others * math.log(_TAIL)
    level += np.log(np.diagonal(root, axis1=1, axis2=2)).sum(1)
    log: FloatArray = level - (half + 0.5 * others) * np.log1p(square / _TAIL)
    return log


def _parts(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return residuals (..., residual) and logarithms of their widths from the rows of the
    likelihood of a camera.
    """
    variance, narrow, mean, width = np.split(rows, 4, axis=-1)
    return np.concatenate([variance, mean], -1), np.concatenate([narrow, width], -1)


# --- value near zero ------------------------------------------------------------------------------

# The distribution of a positive parameter that is hardly told from 0, and of all others, given the
# widths of noise.
#
# The levels depend on the parameter itself, for example on a dark current, and a sampler moves in
# its logarithm. Given the widths the parameter is nearly normal, with a prior of its logarithm: the
# logarithm has a long lower tail, in which the levels see a 0 and the prior alone decides. This
# density is computed on a grid of the logarithm for each set of widths. All others are nearly
# normal given the widths and the parameter, with a mean that is linear in the parameter.


#: cells of the grid, and its reach about the middle of the prior, in its deviations
_CELLS, _REACH = 240, 8.0
_SAFE, _POWER = 0.15, 0.4  #: share and power of the part with wider tails
#: largest change of the logarithm, so that the square of the parameter stays a number
_FARTHEST_NEAR_ZERO = 300.0
_BARE = 1e-300  #: a density of which a logarithm can be taken


class NearZero:
    """The distribution of the parameter ``number`` and of all others, given the widths of the
    noise of a camera.
    """

    def __init__(self, others: GivenWidths, number: int, spread: float) -> None:
        self.at, self._theta = others.at, others.theta
        self._others, own = others, np.arange(len(others.theta)) == number
        self._own, self._rest = own[~others.at], ~own & ~others.at
        self._number, self._unit = number, float(others.unit[self._own][0])
        self._units, self._scale = others.unit[~self._own], float(np.log(np.abs(others.unit)).sum())
        self._middle = float(others.middle[self._own][0])
        narrow = abs(spread / self._unit)
        low, high = np.arcsinh((np.array([-_REACH, _REACH]) - self._middle) / narrow)
        #: from the mode, in units of the prior
        self._points = narrow * np.sinh(np.linspace(low, high, _CELLS + 1))
        self._sizes = np.diff(self._points)
        #: of the trapezoidal rule
        self._counts = 0.5 * (np.append(self._sizes, 0.0) + np.append(0.0, self._sizes))
        self._value = self._value_at(self._points)
        self._prior = -0.5 * (self._points + self._middle) ** 2

    def law(self, widths: FloatArray) -> Law:
        """Return the distribution for each set of ``widths`` (draw, width).

        The density (draw, point) of the logarithm; the mean (draw, other) of all others at the mode
        of the parameter, its change (draw, other) with the parameter, and the root (draw, other,
        other) of their precision. All are in units of the prior.
        """
        slope, precision = self._others.information(widths)
        own, others = self._own, ~self._own
        # the prior of the parameter is that of its logarithm and joins on the grid
        slope_own = slope[:, own][:, 0] + self._middle
        own_own = precision[:, own][:, :, own][:, 0, 0] - 1
        across = precision[:, others][:, :, own]
        root = np.linalg.cholesky(precision[:, others][:, :, others])
        both = np.concatenate([slope[:, others][..., None], across], -1)
        solved = np.linalg.solve(root, both)
        steps, pull = np.moveaxis(np.linalg.solve(np.swapaxes(root, 1, 2), solved), -1, 0)
        curve = (own_own - (solved[..., 1] ** 2).sum(1)).clip(0)
        tilt = slope_own - (solved[..., 0] * solved[..., 1]).sum(1)
        log = tilt[:, None] * self._value - 0.5 * curve[:, None] * self._value**2 + self._prior
        log -= log.max(1, keepdims=True)
        density = (1 - _SAFE) * self._normalised(np.exp(log)) + _SAFE * self._normalised(
            np.exp(_POWER * log)
        )
        return density, steps, -pull, root.astype(np.float64)

    def draw(self, widths: FloatArray, law: Law, rng: Random) -> FloatArray:
        """Return samples (draw, free) with the given ``widths`` and their ``law``."""
        density, steps, pull, root = law
        place = self._place(density, uniform(len(widths), rng))
        samples = np.empty((len(widths), len(self.at)))
        samples[:, self.at] = widths
        samples[:, self._number] = self._theta[self._number] + place * self._unit
        away = steps + self._value_at(place)[:, None] * pull + draw_student(root, rng)
        samples[:, self._rest] = self._theta[self._rest] + away * self._units
        return samples

    def log_density(self, samples: FloatArray, law: Law) -> FloatArray:
        """Return the log density of all parameters but the widths at ``samples``, up to a
        constant.
        """
        density, steps, pull, root = law
        place = (samples[:, self._number] - self._theta[self._number]) / self._unit
        cell, share = self._cell(place)
        draw = np.arange(len(place))
        height = (1 - share) * density[draw, cell] + share * density[draw, cell + 1]
        # as `Mixture`
        own = np.log(np.where((share >= 0) & (share <= 1), height, 0.0).clip(_BARE)) + math.lgamma(
            0.5
        )
        away = (
            (samples[:, self._rest] - self._theta[self._rest]) / self._units
            - steps
            - self._value_at(place)[:, None] * pull
        )
        log: FloatArray = own + student_density(away, root) - self._scale
        return log

    def _value_at(self, place: FloatArray) -> FloatArray:
        """Return the change of the parameter from the mode to each place, in units that are
        those of a small change.
        """
        value: FloatArray = (
            np.expm1((place * self._unit).clip(max=_FARTHEST_NEAR_ZERO)) / self._unit
        )
        return value

    def _normalised(self, density: FloatArray) -> FloatArray:
        normalised: FloatArray = density / (density @ self._counts)[:, None]
        return normalised

    def _cell(self, place: FloatArray) -> tuple[NDArray[np.intp], FloatArray]:
        """Return the cell of each place, and the share of the cell that lies below the place."""
        cell = np.searchsorted(self._points, place).clip(1, _CELLS) - 1
        return cell, (place - self._points[cell]) / self._sizes[cell]

    def _place(self, density: FloatArray, chance: FloatArray) -> FloatArray:
        """Return the place below which lies the probability ``chance`` of each draw."""
        size = self._sizes
        below = np.cumsum(0.5 * (density[:, 1:] + density[:, :-1]) * size, 1)
        cell = (below < (chance * below[:, -1])[:, None]).sum(1).clip(max=_CELLS - 1)
        draw = np.arange(len(chance))
        left = chance * below[:, -1] - np.where(cell > 0, below[draw, cell - 1], 0.0)
        first, last = density[draw, cell], density[draw, cell + 1]
        # the root of first * t + (last - first) * t^2 / 2 = left / size, in the form that loses no
        # digits
        area = left / size[cell]
        share = (
            2 * area / (first + np.sqrt((first**2 + 2 * (last - first) * area).clip(0))).clip(_BARE)
        )
        place: FloatArray = self._points[cell] + share.clip(0, 1) * size[cell]
        return place


# --- tail density ---------------------------------------------------------------------------------

# A density with parts for the long lower tails of positive parameters that are hardly told from 0.
#
# The data see such a parameter as 0 where its logarithm falls, so that the posterior is there the
# prior, of several units. A density that is fitted about the mode seldom proposes from the tail, in
# which a walker then stays.


#: least deviation of a logarithm whose lower tail counts: 0 is then eight deviations away
_DOUBT = 0.12
_LEAST, _STEPS = 0.03, 20  #: least share of a part, and steps in which the shares are found
#: share of the parts, their distance below the mode, and degrees of freedom
_SHARE, _TAIL_REACH, _TAIL_SHARE = 0.05, 2.5, 6.0


@dataclass(frozen=True)
class TailDensity(Density):
    """A density of which a fixed share comes from a mixture for the tails; both are normalised
    alike.
    """

    body: Density
    tails: Mixture

    def draw(self, count: int, rng: Random) -> FloatArray:
        """Draw samples (count, free)."""
        from_tails = uniform(count, rng) < _SHARE
        samples: FloatArray = np.where(
            from_tails[:, None], self.tails.draw(count, rng), self.body.draw(count, rng)
        )
        return samples

    def log_density(self, samples: FloatArray) -> FloatArray:
        """Return the logarithm of the density at samples (draw, free), up to a constant."""
        body, tails = self.body.log_density(samples), self.tails.log_density(samples)
        return log_sum(np.stack([body + np.log1p(-_SHARE), tails + np.log(_SHARE)], -1))


def hardly_told(problem: SensorPosterior, mode: LaplaceFit, doubt: float = _DOUBT) -> list[int]:
    """Return the numbers of the positive parameters that are hardly told from 0, the least certain
    one first.

    These have logarithms with a standard deviation above ``doubt`` at the mode.
    """
    spread = np.sqrt(np.diagonal(mode.covariance))
    other = problem.coordinates.linear | problem.coordinates.widths
    numbers = [i for i, name in enumerate(problem.names) if name not in other and spread[i] > doubt]
    return sorted(numbers, key=lambda i: -spread[i])


def with_tails(body: Density, numbers: Sequence[int], mode: LaplaceFit) -> Density:
    """Return a density with a part for the tail of each parameter in ``numbers``, or ``body``
    without one.

    In such a part all other parameters lie where a line through the mode leads them, with the
    deviations that they have for a known value, because the levels depend on the parameter itself
    and not on its logarithm.
    """
    if not numbers:
        return body
    centres, roots = zip(*(_tail(mode.theta, mode.covariance, i) for i in numbers), strict=True)
    shares = np.full(len(numbers), 1 / len(numbers))
    return TailDensity(body, Mixture(shares, np.stack(centres), np.stack(roots), _TAIL_SHARE))


def with_prior_tails(
    body: Mixture,
    problem: SensorPosterior,
    mode: LaplaceFit,
    is_width: NDArray[np.bool_],
    weighted: tuple[FloatArray, ...],
) -> Mixture:
    """Return a density of the parameters ``is_width`` (free,) with a part for each width, in which
    this width has its prior.

    Below some width the levels see none, and the prior alone decides. All other widths lie as in
    ``body``. The shares of the parts follow from ``weighted``: samples (draw, width) of the
    posterior and their weights (draw,).
    """
    middle = problem.whitened(mode.theta[None])[0]
    units = (1 / (problem.whitened(mode.theta + np.eye(len(mode.theta))) - middle).diagonal())[
        is_width
    ]
    mean = body.shares @ body.centres
    away = body.centres - mean
    covariance = np.einsum("k,kij,klj->il", body.shares, body.roots, body.roots) + away.T @ (
        body.shares[:, None] * away
    )
    centres, roots = np.repeat(mean[None], len(mean), 0), []
    for i, unit in enumerate(units):
        centres[i, i] = mode.theta[is_width][i] - middle[is_width][i] * unit
        roots.append(_root(_given(covariance, i), i, unit))
    parts = [
        Mixture(np.ones(1), centre[None], root[None], _TAIL_SHARE)
        for centre, root in zip(centres, roots, strict=True)
    ]
    first, *shares = _shares([body, *parts], *weighted)
    tails = np.broadcast_to(body.tails, body.shares.shape)
    return Mixture(
        np.concatenate([first * body.shares, shares]),
        np.concatenate([body.centres, centres]),
        np.concatenate([body.roots, np.stack(roots)]),
        np.concatenate([tails, np.full(len(shares), _TAIL_SHARE)]),
    )


def _shares(parts: Sequence[Mixture], samples: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the share of each part with which a density is most like weighted samples; no part
    has less than a few.
    """
    logs = np.stack([mixture.log_density(samples) for mixture in parts], -1)
    shares = np.full(len(parts), 1 / len(parts))
    for _ in range(_STEPS):
        joint = logs + np.log(shares)
        shares = np.maximum(weight @ np.exp(joint - log_sum(joint)[:, None]), _LEAST)
        shares /= shares.sum()
    return shares


def _tail(theta: FloatArray, covariance: FloatArray, i: int) -> tuple[FloatArray, FloatArray]:
    """Return centre and root of the part for the logarithm ``i``."""
    centre = theta - covariance[:, i] / covariance[i, i]
    centre[i] = theta[i] - _TAIL_REACH
    return centre, _root(_given(covariance, i), i, _TAIL_REACH / np.sqrt(2))


def _given(covariance: FloatArray, i: int) -> FloatArray:
    """Return the covariance of all others for a known value of ``i``."""
    conditional: FloatArray = (
        covariance - np.outer(covariance[:, i], covariance[i]) / covariance[i, i]
    )
    return conditional


def _root(covariance: FloatArray, i: int, spread: float) -> FloatArray:
    """Return the root of a ``covariance`` given the value of ``i``, to which ``i`` joins with
    its own ``spread``.
    """
    covariance[i], covariance[:, i] = 0.0, 0.0
    covariance[i, i] = spread**2
    return np.linalg.cholesky(firm(covariance)).astype(np.float64)
