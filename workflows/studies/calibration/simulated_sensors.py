"""Simulation-based calibration of a recipe: parameters from its prior, frames by its own steps, the posterior of them.

Where posterior and simulation are of one law, the parameters that made the frames rank uniformly among draws from the
posterior. Each simulation depends on the recipe and its number alone, and is kept in the store: what was stopped goes
on, and of 1000 simulations the first 200 are those of a shorter study.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from importlib.metadata import version
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from neusee.nodes.calibrate import NAMES, Prior, Sufficient
from neusee.workflows.calibration.identifiability import known
from neusee.workflows.calibration.initial_guess import begin
from neusee.workflows.calibration.log_posterior import SensorPosterior, the_step
from neusee.workflows.calibration.posterior_mode import LaplaceFit, peak
from neusee.workflows.engine.differentiable_function import as_function
from neusee.workflows.engine.provenance import timestamp, versions
from neusee.workflows.graph.recipe_graph import Recipe, needed
from neusee.workflows.keys.cache_key import digest, stream_seed
from neusee.workflows.keys.engine_digest import engine
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.calibration.independent_draws import Drawn

Sampler = Callable[[SensorPosterior, LaplaceFit, int], Drawn]  #: of a problem and its peak, by a seed
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
class Simulation:
    """What one simulation gave; plain values by parameter, so that it can be kept."""

    truth: dict[str, float]
    rank: dict[str, int] = field(default_factory=dict)  #: draws that lie below the truth
    inside: dict[str, bool] = field(default_factory=dict)  #: whether the central 90 % hold the truth
    z: dict[str, float] = field(default_factory=dict)  #: mean less truth, in standard deviations of the draws
    kinds: dict[str, str] = field(default_factory=dict)  #: what the frames tell of it
    draws: int = 0
    tau: float = 0.0  #: steps
    independent: bool = False  #: whether the chain was long enough
    stranded: int = 0  #: walkers that stay where the posterior is none
    seconds: float = 0.0
    refused: str = ""  #: why there is no posterior of these frames


class Bench:
    """Simulates a recipe's calibration again and again."""

    def __init__(self, recipe: Recipe, store: Store, pixels: int, sampler: Sampler, label: str) -> None:
        """``label``: of the sampler, by which its results are known."""
        self.store, self.sampler, self.label = store, sampler, label
        self.exposed = [name for name in needed(recipe, recipe.steps) if recipe.steps[name].node.path == _EXPOSE]
        if not self.exposed:
            raise ValueError(f"{recipe.name} simulates no frames: {_EXPOSE} is the step whose parameters are drawn")
        self.recipe = narrowed(recipe, {name: {"shape": (pixels, pixels)} for name in self.exposed})
        with TemporaryDirectory(prefix="neusee-") as folder:
            self.nominal = SensorPosterior.of(self.recipe, Store(folder))
            self._source = str(self.recipe.steps[self.nominal.step].wires["levels"])
            self._weigh, self._tell = self._functions(Store(folder))

    def simulation(self, number: int) -> Simulation:
        """The simulation of that number, from the store or made now."""
        key = digest("calibration study", self._says(), number)
        try:
            return Simulation(**self.store.get(key))
        except KeyError:
            pass
        found = self._made(stream_seed(self.recipe.seed, f"calibration study {number}"))
        self.store.put_small(
            key, asdict(found), {"step": "study calibration", "seconds": found.seconds, "date": timestamp()}
        )
        return found

    def truth(self, seed: int) -> dict[str, float]:
        """Parameters from the prior."""
        drawn = self.nominal.coordinates.draw(1, torch.Generator().manual_seed(seed))
        return {name: float(x) for name, x in drawn.items()}

    def problem(self, truth: Mapping[str, float], seed: int) -> SensorPosterior:
        """The posterior of frames that were made by these parameters; what was seen alone is new in it."""
        levels = self._levels(truth, seed)
        weigh, tell = (partial(_given, function, {self._source: levels}) for function in (self._weigh, self._tell))
        return replace(self.nominal, levels=levels, weigh=weigh, tell=tell)

    def _made(self, seed: int) -> Simulation:
        began = time.perf_counter()
        truth = self.truth(seed)
        problem = self.problem(truth, seed)
        try:
            highest = peak(problem, begin(problem))
            told = known(problem, highest)
            if told.refused:
                return Simulation(truth, refused=told.refused, seconds=time.perf_counter() - began)
            drawn = self.sampler(problem, highest, seed)
        except ValueError as error:
            return Simulation(truth, refused=str(error), seconds=time.perf_counter() - began)
        found = ranked(problem, truth, drawn)
        return replace(found, kinds=told.kinds, seconds=time.perf_counter() - began)

    def _levels(self, truth: Mapping[str, float], seed: int) -> Sufficient:
        """What frames of these parameters tell, through the recipe's own steps; nothing is kept of them."""
        values = {f"{step}.{name}": x for step in self.exposed for name, x in truth.items()}
        recipe = replace(self.recipe, seed=seed)
        with TemporaryDirectory(prefix="neusee-") as folder, torch.no_grad():
            frames = as_function(recipe, *values, outputs=[self._source], store=Store(folder))
            found: Sufficient = frames(values)[self._source]
        return found

    def _functions(self, store: Store) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
        """As in `SensorPosterior.of`, but of levels that are given."""
        step = self.recipe.steps[self.nominal.step]
        free = [self._source, *(f"{step.name}.{name}" for name in self.nominal.names)]

        def function(told: bool) -> Callable[[Any], Any]:
            changed = replace(step, params={**step.params, "told": told})
            recipe = replace(self.recipe, steps={**self.recipe.steps, step.name: changed})
            return as_function(recipe, *free, outputs=[step.name], store=store)

        return function(False), function(True)

    def _says(self) -> list[Any]:
        """What decides a simulation, beside its number."""
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


def narrowed(recipe: Recipe, changed: Mapping[str, Mapping[str, Any]]) -> Recipe:
    """The recipe with parameters of steps ``changed``, and a prior no wider than `WIDEST`."""
    prior = the_step(recipe, "calibrate.prior")
    capped = {name: _capped(name, law) for name, law in prior.params.items()}
    both = {**changed, prior.name: capped}
    steps = {n: replace(recipe.steps[n], params={**recipe.steps[n].params, **new}) for n, new in both.items()}
    return replace(recipe, steps={**recipe.steps, **steps})


def _capped(name: str, law: tuple[float, float] | None) -> tuple[float, float] | None:
    if law is None:
        return None
    widest = WIDEST[name] if name == "offset" else float(np.exp(WIDEST[name]))
    return law[0], min(law[1], widest)


def widths(prior: Prior) -> dict[str, float]:
    """Of what is free the standard deviation, of the logarithm but of the offset."""
    both = zip(NAMES, prior.width.tolist(), strict=True)
    return {name: width for name, width in both if np.isfinite(width)}


def ranked(problem: SensorPosterior, truth: Mapping[str, float], drawn: Drawn) -> Simulation:
    """Where the truth stands among draws of each parameter."""
    values = {name: x.numpy() for name, x in problem.parameters(drawn.places).items()}
    found = Simulation(
        dict(truth),
        draws=len(drawn.places),
        tau=drawn.tau,
        independent=drawn.independent,
        stranded=drawn.stranded,
    )
    for name, x in values.items():
        found.rank[name] = rank = int((x < truth[name]).sum())
        found.inside[name] = _TAIL * (len(x) + 1) <= rank < (1 - _TAIL) * (len(x) + 1)  # of uniform ranks just 90 %
        found.z[name] = float((x.mean() - truth[name]) / x.std(ddof=1))
    return found
