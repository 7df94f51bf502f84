"""The recipe of one extreme case: a small recipe with the changes of the case, and the inputs of each step."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from neusee.workflows.engine.node_call import call
from neusee.workflows.graph.recipe_graph import Recipe, Step, in_order
from neusee.workflows.graph.run_error import RunError
from neusee.workflows.keys.cache_key import Key, digest, key_of
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.recipe.node_families import find_node
from neusee.workflows.studies.stability.extreme_cases import Case, Size

_COMPARES: dict[str, tuple[tuple[str, dict[str, Any]], ...]] = {  # by node: nodes for the same inputs
    "metrics.lsr": (("losses.suppression_loss", {}), ("losses.suppression_loss", {"log": True})),
    "metrics.bsr": (("losses.background_loss", {}),),
    "metrics.mtf": (("losses.contrast", {}), ("metrics.limits", {})),
    "doe.fabricate": (("doe.smooth", {"feature": "400 um"}),),  # three samples of the small pupil
    "metrics.quality": (("losses.charbonnier", {}), ("losses.fft_l1", {}), ("losses.gradient_penalty", {})),
}
_SMALLER = {"pixels": 256, "levels": 6, "grid": 16, "width": 4}  #: limits of other parameters that make a step slow


def with_losses(recipe: Recipe) -> dict[str, Step]:
    """Return the steps of the recipe, and extra steps that compute losses and related results from the same inputs."""
    steps = dict(recipe.steps)
    for name, step in recipe.steps.items():
        for path, params in _COMPARES.get(step.node.path, ()):
            node = find_node(path)
            wires = {to: step.wires[source] for to, source in zip(node.inputs, step.node.inputs, strict=False)}
            if "stop" in node.inputs:  # from the mask that this step reads
                wires["stop"] = recipe.steps[step.sources[0]].wires["stop"]
            family, _, title = path.partition(".")
            label = f"{'loss ' if family == 'losses' else ''}{title}{' log' if 'log' in params else ''} of {name}"
            steps[label] = Step(label, node, node.params(**params).model_dump(), wires, step.mark, {})
    return steps


def with_size(steps: Mapping[str, Step], size: Size) -> dict[str, Step]:
    """Reduce the pixels, pupil samples and spectral bands of the steps, and keep the pupil diameters."""
    sides = [side for step in steps.values() for name in ("shape",) for side in step.params.get(name) or ()]
    part = size.pixels / max(sides, default=size.pixels)
    return {name: replace(step, params=_smaller(step, size, part)) for name, step in steps.items()}


def _smaller(step: Step, size: Size, part: float) -> dict[str, Any]:
    params = dict(step.params)
    if params.get("shape"):
        params["shape"] = tuple(max(1, round(side * part)) for side in params["shape"])
    if "samples" in params:
        params["pitch"] = params["pitch"] and params["pitch"] * params["samples"] / size.samples
        params["samples"] = size.samples
    if step.node.path == "spectra.bands":
        params["count"] = size.bands
    if step.node.path == "doe.pixelwise":
        params["file"] = (
            None  # its samples do not fit the small pupil: a random height map of its depth takes its place
        )
    if params.get("angle"):
        params["angle"] = tuple(a * min(part, 1.0) for a in params["angle"])
    return params | {k: min(v, params[k]) for k, v in _SMALLER.items() if step.node.random and k in params}


def with_parameters(steps: Mapping[str, Step], case: Case) -> dict[str, Step]:
    """Return the steps with the parameter values of an extreme case."""
    return {name: replace(step, params=_changed(step, case)) for name, step in steps.items()}


def _changed(step: Step, case: Case) -> dict[str, Any]:
    params = dict(step.params)
    for name in step.params:
        for path in (f"*.{name}", f"{step.node.path}.{name}"):
            single = isinstance(params[name], int | float)  # not a range, as of a prior
            if path in case.params and (single or path[0] != "*"):
                new = case.params[path]
                params[name] = new(step.params) if callable(new) else new
    return params


@dataclass
class CaseRecipe:
    """The recipe of one extreme case; each result is computed when it is first needed."""

    recipe: Recipe
    case: Case
    steps: dict[str, Step]
    keys: dict[str, Key] = field(default_factory=dict)
    values: dict[str, Any] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)  #: reasons of steps that gave no value
    usual: CaseRecipe | None = None  #: the recipe without changes, for results that the case leaves alone

    @classmethod
    def of(cls, recipe: Recipe, case: Case, code: Code, usual: CaseRecipe | None = None) -> CaseRecipe:
        """Return the recipe of an extreme case and the store key of each step; changed results have other keys."""
        steps = with_parameters(with_size(with_losses(recipe), case.size), case)
        chain = cls(recipe, case, steps, usual=usual)
        for name in in_order({n: s.sources for n, s in steps.items()}, steps):
            key, _ = key_of(steps[name], chain.keys, recipe.seed, code)
            chain.keys[name] = digest(key, case.name) if _put(steps[name], case) else key
        return chain

    def inputs(self, name: str) -> list[Any]:
        """Return the inputs of a step; raise `LookupError` if an earlier step gave no result."""
        return [self._gathered(self.steps[name].wires.get(i)) for i in self.steps[name].node.inputs]

    def _gathered(self, wire: Any) -> Any:
        if wire is None or isinstance(wire, str):
            return wire and self._value(wire)
        return [self._value(name) for name in wire]

    def _value(self, step: str) -> Any:
        for name in in_order({n: s.sources for n, s in self.steps.items()}, [step]):
            if name not in self.values and name not in self.refused:
                self._compute(name)
        if step not in self.values:
            raise LookupError(step)
        return self.values[step]

    def _compute(self, name: str) -> None:
        step, usual = self.steps[name], self.usual
        if usual and usual.keys[name] == self.keys[name]:
            try:
                self.values[name] = usual._value(name)
            except LookupError:
                self.refused[name] = usual.refused[name]
            return
        if any(source in self.refused for source in step.sources):
            self.refused[name] = "an earlier step gave no result"
            return
        inputs = self.inputs(name)
        try:
            with torch.no_grad():
                value = call(step, inputs, step.params, self.recipe.seed, "cpu")
        except RunError as error:
            self.refused[name] = str(error.cause)
            if not step.node.path.startswith("spectra.lift"):
                return
            # a grey cube, so that later steps are tested
            value = inputs[0].mean(0).expand(len(inputs[1].centres), -1, -1).clone()
            del self.refused[name]
        put = _put(step, self.case)
        self.values[name] = put(value) if put else value


def _put(step: Step, case: Case) -> Any:
    return next((change for path, change in case.values.items() if step.node.path.startswith(path)), None)


def unchanged_steps(chain: CaseRecipe, usual: CaseRecipe) -> Iterator[str]:
    """Yield the steps with the same inputs and parameters in an extreme case as in the recipe without changes."""
    if chain.case is usual.case or chain.case.inputs or chain.case.alike:
        return
    for name, step in chain.steps.items():
        mine, theirs = ([c.keys[s] for s in step.sources] for c in (chain, usual))
        if step.params == usual.steps[name].params and mine == theirs:
            yield name
