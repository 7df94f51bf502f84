"""Where the posterior is highest and how wide it is there: Fisher's scoring from the standard's least squares."""

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
    from neusee.workflows.calibration.log_posterior import Places

_ROUNDS = 60
_CLOSE = 1e-6  #: twice the nats that a step may still win
_NEXT = 1e-3  #: the same where nothing higher is found, or an edge is near
_STEP = 1e-3  #: of a difference, in standard deviations of that coordinate
_EDGE = 1e3  #: nats that a step of that length never costs, but over an edge
_NARROWER = 0.5 ** np.arange(1, 12)  #: shares of the way from the middle of the prior to the guess
_SHORT = 1e-7  #: the same before any deviation is known: a well is known to a part in a million


@dataclass(frozen=True)
class LaplaceFit:
    """A normal law about the highest place."""

    place: Places  #: (free,)
    log: float  #: log posterior there
    covariance: Places  #: (free, free), of the coordinates
    told: Places  #: (row, free) what the levels tell, in standard deviations by one of the prior
    shares: Places  #: (free,) standard deviation of each parameter over that of its prior
    settled: bool  #: no step wins anything any more

    def draw(self, count: int, rng: np.random.Generator) -> Places:
        """(count, free) from the normal law."""
        values, vectors = np.linalg.eigh(self.covariance)
        found: Places = (
            self.place + (rng.standard_normal((count, len(self.place))) * np.sqrt(values.clip(0))) @ vectors.T
        )
        return found


def log_law(top: LaplaceFit, places: Places) -> Places:
    """(count,) of the normal law about a peak, but for a constant."""
    off = places - top.place
    found: Places = -0.5 * np.einsum("ni,ij,nj->n", off, np.linalg.pinv(top.covariance, hermitian=True), off)
    return found


def begin(problem: SensorPosterior) -> Places:
    """A place where the posterior is not none: the guess, or on the way from it to the middle of the prior.

    Raises ValueError where there is none on that way.
    """
    coordinates = problem.coordinates
    middle = coordinates.from_whitened(torch.zeros(len(problem.names), dtype=torch.float64))
    believed = {**coordinates.held, **{name: float(x) for name, x in middle.items()}}
    params = problem.recipe.steps[problem.step].params
    levels = problem.levels
    guessed = guess_camera(levels, believed, params) if isinstance(levels, Levels) else guess(levels, believed, params)
    first, last = (problem.place({name: x[name] for name in problem.names}) for x in (guessed, believed))
    places = np.stack([first, *(last + (first - last) * share for share in _NARROWER), last])
    alive = np.isfinite(problem.log_posterior(places))
    if not alive.any():
        raise ValueError(
            "no sensor that was believed possible gives these numbers: compare rounding, bits and the priors with the "
            "camera, and see what least_squares says"
        )
    found: Places = places[int(alive.argmax())]
    return found


def peak(problem: SensorPosterior, begin: Places) -> LaplaceFit:
    """Climb from ``begin``; what no level tells stays as wide as the prior."""
    place, step_of = begin, np.full(len(begin), _SHORT)
    log = float(problem.log_posterior(place[None])[0])
    if not np.isfinite(log):
        raise ValueError("the levels cannot be by the law of the sensor at the start of the search: see what the "
                         "least squares say, and whether rounding and bits are those of the camera")  # fmt: skip
    for _ in range(_ROUNDS):
        rows, prior = _slopes(problem, place, step_of)
        covariance = _covariance(rows, prior)
        step_of = np.sqrt(covariance.diagonal()) * _STEP
        gradient = _gradient(problem, place, step_of)
        step = covariance @ gradient
        if gradient @ step < _CLOSE:
            break
        place, log, moved = _climb(problem, place, log, step)
        if not moved:
            break
    rows, prior = _slopes(problem, place, step_of)
    covariance = _covariance(rows, prior)
    free = _free(problem, place, step_of, _gradient(problem, place, step_of))
    settled = bool(free @ covariance @ free < _NEXT)
    told = rows @ np.linalg.inv(prior)
    shares = np.sqrt((prior @ covariance @ prior.T).diagonal())
    return LaplaceFit(place, log, covariance, told, shares, settled)


def _climb(problem: SensorPosterior, place: Places, log: float, step: Places) -> tuple[Places, float, bool]:
    """The best of ever shorter steps, tried at once: all coordinates, and all but one that may stand at an edge."""
    ways = np.concatenate([step[None], step * (1 - np.eye(len(step)))])
    tries = (place + ways[:, None] * 0.5 ** np.arange(24)[:, None]).reshape(-1, len(place))
    found = problem.log_posterior(tries)
    best = int(found.argmax())
    if not found[best] > log:
        return place, log, False
    return tries[best], float(found[best]), True


def _differences(of: Callable[[Places], Places], place: Places, step: Places, sides: Places) -> Places:
    """(value, free) by differences between the ``sides`` (2, free) of each coordinate that there are, 1 or 0."""
    apart = np.diag(step)
    found = of(np.concatenate([place + apart * sides[0], place - apart * sides[1]]))
    high, low = np.split(found, 2)
    width = step * sides.sum(0).clip(1)
    slopes: Places = ((high - low) / width.reshape(-1, *(1 for _ in found.shape[1:]))).T
    return slopes


def _sides(problem: SensorPosterior, place: Places, step: Places) -> Places:
    """(2, free) 1 where a step up, or down, is possible: beside a full well, or the end of a converter, it is not."""
    apart = np.diag(step)
    log = problem.log_posterior(np.concatenate([place[None], place + apart, place - apart]))
    found: Places = (log[1:] > log[0] - _EDGE).reshape(2, -1).astype(np.float64)
    return found


def _slopes(problem: SensorPosterior, place: Places, step: Places) -> tuple[Places, Places]:
    """What levels and prior tell of each coordinate: Fisher's information is the product of each with itself."""
    rows = _differences(lambda p: problem.look(p).scaled.numpy(), place, step, _sides(problem, place, step))
    rounded = problem.recipe.steps[problem.step].params["rounding"] == "nearest"
    for name in problem.coordinates.edged.intersection(problem.names) if rounded else ():
        at = problem.names.index(name)  # nothing changes with it but at edges, over which there is no slope
        rows[:, at] = 0.0
        rows[-1, at] = float(problem.look(place[None]).scaled[0, -1])
    return rows, _differences(problem.whitened, place, step, np.ones((2, len(step))))


def _gradient(problem: SensorPosterior, place: Places, step: Places) -> Places:
    sides = _sides(problem, place, step)
    found: Places = _differences(lambda p: problem.log_posterior(p)[:, None], place, step, sides)[0]
    return found


def _free(problem: SensorPosterior, place: Places, step: Places, gradient: Places) -> Places:
    """The slope without what leads over an edge: what lies beyond cannot be, and the highest place is there."""
    up, down = _sides(problem, place, step) == 0
    found: Places = np.where((up & (gradient > 0)) | (down & (gradient < 0)), 0.0, gradient)
    return found


def _covariance(rows: Places, prior: Places) -> Places:
    """Of both together, by singular values: the information itself would lose half of the digits."""
    _, s, v = np.linalg.svd(np.concatenate([rows, prior]), full_matrices=False)
    found: Places = (v.T / s**2) @ v
    return found
