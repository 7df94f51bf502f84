"""Checks of steps before a run: parameters, shapes and small values; reused in a sweep."""

from __future__ import annotations

import functools
import math
import os
from collections.abc import (
    Callable,
    Collection,
    Container,
    Iterable,
    Iterator,
    Mapping,
    Sequence,
    Sized,
)
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from pydantic import ValidationError

from neusee.nodes import Node, ParameterError
from neusee.nodes.parameters import is_file, texts_of
from neusee.workflows.graph.errors import Diagnostic, Location, nearest, shortened
from neusee.workflows.graph.final_values import Setting
from neusee.workflows.graph.recipe_graph import Expectation, Recipe, Step, Wire, in_order, ordered
from neusee.workflows.graph.step_shapes import (
    TensorForm,
    alike,
    bytes_of,
    has_path,
    inputs_of,
    is_same,
    is_tensor,
    tensors_of,
)
from neusee.workflows.keys.cache_key import files_in
from neusee.workflows.recipe.asked_nodes import AskedNodes
from neusee.workflows.recipe.node_families import Own, class_context, nodes_of
from neusee.workflows.recipe.steps import Declared
from neusee.workflows.recipe.text.field_errors import message_of
from neusee.workflows.recipe.text.other_spellings import instead, new_name
from neusee.workflows.recipe.text.recipe_files import NO_CODE_VARIABLE, is_strange, refuse_outside
from neusee.workflows.recipe.text.references import References, broken
from neusee.workflows.recipe.text.yaml_values import Value, Where, kind

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails
    from torch import Tensor


# --- parameters -----------------------------------------------------------------------------------

# Check of the parameters of steps against the signatures of their nodes.


_MOST_CHARACTERS = 40  #: largest number of characters of a value in a message


@dataclass(slots=True)
class Checker:
    """Checker of the parameters of all steps in a recipe, which collects diagnostics and notes
    for the user.
    """

    diagnostics: list[Diagnostic]
    notes: dict[str, None] = field(default_factory=dict)
    #: full path of a file, or of several files, by the path of the value in the recipe
    files: dict[tuple[str | int, ...], Any] = field(default_factory=dict)
    #: the user's families of nodes, whose network classes a parameter may name
    own: Own = field(default_factory=dict)
    asked: AskedNodes = field(default_factory=AskedNodes)

    def read(self, node: Node, block: Value, step: Location) -> dict[str, Any] | None:
        """Return the validated parameters of a step with the defaults of its node, or None if a
        parameter is wrong.
        """
        if broken(block):
            return None
        if block.data is not None and not isinstance(block.data, dict):
            message = f"must be a mapping of parameters, not {kind(block)}"
            self.diagnostics.append(Diagnostic(block.mark, block.name, message))
            return None
        values = {str(name): value for name, value in block.items.items()}
        plain = {name: self._plain(node, name, value) for name, value in values.items()}
        try:
            model = node.params.model_validate(plain, context=class_context(self.own))
        except ValidationError as error:
            self.diagnostics += _problems(error, node, values, block, step)
            return None
        params = {name: getattr(model, name) for name in node.params.model_fields}
        self.asked.note_values(node, plain, params)
        refused_files = _strange_files(params, values)
        self.diagnostics += refused_files
        return None if refused_files else params

    def preflight(
        self,
        bound: Step,
        inputs: Mapping[str, Any],
        source: Callable[[Wire], Mapping[Any, Value]],
        parameters: Value,
        step: Value,
    ) -> Sequence[str] | None:
        """Run a node's own check of a step, and return its notes, or None for a mistake.

        ``inputs`` has the known form of each input, and ``source`` returns the parameters of the
        step that computes an input.
        """
        if bound.node.hooks.preflight is None:
            return ()
        try:
            forms = {name: inputs.get(name) for name in bound.node.preflight_inputs}
            return self.asked.notes(bound, forms)
        except ParameterError as error:
            # the node may blame a parameter of the step that feeds one of its inputs
            fed_input, _, name = error.parameter.rpartition(".")
            value = (source(bound.wires.get(fed_input)) if fed_input else parameters.items).get(
                name
            )
            if value is None:
                self.diagnostics.append(
                    Diagnostic(step.key, f"{step.name}.with.{error.parameter}", str(error))
                )
            else:
                self.diagnostics.append(Diagnostic(value.mark, _value_text(value), str(error)))
        except ValueError as error:
            self.diagnostics.append(Diagnostic(step.key, step.name, str(error)))
        except OSError as error:  # the error of a failed read does not name the file
            names = ", ".join(path.name for path in files_in(bound.params))
            self.diagnostics.append(
                Diagnostic(step.key, step.name, f"{names} cannot be read ({error})")
            )
        return None

    def _plain(self, node: Node, name: str, value: Value) -> Any:
        """Return a parameter value as plain data, with a file path relative to the folder of its
        YAML file.
        """
        items = value.data if isinstance(value.data, list) else [value]
        hint = node.hints.get(name)
        if (
            not is_file(hint)
            or not all(isinstance(item.data, str) for item in items)
            or value.plain in texts_of(hint)
        ):
            return value.plain
        paths = [
            os.path.normpath(Path(item.mark.folder) / Path(item.data).expanduser())
            for item in items
        ]
        full_paths = [os.path.abspath(path) for path in paths]
        self.files[value.path] = full_paths if isinstance(value.data, list) else full_paths[0]
        return paths if isinstance(value.data, list) else paths[0]


