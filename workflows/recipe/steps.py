"""Steps of a recipe: the node and the copies of each, and the steps whose results it reads."""

from __future__ import annotations

import functools
import itertools
import math
import re
import types
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Union, get_args, get_origin

from neusee.nodes import Node
from neusee.workflows.graph.errors import Diagnostic, Location, RecipeError, nearest
from neusee.workflows.graph.recipe_graph import Step, Wire
from neusee.workflows.recipe.asked_nodes import AskedNodes
from neusee.workflows.recipe.node_families import OwnFamilies, is_known
from neusee.workflows.recipe.text.other_spellings import became_input, new_name
from neusee.workflows.recipe.text.references import BROKEN, References, Scope, broken
from neusee.workflows.recipe.text.yaml_values import Value, kind

# --- step declarations ----------------------------------------------------------------------------

# Declarations of the steps in a recipe: the node of each step, and the items, such as lasers, for
# its copies.


_MOST_STEPS = 20_000  #: largest number of steps of a recipe, with all copies
_KEYS = ("node", "each", "from", "with", "device", "cache")
_DEVICE = re.compile(r"any|cpu|gpu|mps|cuda(:\d+)?")
_NAME = re.compile(r"[^\W\d][\w-]*")
_ITEM = re.compile(r"[^\[\],\s]+")


@dataclass(frozen=True, slots=True)
class Declared:
    """Declaration of a step, from which one copy of the step is made for each item, such as each
    laser.
    """

    name: str
    value: Value
    node: Node | None  #: None if the node does not exist; the connections are checked nevertheless
    dims: tuple[str, ...]  #: names of the lists of items in ``each``
    items: tuple[tuple[str, ...], ...]  #: items of each copy; one empty tuple without ``each``

    def instance(self, items: tuple[str, ...]) -> str:
        return f"{self.name}[{','.join(items)}]" if items else self.name

    @property
    def instances(self) -> tuple[str, ...]:
        return tuple(map(self.instance, self.items))

    def entry(self, key: str) -> Value:
        """Return the value of a key of a step, such as ``from`` or ``cache``, or an empty
        mapping for a missing key.
        """
        value = self.value.items.get(key)
        return (
            Value({}, self.value.key, self.value.key, (*self.value.path, key))
            if value is None
            else value
        )

    def scope(self, root: Value, items: tuple[str, ...]) -> Scope:
        blocks = [
            {str(key): item for key, item in root.items[dim].items.items()} for dim in self.dims
        ]
        return Scope(
            {dim: block[item] for dim, block, item in zip(self.dims, blocks, items, strict=True)},
            self.name,
        )


def declare(
    root: Value,
    references: References,
    diagnostics: list[Diagnostic],
    own: OwnFamilies,
    asked: AskedNodes,
) -> tuple[dict[str, Declared], dict[str, Value]]:
    """Return the declared steps of a recipe and the steps that are null; report mistakes in the
    declarations.

    ``own`` has the families of nodes that the recipe names.
    Raises `RecipeError` for more steps than the limit, before the copies are made.
    """
    written = _written_steps(root, diagnostics)
    absent = {name: value for name, value in written if value.data is None}
    steps, step_count = dict[str, Declared](), 0
    find = functools.cache(functools.partial(asked.find, own=own.modules))
    for name, value in written:
        if value.data is None:
            continue
        # a step with mistakes stays known, so that others may name it
        steps[name] = Declared(name, value, None, (), ())
        if not _well_formed(name, value, diagnostics):
            continue
        node = _node(value, find, references, diagnostics, own)
        dims = _dims(value, root, diagnostics)
        copies = _number_of_copies(dims, root)
        step_count += copies
        if step_count > _MOST_STEPS:
            raise RecipeError([_too_many(value, dims or (), root, copies, step_count)])
        steps[name] = Declared(name, value, node, dims or (), _items_of(dims, root))
    return steps, absent


def _number_of_copies(dims: tuple[str, ...] | None, root: Value) -> int:
    """Return the number of copies of a step; 1 where the lists of items are wrong."""
    return math.prod(len(root.items[dim].items) for dim in dims or ())


