"""The posterior of a recipe's sensor as a function of its free parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from neusee.nodes.calibrate import CameraCoordinates, Coordinates, Likelihood, Sufficient
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

_Function = Callable[[Mapping[str, Any]], dict[str, Any]]  #: the likelihood by the name of the step, of parameters
#: from the node of the likelihood to the node of the prior and the class of the coordinates
_KINDS: dict[str, tuple[str, type[Coordinates] | type[CameraCoordinates]]] = {
    "calibrate.density": ("calibrate.prior", Coordinates),
    "calibrate.camera": ("calibrate.camera_prior", CameraCoordinates),
}


@dataclass(frozen=True)
class SensorPosterior:
    """The posterior of a recipe's sensor; a sample is a row of coordinates, one for each free parameter."""

    recipe: Recipe
    step: str  #: name of the step that computes the likelihood
    key: str  #: digest of everything that decides the posterior
    coordinates: Coordinates | CameraCoordinates
    levels: Sufficient | Levels
    weigh: _Function
    weigh_in_full: _Function  #: with deviances and slopes too

    @classmethod
    def of(cls, recipe: Recipe, store: Store) -> SensorPosterior:
        """Return the posterior of a recipe; raise `ValueError` unless there is one likelihood with one prior."""
        density = only_step(recipe, *_KINDS)
        prior_node, kind = _KINDS[density.node.path]
        prior = only_step(recipe, prior_node)
        source = str(density.wires["levels"])
        done = run(recipe, store, (density.name, prior.name, source))
        coordinates = kind.of(done[prior.name], density.params)
        free = [f"{density.name}.{name}" for name in coordinates.names]
        quick = replace(density, params={**density.params, "told": False})

        def function(step: Step) -> _Function:
            changed = replace(recipe, steps={**recipe.steps, step.name: step})
            return as_function(changed, *free, outputs=[step.name], store=store)

        key = digest(*(done.keys[step.name] for step in (density, prior)))
        return cls(recipe, density.name, key, coordinates, done[source], function(quick), function(density))

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the free parameters."""
        return self.coordinates.names

    def parameters(self, samples: FloatArray) -> dict[str, Tensor]:
        """Return the parameters by name, each (...), of samples (..., free)."""
        return self.coordinates.parameters(torch.from_numpy(np.ascontiguousarray(samples)))

    def theta(self, parameters: Mapping[str, float | Tensor]) -> FloatArray:
        """Return the coordinates (..., free) of parameters."""
        coordinates: FloatArray = self.coordinates.place(parameters).numpy()
        return coordinates

    def likelihood(self, samples: FloatArray) -> Likelihood:
        """Return the likelihood of the levels at samples (walker, free)."""
        with torch.no_grad(), one_thread():
            likelihood: Likelihood = self.weigh_in_full(self._named(self.parameters(samples)))[self.step]
        return likelihood

    def log_posterior(self, samples: FloatArray) -> FloatArray:
        """Return the logarithm (walker,) of the posterior density of the coordinates, up to a constant."""
        with torch.no_grad(), one_thread():
            parameters = self.parameters(samples)
            total = self.weigh(self._named(parameters))[self.step].log + self.coordinates.log_prior(parameters)
        log: FloatArray = total.nan_to_num(nan=-torch.inf, posinf=-torch.inf, neginf=-torch.inf).numpy()
        return log

    def whitened(self, samples: FloatArray) -> FloatArray:
        """Return samples (..., free) in standard deviations of the prior."""
        whitened: FloatArray = self.coordinates.whitened(self.parameters(samples)).numpy()
        return whitened

    def _named(self, parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return {f"{self.step}.{name}": x for name, x in parameters.items()}


def only_step(recipe: Recipe, *paths: str) -> Step:
    """Return the only step whose node is in ``paths``; raise `ValueError` for no such step or several."""
    steps = [step for step in recipe.steps.values() if step.node.path in paths]
    if len(steps) != 1:
        count = f"{len(steps)} steps" if steps else "no step"
        raise ValueError(
            f"{recipe.name} has {count} of the node {' or '.join(paths)}, but a calibration has one step: see "
            "`neusee run calibrate` and `neusee run calibrate_camera`"
        )
    return steps[0]