def _strange_files(params: Mapping[str, Any], values: Mapping[str, Value]) -> list[Diagnostic]:
    """Return a diagnostic for each parameter value with a file that the recipe may not read."""
    reasons = [(value, _strange(params[name], value)) for name, value in values.items()]
    return [Diagnostic(value.mark, _value_text(value), why) for value, why in reasons if why]


def _strange(parameter: Any, value: Value) -> str:
    """Return why an untrusted recipe may not read the files of a parameter value, or an
    empty text.
    """
    values = parameter if isinstance(parameter, tuple | list) else [parameter]
    paths = [path for path in values if isinstance(path, Path)]
    if not paths or not is_strange():
        return ""
    if any(file.suffix == ".pt2" for file in paths):
        refused = f"which {NO_CODE_VARIABLE} or --no-code refuses to run"
        return f"a file of torch.export holds code, {refused}"
    try:
        for file in paths:
            refuse_outside(file, value.mark)
    except ValueError as error:
        return str(error)
    return ""


def _problems(
    error: ValidationError, node: Node, values: Mapping[str, Value], block: Value, step: Location
) -> Iterator[Diagnostic]:
    """Yield a diagnostic for each parameter of a step that is wrong, unknown or missing."""
    details = error.errors(include_url=False)
    unknown_names = [
        str(detail["loc"][0]) for detail in details if _is_of_parameter(detail, "extra_forbidden")
    ]
    messages_by_place: dict[tuple[Location, str], list[str]] = {}
    unknown_parameters: dict[str, Diagnostic] = {}
    for detail in details:
        name = str(detail["loc"][0])
        if _is_of_parameter(detail, "extra_forbidden"):
            unknown = f"unknown to {node.path}; {nearest(name, node.params.model_fields)}"
            message = instead(f"{node.path}.{name}") or unknown
            unknown_parameters.setdefault(
                message, Diagnostic(values[name].key, f"{block.name}.{name}", message)
            )
        elif _is_of_parameter(detail, "missing"):
            # a misspelt name is one mistake, not an unknown and a missing parameter
            if not _is_meant(name, unknown_names, node):
                yield Diagnostic(
                    step, f"{block.name}.{name}", f"missing parameter: {node.path} needs {name}"
                )
        else:
            value = _deepest(values[name], detail["loc"][1:])
            messages_by_place.setdefault((value.mark, _value_text(value)), []).append(
                message_of(detail, value)
            )
    # parameters that moved to the same node share one message
    yield from unknown_parameters.values()
    for (mark, path), messages in messages_by_place.items():
        yield Diagnostic(mark, path, _in_one(messages))


def _is_of_parameter(error: ErrorDetails, kind_of_error: str) -> bool:
    """Return True for an error of a parameter itself, not of a value inside of it."""
    return error["type"] == kind_of_error and len(error["loc"]) == 1


def _is_meant(name: str, strangers: Iterable[str], node: Node) -> bool:
    """Return True if an unknown name is a misspelt or an old form of a parameter."""
    suggestions = {nearest(stranger, node.params.model_fields) for stranger in strangers}
    new_names = {new_name(f"{node.path}.{stranger}") for stranger in strangers}
    return f"did you mean {name}?" in suggestions or name in new_names


