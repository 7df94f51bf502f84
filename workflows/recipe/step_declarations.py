"""Declarations of steps in a recipe: the keys of each step, its node and its items."""

from __future__ import annotations

import importlib
import itertools
import os
import pkgutil
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import neusee.nodes
from neusee.nodes import Node
from neusee.workflows.graph.diagnostics import Diagnostic, nearest
from neusee.workflows.recipe.text.references import References, Scope, broken
from neusee.workflows.recipe.text.renamed_keys import instead
from neusee.workflows.recipe.text.yaml_values import Value, kind

_KEYS = ("node", "each", "from", "with", "device")
_DEVICE = re.compile(r"any|cpu|gpu|mps|cuda(:\d+)?")
_NAME = re.compile(r"[^\W\d][\w-]*")
_ITEM = re.compile(r"[^\[\],\s]+")


@dataclass(frozen=True, slots=True)
class Declared:
    """A step before it is copied for its items."""

    name: str
    value: Value
    node: Node | None  #: None where the node does not exist; the wires are checked all the same
    dims: tuple[str, ...]
    items: tuple[tuple[str, ...], ...]  #: one empty tuple without ``each``; no tuple where ``each`` is wrong

    def instance(self, items: tuple[str, ...]) -> str:
        return f"{self.name}[{','.join(items)}]" if items else self.name

    @property
    def instances(self) -> tuple[str, ...]:
        return tuple(map(self.instance, self.items))

    def part(self, key: str) -> Value:
        """Return the value under ``from``, ``with`` or ``device``; an empty mapping if the key is absent."""
        given = self.value.items.get(key)
        return Value({}, self.value.key, self.value.key, (*self.value.path, key)) if given is None else given

    def scope(self, root: Value, items: tuple[str, ...]) -> Scope:
        blocks = [{str(key): item for key, item in root.items[dim].items.items()} for dim in self.dims]
        return Scope({dim: block[item] for dim, block, item in zip(self.dims, blocks, items, strict=True)}, self.name)


def declare(
    root: Value, references: References, diagnostics: list[Diagnostic]
) -> tuple[dict[str, Declared], dict[str, Value]]:
    """Return the steps that can be read, and those that are null."""
    given = root.items.get("steps")
    if given is None or not isinstance(given.data, dict) or not given.data:
        mark = root.mark if given is None else given.mark
        diagnostics.append(Diagnostic(mark, "steps", "a recipe needs steps, or a group with steps (`camera: neusee`)"))
        return {}, {}
    absent = {str(name): value for name, value in given.data.items() if value.data is None}
    steps = {}
    nodes: dict[str, Node] = {}
    for name, value in given.data.items():
        if value.data is not None and _well_formed(str(name), value, diagnostics):
            node, dims = _node(value, nodes, references, diagnostics), _dims(value, root, diagnostics)
            items = tuple(itertools.product(*(map(str, root.items[dim].items) for dim in dims or ())))
            steps[str(name)] = Declared(str(name), value, node, dims or (), () if dims is None else items)
        elif value.data is not None:
            steps[str(name)] = Declared(str(name), value, None, (), ())
    return steps, absent


def _well_formed(name: str, value: Value, diagnostics: list[Diagnostic]) -> bool:
    if not _NAME.fullmatch(name):
        diagnostics.append(Diagnostic(value.key, value.name, "a step's name must consist of letters, digits, _ and -"))
        return False
    if not isinstance(value.data, dict):
        diagnostics.append(Diagnostic(value.mark, value.name, f"must be a mapping or null, not {kind(value)}"))
        return False
    for key, part in value.data.items():
        if key not in _KEYS:
            diagnostics.append(Diagnostic(part.key, part.name, f"unknown; {nearest(str(key), _KEYS)}"))
    return True


def _node(step: Value, nodes: dict[str, Node], references: References, diagnostics: list[Diagnostic]) -> Node | None:
    """Return the node that a step names; ``nodes`` are those found before."""
    given = step.items.get("node")
    if given is None:
        diagnostics.append(Diagnostic(step.key, step.name, "has no node: write `node: family.name`"))
        return None
    given = references.resolve(given, Scope({}, str(step.path[-1])))
    if broken(given):
        return None
    try:
        if str(given.data) not in nodes:
            nodes[str(given.data)] = find_node(str(given.data))
        return nodes[str(given.data)]
    except LookupError as error:
        diagnostics.append(Diagnostic(given.mark, f"{step.name}.node", str(error.args[0])))
        return None


