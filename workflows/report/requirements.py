"""Lookup of the results, parameters and functions of a recipe from which a figure or a data file is made."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.keys.cache_key import code_of, plain
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.report.measured_variants import variants_of
from neusee.workflows.store.result_store import Store

_MEASURED = "variants of "
_PARAMETER = re.compile(r"(?P<step>[^.]+)\.(?P<name>\w+)")


class Missing(LookupError):
    """Error for a step that a figure or data file reads, if the recipe lacks the step or the run does not need it."""


@dataclass(frozen=True, slots=True)
class Bound:
    """A function that applies the node of a step, with the parameters of this step, to other inputs."""

    step: Step

    def __call__(self, *inputs: Any, **changes: Any) -> Any:
        return self.step.node(*inputs, **{**self.step.params, **changes})

    def reference(self, *inputs: Any, **changes: Any) -> Any:
        """Call the float64 reference implementation of the node; raise `Missing` if the node has none."""
        if self.step.node.hooks.reference is None:
            raise Missing(f"the node {self.step.node.path} has no reference implementation in float64")
        return self.step.node.hooks.reference(*inputs, **{**self.step.params, **changes})


@dataclass(frozen=True, slots=True)
class Found:
    """The source of an argument of a drawing function: steps to read, function of their results, and part of a key."""

    steps: tuple[str, ...]
    make: Any  #: a function of the values by step, which returns the argument
    identity: Any  #: plain JSON


def find(need: str, recipe: Recipe, keys: Mapping[str, str], code: Code, store: Store) -> Found:
    """Find the source of an argument of a drawing function in a recipe, from a text such as ``psf[mask]``.

    The module `contents` lists all forms of this text. ``store`` has what studies measured.
    """
    if need.startswith(_MEASURED):
        return _variants(need.removeprefix(_MEASURED), recipe, code, store)
    if need.endswith("()"):
        step = _step(need[:-2], recipe)
        params = [[name, plain(value)] for name, value in step.params.items()]
        return Found((), lambda values: Bound(step), [step.node.path, code_of(step, code), params])
    if match := _PARAMETER.fullmatch(need):
        value = _parameter(match["step"], match["name"], recipe)
        return Found((), lambda values: value, plain(value))
    if need.endswith("*]"):
        return _items(need[:-2], recipe, keys)
    _step(need, recipe)
    if need not in keys:
        raise Missing(f"no output of this run needs the step {need}")
    return Found((need,), lambda values: values[need], keys[need])


def _variants(family: str, recipe: Recipe, code: Code, store: Store) -> Found:
    """Find the errors and run times of the variants of a step, which a study of accuracy has measured."""
    if not any(name.partition("[")[0] == family for name in recipe.steps):
        raise Missing(f"the recipe has no step {family}")
    rows = variants_of(recipe, family, store, code)
    if not rows:
        raise Missing(f"`neusee study accuracy {recipe.name}` measures it, and the next run shows it")
    return Found((), lambda values: rows, rows)


def _parameter(step: str, name: str, recipe: Recipe) -> Any:
    """Return a parameter of a step, or a dictionary with the parameter of each copy of a step such as ``line[*]``."""
    if not step.endswith("*]"):
        return _step(step, recipe).params.get(name)
    prefix = step[:-2]
    return {n[len(prefix) : -1]: s.params.get(name) for n, s in recipe.steps.items() if n.startswith(prefix)}


def is_table(value: Any) -> bool:
    """Return True for a parameter that is a file or coefficients, or a dictionary with such a parameter."""
    if isinstance(value, Mapping):
        return any(isinstance(part, Path | tuple) for part in value.values())
    return isinstance(value, Path)


def _step(name: str, recipe: Recipe) -> Step:
    if name not in recipe.steps:
        raise Missing(f"the recipe has no step {name}")
    return recipe.steps[name]


def _items(prefix: str, recipe: Recipe, keys: Mapping[str, str]) -> Found:
    """Find all copies of a step from the beginning of their names, such as ``spot[mask,``."""
    names = {n[len(prefix) : -1]: n for n in recipe.steps if n.startswith(prefix) and n in keys}
    if not names:
        raise Missing(f"the recipe has no step {prefix}…]")
    identity = [[item, keys[name]] for item, name in names.items()]
    return Found(tuple(names.values()), lambda values: {item: values[name] for item, name in names.items()}, identity)