def _in_one(messages: Iterable[str]) -> str:
    """Return the messages on one value as one: first that a file is missing, then the others as
    alternatives.
    """
    distinct = dict.fromkeys(messages)
    missing_files = [message for message in distinct if message.startswith("no such file")]
    alternatives = [message for message in distinct if message not in missing_files]
    return "; ".join([*missing_files, *([", or ".join(alternatives)] if alternatives else [])])


def _deepest(value: Value, path: tuple[int | str, ...]) -> Value:
    """Return the value at a path of keys below ``value``; keys that it lacks, such as names of
    types, are skipped.
    """
    for key in path:
        value = value.child(key) or value
    return value


def _value_text(value: Value) -> str:
    """Return the name and the text of a recipe value, such as ``sensor.gain = -1``."""
    return f"{value.name} = {shortened(str(value.plain), _MOST_CHARACTERS)}"


# --- known before run -----------------------------------------------------------------------------

# Facts about the results of a recipe before the run: shapes and small values, and the mistakes that
# follow from them.


_CHEAPER = ("channel_sum_form", "low_rank_form", "accepts_channel_sums", "accepts_low_rank")
_GB = 1e9


@dataclass(frozen=True, slots=True)
class CheckedStep:
    """A step with valid parameters, the recipe values of its parameters, and the recipe value of
    the step itself.
    """

    step: Step
    params: Value
    value: Value


class KnownForm(NamedTuple):
    """Outcome of an earlier check of a step: its inputs, its notes and the known form of its
    result.
    """

    checked: CheckedStep
    inputs: Sequence[Any]
    computed: bool
    notes: Sequence[str]
    form: Any

    def holds(self, checked: CheckedStep, inputs: Sequence[Any], computed: bool) -> bool:
        """Return True if the step and the known forms of its inputs are the same objects."""
        return (
            checked is self.checked
            and computed == self.computed
            and all(map(is_same, inputs, self.inputs))
        )


def check_steps(
    checked: Iterable[CheckedStep],
    checker: Checker,
    outputs: Iterable[str] | None,
    earlier_forms: dict[str, KnownForm] | None = None,
) -> None:
    """Check each step with its node's own check and with the shapes of its inputs; collect notes
    and diagnostics.

    ``outputs`` are the steps whose results the recipe returns; None means a cycle of steps, so that
    no shape is known. ``earlier_forms`` has the outcomes of earlier checks of the same graph, and
    is updated.
    """
    by_name = {candidate.step.name: candidate for candidate in checked}
    sources = {name: _sources_among(by_name, candidate.step) for name, candidate in by_name.items()}
    needed_names = set(ordered(sources, [name for name in outputs or () if name in by_name]))
    checks = _FormChecks(
        by_name=by_name,
        checker=checker,
        computed=needed_names,
        is_cycle=outputs is None,
        earlier_forms={} if earlier_forms is None else earlier_forms,
        memory=machine_memory(),
    )
    order = by_name if outputs is None else ordered(sources, by_name)
    notes = {name: checks.notes_of(name) for name in order}
    for name in by_name:
        checker.notes.update(dict.fromkeys(notes.get(name, ())))


def _sources_among(names: Container[str], step: Step) -> tuple[str, ...]:
    return tuple(name for name in step.sources if name in names)


