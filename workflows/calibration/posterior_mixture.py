"""A mixture density that approximates a posterior, fitted to particles that follow the
posterior.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np
import torch

if TYPE_CHECKING:
    from neusee.workflows.calibration.log_posterior import FloatArray, LaplaceFit, SensorPosterior


# --- tempered particles ---------------------------------------------------------------------------

# Particles that move from the prior to the posterior, so that no distant mode and no long ridge is
# missed.
#
# The likelihood enters by a power that grows from 0 to 1. At each power the particles are resampled
# by their weights and moved by differences of other particles (sequential Monte Carlo; Del Moral et
# al., J. R. Stat. Soc. B 68, 411 (2006)). The particles start a better density; they are not draws
# of the posterior themselves.


_KEPT_FRACTION = 0.5  #: effective sample fraction that remains after each increase of the power
#: most sweeps at one power; accepted moves per particle after which the power grows
_MOST_SWEEPS, _ENOUGH_MOVES = 12, 1.5
_MOST_POWERS = 200  #: most powers
# 2.38 / sqrt(2 free) suits a normal distribution
_MOVE_LENGTHS = (
    1.0,
    0.5,
    0.2,
)  #: lengths of a move in units of that which suits a normal distribution
_LEAP_SHARE = 0.1  #: share of moves by a whole difference, from mode to mode
_BLUR = 1e-5  #: standard deviation of a random shift of each move
#: draws of the prior for each particle; many are impossible, such as lenses that scatter more than
#: all light
_PRIOR_DRAWS_PER_PARTICLE = 4


@dataclass
class _Particles:
    place: FloatArray  #: (particle, free)
    prior: FloatArray  #: (particle,) log prior
    log: FloatArray  #: (particle,) log posterior

    def take(self, numbers: FloatArray) -> None:
        """Replace the particles by those with the given ``numbers``."""
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
    # target density: prior times likelihood ** power, from the prior (power 0) to the posterior
    # (power 1)
    particles, power = _from_prior(problem, count, rng), 0.0
    for _ in range(_MOST_POWERS):
        log_likelihood = particles.log - particles.prior
        power_before, power = power, _next_power(log_likelihood, power)
        weights = np.exp((power - power_before) * (log_likelihood - log_likelihood.max()))
        # systematic resampling: one random offset, then equal steps
        cumulative_weights = np.cumsum(weights / weights.sum())
        resampled = np.searchsorted(
            cumulative_weights,
            (rng.random() + np.arange(len(log_likelihood))) / len(log_likelihood),
        ).clip(0, len(log_likelihood) - 1)
        particles.take(rng.permutation(resampled))
        moves_per_particle = 0.0
        for _ in range(_MOST_SWEEPS):
            moves_per_particle += _sweep(problem, particles, power, rng)
            if moves_per_particle > _ENOUGH_MOVES:
                break
        if power == 1.0:
            break
    return particles.place, particles.log


def _from_prior(problem: SensorPosterior, count: int, rng: np.random.Generator) -> _Particles:
    """Return up to ``count`` draws of the prior at which the posterior is not zero."""
    prior_draws = torch.from_numpy(
        rng.standard_normal((_PRIOR_DRAWS_PER_PARTICLE * count, len(problem.names)))
    )
    coordinates = problem.theta(problem.coordinates.from_whitened(prior_draws))
    coordinates = coordinates[np.isfinite(coordinates).all(1)]
    prior, log = _logs(problem, coordinates)
    possible = np.flatnonzero(np.isfinite(log))[:count]
    # moves are differences of two others, which must span all parameters
    if len(possible) < 2 * len(problem.names):
        raise ValueError(
            f"{len(possible)} of {len(prior_draws)} draws of the priors of"
            f" {', '.join(problem.names)} can "
            "produce "
            "these numbers: give priors of lenses that scatter less than all light"
        )
    return _Particles(coordinates[possible], prior[possible], log[possible])


def _logs(problem: SensorPosterior, place: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the log prior and the log posterior at coordinates (particle, free)."""
    with torch.no_grad():
        prior: FloatArray = problem.coordinates.log_prior(problem.parameters(place)).numpy()
    return np.nan_to_num(prior, nan=-np.inf), problem.log_posterior(place)


