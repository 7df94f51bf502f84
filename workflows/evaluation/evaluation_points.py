"""Points of an evaluation: a scene, a laser of some strength, a pipeline; what is stored is not computed again."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from neusee.nodes.bicubic_resize import resize
from neusee.nodes.metrics import quality
from neusee.workflows.engine.differentiable_function import as_function
from neusee.workflows.engine.node_call import call, place
from neusee.workflows.engine.provenance import timestamp
from neusee.workflows.evaluation.evaluation_scenes import Scene
from neusee.workflows.evaluation.pipelines import BEAM, NONE, Composed
from neusee.workflows.graph.recipe_graph import Recipe, Step, needed
from neusee.workflows.keys.cache_key import digest, key_of
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.engine_digest import engine
from neusee.workflows.recipe.distributions.uncertain_inputs import Inputs
from neusee.workflows.store.result_store import Store
from neusee.workflows.tolerance.cheaper_steps import with_substitutions

_MOVED = ("spot", "photons")  #: steps with whose results, and all that follows, another strength is another scene

Point = dict[str, Any]  #: numbers by name; ``bsr`` is a list


@dataclass(frozen=True)
class Wanted:
    """A point that is asked for."""

    scene: Scene
    case: str
    strength: float

    @property
    def lit(self) -> str:
        """The case whose recipe is run: a laser without light is none."""
        return self.case if self.strength > 0 else NONE


class Bench:
    """Computes points one after another, and what several share only once."""

    def __init__(self, store: Store, small: int, device: str = "cpu") -> None:
        self.store, self.small, self.device = store, small, device
        self.computed = 0  #: points that were not in the store
        self.seconds = 0.0  #: of them
        self._code = Code(store.code_memo)
        self._functions: dict[tuple[str, str], Any] = {}
        self._drawn: dict[
            Any, tuple[Recipe, Inputs | None]
        ] = {}  #: the recipe is kept, so that no other gets its identity
        self._fixed: dict[str, Any] = {}  #: by key: what no scene reaches, one copy for all functions
        self._kept = _Kept()

    def point(self, pipeline: Composed, wanted: Wanted) -> Point:
        """The numbers of a point, from the store or measured now."""
        key = self.key(pipeline, wanted)
        with suppress(KeyError):
            found: Point = self.store.get(key)
            return found
        began = time.perf_counter()
        values = self.values(pipeline, wanted)
        point = self._numbers(pipeline, values)
        self.seconds += (spent := time.perf_counter() - began)
        self.computed += 1
        self.store.put_small(key, point, {"step": "evaluate", "seconds": spent, "date": timestamp()})
        return point

    def values(self, pipeline: Composed, wanted: Wanted, more: Sequence[str] = ()) -> dict[str, Any]:
        """The outputs of a run with this scene and laser, and ``more``."""
        outputs = (*pipeline.pipeline.outputs, *more)
        function = self._function(pipeline, wanted.lit, outputs)
        self._kept.turn(wanted)
        with torch.no_grad():
            changed = self._changed(pipeline.recipes[wanted.lit], wanted, outputs)
            known = {name: value for name, value in changed.items() if name in function.free}
            found: dict[str, Any] = function({"scene": wanted.scene.picture, **known})
        return found

    def forget(self) -> None:
        """Let go of what belongs to one laser."""
        self._functions = {name: f for name, f in self._functions.items() if name[1] == NONE}
        used = {id(value) for f in self._functions.values() for value in f.fixed.values()}
        self._fixed = {key: value for key, value in self._fixed.items() if id(value) in used}
        self._kept.clear()

    def key(self, pipeline: Composed, wanted: Wanted) -> str:
        """What decides a point: the keys of a run with its values, and how its pictures are compared."""
        recipe, outputs = pipeline.recipes[wanted.lit], pipeline.pipeline.outputs
        params: dict[str, dict[str, Any]] = {}
        for name, value in self._changed(recipe, wanted, outputs).items():
            step, _, param = name.rpartition(".")
            params.setdefault(step, {})[param] = value
        steps = {
            name: replace(recipe.steps[name], params={**recipe.steps[name].params, **changed})
            for name, changed in params.items()
        }
        keys = self._keys(replace(recipe, steps={**recipe.steps, **steps}), wanted, outputs)
        within = [recipe.tolerance, recipe.exact, self.device.partition(":")[0], self.small]
        own = [self._code.digest(used.__module__) for used in (quality, resize)]
        return digest("evaluate", engine("evaluation.evaluation_points"), [keys[name] for name in outputs], within, own)

    def _keys(self, recipe: Recipe, wanted: Wanted, outputs: Sequence[str]) -> dict[str, str]:
        """By step. Noise is that of the scene; what no scene reaches, such as a mask that is drawn, is the recipe's."""
        keys = {"scene": wanted.scene.key(self._code)}
        live = _reached(recipe, ("scene",))
        for name in needed(recipe, outputs):
            if name not in keys:
                step = recipe.steps[name]
                seed = wanted.scene.seed if name in live else recipe.seed
                keys[name], _ = key_of(step, keys, seed, self._code, place(step, self.device))
        return keys

    def _function(self, pipeline: Composed, case: str, outputs: tuple[str, ...]) -> Any:
        name = (f"{pipeline.name} {outputs}", case)
        if name not in self._functions:
            recipe = pipeline.recipes[case]
            whole = with_substitutions(recipe, outputs)  # as `run` would: the scene is given, and not learnt
            there = set(needed(whole, outputs))
            inputs = self._inputs(recipe, outputs)
            readers = [name for name in (inputs.readers if inputs else ()) if name.rpartition(".")[0] in there]
            free = ["scene", *readers]
            if case != NONE:
                free += [f"direction[{BEAM}].angle", *(f"{spot}.strength" for spot in _spots(recipe, outputs))]
            caller = self._kept.caller(_reached(whole, [n for n in whole.steps if n.partition("[")[0] in _MOVED]))
            found: Any = as_function(whole, *free, outputs=outputs, store=self.store, device=self.device, caller=caller)
            self._share(found, whole)
            self._functions[name] = found
        return self._functions[name]

    def _changed(self, recipe: Recipe, wanted: Wanted, outputs: Sequence[str]) -> dict[str, Any]:
        """The parameters that are other than the recipe's: drawn for the scene, and the laser's of the point."""
        inputs = self._inputs(recipe, outputs)
        drawn = inputs.theta(wanted.scene.drawn(inputs)) if inputs else {}
        return drawn | _moved(recipe, wanted, outputs)

    def _inputs(self, recipe: Recipe, outputs: Sequence[str]) -> Inputs | None:
        """What the recipe draws from a law, where an output hangs on it."""
        if recipe.uncertain is None or not recipe.uncertain.names:
            return None
        key = (id(recipe), tuple(outputs))
        if key not in self._drawn:
            self._drawn[key] = (recipe, None)
            with suppress(ValueError):  # no output depends on any
                self._drawn[key] = (recipe, Inputs.of(recipe, outputs))
        return self._drawn[key][1]

    def _share(self, function: Any, recipe: Recipe) -> None:
        """Let functions hold one copy of what they have in common, so that what follows from it is common too."""
        keys: dict[str, str] = {}
        for name in needed(recipe, function.fixed):
            step = recipe.steps[name]
            keys[name], _ = key_of(step, keys, recipe.seed, self._code, place(step, self.device))
        for name, value in function.fixed.items():
            function.fixed[name] = self._fixed.setdefault(keys[name], value)

    def _numbers(self, pipeline: Composed, values: Mapping[str, Any]) -> Point:
        line = pipeline.pipeline
        picture, truth = values[line.picture], values["truth"]
        whole = values[line.quality]
        small = whole
        if min(truth.shape[-2:]) > self.small:
            domain = pipeline.recipes[NONE].steps[line.quality].params["domain"]
            small = quality(*(smaller(x, self.small) for x in (picture, truth)), domain=domain)
        peak, saturated = values["peak[mask]"], values["saturated[mask]"]
        return {
            **{name: float(value) for name, value in whole._asdict().items()},
            **{f"{name} small": float(value) for name, value in small._asdict().items()},
            "saturated": float(saturated.pixels),
            "peak": float(peak.irradiance),
            "damaged": float(peak.damaged),
            "bsr": values["bsr[mask]"].tolist(),
        }


