"""A density that approximates the posterior of a camera: noise widths, and parameters near zero."""

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

    #: parameters of a conditional distribution, for every set of widths (draw, ...)
    Law = tuple[FloatArray, ...]


# --- camera density -------------------------------------------------------------------------------

# A density of all parameters of a camera: a mixture density of its noise widths, and a distribution
# of all other parameters conditional on the widths.


class Others(Protocol):
    """The distribution of all other parameters conditional on the widths."""

    at: NDArray[np.bool_]  #: (free,) True for a width

    def law(self, widths: FloatArray) -> Law:
        """Return the conditional distribution for each set of ``widths`` (draw, width)."""

    def draw(self, widths: FloatArray, law: Law, rng: Random) -> FloatArray:
        """Return samples (draw, free) with the given ``widths``, from the distributions ``law``."""

    def log_density(self, samples: FloatArray, law: Law) -> FloatArray:
        """Return the conditional log density of the other parameters at ``samples``, up to a
        constant.
        """


@dataclass(frozen=True)
class CameraDensity:
    """A density of all parameters: a density of the widths, and a distribution of the others
    conditional on the widths.
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
        """Return new samples, and the log ratio of the density at ``own`` (draw, free) to the
        density at each new sample.
        """
        # both densities in one pass: the old samples first, the new ones after them
        old_and_new_widths = np.concatenate(
            [own[:, self.others.at], self.widths.draw(len(own), rng)]
        )
        conditional, old_rows, new_rows = (
            self.others.law(old_and_new_widths),
            slice(None, len(own)),
            slice(len(own), None),
        )
        new_samples = self.others.draw(
            old_and_new_widths[new_rows], tuple(array[new_rows] for array in conditional), rng
        )
        log_density = self.widths.log_density(old_and_new_widths) + self.others.log_density(
            np.concatenate([own, new_samples]), conditional
        )
        return new_samples, log_density[old_rows] - log_density[new_rows]


# --- given widths ---------------------------------------------------------------------------------

# A density that approximates the posterior of a real camera, whose noise widths are parameters
# themselves.
#
# The widths come from a mixture. Given the widths, the model is nearly a weighted least-squares
# fit, so that all other parameters are nearly normal, with a mean and a covariance that follow from
# the widths. A normal density or a mixture of all parameters together cannot follow how a wide
# drift makes the dark signal uncertain.


_FREEDOM = 20.0  #: degrees of freedom of the distribution of the other parameters
#: changes of the logarithm of a width that make it negligible, or dominant
_NO_WIDTH, _ENLARGED_WIDTH = -20.0, 5.0
_MOST_LOG_RATIO = (
    60.0  #: largest logarithm of a ratio of variances, so that a precision stays finite
)


class GivenWidths:
    """The conditional distribution of all other parameters of a camera given its noise widths,
    linearised at the mode.
    """

    def __init__(self, problem: SensorPosterior, mode: LaplaceFit) -> None:
        self.theta = mode.theta
        #: (free,) True for a width
        self.at = np.array([name in problem.coordinates.widths for name in problem.names])
        mode_in_prior_sd = problem.whitened(mode.theta[None])[0]
        # change in standard deviations of the prior when one coordinate grows by 1
        prior_sd_per_coordinate = (
            problem.whitened(mode.theta + np.eye(len(mode.theta))) - mode_in_prior_sd
        )
        #: (other,) the mode in standard deviations of the prior, from its middle
        self.middle = mode_in_prior_sd[~self.at]
        #: (other,) coordinates of one standard deviation of the prior
        self.unit = 1 / prior_sd_per_coordinate.diagonal()[~self.at]
        mode_residuals, _ = _parts(problem.likelihood(mode.theta[None]).scaled.numpy())
        slopes = _parts(mode.scaled_slopes.T)[0].T[:, ~self.at]
        # residual times its derivatives: their weighted sum is the gradient of the log likelihood
        self._pull = slopes * mode_residuals[0][:, None]
        self._noise, self._shares = self._variances(problem)
        # each residual's outer product of derivatives, flattened: their weighted sum is the
        # precision
        self._squares = (slopes[:, :, None] * slopes[:, None]).reshape(len(slopes), -1)

    def law(self, widths: FloatArray) -> Law:
        """Return mean (draw, other) and Cholesky root of the precision (draw, other, other), in
        units of the prior.
        """
        log_slope, precision = self.information(widths)
        # a Newton step from the mode leads to the maximum of a normal density
        mean_shift: FloatArray = np.linalg.solve(precision, log_slope[..., None])[..., 0].astype(
            np.float64
        )
        return mean_shift, np.linalg.cholesky(precision).astype(np.float64)

    def information(self, widths: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the gradient (draw, other) of the log density at the mode, and the precision
        (draw, other, other).
        """
        width_variances = np.exp(
            (2 * (widths - self.theta[self.at])).clip(-_MOST_LOG_RATIO, _MOST_LOG_RATIO)
        )
        # weights are inverse variances; each variance is linear in the squares of the widths
        residual_weights = 1 / (self._noise + width_variances @ self._shares)
        other_count = self._pull.shape[1]
        # J' W J of the residuals, plus the unit precision of the prior
        precision = (residual_weights @ self._squares).reshape(
            -1, other_count, other_count
        ) + np.eye(other_count)
        return -(residual_weights @ self._pull + self.middle), precision

    def _variances(self, problem: SensorPosterior) -> tuple[FloatArray, FloatArray]:
        """Return the part of each residual's variance that depends on no width, and the part
        (width, residual) due to each width.

        Variances are relative to those at the mode and linear in the square of each width.
        """
        log_width_change = np.full((2 + self.at.sum(), self.at.sum()), _NO_WIDTH)
        # row 0 is the mode, row 1 has no width, and each further row has one width alone, enlarged
        log_width_change[0] = 0.0
        np.fill_diagonal(log_width_change[2:], _ENLARGED_WIDTH)
        coordinates = np.repeat(self.theta[None], len(log_width_change), 0)
        coordinates[:, self.at] += log_width_change
        log_sd = _parts(problem.likelihood(coordinates).scaled.numpy())[1]
        relative_variance = np.exp(2 * (log_sd - log_sd[0]))
        # divided by the square of the factor exp(5) by which a width was enlarged
        return relative_variance[1], (relative_variance[2:] - relative_variance[1]).clip(
            0
        ) * np.exp(-2 * _ENLARGED_WIDTH)

    def draw(self, widths: FloatArray, law: Law, rng: Random) -> FloatArray:
        """Return samples (draw, free) with the given ``widths``, from the distributions ``law``."""
        mean_shift, precision_root = law
        samples = np.empty((len(mean_shift), len(self.at)))
        samples[:, self.at] = widths
        samples[:, ~self.at] = (
            self.theta[~self.at] + (mean_shift + draw_student(precision_root, rng)) * self.unit
        )
        return samples

    def log_density(self, samples: FloatArray, law: Law) -> FloatArray:
        """Return the conditional log density of the other parameters at ``samples``, up to a
        constant.
        """
        mean_shift, precision_root = law
        # in prior standard deviations, as `law`; the last term is the Jacobian of this change of
        # units
        distance = (samples[:, ~self.at] - self.theta[~self.at]) / self.unit - mean_shift
        return student_density(distance, precision_root) - float(np.log(np.abs(self.unit)).sum())


