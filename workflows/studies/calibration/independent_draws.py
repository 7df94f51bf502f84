"""Few draws from a posterior that hardly depend on each other: one ensemble, as long as that takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from neusee.workflows.calibration import emcee_sampler
from neusee.workflows.calibration.ensembles import go_on
from neusee.workflows.calibration.log_posterior import SensorPosterior
from neusee.workflows.calibration.posterior_mode import LaplaceFit

if TYPE_CHECKING:
    from neusee.workflows.calibration.log_posterior import Places

WALKERS, DRAWS = 64, 99
_FIRST, _GROWTH, _LONGEST = 320, 1.5, 4000  #: steps of the first round; more by round; when a chain is given up
_APART = 6.0  #: autocorrelation times that are thrown away, and as many again that are drawn from
_ALIKE = 1.25  #: ratio of two standard deviations that chance gives at most, of 64 walkers by three tau each
_NOT_KEPT = Path("/dev/null/not kept")  #: a file that never exists: a simulation is over before it could be stopped


@dataclass(frozen=True)
class Drawn:
    """Draws, and whether they are worth as many independent ones."""

    places: Places  #: (draw, free)
    tau: float = 0.0  #: steps, the longest autocorrelation time of any coordinate
    independent: bool = True
    stranded: int = 0  #: walkers that stay where the posterior is none


def walked(problem: SensorPosterior, peak: LaplaceFit, seed: int, how: str = "de", count: int = DRAWS) -> Drawn:
    """``count`` draws by the move ``how``, taken at random of walkers that were looked at once each tau.

    It starts and walks as `calibrate.sample` does; it ends sooner, for each simulation need only give few draws.
    """
    run = emcee_sampler._begun(problem, peak, _NOT_KEPT, 0, seed, WALKERS, emcee_sampler.move(how))
    steps = _FIRST
    while True:
        go_on([run], steps, problem.log_posterior)
        chain = run.backend.get_chain(discard=steps // 2)
        tau = emcee_sampler._tau(chain)
        apart = max(1, round(min(tau, len(chain))))
        seen = chain[::apart].reshape(-1, chain.shape[-1])
        enough = len(chain) >= _APART * tau and len(seen) >= 2 * count and _steady(chain)
        if enough or steps >= _LONGEST:
            break
        steps = int(_GROWTH * steps)
    rng = np.random.default_rng([seed, 2])
    taken = seen[rng.choice(len(seen), min(count, len(seen)), replace=False)]
    return Drawn(taken, tau, enough, emcee_sampler.stranded(run.backend.get_log_prob(discard=steps // 2)))


def _steady(chain: Places) -> bool:
    """Whether walkers (step, walker, free) have stopped to spread: a start at an edge can be far too narrow."""
    early, late = (half.reshape(-1, half.shape[-1]).std(0) for half in np.array_split(chain, 2))
    return bool(((late < _ALIKE * early) & (early < _ALIKE * late)).all())
