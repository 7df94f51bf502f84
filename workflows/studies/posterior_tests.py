"""Tests of a posterior: ranks of true parameters of simulated sensors, and a wider prior."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from neusee.nodes.calibrate import NAMES, Sufficient
from neusee.workflows.calibration import emcee_sampler
from neusee.workflows.calibration.emcee_sampler import walk_until
from neusee.workflows.calibration.identifiability import identify
from neusee.workflows.calibration.log_posterior import (
    LaplaceFit,
    SensorPosterior,
    find_mode,
    initial_theta,
    only_step,
)
from neusee.workflows.engine.differentiable_function import as_function
from neusee.workflows.engine.provenance import versions
from neusee.workflows.graph.recipe_graph import Recipe, needed
from neusee.workflows.keys.cache_key import digest, stream_seed
from neusee.workflows.keys.code_digest import engine
from neusee.workflows.report.figures.style import BLUE, VERMILION, drawn, panels
from neusee.workflows.store.result_store import Store, compute_once

# --- independent draws ----------------------------------------------------------------------------

# Nearly independent draws from a posterior, from one ensemble of walkers.


FloatArray = NDArray[np.float64]
WALKERS, DRAWS = 64, 99
#: steps of the first round, growth for each round, and most steps
_FIRST_STEPS, _GROWTH, _MOST_STEPS = 320, 1.5, 4000
_LEAST_TAUS = 6.0  #: least length of a chain in autocorrelation times; its first half is discarded
#: ratio of two standard deviations that is rarely exceeded by chance, for 64 walkers and three tau
#: each
_ALIKE = 1.25
#: a path that never exists: a simulation is too short to be resumed
_NOT_KEPT = Path("/dev/null/not kept")


@dataclass(frozen=True)
class PosteriorDraws:
    """Draws from a posterior, and measures of the quality of the Markov chain."""

    samples: FloatArray  #: (draw, free parameter)
    tau: float = 0.0  #: steps, the longest autocorrelation time of any coordinate
    independent: bool = True  #: whether the chain was long enough
    stranded: int = 0  #: walkers that stay where the posterior is almost 0


def walk_draws(
    problem: SensorPosterior, mode: LaplaceFit, seed: int, move_name: str = "de", count: int = DRAWS
) -> PosteriorDraws:
    """Return ``count`` posterior draws from a Markov chain thinned to one step per autocorrelation
    time.

    The chain starts and moves as in `emcee_sampler.sample`, but ends sooner, because a simulation
    needs few draws.
    """
    run = emcee_sampler.start_ensemble(
        problem, mode, _NOT_KEPT, 0, emcee_sampler.Sampling(seed, WALKERS, move_name)
    )
    steps = _FIRST_STEPS
    while True:
        walk_until([run], steps, problem.log_posterior)
        chain = run.backend.get_chain(discard=steps // 2)
        autocorrelation_time = emcee_sampler.autocorrelation_time(chain)
        thinning = max(1, round(min(autocorrelation_time, len(chain))))
        draws = chain[::thinning].reshape(-1, chain.shape[-1])
        is_long_enough = (
            len(chain) >= _LEAST_TAUS * autocorrelation_time
            and len(draws) >= 2 * count
            and _steady(chain)
        )
        if is_long_enough or steps >= _MOST_STEPS:
            break
        steps = int(_GROWTH * steps)
    rng = np.random.default_rng([seed, 2])
    chosen_draws = draws[rng.choice(len(draws), min(count, len(draws)), replace=False)]
    return PosteriorDraws(
        chosen_draws,
        autocorrelation_time,
        is_long_enough,
        emcee_sampler.stranded(run.backend.get_log_prob(discard=steps // 2)),
    )


def _steady(chain: FloatArray) -> bool:
    """Return True if both halves of a Markov chain (step, walker, free parameter) have similar
    standard deviations.
    """
    early_deviation, late_deviation = (
        half.reshape(-1, half.shape[-1]).std(0) for half in np.array_split(chain, 2)
    )
    return bool(
        (
            (late_deviation < _ALIKE * early_deviation)
            & (early_deviation < _ALIKE * late_deviation)
        ).all()
    )


# --- simulated sensors ----------------------------------------------------------------------------

# Simulation-based calibration: sensors drawn from the prior, their simulated frames, and their
# posteriors.
#
# Each simulation depends only on the recipe and on the simulation's number, and the store keeps the
# result: an interrupted study continues, and the first 200 of 1000 simulations are those of a
# shorter study.


#: function of a posterior, its mode and a seed, which returns draws from the posterior
Sampler = Callable[[SensorPosterior, LaplaceFit, int], PosteriorDraws]
_EXPOSE = "calibrate.expose"
#: largest prior standard deviation of each logarithm, and of the offset in e-; a wider prior would
#: give sensors that the recipe's frames do not constrain
WIDEST = {
    "gain": 0.1,
    "offset": 20.0,
    "read_noise": 0.1,
    "dark_current": 0.5,
    "full_well": 0.1,
    "quantum_efficiency": 0.05,
    "spread": 0.1,
}
_TAIL = 0.05  #: share of the draws beyond each end of the interval whose coverage is tested


@dataclass(frozen=True)
class SensorSimulation:
    """The result of the calibration of one simulated sensor, in types that the store can save."""

    truth: dict[str, float]
    rank: dict[str, int] = field(default_factory=dict)  #: number of draws below the truth
    #: whether the central 90 % of the draws contain the truth
    inside: dict[str, bool] = field(default_factory=dict)
    #: mean minus truth, in standard deviations of the draws
    z: dict[str, float] = field(default_factory=dict)
    #: by parameter, one of `identifiability.KINDS`
    kinds: dict[str, str] = field(default_factory=dict)
    tau: float = 0.0  #: steps
    independent: bool = False  #: whether the chain was long enough
    stranded: int = 0  #: walkers that stay where the posterior is almost 0
    seconds: float = 0.0
    refused: str = ""  #: why there is no posterior of these frames


class SensorSimulator:
    """Simulates and calibrates sensors for the calibration of a recipe; each simulation has its own
    sensor and frames.
    """

    def __init__(
        self, recipe: Recipe, store: Store, pixels: int, sampler: Sampler, label: str
    ) -> None:
        """Prepare simulations of ``recipe``; ``label`` names the sampler in the store keys of
        the results.
        """
        self.store, self.sampler, self.label = store, sampler, label
        self.exposed = [
            name for name in needed(recipe, recipe.steps) if recipe.steps[name].node.path == _EXPOSE
        ]
        if not self.exposed:
            raise ValueError(f"{recipe.name} simulates no frames: add a step of the node {_EXPOSE}")
        self.recipe = with_narrow_prior(
            recipe, {name: {"shape": (pixels, pixels)} for name in self.exposed}
        )
        with TemporaryDirectory(prefix="neusee-") as folder:
            self.nominal = SensorPosterior.of(self.recipe, Store(folder))
            self._source = str(self.recipe.steps[self.nominal.step].wires["levels"])
            self._weigh, self._weigh_in_full = self._functions(Store(folder))

    def simulation(self, number: int) -> SensorSimulation:
        """Return the simulation with index ``number``, from the store or computed now."""
        key = digest("calibration study", self._key_parts(), number)
        seed, description = (
            stream_seed(self.recipe.seed, f"calibration study {number}"),
            {"step": "study calibration"},
        )
        return compute_once(
            self.store, key, SensorSimulation, lambda: self._simulate(seed), description, small=True
        )

    def truth(self, seed: int) -> dict[str, float]:
        """Draw the parameters of a sensor from the prior."""
        drawn_sensor = self.nominal.coordinates.draw(1, torch.Generator().manual_seed(seed))
        return {name: float(value) for name, value in drawn_sensor.items()}

    def problem(self, truth: Mapping[str, float], seed: int) -> SensorPosterior:
        """Simulate frames of a sensor with the parameters ``truth``, and return the posterior given
        these frames.
        """
        levels = self._levels(truth, seed)

        def with_levels(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
            return lambda theta: function({**theta, self._source: levels})

        weigh, weigh_in_full = with_levels(self._weigh), with_levels(self._weigh_in_full)
        return replace(self.nominal, levels=levels, weigh=weigh, weigh_in_full=weigh_in_full)

    def prior_widths(self) -> dict[str, float]:
        """Return the prior standard deviation of each free parameter: of its logarithm, or for the
        offset in e-.
        """
        widths = zip(NAMES, self.nominal.coordinates.prior.width.tolist(), strict=True)
        return {name: width for name, width in widths if np.isfinite(width)}

    def _simulate(self, seed: int) -> SensorSimulation:
        """Draw a sensor, calibrate its simulated frames, and return the ranks of its true
        parameters.
        """
        began = time.perf_counter()
        truth = self.truth(seed)
        problem = self.problem(truth, seed)
        try:
            mode = find_mode(problem, initial_theta(problem))
            identified = identify(problem, mode)
            if identified.refused:
                raise ValueError(identified.refused)
            posterior_draws = self.sampler(problem, mode, seed)
        except ValueError as error:
            return SensorSimulation(truth, refused=str(error), seconds=time.perf_counter() - began)
        ranked = rank_truth(problem, truth, posterior_draws)
        return replace(ranked, kinds=identified.kinds, seconds=time.perf_counter() - began)

    def _levels(self, truth: Mapping[str, float], seed: int) -> Sufficient:
        """Simulate frames of a sensor with the parameters ``truth``, and return the statistics of
        each light level.
        """
        values: dict[str, float] = {}
        for step in self.exposed:
            # all exposing steps simulate the same sensor
            values |= {f"{step}.{name}": value for name, value in truth.items()}
        recipe = replace(self.recipe, seed=seed)
        with TemporaryDirectory(prefix="neusee-") as folder, torch.no_grad():
            frames = as_function(recipe, *values, outputs=[self._source], store=Store(folder))
            levels: Sufficient = frames(values)[self._source]
        return levels

    def _functions(self, store: Store) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
        """Return the likelihood as a function of light levels and parameters, without and with
        deviances.
        """
        step = self.recipe.steps[self.nominal.step]
        # inputs of the function: the level statistics, and each free parameter
        free = [self._source, *(f"{step.name}.{name}" for name in self.nominal.names)]

        def function(detailed: bool) -> Callable[[Any], Any]:
            changed_step = replace(step, params={**step.params, "told": detailed})
            recipe = replace(self.recipe, steps={**self.recipe.steps, step.name: changed_step})
            return as_function(recipe, *free, outputs=[step.name], store=store)

        return function(False), function(True)

    def _key_parts(self) -> list[Any]:
        """Return the parts of the store key of a simulation."""
        prior = [column.tolist() for column in self.nominal.coordinates.prior]
        code = [engine("studies.posterior_tests"), versions(), version("emcee")]
        return [self.nominal.key, self.recipe.seed, prior, self.label, *code]


def with_narrow_prior(recipe: Recipe, changed: Mapping[str, Mapping[str, Any]]) -> Recipe:
    """Return the recipe with the parameters ``changed`` by step, and with priors no wider than
    `WIDEST`.
    """
    prior = only_step(recipe, "calibrate.prior")
    capped = {
        name: _capped(name, law)
        for name, law in prior.params.items()
        if name in WIDEST or name == "offset"
    }
    params_by_step = {**changed, prior.name: capped}
    steps = {
        step_name: replace(
            recipe.steps[step_name], params={**recipe.steps[step_name].params, **new_params}
        )
        for step_name, new_params in params_by_step.items()
    }
    return replace(recipe, steps={**recipe.steps, **steps})


def _capped(name: str, law: tuple[float, float] | None) -> tuple[float, float] | None:
    """Return the prior (median, width) of a parameter, no wider than `WIDEST`; None without a
    prior.

    The width of the offset is a standard deviation; all other widths are factors.
    """
    if law is None:
        return None
    widest = WIDEST[name] if name == "offset" else float(np.exp(WIDEST[name]))
    return law[0], min(law[1], widest)


def rank_truth(
    problem: SensorPosterior, truth: Mapping[str, float], drawn: PosteriorDraws
) -> SensorSimulation:
    """Return the rank of each true parameter among the draws, and the normalised deviation of the
    posterior mean from it.
    """
    values = {name: draws.numpy() for name, draws in problem.parameters(drawn.samples).items()}
    simulation = SensorSimulation(
        dict(truth), tau=drawn.tau, independent=drawn.independent, stranded=drawn.stranded
    )
    for name, draws in values.items():
        simulation.rank[name] = rank = int((draws < truth[name]).sum())
        # contains exactly 90 % of uniform ranks
        simulation.inside[name] = _TAIL * (len(draws) + 1) <= rank < (1 - _TAIL) * (len(draws) + 1)
        simulation.z[name] = float((draws.mean() - truth[name]) / draws.std(ddof=1))
    return simulation


# --- rank uniformity ------------------------------------------------------------------------------

# Tests of a posterior: uniformity of the ranks of true parameters, and coverage of 90 % intervals.


BINS, SHARE = 10, 0.9
_CHANCE = 0.01  #: probability of a false alarm of the rank tests of all parameters together
_DRAWN = 0.99  #: probability that a bin of uniform ranks is inside the drawn band
_GREY = "#777777"
_CERTAIN = 0.999  #: probability that the coverage of a correct posterior is within its limits
#: limits of the coverage by number of simulations, rounded; the exact limits for 1000 are 0.868 and
#: 0.930
_ROUNDED = {200: (0.825, 0.960), 1000: (0.870, 0.930)}


@dataclass(frozen=True)
class RankTest:
    """The rank test and the coverage test of one parameter over all simulations."""

    name: str
    counts: tuple[int, ...]  #: ranks by bin
    p: float  #: p-value of the hypothesis of uniform ranks
    least_p: float
    coverage: float  #: share of the simulations whose central 90 % of draws contain the truth
    bar: tuple[float, float]  #: limits of the coverage
    z_mean: float
    z_sd: float

    @property
    def uniform(self) -> bool:
        return self.p > self.least_p

    @property
    def covered(self) -> bool:
        return self.bar[0] <= self.coverage <= self.bar[1]

    @property
    def failed(self) -> int:
        return (not self.uniform) + (not self.covered)


def rank_tests(simulations: Sequence[SensorSimulation]) -> list[RankTest]:
    """Return the rank test and coverage test of each parameter, from all simulations that have a
    posterior.
    """
    sound = [simulated for simulated in simulations if not simulated.refused]
    if not sound:
        raise ValueError(
            "no simulation has a posterior; reason of the first simulation:"
            f" {simulations[0].refused}"
        )
    return [_rank_test(name, sound, len(sound[0].rank)) for name in sound[0].rank]


def _rank_test(name: str, sound: Sequence[SensorSimulation], parameters: int) -> RankTest:
    """Return the tests of one parameter over the simulations ``sound``, which all have a posterior.

    ``parameters`` is the number of parameters, by which the probability of a false alarm is
    divided.
    """
    from scipy.stats import chisquare

    counts, _ = np.histogram(
        [simulated.rank[name] for simulated in sound], BINS, (-0.5, DRAWS + 0.5)
    )
    z_scores = np.array([simulated.z[name] for simulated in sound])
    return RankTest(
        name,
        tuple(counts.tolist()),
        float(chisquare(counts).pvalue),
        _CHANCE / parameters,
        float(np.mean([simulated.inside[name] for simulated in sound])),
        coverage_limits(len(sound)),
        float(z_scores.mean()),
        float(z_scores.std(ddof=1)) if len(z_scores) > 1 else math.nan,
    )


def coverage_limits(count: int) -> tuple[float, float]:
    """Return limits for the coverage of intervals; a correct posterior violates them in 1 of 1000
    studies.
    """
    if count in _ROUNDED:
        return _ROUNDED[count]
    least_count, most_count = chance_band(count, SHARE, _CERTAIN)
    return least_count / count, most_count / count


def chance_band(count: int, share: float, certain: float) -> tuple[float, float]:
    """Return the central interval of a binomial distribution with the probability content
    ``certain``.
    """
    from scipy.stats import binom

    least_count, most_count = binom.interval(certain, count, share)
    return float(least_count), float(most_count)


@drawn
def ranks(rank_tests: Sequence[RankTest]) -> Any:
    """Draw a histogram of the ranks of each true parameter, with the 99 % band of uniform ranks."""
    figure, axes = panels(len(rank_tests), 3, 3.4, 2.4, below=0.4, sharex=True)
    for ax, test in zip(axes, rank_tests, strict=True):
        _histogram(ax, test)
    figure.supxlabel(f"draws below the truth, of {DRAWS}", fontsize=10)
    figure.supylabel("simulations", fontsize=10)
    return figure


def _histogram(ax: Any, test: RankTest) -> None:
    """Draw the histogram of the ranks of one parameter, with the band of chance."""
    total, width = sum(test.counts), (DRAWS + 1) / BINS
    band_low, band_high = chance_band(total, 1.0 / BINS, _DRAWN)
    ax.axhspan(band_low, band_high, color="#cccccc", alpha=0.6, linewidth=0)
    ax.axhline(total / BINS, color=_GREY, linewidth=0.8)
    colour = BLUE if test.uniform else VERMILION
    # middles of the bins
    ax.bar(
        [(number + 0.5) * width for number in range(BINS)],
        test.counts,
        0.92 * width,
        color=colour,
        alpha=0.85,
    )
    ax.set_title(f"{test.name.replace('_', ' ')}: p = {test.p:.2g}")
    ax.set_ylim(0, 1.15 * max(band_high, *test.counts))
    ax.grid(False, axis="x")
    ax.set_axisbelow(True)


# --- prior sensitivity ----------------------------------------------------------------------------

# Sensitivity of a posterior to its prior, by reweighting of draws to a prior that is twice as wide.


#: least effective sample fraction for reliable reweighting; for a parameter that only its prior
#: constrains it is a quarter or less
ENOUGH = 0.5


@dataclass(frozen=True)
class ParameterSensitivity:
    """The estimate of one parameter, and its estimates with the prior of each parameter twice as
    wide.
    """

    name: str
    #: one of `identifiability.KINDS`; for `upper` and `lower` the value is a limit of 95 %
    kind: str
    value: float
    sd: float
    #: estimate by the parameter whose prior is twice as wide; None where reweighting is unreliable
    doubled: Mapping[str, float | None]


@dataclass(frozen=True)
class Sensitivity:
    """The sensitivity of the estimates of all parameters to the width of each prior."""

    findings: Sequence[ParameterSensitivity]
    left: Mapping[str, float]  #: effective sample fraction with each prior twice as wide


def sensitivity(
    problem: SensorPosterior, samples: FloatArray, kinds: Mapping[str, str]
) -> Sensitivity:
    """Return the sensitivity of each parameter to each prior, from draws ``samples`` (draw, free
    parameter).
    """
    values = {
        name: parameter_draws.numpy()
        for name, parameter_draws in problem.parameters(samples).items()
    }
    whitened_draws = problem.whitened(samples)
    weights = {
        name: _weights(whitened_draws[:, number]) for number, name in enumerate(problem.names)
    }
    # effective number of draws 1 / sum(w^2), over their number
    effective_fractions = {
        name: float(1.0 / (weights_of_prior @ weights_of_prior) / len(weights_of_prior))
        for name, weights_of_prior in weights.items()
    }
    equal_weights = np.full(len(samples), 1.0 / len(samples))

    def of(name: str) -> ParameterSensitivity:
        parameter_draws, kind = values[name], kinds[name]
        reweighted = {
            widened: _value(parameter_draws, weights_of_prior, kind)
            if effective_fractions[widened] >= ENOUGH
            else None
            for widened, weights_of_prior in weights.items()
        }
        return ParameterSensitivity(
            name,
            kind,
            _value(parameter_draws, equal_weights, kind),
            float(parameter_draws.std(ddof=1)),
            reweighted,
        )

    return Sensitivity([of(name) for name in problem.names], effective_fractions)


def _weights(z: FloatArray) -> FloatArray:
    """Return normalised importance weights of draws ``z`` for a normal prior of standard
    deviation 2 instead of 1.
    """
    # log of N(z; 0, 2) / N(z; 0, 1), up to a constant
    log_ratios = 0.5 * (1.0 - 0.25) * z**2
    ratios = np.exp(log_ratios - log_ratios.max())
    weights: FloatArray = ratios / ratios.sum()
    return weights


def _value(x: FloatArray, weights: FloatArray, kind: str) -> float:
    """Return the weighted mean of the draws ``x``, or their 95 % limit if the frames only limit the
    parameter (``kind`` is ``upper`` or ``lower``).
    """
    if kind not in ("upper", "lower"):
        return float(weights @ x)
    order = np.argsort(x)
    share = 1.0 - _TAIL if kind == "upper" else _TAIL
    index = int(np.searchsorted(np.cumsum(weights[order]), share))
    return float(x[order[min(index, len(x) - 1)]])