def _written_steps(root: Value, diagnostics: list[Diagnostic]) -> list[tuple[str, Value]]:
    """Return the steps that a recipe writes, by name; report a recipe without steps."""
    block = root.items.get("steps")
    if block is None or not isinstance(block.data, dict) or not block.data:
        mark = root.mark if block is None else block.mark
        diagnostics.append(
            Diagnostic(
                mark,
                "steps",
                "a recipe needs steps, or a group with steps, such as `camera: neusee`",
            )
        )
        return []
    return [(str(name), value) for name, value in block.data.items()]


def _items_of(dims: tuple[str, ...] | None, root: Value) -> tuple[tuple[str, ...], ...]:
    """Return the items of each copy of a step; no copy where the lists of items are wrong."""
    if dims is None:
        return ()
    names = [map(str, root.items[dim].items) for dim in dims]
    return tuple(itertools.product(*names))


def _too_many(
    step: Value, dims: tuple[str, ...], root: Value, copies: int, total: int
) -> Diagnostic:
    """Return the diagnostic for the step with which a recipe exceeds the largest
    number of steps.
    """
    if copies <= _MOST_STEPS:
        message = (
            f"with this step the recipe has {total} steps, more than the limit of {_MOST_STEPS}:"
            " split the recipe"
        )
        return Diagnostic(step.key, step.name, message)
    sizes = " x ".join(f"{len(root.items[dim].items)} {dim}" for dim in dims)
    dims_value = step.items["each"]
    message = (
        f"makes {sizes} = {copies} steps, more than the limit of {_MOST_STEPS}: use fewer items,"
        " or a sweep"
    )
    return Diagnostic(dims_value.mark, dims_value.name, message)


def _well_formed(name: str, value: Value, diagnostics: list[Diagnostic]) -> bool:
    """Return True if a step has a valid name and is a mapping; report mistakes and unknown keys."""
    if not _NAME.fullmatch(name):
        diagnostics.append(
            Diagnostic(
                value.key, value.name, "a step's name must consist of letters, digits, _ and -"
            )
        )
        return False
    if not isinstance(value.data, dict):
        diagnostics.append(
            Diagnostic(
                value.mark, value.name, f"a step must be a mapping or null, not {kind(value)}"
            )
        )
        return False
    for key, value_of_key in value.data.items():
        if key not in _KEYS:
            diagnostics.append(
                Diagnostic(
                    value_of_key.key, value_of_key.name, f"unknown; {nearest(str(key), _KEYS)}"
                )
            )
    return True


def _node(
    step: Value,
    find: Callable[[str], Node],
    references: References,
    diagnostics: list[Diagnostic],
    own: OwnFamilies,
) -> Node | None:
    """Return the node that a step names, or None if the name is wrong; ``find`` returns a node
    by name.
    """
    name = step.items.get("node")
    if name is None:
        diagnostics.append(
            Diagnostic(step.key, step.name, "the step has no node: write `node: family.name`")
        )
        return None
    name = references.resolve(name, Scope({}, str(step.path[-1])))
    if broken(name):
        return None
    try:
        return find(str(name.plain))
    except LookupError as error:
        # otherwise the family may be one whose import failed, which is reported already
        if own.is_whole or is_known(str(name.plain).partition(".")[0]):
            diagnostics.append(Diagnostic(name.mark, f"{step.name}.node", str(error.args[0])))
        return None


def _dims(step: Value, root: Value, diagnostics: list[Diagnostic]) -> tuple[str, ...] | None:
    """Return the names of the lists, such as ``lasers``, in a step's key ``each``, or None for a
    mistake.
    """
    setting = step.items.get("each")
    if setting is None or setting.data is None:
        return ()
    lists = _item_lists(root)
    dims: list[str] = []
    earlier_mistakes = len(diagnostics)
    for value in setting.data if isinstance(setting.data, list) else [setting]:
        block = lists.get(value.data) if isinstance(value.data, str) else None
        if block is None:
            hint = nearest(str(value.data), map(str, lists))
            diagnostics.append(
                Diagnostic(
                    value.mark, setting.name, f"there is no list of items {value.data}; {hint}"
                )
            )
        elif value.data in dims or len(dims) == 2:
            diagnostics.append(
                Diagnostic(
                    value.mark, setting.name, "`each` needs one or two different lists of items"
                )
            )
        else:
            dims.append(value.data)
            diagnostics += _wrong_items(block)
    return tuple(dims) if len(diagnostics) == earlier_mistakes else None