def draw_student(root: FloatArray, rng: Random) -> FloatArray:
    """Return random deviations (draw, other) from the mean; ``root`` (draw, other, other) is the
    lower Cholesky factor of the precision.
    """
    # a normal draw over the root of chi² / degrees of freedom has Student's distribution
    student_draws = rng.standard_normal(root.shape[:2]) / np.sqrt(
        rng.chisquare(_FREEDOM, (len(root), 1)) / _FREEDOM
    )
    distance: FloatArray = np.linalg.solve(np.swapaxes(root, 1, 2), student_draws[..., None])[
        ..., 0
    ].astype(np.float64)
    return distance


def student_density(away: FloatArray, root: FloatArray) -> FloatArray:
    """Return the log density at deviations ``away`` from the mean, up to the constant that
    `Mixture` omits too.
    """
    half_freedom, dimension = 0.5 * _FREEDOM, away.shape[1]
    squared_distance = (np.einsum("nij,ni->nj", root, away) ** 2).sum(1)
    # log density of Student's t distribution: its peak minus the decay with the squared distance
    log_peak = (
        math.lgamma(half_freedom + 0.5 * dimension)
        - math.lgamma(half_freedom)
        - 0.5 * dimension * math.log(_FREEDOM)
    )
    log_peak += np.log(np.diagonal(root, axis1=1, axis2=2)).sum(1)
    log_density: FloatArray = log_peak - (half_freedom + 0.5 * dimension) * np.log1p(
        squared_distance / _FREEDOM
    )
    return log_density