def _next_power(gain: FloatArray, power: float) -> float:
    """Return the largest power of the likelihood that keeps the effective sample fraction at
    `_KEPT_FRACTION` or more; ``gain`` is the log likelihood.
    """

    def left(step: float) -> float:
        weights = np.exp(step * (gain - gain.max()))
        # effective sample fraction: (sum of weights)² over sum of squared weights
        return float(weights.sum() ** 2 / (weights**2).sum() / len(weights))

    if left(1.0 - power) >= _KEPT_FRACTION:
        return 1.0
    # bisection of the logarithm of the step
    low_step, high_step = 1e-12, 1.0 - power
    for _ in range(40):
        middle_step = (low_step * high_step) ** 0.5
        low_step, high_step = (
            (middle_step, high_step)
            if left(middle_step) >= _KEPT_FRACTION
            else (low_step, middle_step)
        )
    return power + low_step


def _sweep(
    problem: SensorPosterior, particles: _Particles, power: float, rng: np.random.Generator
) -> float:
    """Propose one move of each particle, and return the mean number of accepted moves per particle.

    A move is a difference of two particles of the other half of all particles (differential
    evolution).
    """
    halves, accepted_moves = np.array_split(rng.permutation(len(particles.log)), 2), 0
    dimension = particles.place.shape[1]
    for moved_half, other_half in (halves, halves[::-1]):
        one_end, other_end = (
            particles.place[other_half[rng.integers(len(other_half), size=len(moved_half))]]
            for _ in range(2)
        )
        # 2.38 / sqrt(2 d) is the best length of such moves for a normal distribution of d
        # coordinates
        scale = rng.choice(_MOVE_LENGTHS, size=len(moved_half)) * 2.38 / (2 * dimension) ** 0.5
        # a whole difference leads from one mode to another
        scale = np.where(rng.random(len(moved_half)) < _LEAP_SHARE, 1.0, scale)
        proposals = particles.place[moved_half] + scale[:, None] * (one_end - other_end)
        proposals = proposals + _BLUR * rng.standard_normal(proposals.shape)
        prior, log = _logs(problem, proposals)
        with np.errstate(invalid="ignore"):
            # log ratio of prior * likelihood ** power; log likelihood = log posterior - log prior
            log_ratio = (1 - power) * (prior - particles.prior[moved_half]) + power * (
                log - particles.log[moved_half]
            )
        # Metropolis rule
        accepted = np.log(rng.random(len(moved_half))) < np.where(
            np.isfinite(log_ratio), log_ratio, -np.inf
        )
        moved_numbers = moved_half[accepted]
        (
            particles.place[moved_numbers],
            particles.prior[moved_numbers],
            particles.log[moved_numbers],
        ) = (
            proposals[accepted],
            prior[accepted],
            log[accepted],
        )
        accepted_moves += int(accepted.sum())
    return accepted_moves / len(particles.log)


# --- posterior mixture ----------------------------------------------------------------------------

# A mixture density that approximates a posterior which may be long, curved, or in several parts.


_PARTICLES, _DRAWS_ABOUT_MODE = 1000, 200  #: number of particles, and of draws around the mode
_LOST_NATS = (
    40.0  #: particles this far below the best log posterior are dropped: their mode does not count
)
_COMPONENTS = 14  #: number of fitted components
_FREEDOM = 6.0  #: default degrees of freedom of each component
#: most fits, steps of each fit, samples that test a fit
_MOST_FITS, _FIT_STEPS, _TRIAL_SAMPLES = 16, 8, 2000
_SOFT_FRACTION, _ENOUGH_FRACTION = (
    0.3,
    0.4,
)  #: effective sample fractions: kept for fitting the next mixture, and at which fitting stops
_BROAD_SHARE, _BROAD_WIDTH = (
    0.05,
    2.0,
)  #: share and relative width of one broad component, which limits the largest weight
_BORROWED_SHARE = (
    0.03  #: share of samples, with the covariance of all, that is added to the components
)
_IMPOSSIBLE_LOG = -1e300  #: log density of an impossible sample


