"""Independent draws of a posterior in place of a walk, for tests of what follows from the draws."""

import numpy as np

from neusee.workflows.calibration.emcee_sampler import Chains
from neusee.workflows.calibration.importance_sampling import draw_samples
from neusee.workflows.calibration.posterior_mixture import normalised

ENSEMBLES, STEPS, WALKERS = 4, 250, 8


def drawn_chains(problem, mode, file, sampling, *_):
    """Return weighted draws of the posterior as chains: independent, so that every check of
    chains holds.
    """
    rng = np.random.default_rng(sampling.seed)
    samples, log = draw_samples(problem, mode, rng)
    at = rng.choice(len(samples), ENSEMBLES * STEPS * WALKERS, p=normalised(log))
    draws = samples[at].reshape(ENSEMBLES, STEPS, WALKERS, -1)
    logs = problem.log_posterior(samples[at]).reshape(draws.shape[:-1])
    return Chains(draws, logs, accepted=0.5, tau=1.0, steps=STEPS, long=True)
