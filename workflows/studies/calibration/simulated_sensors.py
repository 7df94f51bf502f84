"""Simulation-based calibration: sensors drawn from the prior, their simulated frames, and their posteriors.

Each simulation depends only on the recipe and on the simulation's number, and the store keeps the result: an
interrupted study continues, and the first 200 of 1000 simulations are those of a shorter study.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from neusee.nodes.calibrate import NAMES, Sufficient
from neusee.workflows.calibration.identifiability import identify
from neusee.workflows.calibration.log_posterior import SensorPosterior, only_step
from neusee.workflows.calibration.posterior_mode import LaplaceFit, find_mode, initial_theta
from neusee.workflows.engine.differentiable_function import as_function
from neusee.workflows.engine.provenance import versions
from neusee.workflows.graph.recipe_graph import Recipe, needed
from neusee.workflows.keys.cache_key import digest, stream_seed
from neusee.workflows.keys.engine_digest import engine
from neusee.workflows.store.memo import compute_once
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.calibration.independent_draws import PosteriorDraws

#: function of a posterior, its mode and a seed, which returns draws from the posterior
Sampler = Callable[[SensorPosterior, LaplaceFit, int], PosteriorDraws]
_EXPOSE = "calibrate.expose"
#: largest standard deviation of the prior of each logarithm, and of the offset in e-: with a wider prior some sensors
#: would be drawn that the recipe's frames do not constrain
WIDEST = {
    "gain": 0.1,
    "offset": 20.0,
    "read_noise": 0.1,
    "dark_current": 0.5,
    "full_well": 0.1,
    "quantum_efficiency": 0.05,
    "spread": 0.1,
}
_TAIL = 0.05  #: share of the draws beyond either end of the interval whose coverage is counted


@dataclass(frozen=True)
class SensorSimulation:
    """The result of the calibration of one simulated sensor, in types that the store can save."""

    truth: dict[str, float]
    rank: dict[str, int] = field(default_factory=dict)  #: number of draws below the truth
    inside: dict[str, bool] = field(default_factory=dict)  #: whether the central 90 % of the draws contain the truth
    z: dict[str, float] = field(default_factory=dict)  #: mean minus truth, in standard deviations of the draws
    kinds: dict[str, str] = field(default_factory=dict)  #: by parameter, one of `identifiability.KINDS`
    tau: float = 0.0  #: steps
    independent: bool = False  #: whether the chain was long enough
    stranded: int = 0  #: walkers that stay where the posterior is almost 0
    seconds: float = 0.0
    refused: str = ""  #: why there is no posterior of these frames


class SensorSimulator:
    """A simulator of sensors for a recipe's calibration; each simulation has its own sensor and frames."""

    def __init__(self, recipe: Recipe, store: Store, pixels: int, sampler: Sampler, label: str) -> None:
        """Prepare simulations of ``recipe``; ``label`` names the sampler in the store keys of the results."""
        self.store, self.sampler, self.label = store, sampler, label
        self.exposed = [name for name in needed(recipe, recipe.steps) if recipe.steps[name].node.path == _EXPOSE]
        if not self.exposed:
            raise ValueError(f"{recipe.name} simulates no frames: add a step of the node {_EXPOSE}")
        self.recipe = with_narrow_prior(recipe, {name: {"shape": (pixels, pixels)} for name in self.exposed})
        with TemporaryDirectory(prefix="neusee-") as folder:
            self.nominal = SensorPosterior.of(self.recipe, Store(folder))
            self._source = str(self.recipe.steps[self.nominal.step].wires["levels"])
            self._weigh, self._weigh_in_full = self._functions(Store(folder))

    def simulation(self, number: int) -> SensorSimulation:
        """Return the simulation with the number ``number``; compute the simulation if the store does not have it."""
        key = digest("calibration study", self._key_parts(), number)
        seed, about = stream_seed(self.recipe.seed, f"calibration study {number}"), {"step": "study calibration"}
        return compute_once(self.store, key, SensorSimulation, lambda: self._simulate(seed), about, small=True)

    def truth(self, seed: int) -> dict[str, float]:
        """Draw the parameters of a sensor from the prior."""
        drawn = self.nominal.coordinates.draw(1, torch.Generator().manual_seed(seed))
        return {name: float(x) for name, x in drawn.items()}

    def problem(self, truth: Mapping[str, float], seed: int) -> SensorPosterior:
        """Simulate frames of a sensor with the parameters ``truth``, and return the posterior of these frames."""
        levels = self._levels(truth, seed)

        def with_levels(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
            return lambda theta: function({**theta, self._source: levels})

        weigh, weigh_in_full = with_levels(self._weigh), with_levels(self._weigh_in_full)
        return replace(self.nominal, levels=levels, weigh=weigh, weigh_in_full=weigh_in_full)

    def prior_widths(self) -> dict[str, float]:
        """Return the prior standard deviation of the logarithm of each free parameter, or of the offset in e-."""
        widths = zip(NAMES, self.nominal.coordinates.prior.width.tolist(), strict=True)
        return {name: width for name, width in widths if np.isfinite(width)}

    def _simulate(self, seed: int) -> SensorSimulation:
        began = time.perf_counter()
        truth = self.truth(seed)
        problem = self.problem(truth, seed)
        try:
            mode = find_mode(problem, initial_theta(problem))
            identified = identify(problem, mode)
            if identified.refused:
                raise ValueError(identified.refused)
            drawn = self.sampler(problem, mode, seed)
        except ValueError as error:
            return SensorSimulation(truth, refused=str(error), seconds=time.perf_counter() - began)
        ranked = rank_truth(problem, truth, drawn)
        return replace(ranked, kinds=identified.kinds, seconds=time.perf_counter() - began)

    def _levels(self, truth: Mapping[str, float], seed: int) -> Sufficient:
        """Simulate frames of a sensor with the parameters ``truth``, and return statistics of each light level."""
        values = {f"{step}.{name}": x for step in self.exposed for name, x in truth.items()}
        recipe = replace(self.recipe, seed=seed)
        with TemporaryDirectory(prefix="neusee-") as folder, torch.no_grad():
            frames = as_function(recipe, *values, outputs=[self._source], store=Store(folder))
            levels: Sufficient = frames(values)[self._source]
        return levels

    def _functions(self, store: Store) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
        """Return the likelihood as a function of light levels and parameters, first without and then with deviances."""
        step = self.recipe.steps[self.nominal.step]
        free = [self._source, *(f"{step.name}.{name}" for name in self.nominal.names)]

        def function(told: bool) -> Callable[[Any], Any]:
            changed = replace(step, params={**step.params, "told": told})
            recipe = replace(self.recipe, steps={**self.recipe.steps, step.name: changed})
            return as_function(recipe, *free, outputs=[step.name], store=store)

        return function(False), function(True)

    def _key_parts(self) -> list[Any]:
        prior = [x.tolist() for x in self.nominal.coordinates.prior]
        code = [engine("studies.calibration.simulated_sensors"), versions(), version("emcee")]
        return [self.nominal.key, self.recipe.seed, prior, self.label, *code]


def with_narrow_prior(recipe: Recipe, changed: Mapping[str, Mapping[str, Any]]) -> Recipe:
    """Return the recipe with the parameters of each step in ``changed``, and with a prior no wider than `WIDEST`."""
    prior = only_step(recipe, "calibrate.prior")
    capped = {name: _capped(name, law) for name, law in prior.params.items() if name in WIDEST or name == "offset"}
    both = {**changed, prior.name: capped}
    steps = {n: replace(recipe.steps[n], params={**recipe.steps[n].params, **new}) for n, new in both.items()}
    return replace(recipe, steps={**recipe.steps, **steps})


def _capped(name: str, law: tuple[float, float] | None) -> tuple[float, float] | None:
    if law is None:
        return None
    widest = WIDEST[name] if name == "offset" else float(np.exp(WIDEST[name]))
    return law[0], min(law[1], widest)


def rank_truth(problem: SensorPosterior, truth: Mapping[str, float], drawn: PosteriorDraws) -> SensorSimulation:
    """Return the rank of each true parameter among the draws, and the difference of posterior mean and truth."""
    values = {name: x.numpy() for name, x in problem.parameters(drawn.samples).items()}
    found = SensorSimulation(dict(truth), tau=drawn.tau, independent=drawn.independent, stranded=drawn.stranded)
    for name, x in values.items():
        found.rank[name] = rank = int((x < truth[name]).sum())
        found.inside[name] = _TAIL * (len(x) + 1) <= rank < (1 - _TAIL) * (len(x) + 1)  # exactly 90 % of uniform ranks
        found.z[name] = float((x.mean() - truth[name]) / x.std(ddof=1))
    return found
