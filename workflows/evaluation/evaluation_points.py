"""The evaluation points: the metrics of one scene at one laser strength with one pipeline (mask and restorer)."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from neusee.nodes.bicubic_resize import resize
from neusee.nodes.metrics import quality
from neusee.workflows.engine.differentiable_function import as_function
from neusee.workflows.engine.node_call import call, place
from neusee.workflows.evaluation.evaluation_scenes import Scene
from neusee.workflows.evaluation.mistold_filter import shifted
from neusee.workflows.evaluation.pipelines import BEAM, NONE, PipelineRecipes
from neusee.workflows.graph.recipe_graph import Recipe, Step, dependents, needed
from neusee.workflows.graph.told_copies import TOLD
from neusee.workflows.keys.cache_key import device_kind, digest, key_of
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.engine_digest import engine
from neusee.workflows.recipe.distributions.uncertain_inputs import Inputs, NothingDrawn
from neusee.workflows.store.memo import compute_once
from neusee.workflows.store.result_store import Store
from neusee.workflows.tolerance.cheaper_steps import with_substitutions

_MOVED = ("spot", "photons")  #: names of the first steps that depend on the laser strength

PointNumbers = dict[str, Any]  #: numbers by name; ``bsr`` is a list


@dataclass(frozen=True)
class PointRequest:
    """A request for the metrics of one scene at one laser strength."""

    scene: Scene
    strength: float

    @property
    def lit(self) -> str:
        """Return the name of the laser in the scene, which is ``none`` if the strength is 0."""
        return self.scene.case if self.strength > 0 else NONE


class EvaluationPoints:
    """The computation of evaluation points, in which a result that several evaluation points use is computed once."""

    def __init__(self, store: Store, small: int, device: str = "cpu") -> None:
        self.store, self.small, self.device = store, small, device
        self.computed = 0  #: evaluation points that were not in the store
        self.seconds = 0.0  #: computing time of these evaluation points
        self._code = Code(store.code_memo)
        self._functions: dict[tuple[str, str, int], Any] = {}  #: a recipe is known by its identity
        #: by identity of a recipe; the recipe is kept too, so that no other recipe gets the same identity
        self._drawn: dict[Any, tuple[Recipe, Inputs | None]] = {}
        self._fixed: dict[str, Any] = {}  #: by key, results that do not depend on a scene: one copy for all functions
        self._kept = _SharedResults()

    def point(self, pipeline: PipelineRecipes, point: PointRequest) -> PointNumbers:
        """Return the metrics of an evaluation point from the store, or compute and store the metrics."""
        compute = partial(self._measure, pipeline, point)
        return compute_once(self.store, self.key(pipeline, point), dict, compute, {"step": "evaluate"})

    def _measure(self, pipeline: PipelineRecipes, point: PointRequest) -> PointNumbers:
        began = time.perf_counter()
        numbers = self._numbers(pipeline, self.values(pipeline, point))
        self.seconds += time.perf_counter() - began
        self.computed += 1
        return numbers

    def values(self, pipeline: PipelineRecipes, point: PointRequest, more: Sequence[str] = ()) -> dict[str, Any]:
        """Run a pipeline on one scene and laser, and return the outputs and the results of the steps ``more``."""
        outputs = (*pipeline.pipeline.outputs, *more)
        function = self._function(pipeline, point.lit, outputs)
        self._kept.turn(point)
        with torch.no_grad():
            changed = self._changed(pipeline, point, outputs)
            known = {name: value for name, value in changed.items() if name in function.free}
            values: dict[str, Any] = function({"scene": point.scene.picture, **known})
        return values

    def forget(self) -> None:
        """Remove all results that depend on the laser from memory."""
        self._functions = {name: f for name, f in self._functions.items() if name[1] == NONE}
        used = {id(value) for f in self._functions.values() for value in f.fixed.values()}
        self._fixed = {key: value for key, value in self._fixed.items() if id(value) in used}
        self._kept.clear()

    def release(self) -> None:
        """Remove all results from memory, before pipelines with other recipes are evaluated."""
        self._functions.clear()
        self._drawn.clear()
        self._fixed.clear()
        self._kept.clear()

    def key(self, pipeline: PipelineRecipes, point: PointRequest) -> str:
        """Return the cache key of an evaluation point from the keys of its steps and the settings of the comparison."""
        recipe, outputs = pipeline.recipe(point.lit), pipeline.pipeline.outputs
        keys = self.point_keys(pipeline, point, outputs)
        within = [recipe.tolerance, recipe.exact, recipe.estimates, device_kind(self.device), self.small]
        own = [self._code.digest(used.__module__) for used in (quality, resize)]
        return digest("evaluate", engine("evaluation.evaluation_points"), [keys[name] for name in outputs], within, own)

    def point_keys(self, pipeline: PipelineRecipes, point: PointRequest, outputs: Sequence[str]) -> dict[str, str]:
        """Return the cache keys of the steps of an evaluation point."""
        recipe = pipeline.recipe(point.lit)
        params: dict[str, dict[str, Any]] = {}
        for name, value in self._changed(pipeline, point, outputs).items():
            step, _, param = name.rpartition(".")
            params.setdefault(step, {})[param] = value
        steps = {
            name: replace(recipe.steps[name], params={**recipe.steps[name].params, **changed})
            for name, changed in params.items()
        }
        return self.keys(replace(recipe, steps={**recipe.steps, **steps}), outputs, point.scene)

    def keys(self, recipe: Recipe, outputs: Iterable[str], scene: Scene | None = None) -> dict[str, str]:
        """Return the cache key of each step, with the seed of the scene for all steps that depend on the scene."""
        keys = {"scene": scene.key(self._code)} if scene else {}
        live = dependents(recipe, keys)
        for name in needed(recipe, outputs):
            if name not in keys:
                step = recipe.steps[name]
                seed = scene.seed if scene and name in live else recipe.seed
                keys[name], _ = key_of(step, keys, seed, self._code, place(step, self.device))
        return keys

    def _function(self, pipeline: PipelineRecipes, case: str, outputs: tuple[str, ...]) -> Any:
        name = (f"{pipeline.name} {outputs}", case, id(pipeline.recipe))
        if name not in self._functions:
            recipe = replace(pipeline.recipe(case), estimates=False)  # one PSF for all scenes
            whole = with_substitutions(recipe, outputs)  # as in `run`, but the scene is an argument
            steps = set(needed(whole, outputs))
            inputs = self.inputs(pipeline, case, outputs)
            free = ["scene", *(r for r in (inputs.readers if inputs else ()) if r.rpartition(".")[0] in steps)]
            if case != NONE:
                free += [f"direction[{BEAM}].angle", *(f"{spot}.strength" for spot in spots(recipe, outputs))]
            free += [TOLD + name for name in free if TOLD + name.rpartition(".")[0] in steps]
            caller = self._kept.caller(dependents(whole, list(filter(_is_moved, whole.steps))))
            ways: dict[str, Any] = {"store": self.store, "device": self.device, "caller": caller}
            self._functions[name] = as_function(whole, *free, outputs=outputs, **ways)
            self._share(self._functions[name], whole)
        return self._functions[name]

    def _changed(self, pipeline: PipelineRecipes, point: PointRequest, outputs: Sequence[str]) -> dict[str, Any]:
        """Return the parameters that an evaluation point sets: sampled values, laser direction and laser strength.

        A copy of a step from which the restorer is told gets the same values, with the error of the pipeline.
        """
        recipe = pipeline.recipe(point.lit)
        inputs = self.inputs(pipeline, point.lit, outputs)
        changed = inputs.theta(point.scene.draw(inputs)) if inputs else {}
        if point.lit != NONE:
            changed[f"direction[{BEAM}].angle"] = point.scene.angle(recipe)
            changed |= {f"{spot}.strength": point.strength for spot in spots(recipe, outputs)}
        copies = {name: value for name, value in changed.items() if TOLD + name.rpartition(".")[0] in recipe.steps}
        wrong = {name: value for name, value in pipeline.error.items() if value is not None}
        told = {TOLD + name: shifted(x, wrong[name]) if name in wrong else x for name, x in copies.items()}
        return changed | told

    def inputs(self, pipeline: PipelineRecipes, case: str, outputs: Sequence[str]) -> Inputs | None:
        """Return the uncertain inputs of a pipeline, or None if no output depends on an uncertain input.

        A restorer that is told an error gets the values of the recipe without the error, whose steps it copies.
        """
        recipe = (pipeline.true or pipeline.recipe)(case)
        if recipe.uncertain is None or not recipe.uncertain.names:
            return None
        key = (id(recipe), tuple(outputs))
        if key not in self._drawn:
            self._drawn[key] = (recipe, None)
            with suppress(NothingDrawn):  # no output depends on an uncertain input
                self._drawn[key] = (recipe, Inputs.of(recipe, outputs))
        return self._drawn[key][1]

    def _share(self, function: Any, recipe: Recipe) -> None:
        """Replace constant results in a recipe function by the equal results of an earlier function, to save memory."""
        keys = self.keys(recipe, function.fixed)
        for name, value in function.fixed.items():
            function.fixed[name] = self._fixed.setdefault(keys[name], value)

    def _numbers(self, pipeline: PipelineRecipes, values: Mapping[str, Any]) -> PointNumbers:
        line, truth = pipeline.pipeline, values["truth"]
        small = whole = values[line.quality]
        if min(truth.shape[-2:]) > self.small:
            domain = pipeline.recipe(NONE).steps[line.quality].params["domain"]
            small = quality(reduced(values[line.picture], self.small), reduced(truth, self.small), domain=domain)
        peak, saturated = values["peak[mask]"], values["saturated[mask]"]
        return {
            **{name: float(value) for name, value in whole._asdict().items()},
            **{f"{name} small": float(value) for name, value in small._asdict().items()},
            "saturated": float(saturated.pixels),
            "peak": float(peak.irradiance),
            "above": float(peak.above),
            "bsr": values["bsr[mask]"].tolist(),
        }


class _SharedResults:
    """A cache of results that successive evaluation points have in common, by scene and by laser strength."""

    def __init__(self) -> None:
        self._of_scene: dict[Any, tuple[Any, Any]] = {}
        self._of_strength: dict[Any, tuple[Any, Any]] = {}
        self._scene: tuple[Any, ...] = ()
        self._strength = -1.0
        self._seed = 0

    def clear(self) -> None:
        """Remove all cached results from memory."""
        self._of_scene.clear()
        self._of_strength.clear()

    def turn(self, point: PointRequest) -> None:
        """Begin an evaluation point, and remove the cached results of other scenes, lasers and laser strengths."""
        scene = (point.scene.number, point.scene.seed, point.scene.case)
        if scene != self._scene:
            self._of_scene.clear()
        if (*scene, point.strength) != (*self._scene, self._strength):
            self._of_strength.clear()
        self._scene, self._strength, self._seed = scene, point.strength, point.scene.seed

    def caller(self, moved: set[str]) -> Callable[..., Any]:
        """Return a function that computes a step, or returns the cached result if the input objects are the same.

        ``moved`` names the steps that depend on the laser strength.
        """

        def compute(step: Step, inputs: Sequence[Any], params: Mapping[str, Any], seed: int, device: str) -> Any:
            kept = self._of_strength if step.name in moved else self._of_scene
            own = (step.name, self._seed) if step.node.random else ()
            identities = [tuple(map(id, x)) if type(x) is list else id(x) for x in inputs]
            key = (own, step.node.path, repr(sorted(params.items())), device, *identities)
            if key not in kept:  # the inputs are kept too, so that no other object gets their identity
                kept[key] = (inputs, call(step, inputs, params, self._seed, device))
            return kept[key][1]

        return compute


def _is_moved(step: str) -> bool:
    """Return True for the first steps that depend on the laser strength, and for their copies."""
    return step.partition("[")[0].removeprefix(TOLD) in _MOVED


def spots(recipe: Recipe, outputs: Sequence[str]) -> list[str]:
    """Return the names of the steps that have the strength of a laser."""
    return [name for name in needed(recipe, outputs) if name.startswith("spot[")]


def reduced(picture: Tensor, side: int) -> Tensor:
    """Clip a picture to [0, 1], and resize it, antialiased, so that its shorter side has ``side`` pixels."""
    y, x = picture.shape[-2:]
    scale = side / min(y, x)
    return resize(picture.clamp(0, 1), round(y * scale), round(x * scale))
