"""Declarations of the steps in a recipe: the node of each step, and the items, such as lasers, for its copies."""

from __future__ import annotations

import functools
import itertools
import math
import re
from collections.abc import Callable
from dataclasses import dataclass

from neusee.nodes import Node
from neusee.workflows.graph.diagnostics import Diagnostic, RecipeError, nearest
from neusee.workflows.recipe.node_families import find_node, is_known
from neusee.workflows.recipe.own_families import OwnFamilies
from neusee.workflows.recipe.text.references import References, Scope, broken
from neusee.workflows.recipe.text.yaml_values import Value, kind

_MOST = 20_000  #: steps of a recipe, at most, with all copies
_KEYS = ("node", "each", "from", "with", "device", "cache")
_DEVICE = re.compile(r"any|cpu|gpu|mps|cuda(:\d+)?")
_NAME = re.compile(r"[^\W\d][\w-]*")
_ITEM = re.compile(r"[^\[\],\s]+")


@dataclass(frozen=True, slots=True)
class Declared:
    """Declaration of a step, from which one copy of the step is made for each item, such as each laser."""

    name: str
    value: Value
    node: Node | None  #: None if the node does not exist; the wires are checked nevertheless
    dims: tuple[str, ...]  #: names of the lists of items in ``each``
    items: tuple[tuple[str, ...], ...]  #: items of each copy; one empty tuple without ``each``

    def instance(self, items: tuple[str, ...]) -> str:
        return f"{self.name}[{','.join(items)}]" if items else self.name

    @property
    def instances(self) -> tuple[str, ...]:
        return tuple(map(self.instance, self.items))

    def part(self, key: str) -> Value:
        """Return the value of a key of a step, such as ``from`` or ``cache``, or an empty mapping for a missing key."""
        given = self.value.items.get(key)
        return Value({}, self.value.key, self.value.key, (*self.value.path, key)) if given is None else given

    def scope(self, root: Value, items: tuple[str, ...]) -> Scope:
        blocks = [{str(key): item for key, item in root.items[dim].items.items()} for dim in self.dims]
        return Scope({dim: block[item] for dim, block, item in zip(self.dims, blocks, items, strict=True)}, self.name)


def declare(
    root: Value, references: References, diagnostics: list[Diagnostic], own: OwnFamilies
) -> tuple[dict[str, Declared], dict[str, Value]]:
    """Return the declared steps of a recipe and the steps that are null; report mistakes in the declarations.

    ``own`` has the families of nodes that the recipe names.
    Raises `RecipeError` for more steps than the limit, before the copies are made.
    """
    given = root.items.get("steps")
    if given is None or not isinstance(given.data, dict) or not given.data:
        mark = root.mark if given is None else given.mark
        diagnostics.append(Diagnostic(mark, "steps", "a recipe needs steps, or a group with steps (`camera: neusee`)"))
        return {}, {}
    absent = {str(name): value for name, value in given.data.items() if value.data is None}
    steps, total = dict[str, Declared](), 0
    find = functools.cache(functools.partial(find_node, own=own.modules))
    for name, value in ((str(name), value) for name, value in given.data.items() if value.data is not None):
        steps[name] = Declared(name, value, None, (), ())
        if _well_formed(name, value, diagnostics):
            node, dims = _node(value, find, references, diagnostics, own), _dims(value, root, diagnostics)
            copies = math.prod(len(root.items[dim].items) for dim in dims or ())
            total += copies
            if total > _MOST:
                raise RecipeError([_too_many(value, dims or (), root, copies, total)])
            items = tuple(itertools.product(*(map(str, root.items[dim].items) for dim in dims or ())))
            steps[name] = Declared(name, value, node, dims or (), () if dims is None else items)
    return steps, absent


def _too_many(step: Value, dims: tuple[str, ...], root: Value, copies: int, total: int) -> Diagnostic:
    """Return the diagnostic for the step with which a recipe has more steps than the limit."""
    if copies <= _MOST:
        message = f"with this step the recipe has {total} steps, more than the limit of {_MOST}: split the recipe"
        return Diagnostic(step.key, step.name, message)
    sizes = " x ".join(f"{len(root.items[dim].items)} {dim}" for dim in dims)
    each = step.items["each"]
    message = f"makes {sizes} = {copies} steps, more than the limit of {_MOST}: use fewer items, or a sweep"
    return Diagnostic(each.mark, each.name, message)