def _item_lists(root: Value) -> dict[str | int, Value]:
    """Return the blocks of a recipe that are lists of items, by name."""
    return {
        key: block for key, block in root.items.items() if key != "steps" and _is_item_list(block)
    }


def _wrong_items(block: Value) -> list[Diagnostic]:
    """Return a diagnostic for each item whose name cannot stand in the brackets of a step."""
    message = "an item's name must not contain a space, comma or bracket"
    return [
        Diagnostic(item.key, item.name, message)
        for key, item in block.items.items()
        if not _ITEM.fullmatch(str(key))
    ]


def device_of(
    step: Declared, references: References, scope: Scope, diagnostics: list[Diagnostic]
) -> str:
    """Return the device, such as ``gpu``, that a copy of a step requests, or an empty string for
    any device.
    """
    setting = references.resolve(step.entry("device"), scope)
    if broken(setting) or setting.data in ({}, None, "any"):
        return ""
    if not isinstance(setting.data, str) or not _DEVICE.fullmatch(setting.data):
        hint = "write any, cpu, gpu, cuda, cuda:1 or mps"
        diagnostics.append(
            Diagnostic(setting.mark, f"{setting.name} = {setting.plain}", f"unknown device: {hint}")
        )
        return ""
    required_device = step.node.device if step.node else "any"
    if required_device != "any" and (required_device == "cpu") != (setting.data == "cpu"):
        message = f"{step.node and step.node.path} runs only on a {required_device.upper()}"
        diagnostics.append(Diagnostic(setting.mark, f"{setting.name} = {setting.data}", message))
    return setting.data


def cached_of(
    step: Declared, references: References, scope: Scope, diagnostics: list[Diagnostic]
) -> bool:
    """Return False for a step with ``cache: false``, whose result is computed in each run and
    never stored.
    """
    setting = references.resolve(step.entry("cache"), scope)
    if broken(setting) or setting.data in ({}, None):
        return True
    if not isinstance(setting.data, bool):
        diagnostics.append(
            Diagnostic(setting.mark, f"{setting.name} = {setting.plain}", "must be true or false")
        )
        return True
    return setting.data


def _is_item_list(block: Value) -> bool:
    """Return True if a block of a recipe is a list of items such as ``lasers``, which is a
    mapping of mappings.
    """
    return isinstance(block.data, dict) and all(
        isinstance(item.data, dict) for item in block.data.values()
    )


# --- wiring ---------------------------------------------------------------------------------------

# Connections between the steps of a recipe: the steps whose results each step reads, and a check of
# their types.


_NAMED = 12  #: largest number of steps of a cycle that a message names
_LISTS = (list, tuple, Sequence)  #: annotations of an input that takes a list of steps
_WIRE = re.compile(r"\s*([^\[\]\s]+)\s*(?:\[([^\[\]]*)\])?\s*")