def _dims(step: Value, root: Value, diagnostics: list[Diagnostic]) -> tuple[str, ...] | None:
    """Return the item lists of ``each``: none, one or two; None if ``each`` has a mistake."""
    given = step.items.get("each")
    if given is None or given.data is None:
        return ()
    named = list(given.items.values()) if isinstance(given.data, list) else [given]
    lists = [key for key, block in root.items.items() if key != "steps" and _is_item_list(block)]
    dims: list[str] = []
    before = len(diagnostics)
    for value in named:
        block = root.items.get(value.data) if isinstance(value.data, str) else None
        if block is None or value.data not in lists:
            hint = nearest(str(value.data), map(str, lists))
            diagnostics.append(Diagnostic(value.mark, given.name, f"no list of items {value.data}; {hint}"))
        elif value.data in dims or len(dims) == 2:
            diagnostics.append(Diagnostic(value.mark, given.name, "must name one list of items or two different lists"))
        else:
            dims.append(value.data)
            diagnostics += [
                Diagnostic(item.key, item.name, "an item's name has no space, comma or bracket")
                for key, item in block.items.items()
                if not _ITEM.fullmatch(str(key))
            ]
    return tuple(dims) if len(diagnostics) == before else None


def device_of(step: Declared, references: References, scope: Scope, diagnostics: list[Diagnostic]) -> str:
    """Return the device that a copy of a step requests; empty for any device."""
    given = references.resolve(step.part("device"), scope)
    if broken(given) or given.data in ({}, None, "any"):
        return ""
    if not isinstance(given.data, str) or not _DEVICE.fullmatch(given.data):
        hint = "write any, cpu, gpu, cuda, cuda:1 or mps"
        diagnostics.append(Diagnostic(given.mark, f"{given.name} = {given.plain}", f"is not a device: {hint}"))
        return ""
    only = step.node.device if step.node else "any"
    if only != "any" and (only == "cpu") != (given.data == "cpu"):
        message = f"{step.node and step.node.path} runs only on a {only.upper()}"
        diagnostics.append(Diagnostic(given.mark, f"{given.name} = {given.data}", message))
    return given.data


def _is_item_list(block: Value) -> bool:
    """Return True for a mapping of mappings, which may be empty."""
    return isinstance(block.data, dict) and all(isinstance(item.data, dict) for item in block.data.values())


# --- nodes ----------------------------------------------------------------------------------------------------------


def find_node(name: str) -> Node:
    """Return the node of a name such as ``sensor.digitize``; raise `LookupError` with the nearest name."""
    family, _, attribute = name.partition(".")
    if now := instead(name):
        raise LookupError(f"{name} {now}")
    if not _is_family(family):
        raise LookupError(f"no family {family}; {_elsewhere(attribute) or nearest(family, families())}")
    nodes = nodes_of(family)
    if attribute not in nodes:
        raise LookupError(f"no node {name}; {_elsewhere(attribute) or _in_family(family, attribute, nodes)}")
    return nodes[attribute]


def _is_family(name: str) -> bool:
    """Return True if the family exists, by one look-up, because a list of all families reads folders."""
    if f"{neusee.nodes.__name__}.{name}" not in sys.modules:
        folders = neusee.nodes.__path__ if name.isidentifier() else []
        if not any(os.path.isfile(os.path.join(folder, name, "__init__.py")) for folder in folders):
            return False
    return bool(nodes_of(name))


def _in_family(family: str, attribute: str, nodes: Mapping[str, Node]) -> str:
    hint = nearest(attribute, nodes)
    return hint.replace("did you mean ", f"did you mean {family}.")


def _elsewhere(attribute: str) -> str:
    """Return a hint to the nodes of the same name in other families."""
    found = [f"{family}.{attribute}" for family in families() if attribute in nodes_of(family)]
    return f"did you mean {' or '.join(found)}?" if found else ""


def families() -> list[str]:
    """Return the packages of nodes by name, without importing one, and the modules of nodes already imported."""
    names = {info.name for info in pkgutil.iter_modules(neusee.nodes.__path__) if info.ispkg}
    return sorted(names | {name for name in map(_inner, list(sys.modules)) if name and nodes_of(name)})


def _inner(module: str) -> str:
    """Return ``optics`` for ``neusee.nodes.optics``, and an empty string for other modules."""
    inner = module.removeprefix(f"{neusee.nodes.__name__}.")
    return inner if inner != module and re.fullmatch(r"[a-z]\w*", inner) else ""


def nodes_of(family: str) -> dict[str, Node]:
    """Return the public nodes of a family by name."""
    module = importlib.import_module(f"{neusee.nodes.__name__}.{family}")
    return {name: value for name, value in vars(module).items() if isinstance(value, Node)}


def all_nodes() -> Iterator[tuple[str, Node]]:
    """Yield every node with the name that a recipe uses."""
    for family in families():
        for name, node in nodes_of(family).items():
            yield f"{family}.{name}", node
