"""A mixture of densities like a posterior, from particles that follow the posterior."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np
import torch

if TYPE_CHECKING:
    from neusee.workflows.calibration.log_posterior import FloatArray, LaplaceFit, SensorPosterior


# --- tempered particles ---------------------------------------------------------------------------

# Particles that follow a posterior from its prior on, so that no far mode and no long ridge is
# missed.
#
# The likelihood enters by a power that grows from 0 to 1. At each power the particles are resampled
# by their weights and moved by differences of other particles (sequential Monte Carlo; Del Moral et
# al., J. R. Stat. Soc. B 68, 411 (2006)). The particles start a better density; they are not draws
# of the posterior themselves.


_KEPT = 0.5  #: effective sample fraction that a larger power leaves
#: most sweeps at one power; accepted moves of each particle at which the power grows
_SWEEPS, _MOVED = 12, 1.5
_POWERS = 200  #: most powers
_SHARES = (1.0, 0.5, 0.2)  #: lengths of a move in units of that which suits a normal distribution
_LEAP = 0.1  #: share of moves by a whole difference, from mode to mode
_BLUR = 1e-5  #: coordinates, added to each move
#: draws of the prior for each particle, because lenses that scatter more than all light are
#: impossible
_SPARE = 4


@dataclass
class _Particles:
    place: FloatArray  #: (particle, free)
    prior: FloatArray  #: (particle,) log prior
    log: FloatArray  #: (particle,) log posterior

    def take(self, numbers: FloatArray) -> None:
        """Replace the particles by those with these ``numbers``."""
        self.place, self.prior, self.log = (
            self.place[numbers],
            self.prior[numbers],
            self.log[numbers],
        )


def follow_posterior(
    problem: SensorPosterior, count: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return the coordinates of particles (particle, free) near the posterior, and the log
    posterior of each.
    """
    particles, power = _from_prior(problem, count, rng), 0.0
    for _ in range(_POWERS):
        gain = particles.log - particles.prior
        before, power = power, _next_power(gain, power)
        weight = np.exp((power - before) * (gain - gain.max()))
        edges = np.cumsum(weight / weight.sum())
        numbers = np.searchsorted(edges, (rng.random() + np.arange(len(gain))) / len(gain)).clip(
            0, len(gain) - 1
        )
        particles.take(rng.permutation(numbers))
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
        raise ValueError(
            f"{len(alive)} of {len(drawn)} draws of the priors of {', '.join(problem.names)} can "
            "produce "
            "these numbers: give priors of lenses that scatter less than all light"
        )
    return _Particles(place[alive], prior[alive], log[alive])


