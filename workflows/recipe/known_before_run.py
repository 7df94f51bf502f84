"""What is known of the results of a recipe before the run: shapes and small values, and the mistakes that they show."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from neusee.workflows.graph.diagnostics import Diagnostic, nearest
from neusee.workflows.graph.recipe_graph import Expectation, Recipe, Step, Wire, in_order, ordered
from neusee.workflows.graph.step_shapes import Form, alike, bytes_of, form_of, inputs_of, is_same, tensors_of
from neusee.workflows.recipe.parameters import Checker
from neusee.workflows.recipe.text.yaml_values import Value

if TYPE_CHECKING:
    from torch import Tensor

_CHEAPER = ("channel_sum_form", "low_rank_form", "accepts_channel_sums", "accepts_low_rank")
_GB = 1e9


@dataclass(frozen=True, slots=True)
class CheckedStep:
    """A step with valid parameters, the recipe values of its parameters, and the recipe value of the step itself."""

    step: Step
    params: Value
    value: Value


class KnownForm(NamedTuple):
    """What the check of a step with its inputs gave."""

    checked: CheckedStep
    inputs: Sequence[Any]
    computed: bool
    notes: Sequence[str]
    form: Any

    def holds(self, checked: CheckedStep, inputs: Sequence[Any], computed: bool) -> bool:
        """Return True if the step and what is known of its inputs are the same objects."""
        return checked is self.checked and computed == self.computed and all(map(is_same, inputs, self.inputs))


def check_steps(
    checked: Iterable[CheckedStep],
    checker: Checker,
    outputs: Iterable[str] | None,
    before: dict[str, KnownForm] | None = None,
) -> None:
    """Check each step with its node's own check and with the shapes of its inputs; collect notes and diagnostics.

    ``outputs`` are the steps whose results the recipe returns; None means a cycle of steps, so that no shape is known.
    ``before`` has what earlier checks of the same graph found, and is brought up to date.
    """
    by_name = {each.step.name: each for each in checked}
    sources = {name: tuple(s for s in each.step.sources if s in by_name) for name, each in by_name.items()}
    known: dict[str, Any] = {}
    notes: dict[str, Iterable[str]] = {}
    memory = machine_memory()
    computed = set(ordered(sources, [name for name in outputs or () if name in by_name]))
    for name in by_name if outputs is None else ordered(sources, by_name):
        each, forms = by_name[name], inputs_of(by_name[name].step, known)
        if before is not None and name in before and before[name].holds(each, forms, name in computed):
            notes[name], known[name] = before[name].notes, before[name].form
            continue
        inputs = dict(zip(each.step.node.inputs, forms, strict=True))
        found = checker.preflight(each.step, inputs, lambda wire: _params(by_name, wire), each.params, each.value)
        if found is None:
            notes[name] = [] if outputs is None or name in computed else _set_aside(each.step, inputs, checker)
            continue
        notes[name] = found
        try:
            known[name] = form = _form(each.step, known)
            if before is not None and name in before and alike(form, before[name].form):
                known[name] = before[name].form  # the same object, so that later steps need no new check
        except (ValueError, OverflowError) as error:
            checker.diagnostics.append(Diagnostic(each.value.key, each.value.name, str(error)))
        if name in computed and (problem := _too_large(each.step, inputs, known.get(name), memory)):
            del known[name]
            shape = each.params.items.get("shape")
            place = (
                (each.value.key, each.value.name) if shape is None else (shape.mark, f"{shape.name} = {shape.plain}")
            )
            checker.diagnostics.append(Diagnostic(*place, problem))
        elif before is not None and name in known:
            before[name] = KnownForm(each, forms, name in computed, found, known[name])
    for name in by_name:
        checker.notes.update(dict.fromkeys(notes.get(name, ())))


def _set_aside(step: Step, inputs: Mapping[str, Any], checker: Checker) -> list[str]:
    """Return the last mistake as a note if it comes from the inputs of a step that no output of the recipe needs."""
    if all(inputs.get(name) is None for name in step.node.preflight_inputs):
        return []
    problem = checker.diagnostics.pop()
    return [f"{problem.path}: {problem.message} (no output needs the step {step.name})"]


def refuse_indices(recipe: Recipe) -> Iterator[Diagnostic]:
    """Yield a diagnostic for each expected number whose index or field the result cannot have."""
    known: dict[str, Any] = {}
    for name in in_order({name: step.sources for name, step in recipe.steps.items()}, [e.step for e in recipe.expect]):
        known[name] = _form(recipe.steps[name], known)
    for expected in recipe.expect:
        if problem := _wrong_index(expected, known.get(expected.step)):
            yield Diagnostic(expected.mark, f"expect.{expected.name}.at = {list(expected.at)}", problem)


def machine_memory() -> float:
    """Return the bytes of memory of this machine, or infinity if the operating system does not tell."""
    try:
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, ValueError, OSError):
        return float("inf")


def _params(by_name: Mapping[str, CheckedStep], wire: Wire) -> Mapping[Any, Value]:
    """Return the recipe values of the parameters of the step that feeds an input."""
    source = by_name.get(wire) if isinstance(wire, str) else None
    return {} if source is None else source.params.items


def _form(step: Step, known: Mapping[str, Form]) -> Form:
    """Return what is known of the result of a step; a step that is computed before the run tells its own mistakes."""
    if step.node.before_run:
        return step.node(**step.params)
    return form_of(step.node, inputs_of(step, known), step.params)


def _too_large(step: Step, inputs: Mapping[str, Any], result: Any, memory: float) -> str:
    """Return a message if inputs and result of a step cannot be in this machine's memory at once, else an empty text.

    A step that a cheaper form may replace is not judged, because its full result may never exist.
    """
    if result is None or any(getattr(step.node, name) for name in _CHEAPER):
        return ""
    single = [one for value in inputs.values() for one in (value if type(value) is list else [value])]
    needed = bytes_of(result) + max(map(bytes_of, single), default=0.0)
    if needed <= memory:
        return ""
    sizes = " x ".join(map(str, max(tensors_of(result), key=_numbers_of).shape))
    return (
        f"the step {step.name.partition('[')[0]} needs {needed / _GB:.4g} GB for a result of {sizes} values and one "
        f"input, and this machine has {memory / _GB:.3g} GB: choose a smaller shape, or fewer bands or samples"
    )


def _numbers_of(tensor: Tensor) -> int:
    return tensor.numel()


def _wrong_index(expected: Expectation, known: Any) -> str:
    """Return a message if the indices ``at`` of an expected number do not select one number of a result."""
    from torch import Tensor

    found, axis = known, 0
    for part in expected.at:
        if found is None:
            return ""
        if isinstance(part, str):
            if part not in (fields := getattr(found, "_fields", ())):
                return f"the result of {expected.step} has no field {part}; {nearest(part, fields)}"
            found = getattr(found, part)
        elif isinstance(found, Tensor):
            if axis >= found.ndim:
                return f"{_described(expected.step, found)}: give {found.ndim} indices, not {axis + 1}"
            size = found.shape[axis]
            if not -size <= part < size:
                return (
                    f"index {part} is out of range: {_described(expected.step, found)}; axis {axis} has 0 to {size - 1}"
                )
            axis += 1
    if isinstance(found, Tensor) and found.shape[axis:].numel() != 1:
        return f"{_described(expected.step, found)}, of which `at` must select one: give {found.ndim} indices"
    return ""


def _described(step: str, found: Tensor) -> str:
    return f"{step} has {' x '.join(map(str, found.shape)) or '1'} values"
