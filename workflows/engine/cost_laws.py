"""Laws of the cost of a node: seconds and peak memory from shapes and parameters, with coefficients that were measured.

The peak memory of a step is ``a + b inputs + c result + d work`` bytes beyond the memory in use before, and its time is
``e + f operations`` seconds. ``node_costs.json`` has the coefficients of each shipped node, which
tests/benchmarks/fit_costs.py fits to runs of the shipped recipes on a CPU, and the spread of the runs about the law.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any, NamedTuple

from neusee.nodes import Node
from neusee.workflows.engine.band_results import bands_in
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.recipe.step_shapes import Form, bytes_of, complete, form_of, inputs_of, without_values

_UPPER = 4.0  #: peak memory and time of a node that was never measured, as a multiple of what its tensors alone take
_LEAST = 1 << 26  #: bytes of a result whose shape is not known, at the least


class Size(NamedTuple):
    """The size of the problem that a step solves, from which its costs follow."""

    inputs: float  #: bytes
    result: float  #: bytes
    work: float  #: bytes beside inputs and result, up to a factor: `Hooks.work` of the node
    operations: float  #: up to a factor
    bands: int = 0  #: number of bands that can be computed one after another; 0 if not known
    known: bool = True  #: False where the shape of the result is a guess


@dataclass(frozen=True, slots=True)
class Law:
    """The costs of a node as functions of the `Size` of a step."""

    memory: tuple[float, float, float, float]  #: bytes, and factors of inputs, result and work
    seconds: tuple[float, float]  #: s, and s for each operation
    spread: tuple[float, float] = (1.0, 1.0)  #: factor by which a run may exceed the law, for memory and for seconds

    def peak(self, size: Size) -> float:
        """Return the peak memory of a step in bytes beyond the memory in use before; at least its result."""
        a, b, c, d = self.memory
        return max(size.result, a + b * size.inputs + c * size.result + d * size.work)

    def time(self, size: Size) -> float:
        """Return the time of a step in s on the CPU."""
        return self.seconds[0] + self.seconds[1] * size.operations


#: for a node that was never measured: the upper end of what the shipped nodes need
GUESS = Law((float(1 << 24), _UPPER, _UPPER, 2.0), (0.01, 1e-7), (1.0, 1.0))


@cache
def shipped() -> Mapping[str, Law]:
    """Return the laws of the shipped nodes, by the path of the node."""
    text = resources.files(__package__).joinpath("node_costs.json").read_text(encoding="utf-8")
    return {
        path: Law(tuple(law["memory"]), tuple(law["seconds"]), tuple(law["spread"]))
        for path, law in json.loads(text)["nodes"].items()
    }


def sizes_of(recipe: Recipe, order: Sequence[str]) -> dict[str, Size]:
    """Return the size of each step in ``order`` before anything runs; ``order`` lists each step after its inputs."""
    forms: dict[str, Form] = {}
    found: dict[str, Size] = {}
    for name in order:
        step = recipe.steps[name]
        inputs = inputs_of(step, forms)
        try:
            forms[name] = form_of(step.node, inputs, step.params)
        except OverflowError:
            found[name] = Size(0.0, math.inf, math.inf, math.inf)
            continue
        found[name] = _size(step, inputs, forms[name], [found[source] for source in dict.fromkeys(step.sources)])
        if forms[name] is None:  # a guess, so that the sizes of later steps can be computed
            forms[name] = next((x for x in inputs if x is not None), None)
    return found


def _size(step: Step, inputs: Sequence[Form], form: Form, below: Sequence[Size]) -> Size:
    known = form is not None and all(size.known for size in below)
    if form is not None and complete(step.node, inputs):
        return size_of(step.node, inputs, step.params, form)._replace(known=known)
    read = sum(size.result for size in below)
    result = bytes_of(form) if form is not None else max(read, float(_LEAST))
    return Size(read, result, 0.0, (read + result) / 4, 0, known)


def size_of(node: Node, inputs: Sequence[Any], params: Mapping[str, Any], result: Any) -> Size:
    """Return the size of a step from its inputs and its result, which may be values or forms without values."""
    read, written = bytes_of(list(inputs)), bytes_of(result)
    work, operations = 0.0, (read + written) / 4
    if node.hooks.work is not None:
        work, operations = node.hooks.work(result, *inputs, **params)
    return Size(read, written, float(work), float(operations), bands_in(node, inputs))


def measured_size(node: Node, inputs: Sequence[Any], params: Mapping[str, Any], result: Any) -> list[float] | None:
    """Return the size of a step that ran, as the journal keeps it, or None if the rule of the node fails."""
    try:
        forms = [without_values(x) for x in inputs]
        return list(size_of(node, forms, params, without_values(result))[:4])
    except Exception:  # a wrong rule of a node must not lose its result
        return None