@dataclass
class _FormChecks:
    """Checks of the steps of a recipe, one after another, with the known forms of their results."""

    by_name: Mapping[str, CheckedStep]
    checker: Checker
    computed: Collection[str]  #: steps that an output needs
    is_cycle: bool  #: whether the steps depend on each other in a cycle
    earlier_forms: dict[str, KnownForm]  #: outcomes of earlier checks, updated
    memory: float  #: of the machine, bytes
    results: dict[str, Any] = field(default_factory=dict)

    def notes_of(self, name: str) -> Sequence[str]:
        """Check a step whose inputs were checked, and return its notes."""
        current_step = self.by_name[name]
        input_forms, is_computed = inputs_of(current_step.step, self.results), name in self.computed
        known_form = self.earlier_forms.get(name)
        # nothing has changed since an earlier check
        if known_form is not None and known_form.holds(current_step, input_forms, is_computed):
            self.results[name] = known_form.form
            return known_form.notes
        inputs = dict(zip(current_step.step.node.inputs, input_forms, strict=True))
        notes = self.checker.preflight(
            current_step.step,
            inputs,
            lambda wire: _params(self.by_name, wire),
            current_step.params,
            current_step.value,
        )
        # the step has a mistake, which counts only if the step is needed
        if notes is None:
            is_needed = self.is_cycle or is_computed
            return [] if is_needed else _set_aside(current_step.step, inputs, self.checker)
        self._add_result(name)
        problem = is_computed and _too_large(
            current_step.step, inputs, self.results.get(name), self.memory
        )
        if problem:
            del self.results[name]
            self.checker.diagnostics.append(_at_shape(current_step, problem))
        elif name in self.results:
            self.earlier_forms[name] = KnownForm(
                current_step, input_forms, is_computed, notes, self.results[name]
            )
        return notes

    def _add_result(self, name: str) -> None:
        """Add the known form of the result of a step, or a diagnostic if the result
        cannot exist.
        """
        current_step, known_form = self.by_name[name], self.earlier_forms.get(name)
        try:
            inputs = inputs_of(current_step.step, self.results)
            self.results[name] = form = self.checker.asked.form(current_step.step, inputs)
            if known_form is not None and alike(form, known_form.form):
                # the same object, so that later steps need no new check
                self.results[name] = known_form.form
        except (ValueError, OverflowError) as error:
            self.checker.diagnostics.append(
                Diagnostic(current_step.value.key, current_step.value.name, str(error))
            )


def _at_shape(current: CheckedStep, problem: str) -> Diagnostic:
    """Return a diagnostic at the shape that a step sets, or at the step."""
    shape = current.params.items.get("shape")
    if shape is None:
        return Diagnostic(current.value.key, current.value.name, problem)
    return Diagnostic(shape.mark, f"{shape.name} = {shape.plain}", problem)


def _set_aside(step: Step, inputs: Mapping[str, Any], checker: Checker) -> list[str]:
    """Return the last mistake as a note if it comes from the inputs of a step that no output of
    the recipe needs.
    """
    # the mistake is in the parameters alone: it remains a mistake
    if all(inputs.get(name) is None for name in step.node.preflight_inputs):
        return []
    problem = checker.diagnostics.pop()
    return [f"{problem.path}: {problem.message} (no output needs the step {step.name})"]


def refuse_indices(recipe: Recipe, asked: AskedNodes) -> Iterator[Diagnostic]:
    """Yield a diagnostic for each expected number whose index or field the result cannot have."""
    results: dict[str, Any] = {}
    for name in in_order(
        {name: step.sources for name, step in recipe.steps.items()}, [e.step for e in recipe.expect]
    ):
        step = recipe.steps[name]
        results[name] = asked.form(step, inputs_of(step, results))
    for expected in recipe.expect:
        if problem := _wrong_index(expected, results.get(expected.step)):
            yield Diagnostic(
                expected.mark, f"expect.{expected.name}.at = {list(expected.at)}", problem
            )


def machine_memory() -> float:
    """Return the bytes of memory of this machine, or infinity if the operating system does not
    report it.
    """
    try:
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, ValueError, OSError):
        return float("inf")


def _params(by_name: Mapping[str, CheckedStep], wire: Wire) -> Mapping[Any, Value]:
    """Return the recipe values of the parameters of the step that feeds an input."""
    source = by_name.get(wire) if isinstance(wire, str) else None
    return {} if source is None else source.params.items


def _too_large(step: Step, inputs: Mapping[str, Any], result: Any, memory: float) -> str:
    """Return a message if the result of a step and its largest input do not fit together into the
    memory of this machine, else an empty text.

    A step that a cheaper form may replace is not judged, because its full result may never exist.
    """
    if result is None or any(getattr(step.node, name) for name in _CHEAPER):
        return ""
    input_results: list[Any] = []
    for value in inputs.values():
        input_results += value if type(value) is list else [value]
    # at least one input is in memory while the result is computed
    needed_bytes = bytes_of(result) + max(map(bytes_of, input_results), default=0.0)
    if needed_bytes <= memory:
        return ""
    sizes = " x ".join(map(str, max(tensors_of(result), key=_numbers_of).shape))
    return (
        f"the step {step.name.partition('[')[0]} needs {needed_bytes / _GB:.4g} GB for a result of"
        f" {sizes} values and one input, and this machine has {memory / _GB:.3g} GB: choose a"
        " smaller shape, or fewer bands or samples"
    )


def _numbers_of(tensor: Tensor | TensorForm) -> int:
    return tensor.numel()


