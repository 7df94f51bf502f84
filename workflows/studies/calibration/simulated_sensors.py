"""Simulation-based calibration of a recipe: parameters from its prior, frames by its own steps, their posterior.

Where posterior and simulation agree, the parameters of the frames rank uniformly among draws from the posterior. Each
simulation depends on the recipe and its number only, and the store keeps it: an interrupted study goes on, and the
first 200 of 1000 simulations are those of a shorter study.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.metadata import version
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from neusee.nodes.calibrate import NAMES, Prior, Sufficient
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

Sampler = Callable[
    [SensorPosterior, LaplaceFit, int], PosteriorDraws
]  #: draws from a posterior with this mode, by a seed
_EXPOSE = "calibrate.expose"
#: standard deviation of each logarithm, at most, and of the offset in e-: a whole lifetime of sensors in one study
#: would meet frames that tell nothing
WIDEST = {
    "gain": 0.1,
    "offset": 20.0,
    "read_noise": 0.1,
    "dark_current": 0.5,
    "full_well": 0.1,
    "quantum_efficiency": 0.05,
    "spread": 0.1,
}
_TAIL = 0.05  #: of the draws beyond either end of the interval whose coverage is counted


@dataclass(frozen=True)
class SensorSimulation:
    """The result of one simulation; plain values by parameter, so that the store can keep it."""

    truth: dict[str, float]
    rank: dict[str, int] = field(default_factory=dict)  #: draws that lie below the truth
    inside: dict[str, bool] = field(default_factory=dict)  #: whether the central 90 % hold the truth
    z: dict[str, float] = field(default_factory=dict)  #: mean less truth, in standard deviations of the draws
    kinds: dict[str, str] = field(default_factory=dict)  #: what the frames tell of it
    draws: int = 0
    tau: float = 0.0  #: steps
    independent: bool = False  #: whether the chain was long enough
    stranded: int = 0  #: walkers that stay where the posterior is next to nothing
    seconds: float = 0.0
    refused: str = ""  #: why there is no posterior of these frames


class SensorSimulator:
    """Simulations of a recipe's calibration, each with its own sensor and frames."""

    def __init__(self, recipe: Recipe, store: Store, pixels: int, sampler: Sampler, label: str) -> None:
        """Read the recipe; ``label`` names the sampler in the keys of its results."""
        self.store, self.sampler, self.label = store, sampler, label
        self.exposed = [name for name in needed(recipe, recipe.steps) if recipe.steps[name].node.path == _EXPOSE]
        if not self.exposed:
            raise ValueError(f"{recipe.name} simulates no frames: {_EXPOSE} is the step whose parameters are drawn")
        self.recipe = with_narrow_prior(recipe, {name: {"shape": (pixels, pixels)} for name in self.exposed})
        with TemporaryDirectory(prefix="neusee-") as folder:
            self.nominal = SensorPosterior.of(self.recipe, Store(folder))
            self._source = str(self.recipe.steps[self.nominal.step].wires["levels"])
            self._weigh, self._weigh_in_full = self._functions(Store(folder))

    def simulation(self, number: int) -> SensorSimulation:
        """Return the simulation of that number, from the store or computed now."""
        key = digest("calibration study", self._says(), number)
        seed = stream_seed(self.recipe.seed, f"calibration study {number}")
        return compute_once(
            self.store, key, SensorSimulation, lambda: self._simulate(seed), {"step": "study calibration"}, small=True
        )

    def truth(self, seed: int) -> dict[str, float]:
        """Return parameters drawn from the prior."""
        drawn = self.nominal.coordinates.draw(1, torch.Generator().manual_seed(seed))
        return {name: float(x) for name, x in drawn.items()}

    def problem(self, truth: Mapping[str, float], seed: int) -> SensorPosterior:
        """Return the posterior of frames of these parameters; only the levels differ from those of the recipe."""
        levels = self._levels(truth, seed)
        weigh, weigh_in_full = (
            partial(_given, function, {self._source: levels}) for function in (self._weigh, self._weigh_in_full)
        )
        return replace(self.nominal, levels=levels, weigh=weigh, weigh_in_full=weigh_in_full)

    def _simulate(self, seed: int) -> SensorSimulation:
        began = time.perf_counter()
        truth = self.truth(seed)
        problem = self.problem(truth, seed)
        try:
            mode = find_mode(problem, initial_theta(problem))
            told = identify(problem, mode)
            if told.refused:
                return SensorSimulation(truth, refused=told.refused, seconds=time.perf_counter() - began)
            drawn = self.sampler(problem, mode, seed)
        except ValueError as error:
            return SensorSimulation(truth, refused=str(error), seconds=time.perf_counter() - began)
        found = rank_truth(problem, truth, drawn)
        return replace(found, kinds=told.kinds, seconds=time.perf_counter() - began)

    def _levels(self, truth: Mapping[str, float], seed: int) -> Sufficient:
        """Return the statistics of frames of these parameters by the recipe's own steps; no frame is kept."""
        values = {f"{step}.{name}": x for step in self.exposed for name, x in truth.items()}
        recipe = replace(self.recipe, seed=seed)
        with TemporaryDirectory(prefix="neusee-") as folder, torch.no_grad():
            frames = as_function(recipe, *values, outputs=[self._source], store=Store(folder))
            found: Sufficient = frames(values)[self._source]
        return found

    def _functions(self, store: Store) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
        """Return the functions of `SensorPosterior.of`, with the levels as one more argument."""
        step = self.recipe.steps[self.nominal.step]
        free = [self._source, *(f"{step.name}.{name}" for name in self.nominal.names)]

        def function(told: bool) -> Callable[[Any], Any]:
            changed = replace(step, params={**step.params, "told": told})
            recipe = replace(self.recipe, steps={**self.recipe.steps, step.name: changed})
            return as_function(recipe, *free, outputs=[step.name], store=store)

        return function(False), function(True)

    def _says(self) -> list[Any]:
        """Return what decides a simulation, beside its number."""
        prior = [x.tolist() for x in self.nominal.coordinates.prior]
        return [
            self.nominal.key,
            self.recipe.seed,
            prior,
            self.label,
            engine("studies.calibration.simulated_sensors"),
            versions(),
            version("emcee"),
        ]


