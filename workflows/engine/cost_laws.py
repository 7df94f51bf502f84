"""Laws of the cost of a node: seconds and peak memory from shapes and parameters, with coefficients that were measured.

The peak memory of a step is ``a + b inputs + c result + d work`` bytes beyond the memory in use before, and its time is
``e + f operations`` seconds. ``node_costs.json`` has the coefficients of each shipped node, which
tests/benchmarks/fit_costs.py fits to runs of the shipped recipes on a CPU, and the spread of the runs about the law.
Seconds are the processor time of one thread, so that a busy machine does not make a law slow.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any, NamedTuple

from neusee.nodes import Node
from neusee.workflows.engine.band_results import bands_in
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.graph.step_shapes import (
    Form,
    alike,
    bytes_of,
    complete,
    form_of,
    has_path,
    inputs_of,
    is_same,
    without_values,
)

_LEAST = float(1 << 26)  #: bytes of a result whose shape is not known, in a recipe without any known shape


class Size(NamedTuple):
    """The size of the problem that a step solves, from which its costs follow."""

    inputs: float  #: bytes
    result: float  #: bytes
    work: float  #: bytes beside inputs and result, up to a factor: `Hooks.work` of the node
    operations: float  #: up to a factor
    bands: int = 0  #: number of bands that can be computed one after another; 0 if not known
    known: bool = True  #: False where the shape of the result is a guess


class Range(NamedTuple):
    """The least and the largest value that a cost may take, as multiples of its prediction."""

    least: float = 1.0
    most: float = 1.0


Spread = tuple[Range, Range]  #: of the peak memory, and of the seconds
EXACT: Spread = (Range(), Range())


class Loading(NamedTuple):
    """The additional cost of the first step of a process that uses some libraries, because it loads them."""

    libraries: tuple[str, ...]
    memory: float  #: bytes, which the process keeps
    seconds: float


@dataclass(frozen=True, slots=True)
class Law:
    """The costs of a node as functions of the `Size` of a step."""

    memory: tuple[float, float, float, float]  #: bytes, and factors of inputs, result and work
    seconds: tuple[float, float]  #: s, and s for each operation
    spread: Spread = EXACT  #: of runs about the law
    loads: Loading | None = None  #: the libraries that the node loads, whose cost is not in the numbers above
    most: float = 0.0  #: bytes of the largest result that was measured, for a node without a rule of the shape

    def peak(self, size: Size) -> float:
        """Return the peak memory of a step in bytes beyond the memory in use before; at least its result."""
        a, b, c, d = self.memory
        return max(size.result, a + b * size.inputs + c * size.result + d * size.work)

    def time(self, size: Size) -> float:
        """Return the time of a step in s on the CPU."""
        return self.seconds[0] + self.seconds[1] * size.operations


@cache
def _file() -> Mapping[str, Any]:
    text = resources.files(__package__).joinpath("node_costs.json").read_text(encoding="utf-8")
    found: dict[str, Any] = json.loads(text)
    return found


@cache
def shipped() -> Mapping[str, Law]:
    """Return the laws of the shipped nodes, by the path of the node."""
    return {path: _law(law) for path, law in _file()["nodes"].items()}


@cache
def guess() -> Law:
    """Return the law of a node that was never measured: the largest costs for its size that any shipped node has."""
    return _law(_file()["guess"])


def _law(law: Mapping[str, Any]) -> Law:
    spread = (Range(*law["spread"][0]), Range(*law["spread"][1])) if "spread" in law else EXACT
    loads = Loading(tuple(law["loads"][0]), *law["loads"][1:]) if "loads" in law else None
    return Law(tuple(law["memory"]), tuple(law["seconds"]), spread, loads, law.get("most", 0.0))


def libraries_of(paths: Iterable[str]) -> float:
    """Return the bytes of the libraries that the nodes with these paths load, and this process has not loaded yet."""
    total, loaded = 0.0, set[str]()
    for path in paths:
        law = shipped().get(path)
        if law and law.loads and not all(name in loaded or name in sys.modules for name in law.loads.libraries):
            loaded.update(law.loads.libraries)
            total += law.loads.memory
    return total


class Sized(NamedTuple):
    """The size of a step, and what it follows from: the points of a sweep share most steps."""

    step: Step
    inputs: Sequence[Any]
    below: Sequence[Size]
    least: float
    form: Form
    size: Size
    reads_file: bool  #: which may change

    def holds(self, step: Step, inputs: Sequence[Any], below: Sequence[Size], least: float) -> bool:
        """Return True if a step has the same node, parameters and known inputs, and therefore the same size."""
        if self.reads_file or step.node is not self.step.node or least != self.least or below != self.below:
            return False
        same = len(inputs) == len(self.inputs) and all(map(is_same, inputs, self.inputs))
        return same and (step.params is self.step.params or _equal(step.params, self.step.params))


def _equal(params: Mapping[str, Any], others: Mapping[str, Any]) -> bool:
    with suppress(Exception):  # values such as tensors, which have no single answer
        return bool(params == others)
    return False


_sized: dict[str, Sized] = {}  # by step
_MOST_SIZED = 4096


def _remember(sized: Sized) -> None:
    """Keep the size of a step for the next recipe."""
    if len(_sized) >= _MOST_SIZED:
        _sized.clear()
    _sized[sized.step.name] = sized


def sizes_of(recipe: Recipe, order: Sequence[str]) -> dict[str, Size]:
    """Return the size of each step in ``order`` before anything runs; ``order`` lists each step after its inputs.

    A result of unknown shape counts as large as its inputs, or as the largest known result of the recipe if that is
    larger.
    """
    found = _sizes(recipe, order, 0.0)
    if all(size.known for size in found.values()):
        return found
    told = [size.result for size in found.values() if size.known and size.result < math.inf]
    return _sizes(recipe, order, max(told, default=_LEAST))


def _sizes(recipe: Recipe, order: Sequence[str], least: float) -> dict[str, Size]:
    forms: dict[str, Form] = {}
    found: dict[str, Size] = {}
    for name in order:
        step = recipe.steps[name]
        inputs, below = inputs_of(step, forms), [found[source] for source in dict.fromkeys(step.sources)]
        known = _sized.get(name)
        if known is not None and known.holds(step, inputs, below, least):
            forms[name], found[name] = known.form, known.size
            continue
        try:
            forms[name] = form_of(step.node, inputs, step.params)
        except OverflowError:
            found[name] = Size(0.0, math.inf, math.inf, math.inf)
            continue
        found[name] = _size(step, inputs, forms[name], below, least)
        if forms[name] is None and not found[name].known:  # a guess, so that the sizes of later steps can be computed
            forms[name] = next((x for x in inputs if x is not None), None)
        if known is not None and alike(forms[name], known.form):
            forms[name] = known.form  # the same object, so that later steps have the size that they had
        _remember(Sized(step, inputs, below, least, forms[name], found[name], has_path(step.params)))
    return found


def _size(step: Step, inputs: Sequence[Form], form: Form, below: Sequence[Size], least: float) -> Size:
    known = all(size.known for size in below)
    if form is not None and complete(step.node, inputs):
        return size_of(step.node, inputs, step.params, form)._replace(known=known)
    read = sum(size.result for size in below)
    law = shipped().get(step.node.path)
    if form is not None:
        result = bytes_of(form)
    elif law and law.most:
        result = law.most
    else:
        result, known = max(read, least), False
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
