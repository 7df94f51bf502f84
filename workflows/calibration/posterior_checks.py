"""Checks of a posterior: those that a statistician would ask for, each with its bar."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from neusee.nodes.calibrate import Likelihood
from neusee.workflows.calibration.identifiability import Identifiability
from neusee.workflows.calibration.importance_sampling import draw_samples, weights
from neusee.workflows.calibration.log_posterior import SensorPosterior
from neusee.workflows.calibration.posterior_mode import LaplaceFit

if TYPE_CHECKING:
    from neusee.workflows.calibration.emcee_sampler import Chains
    from neusee.workflows.calibration.log_posterior import FloatArray

Mark = Literal["pass", "warn", "fail"]
MISFIT = 1e-3  #: probability below which chance does not explain a deviance
_NEVER = -1e6  #: nats of an impossible sample
_RHAT, _INDEPENDENT, _ACCEPTED = 1.01, 1000.0, (0.1, 0.7)
_TAIL, _SD, _MEAN, _BELOW = 0.5, 0.05, 0.1, 2.0
_LUCK = 4.0  #: standard errors by which widths of two samples may differ


@dataclass(frozen=True)
class Check:
    """One check of a posterior."""

    name: str
    found: str
    bar: str
    mark: Mark


@dataclass(frozen=True)
class GoodnessOfFit:
    """The deviance of all levels, and the probability that chance alone makes it as large."""

    deviance: float
    freedom: float  #: degrees of freedom
    p: float

    @property
    def good(self) -> bool:
        """Return True if chance explains the deviance."""
        return self.p >= MISFIT


@dataclass(frozen=True)
class ImportanceSamples:
    """Samples with Pareto-smoothed weights: the posterior without a chain."""

    samples: FloatArray  #: (draw, free)
    weights: FloatArray  #: (draw,) sum 1
    tail: float  #: k-hat; above 0.7 the weights are unreliable

    def mean(self) -> FloatArray:
        """Return the mean (free,)."""
        found: FloatArray = self.weights @ self.samples
        return found

    def sd(self) -> FloatArray:
        """Return the standard deviation (free,)."""
        found: FloatArray = np.sqrt(self.weights @ (self.samples - self.mean()) ** 2)
        return found

    def doubt(self, like: FloatArray) -> FloatArray:
        """Return the relative standard error (free,) of the widths, for a distribution such as ``like``."""
        z = (like - like.mean(0)) / like.std(0)
        found: FloatArray = np.sqrt(((z**4).mean(0) - 1) * (self.weights**2).sum() / 4)
        return found


def arviz() -> Any:
    """Return the library; raise `ImportError` with the command that installs it."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # ArviZ warns of its next version
            import arviz as found
    except ImportError:
        raise ImportError('calibration needs arviz and h5py: pip install "neusee[calibrate]"') from None
    return found


def importance_samples(problem: SensorPosterior, mode: LaplaceFit, seed: int) -> ImportanceSamples:
    """Return importance samples of the posterior, with Pareto-smoothed weights."""
    samples, log = draw_samples(problem, mode, np.random.default_rng(seed))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        smooth, tail = arviz().psislw(np.where(np.isfinite(log), log - log.max(), _NEVER))
    return ImportanceSamples(samples, weights(smooth), float(tail))


def checks(
    problem: SensorPosterior, mode: LaplaceFit, identifiability: Identifiability, chains: Chains, law: ImportanceSamples
) -> list[Check]:
    """Return all checks; one that fails makes the posterior unfit for use."""
    found = [
        *_of_chains(chains),
        *_of_peak(problem, mode, identifiability, chains, law),
        *_of_data(problem, mode, identifiability),
    ]
    return found


def _of_chains(chains: Chains) -> Iterator[Check]:
    from neusee.workflows.calibration import emcee_sampler

    az = arviz()
    taus = chains.steps / chains.tau
    yield Check("chains are long", f"{taus:.0f} autocorrelation times", "50, tau settled", _mark(chains.long))
    rhat = max(_rhat(az, chains.draws[..., i]) for i in range(chains.draws.shape[-1]))
    yield Check("ensembles agree", f"R-hat {rhat:.4f}", f"at most {_RHAT}", _mark(rhat <= _RHAT))
    bulk, tail = (
        min(_effective_sample_size(az, chains.draws[..., i], how) for i in range(chains.draws.shape[-1]))
        for how in ("bulk", "tail")
    )
    enough = min(bulk, tail) >= _INDEPENDENT
    yield Check(
        "draws are enough",
        f"effective sample size {bulk:.0f}, of the tails {tail:.0f}",
        f"{_INDEPENDENT:.0f} each",
        _mark(enough),
    )
    low, high = _ACCEPTED
    well = low <= chains.accepted <= high
    yield Check("walkers move", f"{chains.accepted:.0%} of the steps", f"{low:.0%} to {high:.0%}", _mark(well, "warn"))
    lost = emcee_sampler.stranded(chains.log)  # R-hat does not see them where all ensembles have some
    said = f"{lost} of {chains.log.shape[0] * chains.log.shape[2]} lie {emcee_sampler.STRANDED:.0f} nats below the rest"
    yield Check("no walker is stranded", said, "none", _mark(lost == 0))