def _given(function: Callable[[Any], Any], levels: Mapping[str, Any], theta: Mapping[str, Any]) -> Any:
    return function({**theta, **levels})


def with_narrow_prior(recipe: Recipe, changed: Mapping[str, Mapping[str, Any]]) -> Recipe:
    """Return the recipe with parameters of steps ``changed``, and a prior no wider than `WIDEST`."""
    prior = only_step(recipe, "calibrate.prior")
    capped = {name: _capped(name, law) for name, law in prior.params.items()}
    both = {**changed, prior.name: capped}
    steps = {n: replace(recipe.steps[n], params={**recipe.steps[n].params, **new}) for n, new in both.items()}
    return replace(recipe, steps={**recipe.steps, **steps})


def _capped(name: str, law: tuple[float, float] | None) -> tuple[float, float] | None:
    if law is None:
        return None
    widest = WIDEST[name] if name == "offset" else float(np.exp(WIDEST[name]))
    return law[0], min(law[1], widest)


def prior_widths(prior: Prior) -> dict[str, float]:
    """Return the standard deviation of each free parameter: of its logarithm, but in e- for the offset."""
    both = zip(NAMES, prior.width.tolist(), strict=True)
    return {name: width for name, width in both if np.isfinite(width)}


def rank_truth(problem: SensorPosterior, truth: Mapping[str, float], drawn: PosteriorDraws) -> SensorSimulation:
    """Return the rank of the truth among draws of each parameter."""
    values = {name: x.numpy() for name, x in problem.parameters(drawn.samples).items()}
    found = SensorSimulation(
        dict(truth),
        draws=len(drawn.samples),
        tau=drawn.tau,
        independent=drawn.independent,
        stranded=drawn.stranded,
    )
    for name, x in values.items():
        found.rank[name] = rank = int((x < truth[name]).sum())
        found.inside[name] = _TAIL * (len(x) + 1) <= rank < (1 - _TAIL) * (len(x) + 1)  # of uniform ranks just 90 %
        found.z[name] = float((x.mean() - truth[name]) / x.std(ddof=1))
    return found