@dataclass(frozen=True, slots=True)
class Wiring:
    """The steps of a recipe, and the connections that pass the results of steps to the inputs of
    other steps.
    """

    root: Value
    steps: Mapping[str, Declared]
    absent: Mapping[str, Value]  #: steps that are null
    references: References
    diagnostics: list[Diagnostic]

    def wires(self, step: Declared, items: tuple[str, ...]) -> dict[str, Wire]:
        """Return the steps that feed each input of one copy of a step, in the order of the
        node's inputs.
        """
        sources = self.references.resolve(step.entry("from"), step.scope(self.root, items))
        values = self._by_input(step.node, sources) if step.node else None
        if step.node is None or values is None:
            return {}
        wires: dict[str, Wire] = {}
        for name in step.node.inputs:
            if name not in values:
                wires[name] = None
                self._require(step, step.node, name, sources)
            elif values[name].data is not BROKEN:
                wires[name] = self._wire(step, step.node, items, name, values[name])
        return wires

    def outputs(self, value: Value, path: str) -> tuple[str, ...]:
        """Return the names of all copies of the steps that a value of ``outputs`` or ``expect``
        names.
        """
        return self._producers(value, path, {}) or ()

    def refuse(self, value: Value, path: str, message: str) -> None:
        """Report a mistake at the location of a recipe value."""
        self.diagnostics.append(Diagnostic(value.mark, path, message))

    def _by_input(self, node: Node, sources: Value) -> dict[str, Value] | None:
        """Return the values in a step's key ``from`` by input, or None for a mistake.

        A single name in ``from`` is for the first input.
        """
        if sources.data is BROKEN:
            return None
        if sources.data is None:
            return {}
        if isinstance(sources.data, list):
            self.refuse(
                sources,
                sources.name,
                "must be a step's name, or a mapping of inputs to names, not a list",
            )
            return None
        if not isinstance(sources.data, dict):
            if node.inputs:
                return {node.inputs[0]: sources}
            self.refuse(sources, sources.name, f"{node.path} takes no inputs: remove `from`")
            return None
        for name, value in sources.data.items():
            if name not in node.inputs:
                hint = nearest(str(name), node.inputs)
                self.diagnostics.append(
                    Diagnostic(value.key, value.name, f"{node.path} has no input {name}; {hint}")
                )
        return {str(name): value for name, value in sources.data.items()}

    def _require(self, step: Declared, node: Node, name: str, sources: Value) -> None:
        """Report an input of a node that the step's key ``from`` does not name, unless the input
        is optional.
        """
        if name in node.optional or (
            name == "stop" and became_input(node.path, map(str, step.entry("with").items))
        ):
            return  # the parameters of an old recipe are reported with the step that replaces them
        if not (isinstance(sources.data, dict) and _misspelt(name, node, sources)):
            mark = sources.mark if sources.items else step.value.key
            advice = f"write from: {{{name}: STEP}}{self._makers(needs(node, name))}"
            self.diagnostics.append(
                Diagnostic(mark, sources.name, f"{node.path} needs the input {name}: {advice}")
            )

    def _wire(
        self, step: Declared, node: Node, items: tuple[str, ...], name: str, value: Value
    ) -> Wire:
        """Return the steps that feed an input, from its value in the step's key ``from``, or
        None for a mistake.
        """
        is_many, path = takes_many(node, name), f"{step.value.name}.from.{name}"
        if self._is_null(value):
            if not is_many and name not in node.optional:
                self._refuse_null(node, name, value, path)
            return () if is_many else None
        items_of_reader = dict(zip(step.dims, items, strict=True))
        names = self._producers(value, path, items_of_reader, self._makers(needs(node, name)))
        if names is None:
            return None
        self._agree(node, name, self._named(value), value, path)
        if not is_many and not self._is_single(value, items_of_reader):
            self._refuse_copies(node, name, value, path, items_of_reader)
            return None
        return names if is_many else names[0]

    def _named(self, value: Value) -> Declared:
        """Return the step that a value names; the step must exist."""
        parsed = _parse(value)
        assert parsed is not None
        return self.steps[parsed[0]]

    def _is_single(self, value: Value, reader_items: Mapping[str, str]) -> bool:
        """Return True if a value names one copy of a step; ``reader_items`` contains the items of
        the step that reads it.
        """
        parsed, producer = _parse(value), self._named(value)
        chosen_items = parsed[1] if parsed else None
        # each list of items is fixed by the reader, or by the brackets
        is_fixed_by_reader = set(producer.dims) <= set(reader_items)
        return is_fixed_by_reader or len(chosen_items or ()) == len(producer.dims)

    def _refuse_copies(
        self, node: Node, name: str, value: Value, path: str, reader_items: Mapping[str, str]
    ) -> None:
        """Report an input of one step that names several copies.

        `reader_items` has the items of the step that reads it.
        """
        producer = self._named(value)
        open_lists = ", ".join(dim for dim in producer.dims if dim not in reader_items)
        message = (
            f"{node.path} takes one step as {name}, but {producer.name} is a step for each of"
            f" {open_lists}: write {_example_of(producer)}"
        )
        self.refuse(value, path, message)

    def _is_null(self, value: Value) -> bool:
        """Return True for an input that is null, or that names a step that is null."""
        parsed = _parse(value)
        return value.data is None or (parsed is not None and parsed[0] in self.absent)

    def _refuse_null(self, node: Node, name: str, value: Value, path: str) -> None:
        """Report an input that a node needs and that is null, or names a step that is null."""
        parsed = _parse(value)
        null_step = self.absent.get(parsed[0]) if parsed else None
        instead = (
            f"{parsed[0]}, which is null ({null_step.mark})" if parsed and null_step else "null"
        )
        self.refuse(value, path, f"{node.path} needs {name}, but this input is {instead}")

    def _producers(
        self, value: Value, path: str, reader_items: Mapping[str, str], makers: str = ""
    ) -> tuple[str, ...] | None:
        """Return the copies of a step that a value names; ``reader_items`` contains the items of
        the step that reads them.
        """
        parsed = _parse(value)
        if parsed is None or parsed[0] not in self.steps:
            self.refuse(value, path, self._unknown(value, makers))
            return None
        producer, items = self.steps[parsed[0]], parsed[1]
        selected = {} if items is None else self._selected_items(producer, items, value, path)
        if selected is None:
            return None
        # items in brackets override those of the reader; a list with neither gives all its items
        item_by_list = {**reader_items, **selected}
        items_by_list = [
            [item_by_list[dim]] if dim in item_by_list else self._items(dim)
            for dim in producer.dims
        ]
        return tuple(producer.instance(items) for items in itertools.product(*items_by_list))

    def _unknown(self, value: Value, makers: str) -> str:
        """Return the error message for a value that should name a step but does not."""
        parsed = _parse(value)
        if parsed is None:
            content = value.data if isinstance(value.data, str) else kind(value)
            return f"must be a step's name such as psf or psf[mask], not {content}"
        name = parsed[0]
        if name in self.absent:
            return f"step {name} is null ({self.absent[name].mark})"
        if present_name := new_name(f"steps.{name}"):
            return f"step {name} is called {present_name.removeprefix('steps.')} now"
        hint = nearest(name, self.steps)
        return (
            f"no step {name};"
            f" {hint if hint.startswith('did you mean') else f'check the name{makers}'}"
        )

    def _selected_items(
        self, producer: Declared, items: Sequence[str], value: Value, path: str
    ) -> dict[str, str] | None:
        """Return the items in the brackets of a name such as ``spot[mask,green]``, by the list that
        contains each item.

        A single item may be in any of the lists of the step.
        """
        if not producer.dims:
            self.refuse(value, path, f"{producer.name} has no items: remove the brackets")
            return None
        open_lists = list(producer.dims)
        selected: dict[str, str] = {}
        for item in items:
            # with an item for every list the items stand in the order of the lists
            candidate_lists = open_lists[:1] if len(items) == len(producer.dims) else open_lists
            list_name = next(
                (list_name for list_name in candidate_lists if item in self._items(list_name)), None
            )
            if list_name is None:
                names = [*itertools.chain.from_iterable(map(self._items, candidate_lists))]
                self.refuse(
                    value, path, f"{producer.name} has no item {item}; {nearest(item, names)}"
                )
                return None
            selected[list_name] = item
            open_lists.remove(list_name)
        return selected

    def _items(self, dim: str) -> list[str]:
        """Return the names of the items in a list such as ``lasers``."""
        return [str(name) for name in self.root.items[dim].items]

    def _agree(self, node: Node, name: str, producer: Declared, value: Value, path: str) -> None:
        """Report a step whose result does not have the type that an input of another step needs."""
        needed, returned = needs(node, name), _returned(producer)
        if returned and needed and not _fits(returned, needed):
            message = (
                f"{node.path} needs {_a(needed)}; {producer.name} returns"
                f" {_a(returned)}{self._makers(needed)}"
            )
            self.refuse(value, path, message)

    def _makers(self, needed: Sequence[type]) -> str:
        """Return a hint that names the steps whose results have a type, or an empty hint for the
        type ``Tensor``.
        """
        if not needed or all(n.__name__ == "Tensor" for n in needed):
            return ""
        makers: list[str] = []
        for step in self.steps.values():
            if _fits(_returned(step), needed):
                makers += step.instances
        if not makers:
            return f"; no step returns {_a(needed)}"
        return f"; steps returning {_a(needed)}: {', '.join(makers[:6])}"


