"""The posterior of a recipe's sensor as a function: what is free, where, and how likely."""

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
from neusee.workflows.engine.runner import run
from neusee.workflows.engine.threads import one_thread
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.store.result_store import Store

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Places = NDArray[np.float64]

#: by the node that weighs levels, the node that says what is free, and how that is walked
_KINDS: dict[str, tuple[str, type[Coordinates] | type[CameraCoordinates]]] = {
    "calibrate.density": ("calibrate.prior", Coordinates),
    "calibrate.camera": ("calibrate.camera_prior", CameraCoordinates),
}


@dataclass(frozen=True)
class SensorPosterior:
    """A recipe's calibration: a place is a row of coordinates, one for each free parameter."""

    recipe: Recipe
    step: str  #: that weighs the levels
    key: str  #: of what decides it
    coordinates: Coordinates | CameraCoordinates
    levels: Sufficient | Levels
    weigh: Callable[[Mapping[str, Any]], dict[str, Any]]
    tell: Callable[[Mapping[str, Any]], dict[str, Any]]  #: also deviances and what the levels tell

    @classmethod
    def of(cls, recipe: Recipe, store: Store) -> SensorPosterior:
        """Raises ValueError for a recipe without both steps, or with two of one."""
        density, prior, kind = _pair(recipe)
        source = str(density.wires["levels"])
        done = run(recipe, store, (density.name, prior.name, source))
        coordinates = kind.of(done[prior.name], density.params)
        free = [f"{density.name}.{name}" for name in coordinates.names]
        quick = replace(density, params={**density.params, "told": False})

        def function(step: Step) -> Callable[[Mapping[str, Any]], dict[str, Any]]:
            changed = replace(recipe, steps={**recipe.steps, step.name: step})
            return as_function(changed, *free, outputs=[step.name], store=store)

        key = digest(*(done.keys[step.name] for step in (density, prior)))
        return cls(recipe, density.name, key, coordinates, done[source], function(quick), function(density))

    @property
    def names(self) -> tuple[str, ...]:
        """The free parameters."""
        return self.coordinates.names

    def parameters(self, places: Places) -> dict[str, Tensor]:
        """Of places (..., free) the parameters, each (...)."""
        return self.coordinates.parameters(torch.from_numpy(np.ascontiguousarray(places)))

    def place(self, parameters: Mapping[str, float | Tensor]) -> Places:
        """(..., free) from parameters."""
        found: Places = self.coordinates.place(parameters).numpy()
        return found

    def look(self, places: Places) -> Likelihood:
        """How likely the levels are at places (walker, free)."""
        with torch.no_grad(), one_thread():
            found: Likelihood = self.tell(self._named(self.parameters(places)))[self.step]
        return found

    def log_posterior(self, places: Places) -> Places:
        """(walker,) log density per unit of the coordinates, but for a constant; minus infinity where there is none."""
        with torch.no_grad(), one_thread():
            parameters = self.parameters(places)
            total = self.weigh(self._named(parameters))[self.step].log + self.coordinates.log_prior(parameters)
        found: Places = total.nan_to_num(nan=-torch.inf, posinf=-torch.inf, neginf=-torch.inf).numpy()
        return found

    def whitened(self, places: Places) -> Places:
        """(..., free) in standard deviations of the prior."""
        found: Places = self.coordinates.whitened(self.parameters(places)).numpy()
        return found

    def _named(self, parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return {f"{self.step}.{name}": x for name, x in parameters.items()}


def _pair(recipe: Recipe) -> tuple[Step, Step, type[Coordinates] | type[CameraCoordinates]]:
    """The step that weighs, the one that says what is free, and how that is walked."""
    weighing = the_step(recipe, *_KINDS)
    prior, kind = _KINDS[weighing.node.path]
    return weighing, the_step(recipe, prior), kind


def the_step(recipe: Recipe, *paths: str) -> Step:
    found = [step for step in recipe.steps.values() if step.node.path in paths]
    if len(found) != 1:
        has = "no step" if not found else f"{len(found)} steps"
        raise ValueError(
            f"{recipe.name} has {has} of the node {' or '.join(paths)}, and a calibration one: `neusee run calibrate` "
            "and `neusee run calibrate_camera` show how"
        )
    return found[0]
