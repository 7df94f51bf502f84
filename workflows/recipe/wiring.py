"""Wiring of a recipe: the steps that feed each step, item by item, and the check of their types."""

from __future__ import annotations

import itertools
import re
import types
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Union, get_args, get_origin

from neusee.nodes import Node
from neusee.workflows.graph.diagnostics import Diagnostic, Location, nearest
from neusee.workflows.graph.recipe_graph import Step, Wire
from neusee.workflows.recipe.step_declarations import Declared
from neusee.workflows.recipe.text.references import BROKEN, References
from neusee.workflows.recipe.text.renamed_keys import became_input, new_name
from neusee.workflows.recipe.text.yaml_values import Value, kind

_NAMED = 12  #: steps of a cycle that a message names
_WIRE = re.compile(r"\s*([^\[\]\s]+)\s*(?:\[([^\[\]]*)\])?\s*")


@dataclass(frozen=True, slots=True)
class Wiring:
    """Wires of all steps of a recipe."""

    root: Value
    steps: Mapping[str, Declared]
    absent: Mapping[str, Value]
    references: References
    diagnostics: list[Diagnostic]

    def wires(self, step: Declared, items: tuple[str, ...]) -> dict[str, Wire]:
        """Return the wires of one copy of a step, in the order of the node's inputs."""
        given = self.references.resolve(step.part("from"), step.scope(self.root, items))
        if step.node is None:
            return {}
        named = self._by_input(step.node, given)
        if named is None:
            return {}
        found: dict[str, Wire] = {}
        for name in step.node.inputs:
            if name not in named:
                found[name] = self._unwired(step, step.node, name, given)
            elif named[name].data is not BROKEN:
                found[name] = self._wire(step, step.node, items, name, named[name])
        return found

    def outputs(self, value: Value, path: str) -> tuple[str, ...]:
        """Return the steps named by an output or an expectation."""
        return self._producers(value, path, {}) or ()

    def _by_input(self, node: Node, given: Value) -> dict[str, Value] | None:
        """Return the values of ``from`` by input; a single name feeds the first input. None if ``from`` is wrong."""
        if given.data is BROKEN:
            return None
        if given.data is None:
            return {}
        if isinstance(given.data, list):
            self._refuse(given, given.name, "must be a step's name, or a mapping of inputs to names, not a list")
            return None
        if not isinstance(given.data, dict):
            if node.inputs:
                return {node.inputs[0]: given}
            self._refuse(given, given.name, f"{node.path} takes no inputs: leave `from` out")
            return None
        for name, value in given.data.items():
            if name not in node.inputs:
                hint = nearest(str(name), node.inputs)
                self.diagnostics.append(Diagnostic(value.key, value.name, f"{node.path} has no input {name}; {hint}"))
        return {str(name): value for name, value in given.data.items()}

    def _unwired(self, step: Declared, node: Node, name: str, given: Value) -> Wire:
        """Return the wire of an input that ``from`` does not name, and report a required one."""
        if name in node.optional or (name == "stop" and became_input(node.path, map(str, step.part("with").items))):
            return None  # the parameters of an old recipe are reported with the step that replaces them
        if not (isinstance(given.data, dict) and _misspelt(name, node, given)):
            mark = given.mark if given.items else step.value.key
            fix = f"write from: {{{name}: STEP}}{self._makers(needs(node, name))}"
            self.diagnostics.append(Diagnostic(mark, given.name, f"{node.path} needs {name}: {fix}"))
        return None

    def _wire(self, step: Declared, node: Node, items: tuple[str, ...], name: str, value: Value) -> Wire:
        many = takes_many(node, name)
        path = f"{step.value.name}.from.{name}"
        if value.data is None:
            return self._nothing(node, name, value, path, "null")
        parsed = _parse(value)
        if parsed and parsed[0] in self.absent:
            null = self.absent[parsed[0]]
            return self._nothing(node, name, value, path, f"{parsed[0]}, which is null ({null.mark})")
        here = dict(zip(step.dims, items, strict=True))
        found = self._producers(value, path, here, self._makers(needs(node, name)))
        if found is None or parsed is None:
            return None
        producer = self.steps[parsed[0]]
        self._agree(node, name, producer, value, path)
        single = set(producer.dims) <= set(here) or (parsed[1] is not None and len(parsed[1]) == len(producer.dims))
        if many:
            return found
        if single:
            return found[0]
        left = ", ".join(dim for dim in producer.dims if dim not in here)
        example = f"{parsed[0]}[{producer.items[0][0]}]" if producer.items else f"{parsed[0]}[…]"
        message = f"{node.path} takes one step as {name}; {parsed[0]} is a step for each of {left}: write {example}"
        self._refuse(value, path, message)
        return None

    def _nothing(self, node: Node, name: str, value: Value, path: str, what: str) -> Wire:
        if takes_many(node, name):
            return ()
        if name not in node.optional:
            self._refuse(value, path, f"{node.path} needs {name}, but it is wired to {what}")
        return None

    def _producers(self, value: Value, path: str, here: Mapping[str, str], makers: str = "") -> tuple[str, ...] | None:
        """Return the copies of a step that a wire names; ``here`` are the items of the reading step."""
        parsed = _parse(value)
        if parsed is None:
            what = value.data if isinstance(value.data, str) else kind(value)
            return self._refuse(value, path, f"must be a step's name such as psf or psf[mask], not {what}")
        name, wanted = parsed
        if name in self.absent:
            return self._refuse(value, path, f"step {name} is null ({self.absent[name].mark})")
        if name not in self.steps:
            hint = nearest(name, self.steps)
            hint = hint if hint.startswith("did you mean") else f"check the name{makers}"
            now = new_name(f"steps.{name}")
            told = f"step {name} is called {now.removeprefix('steps.')} now" if now else f"no step {name}; {hint}"
            return self._refuse(value, path, told)
        producer = self.steps[name]
        fixed = {dim: item for dim, item in here.items() if dim in producer.dims}
        if wanted is not None:
            chosen = self._chosen(producer, wanted, value, path)
            if chosen is None:
                return None
            fixed |= chosen
        choices = [[fixed[dim]] if dim in fixed else self._items(dim) for dim in producer.dims]
        return tuple(producer.instance(items) for items in itertools.product(*choices))

    def _chosen(self, producer: Declared, wanted: Sequence[str], value: Value, path: str) -> dict[str, str] | None:
        """Return the items in brackets by dimension: in order if all are given, else each in the list that has it."""
        if not producer.dims:
            self._refuse(value, path, f"{producer.name} has no items: leave out the brackets")
            return None
        left = list(producer.dims)
        chosen: dict[str, str] = {}
        for item in wanted:
            among = left[:1] if len(wanted) == len(producer.dims) else left
            place = next((dim for dim in among if item in self._items(dim)), None)
            if place is None:
                names = [name for dim in among for name in self._items(dim)]
                self._refuse(value, path, f"{producer.name} has no item {item}; {nearest(item, names)}")
                return None
            chosen[place] = item
            left.remove(place)
        return chosen

    def _items(self, dim: str) -> list[str]:
        return [str(name) for name in self.root.items[dim].items]

    def _agree(self, node: Node, name: str, producer: Declared, value: Value, path: str) -> None:
        """Report a step that returns another type than the input needs."""
        needed = needs(node, name)
        if producer.node is None:
            return
        made = _kinds(producer.node.hints.get("return"))
        if not made or not needed or any(issubclass(m, n) for m in made for n in needed):
            return
        message = f"{node.path} needs {_a(needed)}; {producer.name} returns {_a(made)}{self._makers(needed)}"
        self._refuse(value, path, message)

    def _makers(self, needed: Sequence[type]) -> str:
        """Return a hint with the steps of the needed type, where that type is specific."""
        if not needed or all(n.__name__ == "Tensor" for n in needed):
            return ""
        found = [
            name
            for step in self.steps.values()
            if step.node and any(issubclass(m, n) for m in _kinds(step.node.hints.get("return")) for n in needed)
            for name in step.instances
        ]
        return f"; steps returning {_a(needed)}: {', '.join(found[:6])}" if found else f"; no step returns {_a(needed)}"

    def _refuse(self, value: Value, path: str, message: str) -> tuple[str, ...] | None:
        self.diagnostics.append(Diagnostic(value.mark, path, message))
        return None