def _parse(value: Value) -> tuple[str, list[str] | None] | None:
    """Return the step name and the items in a text such as ``spot[mask,green]``, or None for any
    other value.
    """
    match = _WIRE.fullmatch(value.data) if isinstance(value.data, str) else None
    if match is None:
        return None
    return match[1], None if match[2] is None else [item.strip() for item in match[2].split(",")]


def _example_of(producer: Declared) -> str:
    """Return the name of one copy of a step, as an input may name it."""
    item = producer.items[0][0] if producer.items else "…"
    return f"{producer.name}[{item}]"


def _misspelt(name: str, node: Node, sources: Value) -> bool:
    """Return True if a step's key ``from`` contains a misspelt form of an input's name."""
    strangers = [str(key) for key in sources.items if key not in node.inputs]
    return any(nearest(stranger, node.inputs) == f"did you mean {name}?" for stranger in strangers)


def takes_many(node: Node, name: str) -> bool:
    """Return True if an input of a node takes the results of a list of steps."""
    return any(get_origin(hint) in _LISTS for hint in _options(node.hints.get(name)))


def needs(node: Node, name: str) -> tuple[type, ...]:
    """Return the classes that an input of a node accepts, or an empty tuple for an annotation
    without classes.
    """
    hints = _options(node.hints.get(name))
    kinds: list[type] = []
    for hint in hints:
        kinds += _kinds(get_args(hint)[0] if get_origin(hint) in _LISTS else hint)
    return tuple(kinds)