def _well_formed(name: str, value: Value, diagnostics: list[Diagnostic]) -> bool:
    if not _NAME.fullmatch(name):
        diagnostics.append(Diagnostic(value.key, value.name, "a step's name must consist of letters, digits, _ and -"))
        return False
    if not isinstance(value.data, dict):
        diagnostics.append(Diagnostic(value.mark, value.name, f"a step must be a mapping or null, not {kind(value)}"))
        return False
    for key, part in value.data.items():
        if key not in _KEYS:
            diagnostics.append(Diagnostic(part.key, part.name, f"unknown; {nearest(str(key), _KEYS)}"))
    return True


def _node(
    step: Value,
    find: Callable[[str], Node],
    references: References,
    diagnostics: list[Diagnostic],
    own: OwnFamilies,
) -> Node | None:
    """Return the node that a step names, or None if the name is wrong; ``find`` returns a node by name."""
    given = step.items.get("node")
    if given is None:
        diagnostics.append(Diagnostic(step.key, step.name, "the step has no node: write `node: family.name`"))
        return None
    given = references.resolve(given, Scope({}, str(step.path[-1])))
    if broken(given):
        return None
    try:
        return find(str(given.plain))
    except LookupError as error:
        if own.is_whole or is_known(str(given.plain).partition(".")[0]):  # else a family may be one that failed
            diagnostics.append(Diagnostic(given.mark, f"{step.name}.node", str(error.args[0])))
        return None


def _dims(step: Value, root: Value, diagnostics: list[Diagnostic]) -> tuple[str, ...] | None:
    """Return the names of the lists, such as ``lasers``, in a step's key ``each``, or None for a mistake."""
    given = step.items.get("each")
    if given is None or given.data is None:
        return ()
    values = given.data if isinstance(given.data, list) else [given]
    lists = [key for key, block in root.items.items() if key != "steps" and _is_item_list(block)]
    dims: list[str] = []
    before = len(diagnostics)
    for value in values:
        block = root.items.get(value.data) if isinstance(value.data, str) else None
        if block is None or value.data not in lists:
            hint = nearest(str(value.data), map(str, lists))
            diagnostics.append(Diagnostic(value.mark, given.name, f"there is no list of items {value.data}; {hint}"))
        elif value.data in dims or len(dims) == 2:
            diagnostics.append(Diagnostic(value.mark, given.name, "`each` needs one or two different lists of items"))
        else:
            dims.append(value.data)
            diagnostics += [
                Diagnostic(item.key, item.name, "an item's name must not have a space, comma or bracket")
                for key, item in block.items.items()
                if not _ITEM.fullmatch(str(key))
            ]
    return tuple(dims) if len(diagnostics) == before else None


def device_of(step: Declared, references: References, scope: Scope, diagnostics: list[Diagnostic]) -> str:
    """Return the device, such as ``gpu``, that a copy of a step requests, or an empty string for any device."""
    given = references.resolve(step.part("device"), scope)
    if broken(given) or given.data in ({}, None, "any"):
        return ""
    if not isinstance(given.data, str) or not _DEVICE.fullmatch(given.data):
        hint = "write any, cpu, gpu, cuda, cuda:1 or mps"
        diagnostics.append(Diagnostic(given.mark, f"{given.name} = {given.plain}", f"unknown device: {hint}"))
        return ""
    only = step.node.device if step.node else "any"
    if only != "any" and (only == "cpu") != (given.data == "cpu"):
        message = f"{step.node and step.node.path} runs only on a {only.upper()}"
        diagnostics.append(Diagnostic(given.mark, f"{given.name} = {given.data}", message))
    return given.data


def cached_of(step: Declared, references: References, scope: Scope, diagnostics: list[Diagnostic]) -> bool:
    """Return False for a step with ``cache: false``, whose result is computed in each run and never stored."""
    given = references.resolve(step.part("cache"), scope)
    if broken(given) or given.data in ({}, None):
        return True
    if not isinstance(given.data, bool):
        diagnostics.append(Diagnostic(given.mark, f"{given.name} = {given.plain}", "must be true or false"))
        return True
    return given.data


def _is_item_list(block: Value) -> bool:
    """Return True if a block of a recipe is a list of items such as ``lasers``, which is a mapping of mappings."""
    return isinstance(block.data, dict) and all(isinstance(item.data, dict) for item in block.data.values())