def _parse(value: Value) -> tuple[str, list[str] | None] | None:
    """Return the step and the items of a wire such as ``spot[mask,green]``."""
    match = _WIRE.fullmatch(value.data) if isinstance(value.data, str) else None
    if match is None:
        return None
    return match[1], None if match[2] is None else [item.strip() for item in match[2].split(",")]


def _misspelt(name: str, node: Node, given: Value) -> bool:
    """Return True if an input is given under a misspelt name, which is already reported."""
    strangers = [str(key) for key in given.items if key not in node.inputs]
    return any(nearest(stranger, node.inputs) == f"did you mean {name}?" for stranger in strangers)


def takes_many(node: Node, name: str) -> bool:
    """Return True if an input takes a list of steps."""
    return any(get_origin(hint) in (list, tuple, Sequence) for hint in _options(node.hints.get(name)))


def needs(node: Node, name: str) -> tuple[type, ...]:
    """Return the classes that an input accepts; none if its annotation cannot be compared."""
    found: list[type] = []
    for hint in _options(node.hints.get(name)):
        inner = get_args(hint)[0] if get_origin(hint) in (list, tuple, Sequence) else hint
        found += _kinds(inner)
    return tuple(found)


def _options(hint: Any) -> list[Any]:
    """Return the members of a union, without None and without the extras of ``Annotated``."""
    if get_origin(hint) is Annotated:
        return _options(get_args(hint)[0])
    if get_origin(hint) in (Union, types.UnionType):
        return [option for member in get_args(hint) for option in _options(member)]
    return [] if hint is None or hint is type(None) else [hint]


