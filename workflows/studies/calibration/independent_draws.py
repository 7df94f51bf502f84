"""Nearly independent draws from a posterior, made by one ensemble of walkers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from neusee.workflows.calibration import emcee_sampler
from neusee.workflows.calibration.ensembles import walk_until
from neusee.workflows.calibration.log_posterior import SensorPosterior
from neusee.workflows.calibration.posterior_mode import LaplaceFit

FloatArray = NDArray[np.float64]
WALKERS, DRAWS = 64, 99
_FIRST, _GROWTH, _LONGEST = 320, 1.5, 4000  #: steps of the first round, growth for each round, and most steps
_APART = 6.0  #: least length of a chain in autocorrelation times; its first half is discarded
_ALIKE = 1.25  #: ratio of two standard deviations that chance rarely exceeds, for 64 walkers and three tau each
_NOT_KEPT = Path("/dev/null/not kept")  #: a file that never exists, because a simulation is too short to be resumed


@dataclass(frozen=True)
class PosteriorDraws:
    """Draws from a posterior, and measures of the quality of the Markov chain."""

    samples: FloatArray  #: (draw, free parameter)
    tau: float = 0.0  #: steps, the longest autocorrelation time of any coordinate
    independent: bool = True  #: whether the chain was long enough
    stranded: int = 0  #: walkers that stay where the posterior is almost 0


def walk_draws(
    problem: SensorPosterior, mode: LaplaceFit, seed: int, how: str = "de", count: int = DRAWS
) -> PosteriorDraws:
    """Return ``count`` posterior draws from a Markov chain that is thinned to one step per autocorrelation time.

    The chain starts and walks as in `emcee_sampler.sample`. It ends sooner, because a simulation needs few draws.
    """
    run = emcee_sampler.start_ensemble(problem, mode, _NOT_KEPT, 0, seed, WALKERS, emcee_sampler.move(how))
    steps = _FIRST
    while True:
        walk_until([run], steps, problem.log_posterior)
        chain = run.backend.get_chain(discard=steps // 2)
        tau = emcee_sampler.autocorrelation_time(chain)
        apart = max(1, round(min(tau, len(chain))))
        seen = chain[::apart].reshape(-1, chain.shape[-1])
        enough = len(chain) >= _APART * tau and len(seen) >= 2 * count and _steady(chain)
        if enough or steps >= _LONGEST:
            break
        steps = int(_GROWTH * steps)
    rng = np.random.default_rng([seed, 2])
    taken = seen[rng.choice(len(seen), min(count, len(seen)), replace=False)]
    return PosteriorDraws(taken, tau, enough, emcee_sampler.stranded(run.backend.get_log_prob(discard=steps // 2)))


def _steady(chain: FloatArray) -> bool:
    """Return True if both halves of a Markov chain (step, walker, free parameter) have similar standard deviations."""
    early, late = (half.reshape(-1, half.shape[-1]).std(0) for half in np.array_split(chain, 2))
    return bool(((late < _ALIKE * early) & (early < _ALIKE * late)).all())
