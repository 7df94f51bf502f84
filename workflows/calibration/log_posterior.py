"""The posterior of a sensor as a function of the sensor's free parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from neusee.nodes.calibrate import CameraCoordinates, Coordinates, Likelihood, Rings, ScatterCoordinates, Sufficient
from neusee.nodes.values import Levels
from neusee.workflows.engine.differentiable_function import as_function
from neusee.workflows.engine.local_executor import one_thread
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.store.result_store import Store

if TYPE_CHECKING:
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]

_Function = Callable[[Mapping[str, Any]], dict[str, Any]]  #: from parameters to the likelihood by step name
#: from the node of the likelihood to the node of the prior and the class of the coordinates
_KINDS: dict[str, tuple[str, type[Coordinates] | type[CameraCoordinates] | type[ScatterCoordinates]]] = {
    "calibrate.density": ("calibrate.prior", Coordinates),
    "calibrate.camera": ("calibrate.camera_prior", CameraCoordinates),
    "calibrate.stray_light": ("calibrate.stray_prior", ScatterCoordinates),
}


@dataclass(frozen=True)
class SensorPosterior:
    """The posterior of the sensor of a recipe; a sample has one coordinate for each free parameter."""

    recipe: Recipe
    step: str  #: name of the step that computes the likelihood
    key: str  #: digest of everything that decides the posterior
    coordinates: Coordinates | CameraCoordinates | ScatterCoordinates
    levels: Sufficient | Levels | Rings  #: the data that the likelihood describes
    weigh: _Function
    weigh_in_full: _Function  #: also returns deviances and derivatives
    measured: Levels | None = None  #: the statistics of all frames, from which `levels` follow; None for a lens

    @classmethod
    def of(cls, recipe: Recipe, store: Store) -> SensorPosterior:
        """Return the posterior of a recipe; raise `ValueError` unless the recipe has one likelihood and one prior."""
        density = only_step(recipe, *_KINDS)
        prior_node, kind = _KINDS[density.node.path]
        prior = only_step(recipe, prior_node)
        source = str(density.wires[density.node.inputs[0]])
        whole = (
            str(recipe.steps[source].wires["levels"])
            if recipe.steps[source].node.path == "calibrate.sufficient"
            else source
        )
        done = run(recipe, store, (density.name, prior.name, source, whole))
        coordinates = kind.of(done[prior.name], density.params)
        if isinstance(coordinates, ScatterCoordinates):
            coordinates = coordinates.seen_by(done[source], density.params)
        free = [f"{density.name}.{name}" for name in coordinates.names]
        quick = replace(density, params={**density.params, "told": False})

        def function(step: Step) -> _Function:
            changed = replace(recipe, steps={**recipe.steps, step.name: step})
            return as_function(changed, *free, outputs=[step.name], store=store)

        key = digest(*(done.keys[step.name] for step in (density, prior)))
        measured = done[whole] if isinstance(done[whole], Levels) else None
        return cls(recipe, density.name, key, coordinates, done[source], function(quick), function(density), measured)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the free parameters."""
        return self.coordinates.names

    def parameters(self, samples: FloatArray) -> dict[str, Tensor]:
        """Convert sampler coordinates (..., free parameter) to parameter values by name, each of shape (...)."""
        return self.coordinates.parameters(torch.from_numpy(np.ascontiguousarray(samples)))

    def theta(self, parameters: Mapping[str, float | Tensor]) -> FloatArray:
        """Convert parameter values by name to sampler coordinates (..., free parameter)."""
        coordinates: FloatArray = self.coordinates.place(parameters).numpy()
        return coordinates

    def likelihood(self, samples: FloatArray) -> Likelihood:
        """Return the likelihood of the measured light levels at samples (walker, free parameter)."""
        with torch.no_grad(), one_thread():
            likelihood: Likelihood = self.weigh_in_full(self._named(self.parameters(samples)))[self.step]
        return likelihood

    def log_posterior(self, samples: FloatArray) -> FloatArray:
        """Return the log posterior density at samples (walker, free parameter), up to a constant."""
        with torch.no_grad(), one_thread():
            parameters = self.parameters(samples)
            total = self.weigh(self._named(parameters))[self.step].log + self.coordinates.log_prior(parameters)
        log: FloatArray = total.nan_to_num(nan=-torch.inf, posinf=-torch.inf, neginf=-torch.inf).numpy()
        return log

    def whitened(self, samples: FloatArray) -> FloatArray:
        """Convert samples to distances from the middle of the prior, in standard deviations of the prior."""
        whitened: FloatArray = self.coordinates.whitened(self.parameters(samples)).numpy()
        return whitened

    def _named(self, parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return {f"{self.step}.{name}": x for name, x in parameters.items()}


def only_step(recipe: Recipe, *paths: str) -> Step:
    """Return the only step whose node is in ``paths``; raise `ValueError` if there is no such step or more than one."""
    steps = [step for step in recipe.steps.values() if step.node.path in paths]
    if len(steps) != 1:
        count = f"{len(steps)} steps" if steps else "no step"
        names = " or ".join(filter(None, (", ".join(paths[:-1]), paths[-1])))
        raise ValueError(
            f"{recipe.name} has {count} of the node {names}, but a calibration needs exactly one: see "
            "`neusee run calibrate`, `neusee run calibrate_camera` and `neusee run calibrate_stray_light`"
        )
    return steps[0]
