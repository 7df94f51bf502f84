"""Particles that follow a posterior from its prior on, so that no far mode and no long ridge is missed.

The likelihood enters by a power that grows from 0 to 1. At each power the particles are resampled by their weights and
moved by differences of other particles (sequential Monte Carlo; Del Moral et al., J. R. Stat. Soc. B 68, 411 (2006)).
The particles start a better density; they are not draws of the posterior themselves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

if TYPE_CHECKING:
    from neusee.workflows.calibration.log_posterior import FloatArray, SensorPosterior

_KEPT = 0.5  #: effective sample fraction that a larger power leaves
_SWEEPS, _MOVED = 12, 1.5  #: most sweeps at one power; accepted moves of each particle at which the power grows
_POWERS = 200  #: most powers
_SHARES = (1.0, 0.5, 0.2)  #: lengths of a move in units of that which suits a normal distribution
_LEAP = 0.1  #: share of moves by a whole difference, from mode to mode
_BLUR = 1e-5  #: coordinates, added to each move
_SPARE = 4  #: draws of the prior for each particle, because lenses that scatter more than all light are impossible


@dataclass
class _Particles:
    place: FloatArray  #: (particle, free)
    prior: FloatArray  #: (particle,) log prior
    log: FloatArray  #: (particle,) log posterior

    def take(self, at: FloatArray) -> None:
        """Replace the particles by those with the numbers ``at``."""
        self.place, self.prior, self.log = self.place[at], self.prior[at], self.log[at]


def follow_posterior(problem: SensorPosterior, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return the coordinates of particles (particle, free) near the posterior, and the log posterior of each."""
    particles, power = _from_prior(problem, count, rng), 0.0
    for _ in range(_POWERS):
        gain = particles.log - particles.prior
        before, power = power, _next_power(gain, power)
        weight = np.exp((power - before) * (gain - gain.max()))
        edges = np.cumsum(weight / weight.sum())
        chosen = np.searchsorted(edges, (rng.random() + np.arange(len(gain))) / len(gain)).clip(0, len(gain) - 1)
        particles.take(rng.permutation(chosen))
        moved = 0.0
        for _ in range(_SWEEPS):
            moved += _sweep(problem, particles, power, rng)
            if moved > _MOVED:
                break
        if power == 1.0:
            break
    return particles.place, particles.log


def _from_prior(problem: SensorPosterior, count: int, rng: np.random.Generator) -> _Particles:
    """Return up to ``count`` draws of the prior at which the posterior is not zero."""
    drawn = torch.from_numpy(rng.standard_normal((_SPARE * count, len(problem.names))))
    place = problem.theta(problem.coordinates.from_whitened(drawn))
    place = place[np.isfinite(place).all(1)]
    prior, log = _logs(problem, place)
    alive = np.flatnonzero(np.isfinite(log))[:count]
    if len(alive) < 2 * len(problem.names):
        raise ValueError(f"{len(alive)} of {len(drawn)} draws of the priors of {', '.join(problem.names)} can produce "
                         "these numbers: give priors of lenses that scatter less than all light")  # fmt: skip
    return _Particles(place[alive], prior[alive], log[alive])


def _logs(problem: SensorPosterior, place: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the log prior and the log posterior at coordinates (particle, free)."""
    with torch.no_grad():
        prior: FloatArray = problem.coordinates.log_prior(problem.parameters(place)).numpy()
    return np.nan_to_num(prior, nan=-np.inf), problem.log_posterior(place)


def _next_power(gain: FloatArray, power: float) -> float:
    """Return the largest power of the likelihood whose weights, after ``power``, leave enough effective samples."""

    def left(more: float) -> float:
        weight = np.exp(more * (gain - gain.max()))
        return float(weight.sum() ** 2 / (weight**2).sum() / len(weight))

    if left(1.0 - power) >= _KEPT:
        return 1.0
    low, high = 1e-12, 1.0 - power
    for _ in range(40):
        middle = (low * high) ** 0.5
        low, high = (middle, high) if left(middle) >= _KEPT else (low, middle)
    return power + low


def _sweep(problem: SensorPosterior, particles: _Particles, power: float, rng: np.random.Generator) -> float:
    """Propose one move of each particle by a difference of two of the other half; return the share that is accepted."""
    halves, moved = np.array_split(rng.permutation(len(particles.log)), 2), 0
    free = particles.place.shape[1]
    for own, other in (halves, halves[::-1]):
        first, second = (particles.place[other[rng.integers(len(other), size=len(own))]] for _ in range(2))
        step = rng.choice(_SHARES, size=len(own)) * 2.38 / (2 * free) ** 0.5
        step = np.where(rng.random(len(own)) < _LEAP, 1.0, step)
        new = particles.place[own] + step[:, None] * (first - second)
        new = new + _BLUR * rng.standard_normal(new.shape)
        prior, log = _logs(problem, new)
        with np.errstate(invalid="ignore"):
            rise = (1 - power) * (prior - particles.prior[own]) + power * (log - particles.log[own])
        accepted = np.log(rng.random(len(own))) < np.where(np.isfinite(rise), rise, -np.inf)
        at = own[accepted]
        particles.place[at], particles.prior[at], particles.log[at] = new[accepted], prior[accepted], log[accepted]
        moved += int(accepted.sum())
    return moved / len(particles.log)