def _wrong_index(expected: Expectation, result: Any) -> str:
    """Return a message if the indices ``at`` of an expected number do not select one number of a
    result.
    """
    selected, axis = result, 0
    for index in expected.at:
        # nothing is known of the result before the run
        if selected is None:
            return ""
        if isinstance(index, str):
            if index not in (fields := getattr(selected, "_fields", ())):
                return (
                    f"the result of {expected.step} has no field {index}; {nearest(index, fields)}"
                )
            selected = getattr(selected, index)
        elif is_tensor(selected):
            if axis >= selected.ndim:
                return (
                    f"{_described(expected.step, selected)}: give {selected.ndim} indices,"
                    f" not {axis + 1}"
                )
            size = selected.shape[axis]
            if not -size <= index < size:
                return (
                    f"index {index} is out of range: {_described(expected.step, selected)}; the"
                    f" indices of axis {axis} are 0 to {size - 1}"
                )
            # each number selects along one more axis of the tensor
            axis += 1
    if is_tensor(selected) and math.prod(selected.shape[axis:]) != 1:
        return (
            f"{_described(expected.step, selected)}, of which `at` must select one: give"
            f" {selected.ndim} indices"
        )
    return ""


def _described(step: str, tensor: Tensor | TensorForm) -> str:
    return f"{step} has {' x '.join(map(str, tensor.shape)) or '1'} values"


# --- bound steps ----------------------------------------------------------------------------------

# Memory of a step graph for the points of a sweep: a step is checked again only if a value that it
# reads has changed.
#
# Values of a recipe are never changed in place, and an override rebuilds the values along its path
# alone. So a value that is the same object at two points is equal at both, with all that it holds.
# Steps that read files are always checked.


@dataclass(frozen=True, slots=True, eq=False)
class BoundStep:
    """A step without mistakes, and the values that its references read; None for a path without
    a value.
    """

    checked: CheckedStep
    reads: Mapping[str | int, Mapping[Where, Value | None]]  #: by block of the recipe
    #: each of these blocks, which has not changed if it is the same object
    blocks: Mapping[str | int, Value | None]
    used: frozenset[Where]  #: paths of the values that the step reads
    offered: frozenset[Where]  #: paths that the step looks up and that have no value

    @classmethod
    def of(
        cls, checked: CheckedStep, reads: Mapping[Where, Value | None], root: Value
    ) -> BoundStep:
        """Remember a step and what it ``reads`` in the recipe ``root``, by path."""
        by_block: dict[str | int, dict[Where, Value | None]] = {}
        for path, value in reads.items():
            by_block.setdefault(path[0], {})[path] = value
        blocks = {name: root.child(name) for name in by_block}
        read_paths = frozenset(value.path for value in reads.values() if value is not None)
        return cls(
            checked,
            by_block,
            blocks,
            read_paths,
            frozenset(path for path, value in reads.items() if value is None),
        )

    def holds(self, root: Value) -> bool:
        """Return True if each value that the step read is still the same object."""
        return all(
            root.child(name) is block
            or all(root.below(path) is value for path, value in self.reads[name].items())
            for name, block in self.blocks.items()
        )


@dataclass(eq=False)
class GraphMemory:
    """Outcomes of earlier checks of one step graph: steps, forms of results, and final values by
    block.
    """

    bound: dict[str, BoundStep] = field(default_factory=dict)
    forms: dict[str, KnownForm] = field(default_factory=dict)
    #: of graphs without a cycle
    sources: list[tuple[tuple[str, ...], ...]] = field(default_factory=list)
    #: by path of the block
    settings: dict[Where, tuple[Value, dict[str, Setting]]] = field(default_factory=dict)

    def find(self, name: str, references: References) -> CheckedStep | None:
        """Return the step ``name`` as it was checked before, or None if a value that it reads
        has changed.
        """
        bound = self.bound.get(name)
        if bound is None or not bound.holds(references.root):
            return None
        references.offered |= bound.offered
        references.used |= bound.used
        return bound.checked