def _of_peak(
    problem: SensorPosterior, mode: LaplaceFit, identifiability: Identifiability, chains: Chains, law: ImportanceSamples
) -> Iterator[Check]:
    yield Check(
        "the mode was found", "settled" if mode.settled else "the search stopped", "settled", _mark(mode.settled)
    )
    below = mode.log - float(chains.log.max())
    said = f"{abs(below):.2g} nats {'below' if below > 0 else 'above'} the mode"
    yield Check("draws reach the mode", said, f"within {_BELOW:.0f}", _mark(abs(below) <= _BELOW))
    at = [i for i, name in enumerate(problem.names) if identifiability.kinds[name] == "estimate"]
    if not at:
        return
    sd, mean = law.sd()[at], law.mean()[at]
    flat = chains.flat[:, at]
    apart, off = np.abs(flat.std(0) / sd - 1), np.max(np.abs(flat.mean(0) - mean) / sd)
    told = np.maximum(_SD, _LUCK * law.doubt(flat))
    worst = int(np.argmax(apart / told))
    said = f"widths within {apart[worst]:.1%}, means {off:.2f} sd; k-hat {law.tail:.2f}"
    bar = f"{told[worst]:.0%} and {_MEAN} sd, where k-hat is below {_TAIL}"
    agrees = bool((apart <= told).all()) and off <= _MEAN
    yield Check("importance sampling agrees", said, bar, _mark(agrees, "fail" if law.tail < _TAIL else "warn"))


def _of_data(problem: SensorPosterior, mode: LaplaceFit, identifiability: Identifiability) -> Iterator[Check]:
    look = problem.likelihood(mode.theta[None])
    if float(look.degrees_of_freedom.sum()) > len(identifiability.estimated):
        found = goodness_of_fit(look, len(identifiability.estimated))
        said = f"deviance {found.deviance:.1f} of {found.freedom:.0f} degrees of freedom, p = {found.p:.2g}"
        yield Check("the model of the sensor fits the levels", said, f"p above {MISFIT}", _mark(found.good))
    count = len(identifiability.directions)
    weak = f"{count} of {len(identifiability.strengths)} directions are not determined"
    said = weak if count else "all parameters are determined"
    yield Check("the levels determine the parameters", said, "all, else no value is given", _mark(not count, "warn"))


def goodness_of_fit(likelihood: Likelihood, free: int = 0) -> GoodnessOfFit:
    """Return the goodness of fit of one sensor, of which ``free`` parameters were fitted to the same levels.

    Raises: `ValueError` for a likelihood without deviances, for many sensors at once, and where nothing is left to
    test.
    """
    from scipy.special import chdtrc

    if not len(likelihood.degrees_of_freedom):
        raise ValueError("this likelihood has no deviances: compute it with told: true")
    if likelihood.deviance.numel() != len(likelihood.degrees_of_freedom):
        raise ValueError(
            f"deviances {tuple(likelihood.deviance.shape)} are not of one sensor: give one row of parameters"
        )
    deviance, freedom = float(likelihood.deviance.sum()), float(likelihood.degrees_of_freedom.sum()) - free
    if freedom <= 0:
        raise ValueError(f"{freedom + free:.0f} numbers cannot test {free} free parameters: give more levels")
    return GoodnessOfFit(deviance, freedom, float(chdtrc(freedom, deviance)))


def _mark(good: bool, else_: Mark = "fail") -> Mark:
    return "pass" if good else else_


def _rhat(az: Any, draws: FloatArray) -> float:
    """Return R-hat of ensembles (ensemble, step, walker); the walkers of one ensemble depend on each other."""
    return float(az.rhat(draws.reshape(len(draws), -1)))


def _effective_sample_size(az: Any, draws: FloatArray, how: str) -> float:
    """Return the effective sample size of draws (ensemble, step, walker)."""
    chains = draws.transpose(0, 2, 1).reshape(-1, draws.shape[1])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # short chains fail by their effective sample size
        return float(az.ess(chains, method=how))


def count_failures(found: Sequence[Check]) -> int:
    """Return how many checks fail."""
    return sum(check.mark == "fail" for check in found)
