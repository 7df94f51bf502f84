"""Connections between the steps of a recipe: the steps whose results each step reads, and a check of their types."""

from __future__ import annotations

import itertools
import re
import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
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
_LISTS = (list, tuple, Sequence)  #: annotations of an input that takes a list of steps
_WIRE = re.compile(r"\s*([^\[\]\s]+)\s*(?:\[([^\[\]]*)\])?\s*")


@dataclass(frozen=True, slots=True)
class Wiring:
    """The steps of a recipe, and the connections that pass the results of steps to the inputs of other steps."""

    root: Value
    steps: Mapping[str, Declared]
    absent: Mapping[str, Value]  #: steps that are null
    references: References
    diagnostics: list[Diagnostic]

    def wires(self, step: Declared, items: tuple[str, ...]) -> dict[str, Wire]:
        """Return the steps that feed each input of one copy of a step, in the order of the node's inputs."""
        given = self.references.resolve(step.part("from"), step.scope(self.root, items))
        values = self._by_input(step.node, given) if step.node else None
        if step.node is None or values is None:
            return {}
        wires: dict[str, Wire] = {}
        for name in step.node.inputs:
            if name not in values:
                wires[name] = None
                self._require(step, step.node, name, given)
            elif values[name].data is not BROKEN:
                wires[name] = self._wire(step, step.node, items, name, values[name])
        return wires

    def outputs(self, value: Value, path: str) -> tuple[str, ...]:
        """Return the names of all copies of the steps that a value of ``outputs`` or ``expect`` names."""
        return self._producers(value, path, {}) or ()

    def refuse(self, value: Value, path: str, message: str) -> None:
        """Report a mistake at the location of a recipe value."""
        self.diagnostics.append(Diagnostic(value.mark, path, message))

    def _by_input(self, node: Node, given: Value) -> dict[str, Value] | None:
        """Return the values in a step's key ``from`` by input, or None for a mistake.

        A single name in ``from`` is for the first input.
        """
        if given.data is BROKEN:
            return None
        if given.data is None:
            return {}
        if isinstance(given.data, list):
            self.refuse(given, given.name, "must be a step's name, or a mapping of inputs to names, not a list")
            return None
        if not isinstance(given.data, dict):
            if node.inputs:
                return {node.inputs[0]: given}
            self.refuse(given, given.name, f"{node.path} takes no inputs: leave `from` out")
            return None
        for name, value in given.data.items():
            if name not in node.inputs:
                hint = nearest(str(name), node.inputs)
                self.diagnostics.append(Diagnostic(value.key, value.name, f"{node.path} has no input {name}; {hint}"))
        return {str(name): value for name, value in given.data.items()}

    def _require(self, step: Declared, node: Node, name: str, given: Value) -> None:
        """Report an input of a node that the step's key ``from`` does not name, unless the input is optional."""
        if name in node.optional or (name == "stop" and became_input(node.path, map(str, step.part("with").items))):
            return  # the parameters of an old recipe are reported with the step that replaces them
        if not (isinstance(given.data, dict) and _misspelt(name, node, given)):
            mark = given.mark if given.items else step.value.key
            fix = f"write from: {{{name}: STEP}}{self._makers(needs(node, name))}"
            self.diagnostics.append(Diagnostic(mark, given.name, f"{node.path} needs the input {name}: {fix}"))

    def _wire(self, step: Declared, node: Node, items: tuple[str, ...], name: str, value: Value) -> Wire:
        """Return the steps that feed an input, from its value in the step's key ``from``, or None for a mistake."""
        many, path, parsed = takes_many(node, name), f"{step.value.name}.from.{name}", _parse(value)
        null = self.absent.get(parsed[0]) if parsed else None
        if value.data is None or null:
            if not many and name not in node.optional:
                what = f"{parsed[0]}, which is null ({null.mark})" if parsed and null else "null"
                self.refuse(value, path, f"{node.path} needs {name}, but the input is {what}")
            return () if many else None
        here = dict(zip(step.dims, items, strict=True))
        names = self._producers(value, path, here, self._makers(needs(node, name)))
        if names is None or parsed is None:
            return None
        producer = self.steps[parsed[0]]
        self._agree(node, name, producer, value, path)
        if many:
            return names
        if set(producer.dims) <= set(here) or (parsed[1] is not None and len(parsed[1]) == len(producer.dims)):
            return names[0]
        left = ", ".join(dim for dim in producer.dims if dim not in here)
        example = f"{parsed[0]}[{producer.items[0][0]}]" if producer.items else f"{parsed[0]}[…]"
        message = f"{node.path} takes one step as {name}; {parsed[0]} is a step for each of {left}: write {example}"
        self.refuse(value, path, message)
        return None

    def _producers(self, value: Value, path: str, here: Mapping[str, str], makers: str = "") -> tuple[str, ...] | None:
        """Return the copies of a step that a value names; ``here`` contains the items of the step that reads them."""
        parsed = _parse(value)
        if parsed is None or parsed[0] not in self.steps:
            self.refuse(value, path, self._unknown(value, makers))
            return None
        producer, items = self.steps[parsed[0]], parsed[1]
        chosen = {} if items is None else self._chosen(producer, items, value, path)
        if chosen is None:
            return None
        fixed = {**here, **chosen}
        choices = [[fixed[dim]] if dim in fixed else self._items(dim) for dim in producer.dims]
        return tuple(producer.instance(items) for items in itertools.product(*choices))

    def _unknown(self, value: Value, makers: str) -> str:
        """Return the error message for a value that should name a step but does not."""
        parsed = _parse(value)
        if parsed is None:
            what = value.data if isinstance(value.data, str) else kind(value)
            return f"must be a step's name such as psf or psf[mask], not {what}"
        name = parsed[0]
        if name in self.absent:
            return f"step {name} is null ({self.absent[name].mark})"
        if now := new_name(f"steps.{name}"):
            return f"step {name} is called {now.removeprefix('steps.')} now"
        hint = nearest(name, self.steps)
        return f"no step {name}; {hint if hint.startswith('did you mean') else f'check the name{makers}'}"

    def _chosen(self, producer: Declared, items: Sequence[str], value: Value, path: str) -> dict[str, str] | None:
        """Return the items in the brackets of a name such as ``spot[mask,green]``, by the list that contains each item.

        A single item may be in any of the lists of the step.
        """
        if not producer.dims:
            self.refuse(value, path, f"{producer.name} has no items: leave out the brackets")
            return None
        left = list(producer.dims)
        chosen: dict[str, str] = {}
        for item in items:
            among = left[:1] if len(items) == len(producer.dims) else left
            dim = next((dim for dim in among if item in self._items(dim)), None)
            if dim is None:
                names = [name for dim in among for name in self._items(dim)]
                self.refuse(value, path, f"{producer.name} has no item {item}; {nearest(item, names)}")
                return None
            chosen[dim] = item
            left.remove(dim)
        return chosen

    def _items(self, dim: str) -> list[str]:
        return [str(name) for name in self.root.items[dim].items]

    def _agree(self, node: Node, name: str, producer: Declared, value: Value, path: str) -> None:
        """Report a step whose result does not have the type that an input of another step needs."""
        needed, returned = needs(node, name), _returned(producer)
        if returned and needed and not _fits(returned, needed):
            message = f"{node.path} needs {_a(needed)}; {producer.name} returns {_a(returned)}{self._makers(needed)}"
            self.refuse(value, path, message)

    def _makers(self, needed: Sequence[type]) -> str:
        """Return a hint that names the steps whose results have a type, or an empty hint for the type ``Tensor``."""
        if not needed or all(n.__name__ == "Tensor" for n in needed):
            return ""
        makers = [name for s in self.steps.values() if _fits(_returned(s), needed) for name in s.instances]
        if not makers:
            return f"; no step returns {_a(needed)}"
        return f"; steps returning {_a(needed)}: {', '.join(makers[:6])}"