Random = np.random.Generator | np.random.RandomState


class Density(Protocol):
    """A density that approximates the posterior and from which samples can be drawn."""

    def draw(self, count: int, rng: Random) -> FloatArray:
        """Draw samples (count, free)."""

    def log_density(self, samples: FloatArray) -> FloatArray:
        """Return the logarithm of the density at samples (draw, free), up to a constant."""

    def propose(self, own: FloatArray, rng: Random) -> tuple[FloatArray, FloatArray]:
        """Return new samples, and the log ratio of the density at ``own`` (draw, free) to the
        density at each new sample.
        """
        new_samples = self.draw(len(own), rng)
        return new_samples, self.log_density(own) - self.log_density(new_samples)


@dataclass(frozen=True)
class Mixture(Density):
    """A mixture of multivariate Student's t distributions."""

    shares: FloatArray  #: (component,) sum 1
    centres: FloatArray  #: (component, free)
    roots: FloatArray  #: (component, free, free) lower Cholesky factors of the scale matrices
    tails: FloatArray | float = _FREEDOM  #: (component,) degrees of freedom

    def draw(self, count: int, rng: Random) -> FloatArray:
        """Draw samples (count, free)."""
        component = rng.choice(len(self.shares), size=count, p=self.shares)
        normal_draws = rng.standard_normal((count, self.centres.shape[1]))
        freedom = np.broadcast_to(self.tails, self.shares.shape)[component]
        # a normal draw over the root of chi² / degrees of freedom has Student's distribution
        student_draws = normal_draws / np.sqrt(rng.chisquare(freedom) / freedom)[:, None]
        samples: FloatArray = self.centres[component] + np.einsum(
            "nij,nj->ni", self.roots[component], student_draws
        )
        return samples

    def log_density(self, samples: FloatArray) -> FloatArray:
        """Return the logarithm of the density at samples (draw, free), up to a constant."""
        exponent = 0.5 * (self.tails + self.centres.shape[1])
        return log_sum(
            self._levels
            + self._constants
            - exponent * np.log1p(self._squares(samples) / self.tails)
        )

    def normal_shares(self, samples: FloatArray) -> FloatArray:
        """Return the share (draw, component) of each component in the density at samples, for
        normal components.
        """
        logs = self._levels - 0.5 * self._squares(samples)
        shares: FloatArray = np.exp(logs - log_sum(logs)[:, None])
        return shares

    @cached_property
    def _levels(self) -> FloatArray:
        """Return the terms of the log density of each component (component,) that come from its
        share and width.
        """
        scales = np.diagonal(self.roots, axis1=1, axis2=2)
        log_heights: FloatArray = np.log(self.shares.clip(1e-300)) - np.log(scales).sum(1)
        return log_heights

    @cached_property
    def _constants(self) -> FloatArray:
        """Return the terms of the log density of each component that come from its degrees of
        freedom.
        """
        from scipy.special import gammaln

        half_freedom, dimension = 0.5 * np.asarray(self.tails), self.centres.shape[1]
        constants: FloatArray = (
            gammaln(half_freedom + 0.5 * dimension)
            - gammaln(half_freedom)
            - 0.5 * dimension * np.log(2 * half_freedom)
        )
        return constants

    @cached_property
    def _inverses(self) -> FloatArray:
        return np.linalg.inv(self.roots).astype(np.float64)

    def _squares(self, samples: FloatArray) -> FloatArray:
        """Return the squared Mahalanobis distance (draw, component) from the centre of each
        component.
        """
        scaled_distance = self._inverses @ (samples.T[None] - self.centres[:, :, None])
        squared_distance: FloatArray = (scaled_distance**2).sum(1).T
        return squared_distance


