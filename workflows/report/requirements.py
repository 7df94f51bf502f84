"""Lookup of the values, parameters and bound steps that a picture or a file reads in a recipe."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.keys.cache_key import plain
from neusee.workflows.keys.code_digest import Code

_PARAMETER = re.compile(r"(?P<step>[^.]+)\.(?P<name>\w+)")


class Missing(LookupError):
    """A step that the recipe does not have, or that no output of the run needs."""


@dataclass(frozen=True, slots=True)
class Bound:
    """A step outside the graph: the node with its parameters, callable with any inputs."""

    step: Step

    def __call__(self, *inputs: Any, rng: torch.Generator | None = None, **changes: Any) -> Any:
        stream = {"rng": rng} if self.step.node.random else {}
        return self.step.node(*inputs, **{**self.step.params, **changes, **stream})

    @property
    def random(self) -> bool:
        """Return True if the node draws random numbers."""
        return self.step.node.random

    def reference(self, *inputs: Any, **changes: Any) -> Any:
        """Compute the node's reference, its direct float64 form; raise Missing if the node has none."""
        if self.step.node.hooks.reference is None:
            raise Missing(f"the node {self.step.node.path} has no reference")
        return self.step.node.hooks.reference(*inputs, **{**self.step.params, **changes})


@dataclass(frozen=True, slots=True)
class Found:
    """A resolved need: the steps that are read, a function that builds the argument, and the argument's identity."""

    steps: tuple[str, ...]
    make: Any  #: a function of the values by step, which returns the argument
    identity: Any  #: plain JSON


def find(need: str, recipe: Recipe, keys: Mapping[str, str], code: Code) -> Found:
    """Resolve a need, whose notation `neusee.workflows.report.contents` describes."""
    if need.endswith("()"):
        step = _step(need[:-2], recipe)
        return Found((), lambda values: Bound(step), _identity(step, code))
    if match := _PARAMETER.fullmatch(need):
        value = _step(match["step"], recipe).params.get(match["name"])
        return Found((), lambda values: value, plain(value))
    if need.endswith("*]"):
        return _items(need[:-2], recipe, keys)
    _step(need, recipe)
    return Found((need,), lambda values: values[need], _key(need, keys))


def _step(name: str, recipe: Recipe) -> Step:
    if name not in recipe.steps:
        raise Missing(f"the recipe has no step {name}")
    return recipe.steps[name]


def _key(name: str, keys: Mapping[str, str]) -> str:
    if name not in keys:
        raise Missing(f"no output of this run needs the step {name}")
    return keys[name]


def _items(prefix: str, recipe: Recipe, keys: Mapping[str, str]) -> Found:
    """Find all items of a step: for the prefix ``spot[mask,``, by the rest of the name of each item."""
    names = {n[len(prefix) : -1]: n for n in recipe.steps if n.startswith(prefix) and n in keys}
    if not names:
        raise Missing(f"the recipe has no step {prefix}…]")
    identity = [[item, keys[name]] for item, name in names.items()]
    return Found(tuple(names.values()), lambda values: {item: values[name] for item, name in names.items()}, identity)


def _identity(step: Step, code: Code) -> Any:
    module = step.node.fn.__module__
    return [step.node.path, code.digest(module), [[name, plain(value)] for name, value in step.params.items()]]