def _logs(problem: SensorPosterior, place: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the log prior and the log posterior at coordinates (particle, free)."""
    with torch.no_grad():
        prior: FloatArray = problem.coordinates.log_prior(problem.parameters(place)).numpy()
    return np.nan_to_num(prior, nan=-np.inf), problem.log_posterior(place)


def _next_power(gain: FloatArray, power: float) -> float:
    """Return the largest power of the likelihood whose weights, after ``power``, leave enough
    effective samples.
    """

    def left(step: float) -> float:
        weight = np.exp(step * (gain - gain.max()))
        return float(weight.sum() ** 2 / (weight**2).sum() / len(weight))

    if left(1.0 - power) >= _KEPT:
        return 1.0
    low, high = 1e-12, 1.0 - power
    for _ in range(40):
        middle = (low * high) ** 0.5
        low, high = (middle, high) if left(middle) >= _KEPT else (low, middle)
    return power + low


def _sweep(
    problem: SensorPosterior, particles: _Particles, power: float, rng: np.random.Generator
) -> float:
    """Propose one move of each particle by a difference of two of the other half; return the
    share that is accepted.
    """
    halves, moved = np.array_split(rng.permutation(len(particles.log)), 2), 0
    free = particles.place.shape[1]
    for own, other in (halves, halves[::-1]):
        first, second = (
            particles.place[other[rng.integers(len(other), size=len(own))]] for _ in range(2)
        )
        step = rng.choice(_SHARES, size=len(own)) * 2.38 / (2 * free) ** 0.5
        step = np.where(rng.random(len(own)) < _LEAP, 1.0, step)
        new = particles.place[own] + step[:, None] * (first - second)
        new = new + _BLUR * rng.standard_normal(new.shape)
        prior, log = _logs(problem, new)
        with np.errstate(invalid="ignore"):
            rise = (1 - power) * (prior - particles.prior[own]) + power * (log - particles.log[own])
        accepted = np.log(rng.random(len(own))) < np.where(np.isfinite(rise), rise, -np.inf)
        replaced = own[accepted]
        particles.place[replaced], particles.prior[replaced], particles.log[replaced] = (
            new[accepted],
            prior[accepted],
            log[accepted],
        )
        moved += int(accepted.sum())
    return moved / len(particles.log)


# --- posterior mixture ----------------------------------------------------------------------------

# A mixture of densities like a posterior that may be long, bent, or in several parts.


_PARTICLES, _BESIDE = 1000, 200  #: particles, and draws about the mode
_FAR = 40.0  #: nats below the best point at which a particle is lost in a mode that does not count
_PARTS = 14  #: components that are fitted
_TAIL = 6.0  #: degrees of freedom of each component, where the mixture has no others
#: most fits, steps of each fit, samples on which a fit is tried
_ROUNDS, _STEPS, _TRIED = 16, 8, 2000
_SOFT, _ENOUGH = 0.3, 0.4  #: effective sample fractions: to fit the next mixture, to stop
_BROAD, _WIDER = 0.05, 2.0  #: share and width of one broad component, which bounds the weights
_BORROWED = 0.03  #: share of samples whose covariance in all is added to that of the components
_NEVER = -1e300  #: log density of an impossible sample


Random = np.random.Generator | np.random.RandomState


class Density(Protocol):
    """A density like the posterior, from which samples can be drawn."""

    def draw(self, count: int, rng: Random) -> FloatArray:
        """Draw samples (count, free)."""

    def log_density(self, samples: FloatArray) -> FloatArray:
        """Return the logarithm of the density at samples (draw, free), up to a constant."""

    def propose(self, own: FloatArray, rng: Random) -> tuple[FloatArray, FloatArray]:
        """Return new samples like ``own`` (draw, free), and the logarithm of the density at
        ``own`` over that there.
        """
        drawn = self.draw(len(own), rng)
        return drawn, self.log_density(own) - self.log_density(drawn)


@dataclass(frozen=True)
class Mixture(Density):
    """A mixture of Student's t distributions of several coordinates."""

    shares: FloatArray  #: (component,) sum 1
    centres: FloatArray  #: (component, free)
    roots: FloatArray  #: (component, free, free) lower triangular roots of the scale matrices
    tails: FloatArray | float = _TAIL  #: (component,) degrees of freedom

    def draw(self, count: int, rng: Random) -> FloatArray:
        """Draw samples (count, free)."""
        component = rng.choice(len(self.shares), size=count, p=self.shares)
        normal = rng.standard_normal((count, self.centres.shape[1]))
        tail = np.broadcast_to(self.tails, self.shares.shape)[component]
        off = normal / np.sqrt(rng.chisquare(tail) / tail)[:, None]
        samples: FloatArray = self.centres[component] + np.einsum(
            "nij,nj->ni", self.roots[component], off
        )
        return samples

    def log_density(self, samples: FloatArray) -> FloatArray:
        """Return the logarithm of the density at samples (draw, free), up to a constant."""
        power = 0.5 * (self.tails + self.centres.shape[1])
        return log_sum(
            self._levels + self._constants - power * np.log1p(self._squares(samples) / self.tails)
        )

    def normal_shares(self, samples: FloatArray) -> FloatArray:
        """Return the share (draw, component) of each component in the density of normal
        components at samples.
        """
        logs = self._levels - 0.5 * self._squares(samples)
        shares: FloatArray = np.exp(logs - log_sum(logs)[:, None])
        return shares

    @cached_property
    def _levels(self) -> FloatArray:
        widths = np.diagonal(self.roots, axis1=1, axis2=2)
        levels: FloatArray = np.log(self.shares.clip(1e-300)) - np.log(widths).sum(1)
        return levels

    @cached_property
    def _constants(self) -> FloatArray:
        """Return what the degrees of freedom of each component add to its log density at the
        centre.
        """
        from scipy.special import gammaln

        half, free = 0.5 * np.asarray(self.tails), self.centres.shape[1]
        constants: FloatArray = (
            gammaln(half + 0.5 * free) - gammaln(half) - 0.5 * free * np.log(2 * half)
        )
        return constants

    @cached_property
    def _inverses(self) -> FloatArray:
        return np.linalg.inv(self.roots).astype(np.float64)

    def _squares(self, samples: FloatArray) -> FloatArray:
        """Return the squared distance (draw, component) from each centre, in widths of the
        component.
        """
        away = self._inverses @ (samples.T[None] - self.centres[:, :, None])
        squares: FloatArray = (away**2).sum(1).T
        return squares


def fit_mixture(
    problem: SensorPosterior, mode: LaplaceFit, count: int, rng: np.random.Generator
) -> tuple[Mixture, FloatArray, FloatArray]:
    """Return a mixture like the posterior, samples of it (count, free), and the log of posterior
    over mixture of each.

    A first mixture is fitted to particles and to draws about the mode, and stays a half of every
    further one, because a part of the posterior that has no samples is missed without a sign in the
    weights. The other half is fitted to weighted samples, again and again. The mixture with the
    largest effective sample size is kept, and new samples are drawn from it, whose own effective
    sample size the caller must check.
    """
    points = _start(problem, mode, rng)
    first = mixture = best_mixture = _fitted(points, np.full(len(points), 1 / len(points)), rng)
    best = -1.0
    for _ in range(_ROUNDS):
        samples, log = weighed(problem, mixture, _TRIED, rng)
        fraction = effective(log)
        if fraction > best:
            best, best_mixture = fraction, mixture
        if fraction >= _ENOUGH:
            break
        mixture = _joined(first, _fitted(samples, normalised(softened(log)), rng))
    return best_mixture, *weighed(problem, best_mixture, count, rng)


def _joined(first: Mixture, second: Mixture) -> Mixture:
    """Return the mixture of two mixtures in equal parts."""
    shares = 0.5 * np.concatenate([first.shares, second.shares])
    centres = np.concatenate([first.centres, second.centres])
    roots = np.concatenate([first.roots, second.roots])
    return Mixture(shares, centres, roots)


def weighed(
    problem: SensorPosterior, density: Density, count: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return samples of a density, and the logarithm of posterior over density of each."""
    samples = density.draw(count, rng)
    return samples, finite(problem.log_posterior(samples)) - density.log_density(samples)


def _start(problem: SensorPosterior, mode: LaplaceFit, rng: np.random.Generator) -> FloatArray:
    """Return particles and draws about the mode (point, free), without those that are lost far
    below the best.
    """
    places, logs = follow_posterior(problem, _PARTICLES, rng)
    beside = mode.draw(_BESIDE, rng)
    places = np.concatenate([places, beside])
    logs = np.concatenate([logs, problem.log_posterior(beside)])
    return places[logs > max(float(logs.max()), mode.log) - _FAR]


def _fitted(samples: FloatArray, weight: FloatArray, rng: np.random.Generator) -> Mixture:
    """Return the mixture that expectation and maximisation find for weighted samples, and a
    broad component.
    """
    centre, covariance = moments(samples, weight)
    root = np.linalg.cholesky(firm(covariance))
    starts = _apart(np.linalg.solve(root, (samples - centre).T).T, weight, rng)
    mixture = Mixture(
        np.full(_PARTS, 1 / _PARTS), samples[starts], np.repeat(0.5 * root[None], _PARTS, 0)
    )
    for _ in range(_STEPS):
        parts = weight[:, None] * mixture.normal_shares(samples)
        mixture = maximised(samples, parts, covariance)
    return Mixture(
        np.append((1 - _BROAD) * mixture.shares, _BROAD),
        np.concatenate([mixture.centres, centre[None]]),
        np.concatenate([mixture.roots, _WIDER * root[None]]),
    )


def _apart(places: FloatArray, weight: FloatArray, rng: np.random.Generator) -> list[int]:
    """Return the numbers of samples to start the components from: every second one is far from
    those before.
    """
    pool = rng.choice(len(places), size=4 * _PARTICLES // 10, p=weight)
    starts, away = [int(pool[0])], ((places[pool] - places[pool[0]]) ** 2).sum(1)
    for number in range(1, _PARTS):
        far = number % 2 and away.sum() > 0
        chances = away / away.sum() if far else None
        starts.append(int(rng.choice(pool, p=chances)))
        away = np.minimum(away, ((places[pool] - places[starts[-1]]) ** 2).sum(1))
    return starts


def maximised(
    samples: FloatArray, parts: FloatArray, overall: FloatArray, borrowed: float = _BORROWED
) -> Mixture:
    """Return the mixture of normal components with the moments of samples, by their shares
    ``parts``.

    ``borrowed`` is the share of samples with the covariance ``overall`` that is added to all
    components together.
    """
    shares = parts.sum(0)
    centres = parts.T @ samples / shares.clip(1e-300)[:, None]
    away = samples[None] - centres[:, None]
    sums = np.swapaxes(away * parts.T[:, :, None], 1, 2) @ away
    added = borrowed / len(shares)
    covariance = (sums + added * overall) / (shares + added)[:, None, None]
    roots = np.linalg.cholesky(firm(covariance)).astype(np.float64)
    return Mixture(shares / shares.sum(), centres, roots)


def moments(samples: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the mean and the covariance of weighted samples."""
    centre = weight @ samples
    away = samples - centre
    return centre, away.T @ (weight[:, None] * away)


def firm(covariance: FloatArray) -> FloatArray:
    """Return covariances (..., free, free) whose rounding cannot make a variance negative."""
    firm = covariance.copy()
    diagonal = np.arange(covariance.shape[-1])
    firm[..., diagonal, diagonal] *= 1 + 1e-9
    return firm


def uniform(count: int, rng: Random) -> FloatArray:
    """Return ``count`` numbers between 0 and 1 from either kind of generator."""
    return rng.random_sample(count) if isinstance(rng, np.random.RandomState) else rng.random(count)


def softened(log: FloatArray) -> FloatArray:
    """Return ``log`` times the largest factor, up to 1, whose weights leave enough effective
    samples for a fit.
    """
    if effective(log) >= _SOFT:
        return log
    low, high = 1e-12, 1.0
    for _ in range(40):
        middle = (low * high) ** 0.5
        low, high = (middle, high) if effective(middle * log) >= _SOFT else (low, middle)
    return low * log


def effective(log: FloatArray) -> float:
    """Return the effective sample size of weights with the logarithms ``log``, divided by their
    number.
    """
    return float(1 / (normalised(log) ** 2).sum() / len(log))


def normalised(log: FloatArray) -> FloatArray:
    """Return weights with a sum of 1 from the logarithms of unnormalised weights."""
    weight = np.exp(log - log.max())
    weights: FloatArray = weight / weight.sum()
    return weights


def finite(log: FloatArray) -> FloatArray:
    """Return logarithms with a very small number in place of minus infinity and NaN."""
    return np.nan_to_num(log, nan=_NEVER, neginf=_NEVER)


def log_sum(logs: FloatArray) -> FloatArray:
    """Return the logarithm of the sum of exponentials along the last axis."""
    top = logs.max(-1)
    total: FloatArray = top + np.log(np.exp(logs - top[..., None]).sum(-1))
    return total