def fit_mixture(
    problem: SensorPosterior, mode: LaplaceFit, count: int, rng: np.random.Generator
) -> tuple[Mixture, FloatArray, FloatArray]:
    """Return a mixture that approximates the posterior, samples of it (count, free), and the log
    ratio of posterior to mixture for each.

    A first mixture is fitted to particles and to draws around the mode. It stays half of every
    later mixture, because a part of the posterior without samples would be missed and the weights
    would not show it. The other half is fitted repeatedly to weighted samples. The mixture with the
    largest effective sample size is kept, and new samples are drawn from it. The caller must check
    the effective sample size of these.
    """
    start_points = _start(problem, mode, rng)
    first_mixture = mixture = best_mixture = _fitted(
        start_points, np.full(len(start_points), 1 / len(start_points)), rng
    )
    best_fraction = -1.0
    for _ in range(_MOST_FITS):
        samples, log_weights = weighed(problem, mixture, _TRIAL_SAMPLES, rng)
        fraction = effective(log_weights)
        if fraction > best_fraction:
            best_fraction, best_mixture = fraction, mixture
        if fraction >= _ENOUGH_FRACTION:
            break
        # the first mixture stays half of every next one
        mixture = _joined(first_mixture, _fitted(samples, normalised(softened(log_weights)), rng))
    return best_mixture, *weighed(problem, best_mixture, count, rng)


def _joined(first: Mixture, second: Mixture) -> Mixture:
    """Return the mixture of two mixtures with equal shares."""
    shares = 0.5 * np.concatenate([first.shares, second.shares])
    centres = np.concatenate([first.centres, second.centres])
    roots = np.concatenate([first.roots, second.roots])
    return Mixture(shares, centres, roots)


