"""Cache of the step graphs of recipes; a graph is valid while the steps, their copies and nodes are unchanged.

The node and the wires of a step depend on no other values, so that the points of a sweep share one graph. Parameters
are checked again where they have changed, and files for each point.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from neusee.nodes import Node
from neusee.workflows.graph.recipe_graph import Wire
from neusee.workflows.recipe.bound_steps import GraphMemory
from neusee.workflows.recipe.node_families import Own, nodes_of
from neusee.workflows.recipe.step_declarations import Declared
from neusee.workflows.recipe.text.yaml_values import Value

Names = tuple[tuple[str, tuple[str, ...] | None], ...]  #: name and items of each block; None for a block without items

_MOST = 16  #: largest number of graphs in the cache
_graphs: dict[tuple[Value | None, Value | None, Names], CachedGraph] = {}  #: by `_key`


@dataclass(frozen=True, slots=True, eq=False)
class CachedGraph:
    """Cached steps of a recipe without mistakes, and the connections between the steps."""

    steps: dict[str, Declared]
    absent: dict[str, Value]
    wires: Mapping[str, Mapping[str, Wire]]  #: by step, for the steps whose wires are not references
    memory: GraphMemory = field(default_factory=GraphMemory)


def cached_graph(root: Value, own: Own) -> CachedGraph | None:
    """Return the cached step graph of a recipe, or None if the cache has no valid graph of the recipe.

    ``own`` has the families of nodes that the recipe names.
    """
    graph = _graphs.get(_key(root))
    families = functools.cache(functools.partial(nodes_of, own=own))
    return graph if graph is not None and all(_is_current(step, families) for step in graph.steps.values()) else None


def cache_graph(
    root: Value, steps: dict[str, Declared], absent: dict[str, Value], wires: Mapping[str, Mapping[str, Wire]]
) -> None:
    """Add the step graph of a recipe without mistakes to the cache; omit inputs of steps that references set."""
    if any(_refers(step.value.items.get("node")) for step in steps.values()):
        return
    fixed = [name for step in steps.values() if not _refers(step.value.items.get("from")) for name in step.instances]
    graph = CachedGraph(steps, absent, {name: wires[name] for name in fixed})
    key = _key(root)
    while len(_graphs) >= _MOST:
        _graphs.pop(next(iter(_graphs), key), None)
    _graphs[key] = graph


def _names(root: Value) -> Names:
    blocks = ((str(key), block.data) for key, block in root.items.items() if key != "steps")
    return tuple((key, _items(data) if isinstance(data, dict) else None) for key, data in blocks)


def _items(block: dict[str | int, Value]) -> tuple[str, ...] | None:
    return tuple(map(str, block)) if all(isinstance(item.data, dict) for item in block.values()) else None


def _key(root: Value) -> tuple[Value | None, Value | None, Names]:
    """Return what decides a graph: the steps, the user's own nodes, and the names of the items."""
    return root.items.get("steps"), root.items.get("nodes"), _names(root)


def _is_current(step: Declared, families: Callable[[str], Mapping[str, Node]]) -> bool:
    """Return True if the node of a cached step has not been replaced by another node of the same name."""
    family, _, name = str(step.value.items["node"].data).partition(".")
    try:
        return families(family).get(name) is step.node
    except LookupError:
        return False


def _refers(value: Value | None) -> bool:
    if value is None:
        return False
    return "${" in value.data if isinstance(value.data, str) else any(map(_refers, value.items.values()))