def _returned(step: Declared) -> list[type]:
    """Return the classes that the result of a step may have."""
    return _kinds(step.node.hints.get("return")) if step.node else []


def _fits(returned: Iterable[type], needed: Iterable[type]) -> bool:
    """Return True if a returned class is one of the needed classes, or a subclass of one."""
    return any(
        issubclass(returned_class, needed_class)
        for returned_class, needed_class in itertools.product(returned, needed)
    )


def _options(hint: Any) -> list[Any]:
    """Return the types that a type annotation allows, without None and ``Annotated``."""
    if get_origin(hint) is Annotated:
        return _options(get_args(hint)[0])
    if get_origin(hint) in (Union, types.UnionType):
        return list(itertools.chain.from_iterable(map(_options, get_args(hint))))
    return [] if hint is None or hint is type(None) else [hint]


def _kinds(hint: Any) -> list[type]:
    """Return the classes in a type annotation; ``object`` is left out, because it
    excludes nothing.
    """
    return [
        option for option in _options(hint) if isinstance(option, type) and option is not object
    ]


def _a(kinds: Sequence[type]) -> str:
    """Return classes in words, such as ``a Psf or Tensor``."""
    return "a " + " or ".join(dict.fromkeys(type_.__name__ for type_ in kinds))


# --- cycles ---------------------------------------------------------------------------------------


def cycles(steps: Mapping[str, Step], marks: Mapping[str, Location]) -> Iterator[Diagnostic]:
    """Yield one diagnostic for each cycle of steps in a recipe, with the lines of these steps."""
    reported: set[frozenset[str]] = set()
    for loop in _loops(
        {name: [s for s in step.sources if s in steps] for name, step in steps.items()}
    ):
        # copies of one step count as one
        names = list(dict.fromkeys(name.partition("[")[0] for name in loop))
        if frozenset(names) in reported:
            continue
        reported.add(frozenset(names))
        # a cycle is written from the step that comes first in the file
        start = min(range(len(names)), key=lambda n: marks[names[n]])
        names = names[start:] + names[:start]
        shown_names = (
            names
            if len(names) <= _NAMED
            else [*names[: _NAMED - 1], f"({len(names) - _NAMED} more)", names[-1]]
        )
        lines = _lines_of([marks[name] for name in names[:_NAMED]])
        yield Diagnostic(
            marks[names[0]], "steps", f"cycle: {' -> '.join([*shown_names, names[0]])} ({lines})"
        )


def _lines_of(marks: list[Location]) -> str:
    """Return the lines of places in words, with their files if there are several."""
    if len({mark.file for mark in marks}) > 1:
        return ", ".join(f"{mark.file}:{mark.line}" for mark in marks)
    return f"line{'s' * (len(marks) > 1)} {', '.join(str(mark.line) for mark in marks)}"


def _loops(sources: Mapping[str, list[str]]) -> Iterator[list[str]]:
    """Yield the names of the steps in each cycle, each step before the step that reads its
    result.
    """
    visited: set[str] = set()
    for root in sources:
        path: dict[str, Iterator[str]] = {} if root in visited else {root: iter(sources[root])}
        # depth-first search with an explicit stack: each open step with its sources still to visit
        while path:
            name = next(reversed(path))
            # the next source of the innermost open step
            source = next(path[name], None)
            if source is None:
                visited.add(name)
                path.popitem()
            elif source in path:
                names = list(path)
                # the open steps from the repeated one on, sources first
                yield names[names.index(source) :][::-1]
            elif source not in visited:
                path[source] = iter(sources[source])