def weighed(
    problem: SensorPosterior, density: Density, count: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return samples of a density, and for each the log ratio of posterior to density."""
    samples = density.draw(count, rng)
    return samples, finite(problem.log_posterior(samples)) - density.log_density(samples)


def _start(problem: SensorPosterior, mode: LaplaceFit, rng: np.random.Generator) -> FloatArray:
    """Return particles and draws around the mode (point, free), without those far below the best
    log posterior.
    """
    points, log_posteriors = follow_posterior(problem, _PARTICLES, rng)
    near_mode = mode.draw(_DRAWS_ABOUT_MODE, rng)
    points = np.concatenate([points, near_mode])
    log_posteriors = np.concatenate([log_posteriors, problem.log_posterior(near_mode)])
    return points[log_posteriors > max(float(log_posteriors.max()), mode.log) - _LOST_NATS]


def _fitted(samples: FloatArray, weight: FloatArray, rng: np.random.Generator) -> Mixture:
    """Return the normal mixture fitted to weighted samples by expectation maximisation, with a
    broad component added.
    """
    centre, covariance = moments(samples, weight)
    overall_root = np.linalg.cholesky(firm(covariance))
    start_numbers = _distant_starts(
        np.linalg.solve(overall_root, (samples - centre).T).T, weight, rng
    )
    mixture = Mixture(
        # scale factor 0.5: narrower than all samples, so that the components can separate
        np.full(_COMPONENTS, 1 / _COMPONENTS),
        samples[start_numbers],
        np.repeat(0.5 * overall_root[None], _COMPONENTS, 0),
    )
    for _ in range(_FIT_STEPS):
        weighted_shares = weight[:, None] * mixture.normal_shares(samples)
        mixture = maximised(samples, weighted_shares, covariance)
    return Mixture(
        np.append((1 - _BROAD_SHARE) * mixture.shares, _BROAD_SHARE),
        np.concatenate([mixture.centres, centre[None]]),
        np.concatenate([mixture.roots, _BROAD_WIDTH * overall_root[None]]),
    )


def _distant_starts(places: FloatArray, weight: FloatArray, rng: np.random.Generator) -> list[int]:
    """Return the indices of the samples at which the components start.

    Every second start is drawn with a probability proportional to its squared distance from the
    starts before it, as in k-means++; the others are drawn by weight.
    """
    # a pool drawn by weight, so that a uniform choice from it is a choice by weight
    pool = rng.choice(len(places), size=4 * _PARTICLES // 10, p=weight)
    starts, squared_distance = [int(pool[0])], ((places[pool] - places[pool[0]]) ** 2).sum(1)
    for number in range(1, _COMPONENTS):
        takes_far = number % 2 and squared_distance.sum() > 0
        chances = squared_distance / squared_distance.sum() if takes_far else None
        starts.append(int(rng.choice(pool, p=chances)))
        # squared distance to the nearest start so far
        squared_distance = np.minimum(
            squared_distance, ((places[pool] - places[starts[-1]]) ** 2).sum(1)
        )
    return starts


def maximised(
    samples: FloatArray, parts: FloatArray, overall: FloatArray, borrowed: float = _BORROWED_SHARE
) -> Mixture:
    """Return the mixture of normal components with the weighted moments of samples; ``parts``
    (draw, component) are the weights.

    ``borrowed`` is the share of samples with the covariance ``overall`` that is added to all
    components together.
    """
    shares = parts.sum(0)
    centres = parts.T @ samples / shares.clip(1e-300)[:, None]
    deviations = samples[None] - centres[:, None]
    scatter_matrices = np.swapaxes(deviations * parts.T[:, :, None], 1, 2) @ deviations
    borrowed_each = borrowed / len(shares)
    # with some of the covariance of all samples, so that no component collapses
    covariance = (scatter_matrices + borrowed_each * overall) / (shares + borrowed_each)[
        :, None, None
    ]
    roots = np.linalg.cholesky(firm(covariance)).astype(np.float64)
    return Mixture(shares / shares.sum(), centres, roots)


def moments(samples: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the mean and the covariance of weighted samples."""
    centre = weight @ samples
    deviations = samples - centre
    return centre, deviations.T @ (weight[:, None] * deviations)


def firm(covariance: FloatArray) -> FloatArray:
    """Return covariances (..., free, free) with slightly raised diagonals, so that rounding cannot
    make them indefinite.
    """
    firmed = covariance.copy()
    index = np.arange(covariance.shape[-1])
    firmed[..., index, index] *= 1 + 1e-9
    return firmed


def uniform(count: int, rng: Random) -> FloatArray:
    """Return ``count`` numbers between 0 and 1 from either kind of generator."""
    return rng.random_sample(count) if isinstance(rng, np.random.RandomState) else rng.random(count)


def softened(log: FloatArray) -> FloatArray:
    """Return ``log`` times the largest factor, up to 1, that leaves enough effective samples for a
    fit.
    """
    if effective(log) >= _SOFT_FRACTION:
        return log
    # bisection of the logarithm of the factor
    low_factor, high_factor = 1e-12, 1.0
    for _ in range(40):
        middle_factor = (low_factor * high_factor) ** 0.5
        low_factor, high_factor = (
            (middle_factor, high_factor)
            if effective(middle_factor * log) >= _SOFT_FRACTION
            else (low_factor, middle_factor)
        )
    return low_factor * log


def effective(log: FloatArray) -> float:
    """Return the effective sample size of weights with the logarithms ``log``, as a fraction of
    their number.
    """
    return float(1 / (normalised(log) ** 2).sum() / len(log))


def normalised(log: FloatArray) -> FloatArray:
    """Return weights with a sum of 1 from the logarithms of unnormalised weights."""
    unnormalised = np.exp(log - log.max())
    weights: FloatArray = unnormalised / unnormalised.sum()
    return weights


def finite(log: FloatArray) -> FloatArray:
    """Return logarithms with minus infinity and NaN replaced by a very small number."""
    return np.nan_to_num(log, nan=_IMPOSSIBLE_LOG, neginf=_IMPOSSIBLE_LOG)


def log_sum(logs: FloatArray) -> FloatArray:
    """Return the logarithm of the sum of exponentials along the last axis."""
    # the largest is subtracted first, so that no exponential overflows
    largest = logs.max(-1)
    log_total: FloatArray = largest + np.log(np.exp(logs - largest[..., None]).sum(-1))
    return log_total
