"""Shapes, types and small values of the results of a recipe, found before anything runs.

A form is a tensor on the device ``meta``, which has a shape and no values, a tensor of few numbers,
or a named tuple of such tensors. The rule of a node (``@node.shape``) computes the form of its
result from the forms of its inputs. No node runs for this, apart from those with ``before_run``,
whose results have few numbers.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neusee.nodes import Node
from neusee.workflows.graph.recipe_graph import Recipe, Step

if TYPE_CHECKING:
    from torch import Tensor

Form = Any  #: a tensor, a named tuple of tensors, or None where the shape is not known


@dataclass(frozen=True, slots=True)
class TensorForm:
    """What another process found of a tensor; it stands in place of the tensor without torch."""

    shape: tuple[int, ...]
    dtype: str
    bytes_each: int  #: of one element
    values: str = ""  #: digest of the values, empty where they are not known

    @property
    def ndim(self) -> int:
        return len(self.shape)

    def numel(self) -> int:
        return math.prod(self.shape)

    def element_size(self) -> int:
        return self.bytes_each


def is_tensor(form: Form) -> bool:
    """Return True for a tensor, and for what another process found of one; import no torch."""
    torch = sys.modules.get("torch")  # without it there is no tensor
    return isinstance(form, TensorForm) or (torch is not None and isinstance(form, torch.Tensor))


def forms_of(recipe: Recipe, order: Iterable[str]) -> dict[str, Form]:
    """Return the form of the result of each step in ``order``, which lists each step after its
    inputs.
    """
    forms: dict[str, Form] = {}
    for name in order:
        step = recipe.steps[name]
        forms[name] = form_of(step.node, inputs_of(step, forms), step.params)
    return forms


def inputs_of(step: Step, forms: Mapping[str, Form]) -> list[Form]:
    """Return the forms of the inputs of a step, in the order of the node; a list input is a list
    of forms.
    """
    wires = (step.wires.get(name) for name in step.node.inputs)
    return [
        # None for no wire, one form, or one for each step of a list
        wire
        and (forms.get(wire) if isinstance(wire, str) else [forms.get(source) for source in wire])
        for wire in wires
    ]


def form_of(node: Node, inputs: Sequence[Form], params: Mapping[str, Any]) -> Form:
    """Return the form of the result of a node, or None if the node has no rule or the rule needs an
    unknown input.

    Raises: OverflowError for a result with more bytes than any machine can address.
    """
    try:
        if node.hooks.shape is not None:
            return node.hooks.shape(*inputs, **params)
        return node(**params) if node.before_run else None
    except RuntimeError as error:
        if "overflow" in str(error):
            raise OverflowError(str(error)) from error
    except OverflowError:
        raise
    except Exception:  # a wrong recipe fails where the step runs, with the names of its inputs
        pass
    return None


def is_same(form: Form, other: Form) -> bool:
    """Return True if two forms of an input are the same object, or lists of the same objects."""
    if type(form) is list and type(other) is list:
        return len(form) == len(other) and all(a is b for a, b in zip(form, other, strict=True))
    return form is other


def has_path(value: Any) -> bool:
    """Return True if a parameter, or a part of it, is the path of a file, which may change."""
    if isinstance(value, Mapping):
        return any(map(has_path, value.values()))
    return isinstance(value, Path) or (
        isinstance(value, list | tuple) and any(map(has_path, value))
    )


def complete(node: Node, inputs: Sequence[Form]) -> bool:
    """Return True if the shape of every input that a node needs is known, and of every item of a
    list.
    """
    forms_and_names = zip(inputs, node.inputs, strict=False)
    if any(x is None and name not in node.optional for x, name in forms_and_names):
        return False
    lists = (x for x in inputs if type(x) is list)
    return not any(item is None for item in chain.from_iterable(lists))


def without_values(value: Any) -> Form:
    """Return the form of a value: tensors of many numbers become tensors on the device ``meta``."""
    from torch import Tensor

    if isinstance(value, Tensor):
        return value if value.numel() <= _MOST_NUMBERS else value.detach().to("meta")
    if hasattr(value, "_make"):
        return value._make(map(without_values, value))
    return [without_values(item) for item in value] if isinstance(value, list) else value


#: elements of a tensor up to which its values are kept, which may decide the work of a later node
_MOST_NUMBERS = 4096


def bytes_of(form: Form) -> float:
    """Return the bytes of a result from its form, or of a list of results."""
    return float(
        sum(math.prod(tensor.shape) * tensor.element_size() for tensor in tensors_of(form))
    )


def tensors_of(form: Form) -> list[Tensor | TensorForm]:
    """Return the tensors of a result, or of a list of results."""
    if is_tensor(form):
        return [form]
    if isinstance(form, tuple | list):
        return list(chain.from_iterable(map(tensors_of, form)))
    return []


def alike(form: Form, other: Form) -> bool:
    """Return True if two forms are equivalent: equal shapes and types, and equal values as far as
    these are known.
    """
    from torch import Tensor, equal

    if type(form) is not type(other):
        return False
    if isinstance(form, Tensor):
        shape_type_device = (form.shape, form.dtype, form.device)
        if shape_type_device != (other.shape, other.dtype, other.device):
            return False
        return form.device.type == "meta" or equal(form, other)
    if isinstance(form, list | tuple):
        return len(form) == len(other) and all(map(alike, form, other))
    return form is None or (isinstance(form, str | int | float) and form == other)