def _parts(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return residuals (..., residual) and the logarithms of their standard deviations.

    The last axis of a camera's likelihood has four equal parts: residuals of the variances,
    logarithms of their standard deviations, residuals of the means, logarithms of their standard
    deviations.
    """
    variance_residuals, log_variance_sd, mean_residuals, log_mean_sd = np.split(rows, 4, axis=-1)
    return np.concatenate([variance_residuals, mean_residuals], -1), np.concatenate(
        [log_variance_sd, log_mean_sd], -1
    )


# --- value near zero ------------------------------------------------------------------------------

# The distribution of a positive parameter that is hardly distinguishable from 0, and of all others,
# conditional on the noise widths.
#
# The levels depend on the parameter itself, for example on a dark current, and a sampler moves in
# its logarithm. Given the widths the parameter is nearly normal, with a prior of its logarithm: the
# logarithm has a long lower tail, in which the levels see a 0 and the prior alone decides. This
# density is computed on a grid of the logarithm for each set of widths. All others are nearly
# normal given the widths and the parameter, with a mean that is linear in the parameter.


#: number of grid cells, and half-width of the grid around the middle of the prior in prior standard
#: deviations
_GRID_CELLS, _GRID_REACH = 240, 8.0
_WIDE_SHARE, _WIDE_POWER = 0.15, 0.4  #: share and power of the part with wider tails
#: largest change of the logarithm, so that the square of the parameter stays finite
_FARTHEST_NEAR_ZERO = 300.0
_SMALLEST_DENSITY = 1e-300  #: smallest density whose logarithm is finite


class NearZero:
    """The conditional distribution of the parameter with index ``number``, and of all others, given
    the noise widths of a camera.
    """

    def __init__(self, others: GivenWidths, number: int, spread: float) -> None:
        self.at, self._theta = others.at, others.theta
        self._others, is_parameter = others, np.arange(len(others.theta)) == number
        self._own, self._rest = is_parameter[~others.at], ~is_parameter & ~others.at
        self._number, self._unit = number, float(others.unit[self._own][0])
        self._units, self._scale = others.unit[~self._own], float(np.log(np.abs(others.unit)).sum())
        self._middle = float(others.middle[self._own][0])
        grid_scale = abs(spread / self._unit)
        # grid points at equal steps of asinh: dense around the mode, sparse far from it
        grid_start, grid_end = np.arcsinh(
            (np.array([-_GRID_REACH, _GRID_REACH]) - self._middle) / grid_scale
        )
        #: grid points as distances from the mode, in prior standard deviations
        self._points = grid_scale * np.sinh(np.linspace(grid_start, grid_end, _GRID_CELLS + 1))
        self._sizes = np.diff(self._points)
        #: weights of the trapezoidal rule
        self._counts = 0.5 * (np.append(self._sizes, 0.0) + np.append(0.0, self._sizes))
        self._value = self._value_at(self._points)
        self._prior = -0.5 * (self._points + self._middle) ** 2

    def law(self, widths: FloatArray) -> Law:
        """Return the conditional distribution for each set of ``widths`` (draw, width).

        The density (draw, point) of the logarithm; the mean (draw, other) of all others at the mode
        of the parameter, its change (draw, other) with the parameter, and the root (draw, other,
        other) of their precision. All are in units of the prior.
        """
        log_slope, precision = self._others.information(widths)
        is_own, is_other = self._own, ~self._own
        # remove the parameter's prior, which applies to its logarithm and is added on the grid
        own_slope = log_slope[:, is_own][:, 0] + self._middle
        own_precision = precision[:, is_own][:, :, is_own][:, 0, 0] - 1
        cross_precision = precision[:, is_other][:, :, is_own]
        precision_root = np.linalg.cholesky(precision[:, is_other][:, :, is_other])
        # solve for two right-hand sides at once: column 0 is the gradient, column 1 the coupling
        right_sides = np.concatenate([log_slope[:, is_other][..., None], cross_precision], -1)
        solved = np.linalg.solve(precision_root, right_sides)
        steps, coupling = np.moveaxis(
            np.linalg.solve(np.swapaxes(precision_root, 1, 2), solved), -1, 0
        )
        # Schur complement: marginal precision of the parameter, with all others integrated out
        marginal_precision = (own_precision - (solved[..., 1] ** 2).sum(1)).clip(0)
        marginal_slope = own_slope - (solved[..., 0] * solved[..., 1]).sum(1)
        # log density on the grid: a parabola in the parameter itself, plus the prior of its
        # logarithm; a part of the density gets wider tails, so that no weight becomes too large
        log_density = (
            marginal_slope[:, None] * self._value
            - 0.5 * marginal_precision[:, None] * self._value**2
            + self._prior
        )
        log_density -= log_density.max(1, keepdims=True)
        density = (1 - _WIDE_SHARE) * self._normalised(
            np.exp(log_density)
        ) + _WIDE_SHARE * self._normalised(np.exp(_WIDE_POWER * log_density))
        return density, steps, -coupling, precision_root.astype(np.float64)

    def draw(self, widths: FloatArray, law: Law, rng: Random) -> FloatArray:
        """Return samples (draw, free) with the given ``widths``, from the distributions ``law``."""
        density, steps, coupling, precision_root = law
        position = self._place(density, uniform(len(widths), rng))
        samples = np.empty((len(widths), len(self.at)))
        samples[:, self.at] = widths
        samples[:, self._number] = self._theta[self._number] + position * self._unit
        distance = (
            steps + self._value_at(position)[:, None] * coupling + draw_student(precision_root, rng)
        )
        samples[:, self._rest] = self._theta[self._rest] + distance * self._units
        return samples

    def log_density(self, samples: FloatArray, law: Law) -> FloatArray:
        """Return the log density of all parameters except the widths at ``samples``, up to a
        constant.
        """
        density, steps, coupling, precision_root = law
        position = (samples[:, self._number] - self._theta[self._number]) / self._unit
        cell, cell_fraction = self._cell(position)
        draw_number = np.arange(len(position))
        # linear between the points of the grid, 0 beyond its ends
        own_density = (1 - cell_fraction) * density[draw_number, cell] + cell_fraction * density[
            draw_number, cell + 1
        ]
        # lgamma(0.5): the constant that `Mixture` omits too
        own_log_density = np.log(
            np.where((cell_fraction >= 0) & (cell_fraction <= 1), own_density, 0.0).clip(
                _SMALLEST_DENSITY
            )
        ) + math.lgamma(0.5)
        distance = (
            (samples[:, self._rest] - self._theta[self._rest]) / self._units
            - steps
            - self._value_at(position)[:, None] * coupling
        )
        log_density: FloatArray = (
            own_log_density + student_density(distance, precision_root) - self._scale
        )
        return log_density

    def _value_at(self, place: FloatArray) -> FloatArray:
        """Return the change of the parameter between the mode and ``place``, a change of its
        logarithm, scaled to equal ``place`` for small changes.
        """
        change: FloatArray = (
            np.expm1((place * self._unit).clip(max=_FARTHEST_NEAR_ZERO)) / self._unit
        )
        return change

    def _normalised(self, density: FloatArray) -> FloatArray:
        """Return each density (draw, point) divided by its integral over the grid."""
        normalised: FloatArray = density / (density @ self._counts)[:, None]
        return normalised

    def _cell(self, place: FloatArray) -> tuple[NDArray[np.intp], FloatArray]:
        """Return the grid cell of each place, and the relative position in the cell from 0 to 1."""
        cell = np.searchsorted(self._points, place).clip(1, _GRID_CELLS) - 1
        return cell, (place - self._points[cell]) / self._sizes[cell]

    def _place(self, density: FloatArray, chance: FloatArray) -> FloatArray:
        """Return the quantile on the grid for each probability ``chance`` (draw,).

        It inverts the cumulative distribution of each density (draw, point), which is linear within
        a cell.
        """
        cell_sizes = self._sizes
        # cumulative integral by the trapezoidal rule
        cumulative = np.cumsum(0.5 * (density[:, 1:] + density[:, :-1]) * cell_sizes, 1)
        # index of the cell that contains the quantile
        cell = (cumulative < (chance * cumulative[:, -1])[:, None]).sum(1).clip(max=_GRID_CELLS - 1)
        draw_number = np.arange(len(chance))
        remainder = chance * cumulative[:, -1] - np.where(
            cell > 0, cumulative[draw_number, cell - 1], 0.0
        )
        left_density, right_density = density[draw_number, cell], density[draw_number, cell + 1]
        # root t of left * t + (right - left) * t^2 / 2 = remainder / size, in the form without
        # cancellation
        mean_height = remainder / cell_sizes[cell]
        cell_fraction = (
            2
            * mean_height
            / (
                left_density
                + np.sqrt(
                    (left_density**2 + 2 * (right_density - left_density) * mean_height).clip(0)
                )
            ).clip(_SMALLEST_DENSITY)
        )
        position: FloatArray = self._points[cell] + cell_fraction.clip(0, 1) * cell_sizes[cell]
        return position


# --- tail density ---------------------------------------------------------------------------------

# A density with parts for the long lower tails of positive parameters that are hardly
# distinguishable from 0.
#
# The data see such a parameter as 0 where its logarithm falls, so that the posterior is there the
# prior, of several units. A density that is fitted about the mode seldom proposes from the tail, in
# which a walker then stays.


#: standard deviation of a logarithm from which its lower tail counts: 0 is then eight deviations
#: away
_DOUBTFUL_SD = 0.12
_LEAST_PART_SHARE, _SHARE_STEPS = (
    0.03,
    20,
)  #: least share of a part, and number of steps to find the shares
#: share of the tail parts in the density, their distance below the mode, and their degrees of
#: freedom
_TAIL_SHARE_OF_DENSITY, _TAIL_REACH, _TAIL_FREEDOM = 0.05, 2.5, 6.0


@dataclass(frozen=True)
class TailDensity(Density):
    """A density with a fixed share from a mixture for the tails; both are normalised alike."""

    body: Density
    tails: Mixture

    def draw(self, count: int, rng: Random) -> FloatArray:
        """Draw samples (count, free)."""
        from_tails = uniform(count, rng) < _TAIL_SHARE_OF_DENSITY
        samples: FloatArray = np.where(
            from_tails[:, None], self.tails.draw(count, rng), self.body.draw(count, rng)
        )
        return samples

    def log_density(self, samples: FloatArray) -> FloatArray:
        """Return the logarithm of the density at samples (draw, free), up to a constant."""
        body_log, tail_log = self.body.log_density(samples), self.tails.log_density(samples)
        return log_sum(
            np.stack(
                [
                    body_log + np.log1p(-_TAIL_SHARE_OF_DENSITY),
                    tail_log + np.log(_TAIL_SHARE_OF_DENSITY),
                ],
                -1,
            )
        )


def hardly_told(
    problem: SensorPosterior, mode: LaplaceFit, doubt: float = _DOUBTFUL_SD
) -> list[int]:
    """Return the indices of the positive parameters that are hardly distinguishable from 0, the
    least certain first.

    These have logarithms with a standard deviation above ``doubt`` at the mode.
    """
    log_sd = np.sqrt(np.diagonal(mode.covariance))
    not_logarithms = problem.coordinates.linear | problem.coordinates.widths
    numbers = [
        i
        for i, name in enumerate(problem.names)
        if name not in not_logarithms and log_sd[i] > doubt
    ]
    return sorted(numbers, key=lambda i: -log_sd[i])


def with_tails(body: Density, numbers: Sequence[int], mode: LaplaceFit) -> Density:
    """Return a density with a tail part for each parameter in ``numbers``; ``body`` itself if there
    are none.

    In a tail part all other parameters follow a linear regression at the mode, with the deviations
    that they have for a known value, because the levels depend on the parameter itself and not on
    its logarithm.
    """
    if not numbers:
        return body
    centres, roots = zip(
        *(_tail_part(mode.theta, mode.covariance, i) for i in numbers), strict=True
    )
    shares = np.full(len(numbers), 1 / len(numbers))
    return TailDensity(body, Mixture(shares, np.stack(centres), np.stack(roots), _TAIL_FREEDOM))


def with_prior_tails(
    body: Mixture,
    problem: SensorPosterior,
    mode: LaplaceFit,
    is_width: NDArray[np.bool_],
    weighted: tuple[FloatArray, ...],
) -> Mixture:
    """Return a density of the widths (``is_width``) with an extra part for each width, in which
    this width follows its prior.

    Small widths do not affect the levels, so that only the prior constrains them. All other widths
    are distributed as in ``body``. The shares of the parts are fitted to ``weighted``: samples
    (draw, width) of the posterior and their weights (draw,).
    """
    mode_in_prior_sd = problem.whitened(mode.theta[None])[0]
    # coordinates of one standard deviation of the prior of each width
    prior_sd = (
        1 / (problem.whitened(mode.theta + np.eye(len(mode.theta))) - mode_in_prior_sd).diagonal()
    )[is_width]
    mean = body.shares @ body.centres
    centre_distance = body.centres - mean
    # covariance of the whole mixture: mean covariance of its parts, plus covariance of their
    # centres
    covariance = np.einsum(
        "k,kij,klj->il", body.shares, body.roots, body.roots
    ) + centre_distance.T @ (body.shares[:, None] * centre_distance)
    centres, roots = np.repeat(mean[None], len(mean), 0), []
    for i, unit in enumerate(prior_sd):
        # the middle of the prior of this width
        centres[i, i] = mode.theta[is_width][i] - mode_in_prior_sd[is_width][i] * unit
        roots.append(_root(_covariance_given(covariance, i), i, unit))
    width_tails = [
        Mixture(np.ones(1), centre[None], root[None], _TAIL_FREEDOM)
        for centre, root in zip(centres, roots, strict=True)
    ]
    # the shares that maximise the likelihood of the samples
    body_share, *tail_shares = _shares([body, *width_tails], *weighted)
    body_freedom = np.broadcast_to(body.tails, body.shares.shape)
    return Mixture(
        np.concatenate([body_share * body.shares, tail_shares]),
        np.concatenate([body.centres, centres]),
        np.concatenate([body.roots, np.stack(roots)]),
        np.concatenate([body_freedom, np.full(len(tail_shares), _TAIL_FREEDOM)]),
    )


def _shares(parts: Sequence[Mixture], samples: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the shares of the parts that maximise the likelihood of weighted samples.

    Each share is at least `_LEAST_PART_SHARE` before the shares are normalised. Each step of
    expectation maximisation sets the share of a part to the mean probability that a sample belongs
    to it.
    """
    log_densities = np.stack([mixture.log_density(samples) for mixture in parts], -1)
    part_shares = np.full(len(parts), 1 / len(parts))
    for _ in range(_SHARE_STEPS):
        log_joint = log_densities + np.log(part_shares)
        part_shares = np.maximum(
            weight @ np.exp(log_joint - log_sum(log_joint)[:, None]), _LEAST_PART_SHARE
        )
        part_shares /= part_shares.sum()
    return part_shares


def _tail_part(theta: FloatArray, covariance: FloatArray, i: int) -> tuple[FloatArray, FloatArray]:
    """Return centre (free,) and Cholesky root (free, free) of the tail part for the logarithm with
    index ``i``.
    """
    # the other parameters follow their regression on `i`
    tail_centre = theta - covariance[:, i] / covariance[i, i]
    tail_centre[i] = theta[i] - _TAIL_REACH
    return tail_centre, _root(_covariance_given(covariance, i), i, _TAIL_REACH / np.sqrt(2))


def _covariance_given(covariance: FloatArray, i: int) -> FloatArray:
    """Return the covariance of all other parameters conditional on parameter ``i``."""
    conditional: FloatArray = (
        covariance - np.outer(covariance[:, i], covariance[i]) / covariance[i, i]
    )
    return conditional


def _root(covariance: FloatArray, i: int, spread: float) -> FloatArray:
    """Return the Cholesky root of a covariance in which parameter ``i`` is independent with the
    standard deviation ``spread``.

    ``covariance`` is that of all others conditional on ``i``, and is changed in place.
    """
    covariance[i], covariance[:, i] = 0.0, 0.0
    covariance[i, i] = spread**2
    return np.linalg.cholesky(firm(covariance)).astype(np.float64)
