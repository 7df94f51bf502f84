"""The mode of a posterior and its covariance: Fisher's scoring from the least squares of the standard."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from neusee.nodes.calibrate import guess, guess_camera
from neusee.nodes.values import Levels
from neusee.workflows.calibration.log_posterior import SensorPosterior

if TYPE_CHECKING:
    from neusee.workflows.calibration.log_posterior import FloatArray

_ROUNDS = 60
_CLOSE = 1e-6  #: twice the nats that a step may still gain
_NEXT = 1e-3  #: the same where no step gains, or an edge is near
_STEP = 1e-3  #: step of a difference, in standard deviations of that coordinate
_EDGE = 1e3  #: nats that such a step costs only over an edge
_NARROWER = 0.5 ** np.arange(1, 12)  #: shares of the way from the middle of the prior to the guess
_SHORT = 1e-7  #: step before any standard deviation is known: a well is known to a part in a million


@dataclass(frozen=True)
class LaplaceFit:
    """A normal distribution about the mode of a posterior."""

    theta: FloatArray  #: (free,)
    log: float  #: log posterior at the mode
    covariance: FloatArray  #: (free, free), of the coordinates
    scaled_slopes: FloatArray  #: (row, free) slopes of the levels per standard deviation of the prior
    shares: FloatArray  #: (free,) standard deviation of each parameter over that of its prior
    settled: bool  #: whether no step gains any more

    def draw(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Return samples (count, free) of the normal distribution."""
        values, vectors = np.linalg.eigh(self.covariance)
        normal = rng.standard_normal((count, len(self.theta)))
        found: FloatArray = self.theta + (normal * np.sqrt(values.clip(0))) @ vectors.T
        return found


def log_density(mode: LaplaceFit, samples: FloatArray) -> FloatArray:
    """Return the log density (count,) of the normal distribution about a mode, up to a constant."""
    off = samples - mode.theta
    found: FloatArray = -0.5 * np.einsum("ni,ij,nj->n", off, np.linalg.pinv(mode.covariance, hermitian=True), off)
    return found


def initial_theta(problem: SensorPosterior) -> FloatArray:
    """Return where the search for the mode starts: the guess, or a point between it and the middle of the prior.

    The posterior is not zero there. Raises: `ValueError` where it is zero at all points between.
    """
    coordinates = problem.coordinates
    middle = coordinates.from_whitened(torch.zeros(len(problem.names), dtype=torch.float64))
    believed = {**coordinates.held, **{name: float(x) for name, x in middle.items()}}
    params = problem.recipe.steps[problem.step].params
    levels = problem.levels
    guessed = guess_camera(levels, believed, params) if isinstance(levels, Levels) else guess(levels, believed, params)
    first, last = (problem.theta({name: x[name] for name in problem.names}) for x in (guessed, believed))
    samples = np.stack([first, *(last + (first - last) * share for share in _NARROWER), last])
    alive = np.isfinite(problem.log_posterior(samples))
    if not alive.any():
        raise ValueError(
            "no sensor allowed by the priors can produce these numbers: check rounding, bits and priors, then run "
            "least_squares"
        )
    found: FloatArray = samples[int(alive.argmax())]
    return found


def find_mode(problem: SensorPosterior, initial_theta: FloatArray) -> LaplaceFit:
    """Climb from ``initial_theta`` to the mode; a direction that no level constrains stays as wide as the prior."""
    theta, step_of = initial_theta, np.full(len(initial_theta), _SHORT)
    log = float(problem.log_posterior(theta[None])[0])
    if not np.isfinite(log):
        raise ValueError("the sensor at the start of the search cannot produce these levels: run least_squares, and "
                         "check rounding and bits against the camera")  # fmt: skip
    for _ in range(_ROUNDS):
        rows, prior = _slopes(problem, theta, step_of)
        covariance = _covariance(rows, prior)
        step_of = np.sqrt(covariance.diagonal()) * _STEP
        gradient = _gradient(problem, theta, step_of)
        step = covariance @ gradient
        if gradient @ step < _CLOSE:
            break
        theta, log, moved = _climb(problem, theta, log, step)
        if not moved:
            break
    rows, prior = _slopes(problem, theta, step_of)
    covariance = _covariance(rows, prior)
    free = _free(problem, theta, step_of, _gradient(problem, theta, step_of))
    settled = bool(free @ covariance @ free < _NEXT)
    scaled_slopes = rows @ np.linalg.inv(prior)
    shares = np.sqrt((prior @ covariance @ prior.T).diagonal())
    return LaplaceFit(theta, log, covariance, scaled_slopes, shares, settled)


