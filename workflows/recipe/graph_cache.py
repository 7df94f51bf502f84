"""Cache of recipe graphs, valid while the graph, its items and its nodes are unchanged.

The node of a step and the steps that feed it depend on ``steps`` and on the names of the items,
and on no other value: a thousand points of a sweep need not resolve them again. Parameters, files
and everything else that depends on values are checked every time.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

import neusee.nodes
from neusee.workflows.graph.recipe_graph import Recipe, Wire
from neusee.workflows.recipe.step_declarations import Declared
from neusee.workflows.recipe.text.yaml_values import Value

K = TypeVar("K")
V = TypeVar("V")
Names = tuple[tuple[str, tuple[str, ...] | None], ...]  #: by block: its items; None if it is no list of items

_MOST = 16
_graphs: dict[tuple[int, Names], CachedGraph] = {}
_written: dict[int, tuple[Value, Recipe]] = {}  #: id of a top mapping -> that mapping, and its recipe


@dataclass(frozen=True, slots=True)
class CachedGraph:
    """Steps and wires without a mistake."""

    value: Value  #: the ``steps``, held so that no other value takes their id
    steps: dict[str, Declared]
    absent: dict[str, Value]
    wires: Mapping[str, Mapping[str, Wire]]  #: of the bound steps whose wires are not references


def cached_graph(root: Value) -> CachedGraph | None:
    """Return the cached graph of a recipe if its nodes are still those of the program, else None."""
    steps = root.items.get("steps")
    found = _graphs.get((id(steps), _names(root)))
    return found if found is not None and all(map(_current, found.steps.values())) else None


def cache_graph(
    root: Value, steps: dict[str, Declared], absent: dict[str, Value], wires: Mapping[str, Mapping[str, Wire]]
) -> None:
    """Cache a graph without mistakes; its references are resolved every time."""
    if any(_refers(step.value.items.get("node")) for step in steps.values()):
        return
    fixed = [name for step in steps.values() if not _refers(step.value.items.get("from")) for name in step.instances]
    value = root.items["steps"]
    found = CachedGraph(value, steps, absent, {name: wires[name] for name in fixed})
    memoise(_graphs, (id(value), _names(root)), found)


def cached_recipe(root: Value) -> Recipe | None:
    """Return the recipe of a top mapping that was checked before, else None."""
    found = _written.get(id(root))
    return found[1] if found is not None and cached_graph(root) is not None else None


def cache_recipe(root: Value, recipe: Recipe) -> Recipe:
    """Cache the recipe of a top mapping, and return the recipe."""
    memoise(_written, id(root), (root, recipe))
    return recipe


def memoise(known: dict[K, V], name: K, value: V) -> None:
    """Store a value in a cache of limited size, and drop the oldest entries."""
    while len(known) >= _MOST:
        known.pop(next(iter(known), name), None)
    known[name] = value


def _names(root: Value) -> Names:
    blocks = ((str(key), block.data) for key, block in root.items.items() if key != "steps")
    return tuple((key, _items(data) if isinstance(data, dict) else None) for key, data in blocks)


def _items(block: dict[str | int, Value]) -> tuple[str, ...] | None:
    return tuple(map(str, block)) if all(isinstance(item.data, dict) for item in block.values()) else None


def _current(step: Declared) -> bool:
    """Return True if the node that a step names is still the cached node."""
    family, _, name = str(step.value.items["node"].data).partition(".")
    return getattr(sys.modules.get(f"{neusee.nodes.__name__}.{family}"), name, None) is step.node


def _refers(value: Value | None) -> bool:
    if value is None:
        return False
    return "${" in value.data if isinstance(value.data, str) else any(map(_refers, value.items.values()))
