"""Whether what was drawn may be believed: the checks that a statistician would ask for, each with its bar."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from neusee.workflows.calibration.goodness_of_fit import MISFIT, fit
from neusee.workflows.calibration.identifiability import Known
from neusee.workflows.calibration.importance_sampling import drawn, weights
from neusee.workflows.calibration.log_posterior import SensorPosterior
from neusee.workflows.calibration.posterior_mode import LaplaceFit

if TYPE_CHECKING:
    from neusee.workflows.calibration.emcee_sampler import Chains
    from neusee.workflows.calibration.log_posterior import Places

Mark = Literal["pass", "warn", "fail"]
_NEVER = -1e6  #: nats, of a draw that cannot be
_RHAT, _INDEPENDENT, _ACCEPTED = 1.01, 1000.0, (0.1, 0.7)
_TAIL, _SD, _MEAN, _BELOW = 0.5, 0.05, 0.1, 2.0
_LUCK = 4.0  #: standard errors by which widths of two samples may differ


@dataclass(frozen=True)
class Check:
    """One check."""

    name: str
    found: str
    bar: str
    mark: Mark


@dataclass(frozen=True)
class Weighed:
    """Draws with Pareto-smoothed weights: the posterior without a chain."""

    places: Places  #: (draw, free)
    weights: Places  #: (draw,) sum 1
    tail: float  #: k-hat: above 0.7 the weights say nothing

    def mean(self) -> Places:
        """(free,)"""
        found: Places = self.weights @ self.places
        return found

    def sd(self) -> Places:
        """(free,)"""
        found: Places = np.sqrt(self.weights @ (self.places - self.mean()) ** 2)
        return found

    def doubt(self, like: Places) -> Places:
        """(free,) how far the widths may be off by the luck of so many draws, relative, of a law such as ``like``."""
        z = (like - like.mean(0)) / like.std(0)
        found: Places = np.sqrt(((z**4).mean(0) - 1) * (self.weights**2).sum() / 4)
        return found


def arviz() -> Any:
    """The library; raises ImportError with the way to have it."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of its next edition
            import arviz as found
    except ImportError:
        raise ImportError('calibration needs arviz and h5py: pip install "neusee[calibrate]"') from None
    return found


def weighed(problem: SensorPosterior, peak: LaplaceFit, seed: int) -> Weighed:
    """Importance sampling, with Pareto-smoothed weights."""
    places, log = drawn(problem, peak, np.random.default_rng(seed))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        smooth, tail = arviz().psislw(np.where(np.isfinite(log), log - log.max(), _NEVER))
    return Weighed(places, weights(smooth), float(tail))


def checks(problem: SensorPosterior, peak: LaplaceFit, known: Known, chains: Chains, law: Weighed) -> list[Check]:
    """All of them; one that fails makes the posterior unfit for use."""
    found = [*_of_chains(chains), *_of_peak(problem, peak, known, chains, law), *_of_data(problem, peak, known)]
    return found


def _of_chains(chains: Chains) -> Iterator[Check]:
    from neusee.workflows.calibration import emcee_sampler

    az = arviz()
    taus = chains.steps / chains.tau
    yield Check("chains are long", f"{taus:.0f} autocorrelation times", "50, tau settled", _mark(chains.long))
    rhat = max(_rhat(az, chains.draws[..., i]) for i in range(chains.draws.shape[-1]))
    yield Check("ensembles agree", f"R-hat {rhat:.4f}", f"at most {_RHAT}", _mark(rhat <= _RHAT))
    bulk, tail = (
        min(_worth(az, chains.draws[..., i], how) for i in range(chains.draws.shape[-1])) for how in ("bulk", "tail")
    )
    enough = min(bulk, tail) >= _INDEPENDENT
    yield Check("draws are enough", f"worth {bulk:.0f}, tails {tail:.0f}", f"{_INDEPENDENT:.0f} each", _mark(enough))
    low, high = _ACCEPTED
    well = low <= chains.accepted <= high
    yield Check("walkers move", f"{chains.accepted:.0%} of the steps", f"{low:.0%} to {high:.0%}", _mark(well, "warn"))
    lost = emcee_sampler.stranded(chains.log)  # R-hat does not see them where all ensembles have some
    said = f"{lost} of {chains.log.shape[0] * chains.log.shape[2]} lie {emcee_sampler.STRANDED:.0f} nats below the rest"
    yield Check("no walker is stranded", said, "none", _mark(lost == 0))


def _of_peak(problem: SensorPosterior, peak: LaplaceFit, known: Known, chains: Chains, law: Weighed) -> Iterator[Check]:
    yield Check(
        "the peak was found", "settled" if peak.settled else "the search stopped", "settled", _mark(peak.settled)
    )
    below = peak.log - float(chains.log.max())
    said = f"{abs(below):.2g} nats {'below' if below > 0 else 'above'} the peak"
    yield Check("draws reach the peak", said, f"within {_BELOW:.0f}", _mark(abs(below) <= _BELOW))
    at = [i for i, name in enumerate(problem.names) if known.kinds[name] == "estimate"]
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


def _of_data(problem: SensorPosterior, peak: LaplaceFit, known: Known) -> Iterator[Check]:
    look = problem.look(peak.place[None])
    if float(look.degrees_of_freedom.sum()) > len(known.estimated):
        found = fit(look, len(known.estimated))
        said = f"deviance {found.deviance:.1f} of {found.freedom:.0f} degrees of freedom, p = {found.p:.2g}"
        yield Check("the sensor's law fits the levels", said, f"p above {MISFIT}", _mark(found.good))
    count = len(known.directions)
    said = "all parameters are told" if not count else f"{count} of {len(known.strengths)} directions are not told"
    yield Check("the levels tell the parameters", said, "all, else no value is given", _mark(not count, "warn"))


def _mark(good: bool, else_: Mark = "fail") -> Mark:
    return "pass" if good else else_


def _rhat(az: Any, draws: Places) -> float:
    """Of ensembles (ensemble, step, walker): the walkers of one know of each other."""
    return float(az.rhat(draws.reshape(len(draws), -1)))


def _worth(az: Any, draws: Places, how: str) -> float:
    """How many independent draws (ensemble, step, walker) are as good as."""
    chains = draws.transpose(0, 2, 1).reshape(-1, draws.shape[1])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of chains that are short: they fail by what comes out
        return float(az.ess(chains, method=how))


def failed(found: Sequence[Check]) -> int:
    """How many fail."""
    return sum(check.mark == "fail" for check in found)