def _climb(problem: SensorPosterior, theta: FloatArray, log: float, step: FloatArray) -> tuple[FloatArray, float, bool]:
    """Return the best of ever shorter steps, tried at once: of all coordinates, and of all but one near an edge."""
    ways = np.concatenate([step[None], step * (1 - np.eye(len(step)))])
    tries = (theta + ways[:, None] * 0.5 ** np.arange(24)[:, None]).reshape(-1, len(theta))
    found = problem.log_posterior(tries)
    best = int(found.argmax())
    if not found[best] > log:
        return theta, log, False
    return tries[best], float(found[best]), True


def _differences(
    of: Callable[[FloatArray], FloatArray], theta: FloatArray, step: FloatArray, sides: FloatArray
) -> FloatArray:
    """Return slopes (value, free) by differences between the ``sides`` (2, free) of each coordinate, 1 or 0."""
    apart = np.diag(step)
    found = of(np.concatenate([theta + apart * sides[0], theta - apart * sides[1]]))
    high, low = np.split(found, 2)
    width = step * sides.sum(0).clip(1)
    slopes: FloatArray = ((high - low) / width.reshape(-1, *(1 for _ in found.shape[1:]))).T
    return slopes


def _sides(problem: SensorPosterior, theta: FloatArray, step: FloatArray) -> FloatArray:
    """Return (2, free) 1 where a step up, or down, is possible; beside a full well or a converter's end none is."""
    apart = np.diag(step)
    log = problem.log_posterior(np.concatenate([theta[None], theta + apart, theta - apart]))
    found: FloatArray = (log[1:] > log[0] - _EDGE).reshape(2, -1).astype(np.float64)
    return found


def _slopes(problem: SensorPosterior, theta: FloatArray, step: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the slopes of levels and prior by coordinate; Fisher's information is their product with themselves."""
    rows = _differences(lambda p: problem.likelihood(p).scaled.numpy(), theta, step, _sides(problem, theta, step))
    rounded = problem.recipe.steps[problem.step].params["rounding"] == "nearest"
    for name in problem.coordinates.edged.intersection(problem.names) if rounded else ():
        at = problem.names.index(name)  # nothing changes with it but at edges, over which there is no slope
        rows[:, at] = 0.0
        rows[-1, at] = float(problem.likelihood(theta[None]).scaled[0, -1])
    return rows, _differences(problem.whitened, theta, step, np.ones((2, len(step))))


def _gradient(problem: SensorPosterior, theta: FloatArray, step: FloatArray) -> FloatArray:
    sides = _sides(problem, theta, step)
    found: FloatArray = _differences(lambda p: problem.log_posterior(p)[:, None], theta, step, sides)[0]
    return found


def _free(problem: SensorPosterior, theta: FloatArray, step: FloatArray, gradient: FloatArray) -> FloatArray:
    """Return the gradient without the components that lead over an edge, beyond which the posterior is zero."""
    up, down = _sides(problem, theta, step) == 0
    found: FloatArray = np.where((up & (gradient > 0)) | (down & (gradient < 0)), 0.0, gradient)
    return found


def _covariance(rows: FloatArray, prior: FloatArray) -> FloatArray:
    """Return the covariance by singular values of the slopes: the information itself would lose half of the digits."""
    _, s, v = np.linalg.svd(np.concatenate([rows, prior]), full_matrices=False)
    found: FloatArray = (v.T / s**2) @ v
    return found