class Attempt:
    """The check of one step, which is remembered if it made no mistake, gave no note and reads
    no file.
    """

    def __init__(self, references: References, checker: Checker) -> None:
        self._references, self._checker = references, checker
        self._first, self._before = len(references.trace), self._state()

    def remember(self, name: str, checked: CheckedStep, memory: GraphMemory | None) -> None:
        """Let later checks of the same graph find the step."""
        if (
            memory is None
            or has_path(checked.step.params)
            or self._checker.own
            or self._state() != self._before
        ):
            return
        reads = dict(self._references.trace[self._first :])
        memory.bound[name] = BoundStep.of(checked, reads, self._references.root)

    def _state(self) -> tuple[int, ...]:
        """Return the number of messages so far, in each list; it grows with a mistake or a note."""
        references, checker = self._references, self._checker
        reports: tuple[Sized, ...] = (references.diagnostics, references.lacking, references.notes)
        lists = (*reports, checker.diagnostics, checker.notes)
        return tuple(len(messages) for messages in lists)


# --- graph cache ----------------------------------------------------------------------------------

# Cache of the step graphs of recipes; a graph is valid while the steps, their copies and nodes are
# unchanged.
#
# The node and the connections of a step depend on no other values, so that the points of a sweep
# share one graph. Parameters are checked again where they have changed, and files for each point.


#: name and items of each block; None for a block without items
Names = tuple[tuple[str, tuple[str, ...] | None], ...]

_MOST_GRAPHS = 16  #: largest number of graphs in the cache
_graphs: dict[tuple[Value | None, Value | None, Names], CachedGraph] = {}  #: by `_key`


@dataclass(frozen=True, slots=True, eq=False)
class CachedGraph:
    """Cached steps of a recipe without mistakes, and the connections between the steps."""

    steps: dict[str, Declared]
    absent: dict[str, Value]
    #: by step, for the steps whose connections are not references
    wires: Mapping[str, Mapping[str, Wire]]
    memory: GraphMemory = field(default_factory=GraphMemory)


def cached_graph(root: Value, own: Own) -> CachedGraph | None:
    """Return the cached step graph of a recipe, or None if the cache has no valid graph of the
    recipe.

    ``own`` has the families of nodes that the recipe names.
    """
    graph = _graphs.get(_key(root))
    families = functools.cache(functools.partial(nodes_of, own=own))
    return (
        graph
        if graph is not None and all(_is_current(step, families) for step in graph.steps.values())
        else None
    )


def cache_graph(
    root: Value,
    steps: dict[str, Declared],
    absent: dict[str, Value],
    wires: Mapping[str, Mapping[str, Wire]],
) -> None:
    """Add the step graph of a recipe without mistakes to the cache; omit inputs of steps that
    references set.
    """
    if any(_refers(step.value.items.get("node")) for step in steps.values()):
        return
    steps_with_fixed_wires: list[str] = []
    for step in steps.values():
        if not _refers(step.value.items.get("from")):
            steps_with_fixed_wires += step.instances
    graph = CachedGraph(steps, absent, {name: wires[name] for name in steps_with_fixed_wires})
    key = _key(root)
    # the oldest graph goes first
    while len(_graphs) >= _MOST_GRAPHS:
        _graphs.pop(next(iter(_graphs), key), None)
    _graphs[key] = graph


def _names(root: Value) -> Names:
    """Return the names of all blocks but the steps.

    Beside each name are those of its items, or None for a block that is no list of items.
    """
    other_blocks = ((str(key), block.data) for key, block in root.items.items() if key != "steps")
    return tuple(
        (key, _items(data) if isinstance(data, dict) else None) for key, data in other_blocks
    )


def _items(block: dict[str | int, Value]) -> tuple[str, ...] | None:
    """Return the names of the items of a block; None for a block with a single value."""
    return (
        tuple(map(str, block))
        if all(isinstance(item.data, dict) for item in block.values())
        else None
    )


def _key(root: Value) -> tuple[Value | None, Value | None, Names]:
    """Return the key of a step graph: its steps, the user's own nodes, and the names of
    the items.
    """
    return root.items.get("steps"), root.items.get("nodes"), _names(root)


def _is_current(step: Declared, families: Callable[[str], Mapping[str, Node]]) -> bool:
    """Return True if the name of the node of a cached step still means the same node."""
    family, _, name = str(step.value.items["node"].data).partition(".")
    try:
        return families(family).get(name) is step.node
    except LookupError:
        return False


def _refers(value: Value | None) -> bool:
    """Return True if a value contains a reference such as ``${sensor.gain}``, at any depth."""
    if value is None:
        return False
    return (
        "${" in value.data
        if isinstance(value.data, str)
        else any(map(_refers, value.items.values()))
    )
