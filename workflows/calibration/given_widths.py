"""A density like the posterior of a real camera, whose noise has widths that are parameters themselves.

The widths come from a mixture. Given the widths, the model is nearly a weighted least-squares fit, so that all other
parameters are nearly normal, with a mean and a covariance that follow from the widths. A normal density or a mixture
of all parameters together cannot follow how a wide drift makes the dark signal uncertain.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from neusee.workflows.calibration.posterior_mixture import Random

if TYPE_CHECKING:
    from neusee.workflows.calibration.camera_density import Law
    from neusee.workflows.calibration.log_posterior import FloatArray, SensorPosterior
    from neusee.workflows.calibration.posterior_mode import LaplaceFit

_TAIL = 20.0  #: degrees of freedom of the other parameters, given the widths
_NONE, _MORE = -20.0, 5.0  #: changes of the logarithm of a width, so that it counts for nothing, or for all
_FARTHEST = 60.0  #: largest logarithm of a ratio of variances, so that a precision stays a number


class GivenWidths:
    """The distribution of all other parameters of a camera given the widths of its noise, linear about the mode."""

    def __init__(self, problem: SensorPosterior, mode: LaplaceFit) -> None:
        self.theta = mode.theta
        self.at = np.array([name in problem.coordinates.widths for name in problem.names])  #: (free,) True for a width
        middle = problem.whitened(mode.theta[None])[0]
        steps = problem.whitened(mode.theta + np.eye(len(mode.theta))) - middle
        self.middle = middle[~self.at]  #: (other,) the mode in standard deviations of the prior, from its middle
        self.unit = 1 / steps.diagonal()[~self.at]  #: (other,) coordinates of one standard deviation of the prior
        away, _ = _parts(problem.likelihood(mode.theta[None]).scaled.numpy())
        slopes = _parts(mode.scaled_slopes.T)[0].T[:, ~self.at]
        self._pull = slopes * away[0][:, None]
        self._noise, self._shares = self._variances(problem)
        self._squares = (slopes[:, :, None] * slopes[:, None]).reshape(len(slopes), -1)

    def law(self, widths: FloatArray) -> Law:
        """Return mean (draw, other) and root of the precision (draw, other, other), in units of the prior."""
        slope, precision = self.information(widths)
        step: FloatArray = np.linalg.solve(precision, slope[..., None])[..., 0].astype(np.float64)
        return step, np.linalg.cholesky(precision).astype(np.float64)

    def information(self, widths: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return slope (draw, other) of the log density at the mode, and precision (draw, other, other)."""
        squares = np.exp((2 * (widths - self.theta[self.at])).clip(-_FARTHEST, _FARTHEST))
        weight = 1 / (self._noise + squares @ self._shares)
        others = self._pull.shape[1]
        precision = (weight @ self._squares).reshape(-1, others, others) + np.eye(others)
        return -(weight @ self._pull + self.middle), precision

    def _variances(self, problem: SensorPosterior) -> tuple[FloatArray, FloatArray]:
        """Return the part of the variance of each residual that no width adds, and the part (width, residual) of each.

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
        """Return the log density of the other parameters at ``samples`` given the widths, up to a constant."""
        step, root = law
        away = (samples[:, ~self.at] - self.theta[~self.at]) / self.unit - step
        return student_density(away, root) - float(np.log(np.abs(self.unit)).sum())


def draw_student(root: FloatArray, rng: Random) -> FloatArray:
    """Return distances (draw, other) from the mean, with the ``root`` (draw, other, other) of their precision."""
    normal = rng.standard_normal(root.shape[:2]) / np.sqrt(rng.chisquare(_TAIL, (len(root), 1)) / _TAIL)
    away: FloatArray = np.linalg.solve(np.swapaxes(root, 1, 2), normal[..., None])[..., 0].astype(np.float64)
    return away


def student_density(away: FloatArray, root: FloatArray) -> FloatArray:
    """Return the log density at distances from the mean, up to the constant that `Mixture` leaves out too."""
    half, others = 0.5 * _TAIL, away.shape[1]
    square = (np.einsum("nij,ni->nj", root, away) ** 2).sum(1)
    level = math.lgamma(half + 0.5 * others) - math.lgamma(half) - 0.5 * others * math.log(_TAIL)
    level += np.log(np.diagonal(root, axis1=1, axis2=2)).sum(1)
    log: FloatArray = level - (half + 0.5 * others) * np.log1p(square / _TAIL)
    return log


def _parts(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return residuals (..., residual) and logarithms of their widths from the rows of the likelihood of a camera."""
    variance, narrow, mean, width = np.split(rows, 4, axis=-1)
    return np.concatenate([variance, mean], -1), np.concatenate([narrow, width], -1)
