"""The mode and the covariance of a posterior, by Fisher scoring from the least-squares estimate of EMVA 1288."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from neusee.nodes.calibrate import Rings, guess, guess_camera, guess_scatter
from neusee.nodes.values import Levels
from neusee.workflows.calibration.log_posterior import SensorPosterior

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from neusee.workflows.calibration.log_posterior import FloatArray

_ROUNDS = 60
_CLOSE = 1e-6  #: twice the nats that one more step may gain at the end of the search
_NEXT = 1e-3  #: twice the nats that one more step may gain at a settled mode beside an edge
_STEP = 1e-3  #: step of a difference, in standard deviations of the coordinate
_WIDEST = 1e3  #: standard deviation of a coordinate that nothing determines, so that a step stays a number
_EDGE = 1e3  #: nats: a step of a difference that costs more crosses an edge
_NARROWER = 0.5 ** np.arange(1, 12)  #: shares of the way from the middle of the prior to the guess
_TRIED, _BEST, _HIGHER = 1000, 2, 1.0  #: draws of the prior, the best to start from, nats that count as higher
_SHORT = 1e-7  #: step before any standard deviation is known: levels may determine a well to a part in a million


@dataclass(frozen=True)
class LaplaceFit:
    """The Laplace approximation of a posterior: the normal distribution about the mode."""

    theta: FloatArray  #: (free,)
    log: float  #: log posterior at the mode
    covariance: FloatArray  #: (free, free), of the coordinates
    scaled_slopes: FloatArray  #: (row, free) derivatives of the levels per standard deviation of the prior
    shares: FloatArray  #: (free,) standard deviation of each parameter over that of its prior
    settled: bool  #: True if no further step raises the posterior

    def draw(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Draw samples (count, free) from the normal distribution about the mode."""
        values, vectors = np.linalg.eigh(self.covariance)
        normal = rng.standard_normal((count, len(self.theta)))
        samples: FloatArray = self.theta + (normal * np.sqrt(values.clip(0))) @ vectors.T
        return samples


def initial_theta(problem: SensorPosterior) -> FloatArray:
    """Return the start of the search for the mode, a point between a first guess and the middle of the prior.

    The start is the point closest to the guess at which the posterior is not zero.
    Raises: `ValueError` if the posterior is zero at all points.
    """
    coordinates = problem.coordinates
    middle = coordinates.from_whitened(torch.zeros(len(problem.names), dtype=torch.float64))
    believed = {**coordinates.held, **{name: float(x) for name, x in middle.items()}}
    guessed = _guessed(problem, believed)
    first, last = (problem.theta({name: x[name] for name in problem.names}) for x in (guessed, believed))
    samples = np.stack([first, *(last + (first - last) * share for share in _NARROWER), last])
    alive = np.isfinite(problem.log_posterior(samples))
    if not alive.any():
        raise ValueError(
            "no sensor allowed by the priors can produce these numbers: check rounding, bits and priors, then run "
            "least_squares"
        )
    start: FloatArray = samples[int(alive.argmax())]
    return start


def _guessed(problem: SensorPosterior, believed: dict[str, float]) -> dict[str, float]:
    params, levels = problem.recipe.steps[problem.step].params, problem.levels
    if isinstance(levels, Levels):
        return guess_camera(levels, believed, params)
    if isinstance(levels, Rings):
        return guess_scatter(levels, believed, params)
    return guess(levels, believed, params)


def search_mode(problem: SensorPosterior) -> LaplaceFit:
    """Search for the mode from the first guess and from draws of the prior, and return the highest that settles.

    A posterior that may be long and bent is also returned without a settled mode: its samples do not start there.
    Raises: `ValueError` if no search settles.
    """
    fits = [find_mode(problem, initial_theta(problem))]
    for starts in (_TRIED, 4 * _TRIED):
        drawn = problem.theta(problem.coordinates.draw(starts, torch.Generator().manual_seed(starts)))
        drawn = drawn[np.isfinite(drawn).all(1)]
        logs = problem.log_posterior(drawn)
        best = [at for at in np.argsort(-logs)[:_BEST] if np.isfinite(logs[at])]
        fits += [find_mode(problem, drawn[at]) for at in best]
        settled = [fit for fit in fits if fit.settled]
        if settled and max(fit.log for fit in fits) <= max(fit.log for fit in settled) + _HIGHER:
            return max(settled, key=lambda fit: fit.log)
    if problem.coordinates.bent:
        return max(fits, key=lambda fit: fit.log)
    raise ValueError(_unsettled(problem, fits))


def _unsettled(problem: SensorPosterior, fits: list[LaplaceFit]) -> str:
    best = max(fits, key=lambda fit: fit.log)
    values = ", ".join(f"{name} {float(x):.3g}" for name, x in problem.parameters(best.theta).items())
    well = (
        ". If the well of this sensor ends the electrons before the read noise is added, set share: 0.7 in the step of "
        "calibrate.sufficient"
    )
    return (
        f"none of {len(fits)} searches ends at a mode of the posterior (the highest stops at {values}), so the model "
        "does not describe these levels: run least_squares, and check levels, rounding and bits"
        f"{well if 'full_well' in problem.coordinates.every else ''}"
    )