def _parse(value: Value) -> tuple[str, list[str] | None] | None:
    """Return the step name and the items in a text such as ``spot[mask,green]``, or None for any other value."""
    match = _WIRE.fullmatch(value.data) if isinstance(value.data, str) else None
    if match is None:
        return None
    return match[1], None if match[2] is None else [item.strip() for item in match[2].split(",")]


def _misspelt(name: str, node: Node, given: Value) -> bool:
    """Return True if a step's key ``from`` contains a misspelt form of an input's name."""
    strangers = [str(key) for key in given.items if key not in node.inputs]
    return any(nearest(stranger, node.inputs) == f"did you mean {name}?" for stranger in strangers)


def takes_many(node: Node, name: str) -> bool:
    """Return True if an input of a node takes the results of a list of steps."""
    return any(get_origin(hint) in _LISTS for hint in _options(node.hints.get(name)))


def needs(node: Node, name: str) -> tuple[type, ...]:
    """Return the classes that an input of a node accepts, or an empty tuple for an annotation without classes."""
    hints = _options(node.hints.get(name))
    return tuple(k for h in hints for k in _kinds(get_args(h)[0] if get_origin(h) in _LISTS else h))


def _returned(step: Declared) -> list[type]:
    return _kinds(step.node.hints.get("return")) if step.node else []


def _fits(returned: Iterable[type], needed: Iterable[type]) -> bool:
    return any(issubclass(r, n) for r, n in itertools.product(returned, needed))


def _options(hint: Any) -> list[Any]:
    """Return the types that a type annotation allows, without None and ``Annotated``."""
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
    """Yield one diagnostic for each cycle of steps in a recipe, with the lines of these steps."""
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
    """Yield the names of the steps in each cycle, each step before the step that reads its result."""
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