def _kinds(hint: Any) -> list[type]:
    return [option for option in _options(hint) if isinstance(option, type) and option is not object]


def _a(kinds: Sequence[type]) -> str:
    return "a " + " or ".join(dict.fromkeys(k.__name__ for k in kinds))


# --- cycles -----------------------------------------------------------------------------------------------------------


def cycles(steps: Mapping[str, Step], marks: Mapping[str, Location]) -> Iterator[Diagnostic]:
    """Yield one diagnostic for each cycle, with the lines of its steps."""
    seen: set[frozenset[str]] = set()
    for loop in _loops({name: [s for s in step.sources if s in steps] for name, step in steps.items()}):
        names = list(dict.fromkeys(name.partition("[")[0] for name in loop))
        if frozenset(names) in seen:
            continue
        seen.add(frozenset(names))
        start = min(range(len(names)), key=lambda n: marks[names[n]])
        names = names[start:] + names[:start]
        few = names if len(names) <= _NAMED else [*names[: _NAMED - 1], f"({len(names) - _NAMED} more)", names[-1]]
        where = _lines_of([marks[name] for name in names[:_NAMED]])
        yield Diagnostic(marks[names[0]], "steps", f"cycle: {' -> '.join([*few, names[0]])} ({where})")


def _lines_of(marks: list[Location]) -> str:
    if len({mark.file for mark in marks}) > 1:
        return ", ".join(f"{mark.file}:{mark.line}" for mark in marks)
    return f"line{'s' * (len(marks) > 1)} {', '.join(str(mark.line) for mark in marks)}"


def _loops(sources: Mapping[str, list[str]]) -> Iterator[list[str]]:
    """Yield each cycle that a walk from sink to source closes, in the direction of the data; without recursion."""
    done: set[str] = set()
    for root in sources:
        path: dict[str, Iterator[str]] = {} if root in done else {root: iter(sources[root])}
        while path:
            name = next(reversed(path))
            source = next(path[name], None)
            if source is None:
                done.add(name)
                path.popitem()
            elif source in path:
                names = list(path)
                yield names[names.index(source) :][::-1]
            elif source not in done:
                path[source] = iter(sources[source])