def find_mode(problem: SensorPosterior, initial_theta: FloatArray) -> LaplaceFit:
    """Search for the mode from ``initial_theta``, and return the normal distribution about the mode.

    In a direction that no level constrains, the distribution is as wide as the prior.
    """
    theta, step_of = initial_theta, np.full(len(initial_theta), _SHORT)
    log = float(problem.log_posterior(theta[None])[0])
    if not np.isfinite(log):
        raise ValueError("the sensor at the start of the search cannot produce these levels: run least_squares, and "
                         "check rounding and bits against the camera")  # fmt: skip
    for _ in range(_ROUNDS):
        rows, prior = _slopes(problem, theta, step_of)
        covariance = _covariance(rows, prior)
        step_of = np.sqrt(covariance.diagonal()).clip(max=_WIDEST) * _STEP
        gradient = _gradient(problem, theta, step_of)
        free = _free(problem, theta, step_of, gradient)
        within = _within(covariance, free != gradient) @ free
        if free @ within < _CLOSE:
            break
        theta, log, moved = _climb(problem, theta, log, covariance @ gradient, within)
        if not moved:
            break
    rows, prior = _slopes(problem, theta, step_of)
    covariance = _covariance(rows, prior)
    gradient = _gradient(problem, theta, step_of)
    free = _free(problem, theta, step_of, gradient)
    settled = bool(free @ _within(covariance, free != gradient) @ free < _NEXT)
    scaled_slopes = rows @ np.linalg.inv(prior)
    shares = np.sqrt((prior @ covariance @ prior.T).diagonal())
    return LaplaceFit(theta, log, covariance, scaled_slopes, shares, settled)


def _climb(
    problem: SensorPosterior, theta: FloatArray, log: float, step: FloatArray, within: FloatArray
) -> tuple[FloatArray, float, bool]:
    """Return the most probable point along ``step``, its log posterior, and True if this is higher than at ``theta``.

    The points change all coordinates, or all except one, which may be at an edge; or they lie along ``within``, which
    leaves each coordinate that is at an edge.
    """
    ways = np.concatenate([step[None], within[None], step * (1 - np.eye(len(step)))])
    tries = (theta + ways[:, None] * 0.5 ** np.arange(24)[:, None]).reshape(-1, len(theta))
    logs = problem.log_posterior(tries)
    best = int(logs.argmax())
    return (tries[best], float(logs[best]), True) if logs[best] > log else (theta, log, False)


def _differences(
    function: Callable[[FloatArray], FloatArray], theta: FloatArray, step: FloatArray, sides: FloatArray
) -> FloatArray:
    """Return the derivatives of ``function`` by finite differences; ``sides`` selects steps up and steps down."""
    apart = np.diag(step)
    high, low = np.split(function(np.concatenate([theta + apart * sides[0], theta - apart * sides[1]])), 2)
    slopes: FloatArray = (high - low).T / (step * sides.sum(0).clip(1))
    return slopes


def _sides(problem: SensorPosterior, theta: FloatArray, step: FloatArray) -> FloatArray:
    """Return 1 for each step up or down that meets no edge of the posterior, such as a full well, and 0 for others."""
    apart = np.diag(step)
    log = problem.log_posterior(np.concatenate([theta[None], theta + apart, theta - apart]))
    possible: FloatArray = (log[1:] > log[0] - _EDGE).reshape(2, -1).astype(np.float64)
    return possible


def _slopes(problem: SensorPosterior, theta: FloatArray, step: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return derivatives of light levels and prior by coordinate; their Gram matrix is Fisher's information."""
    rows = _differences(lambda p: problem.likelihood(p).scaled.numpy(), theta, step, _sides(problem, theta, step))
    rounded = problem.recipe.steps[problem.step].params.get("rounding") in ("nearest", "truncation")
    for name in problem.coordinates.edged.intersection(problem.names) if rounded else ():
        at = problem.names.index(name)  # levels depend on this parameter only at edges, where they have no derivative
        rows[:, at] = 0.0
        rows[-1, at] = float(problem.likelihood(theta[None]).scaled[0, -1])
    return rows, _differences(problem.whitened, theta, step, np.ones((2, len(step))))


def _gradient(problem: SensorPosterior, theta: FloatArray, step: FloatArray) -> FloatArray:
    """Return the gradient of the log posterior with respect to the free parameters."""
    sides = _sides(problem, theta, step)
    gradient: FloatArray = _differences(problem.log_posterior, theta, step, sides)
    return gradient


def _free(problem: SensorPosterior, theta: FloatArray, step: FloatArray, gradient: FloatArray) -> FloatArray:
    """Return the gradient, with 0 for each component that leads to parameters where the posterior is zero."""
    up, down = _sides(problem, theta, step) == 0
    return np.where((up & (gradient > 0)) | (down & (gradient < 0)), 0.0, gradient)


def _within(covariance: FloatArray, held: NDArray[np.bool_]) -> FloatArray:
    """Return the covariance of all coordinates where those that are ``held`` stay as they are."""
    if not held.any():
        return covariance
    across = covariance[:, held]
    within: FloatArray = covariance - across @ np.linalg.solve(across[held], across.T)
    return within


def _covariance(rows: FloatArray, prior: FloatArray) -> FloatArray:
    """Return the covariance of the parameters from an SVD of derivatives, which is more precise than an inversion."""
    _, s, v = np.linalg.svd(np.concatenate([rows, prior]), full_matrices=False)
    covariance: FloatArray = (v.T / s**2) @ v
    return covariance