def _moved(recipe: Recipe, wanted: Wanted, outputs: Sequence[str]) -> dict[str, Any]:
    """The parameters that a point changes: the laser's direction and strength, where there is one."""
    if wanted.lit == NONE:
        return {}
    strengths = {f"{spot}.strength": wanted.strength for spot in _spots(recipe, outputs)}
    return {f"direction[{BEAM}].angle": wanted.scene.angle(recipe), **strengths}


class _Kept:
    """Results that the next point needs again: of a scene until the next one, of a strength until the next one."""

    def __init__(self) -> None:
        self._of_scene: dict[Any, tuple[Any, Any]] = {}
        self._of_strength: dict[Any, tuple[Any, Any]] = {}
        self._scene: tuple[Any, ...] = ()
        self._strength = -1.0
        self._seed = 0

    def clear(self) -> None:
        """Let go of all."""
        self._of_scene.clear()
        self._of_strength.clear()

    def turn(self, wanted: Wanted) -> None:
        """Go to a point; what belongs to another scene, case or strength is let go."""
        scene = (wanted.scene.number, wanted.scene.seed, wanted.case)
        if scene != self._scene:
            self._of_scene.clear()
        if (*scene, wanted.strength) != (*self._scene, self._strength):
            self._of_strength.clear()
        self._scene, self._strength, self._seed = scene, wanted.strength, wanted.scene.seed

    def caller(self, moved: set[str]) -> Callable[..., Any]:
        """A step's result, from before where the very same inputs went into the same step; ``moved``: by a strength."""

        def asked(step: Step, inputs: Sequence[Any], params: Mapping[str, Any], seed: int, device: str) -> Any:
            kept = self._of_strength if step.name in moved else self._of_scene
            own = (step.name, self._seed) if step.node.random else ()
            key = (own, step.node.path, repr(sorted(params.items())), device, *_identities(inputs))
            if key not in kept:  # the inputs are kept too, so that no other object gets their identity
                kept[key] = (inputs, call(step, inputs, params, self._seed, device))
            return kept[key][1]

        return asked


def _identities(inputs: Sequence[Any]) -> list[Any]:
    return [tuple(id(y) for y in x) if type(x) is list else id(x) for x in inputs]


def _spots(recipe: Recipe, outputs: Sequence[str]) -> list[str]:
    return [name for name in needed(recipe, outputs) if name.startswith("spot[")]


def _reached(recipe: Recipe, roots: Sequence[str]) -> set[str]:
    found = set(roots)
    for name in needed(recipe, recipe.steps):
        if not found.isdisjoint(recipe.steps[name].sources):
            found.add(name)
    return found


def smaller(picture: Tensor, side: int) -> Tensor:
    """What a display shows of a picture, its shorter side reduced to so many pixels, antialiased, in linear light."""
    y, x = picture.shape[-2:]
    scale = side / min(y, x)
    return resize(picture.clamp(0, 1), round(y * scale), round(x * scale))
