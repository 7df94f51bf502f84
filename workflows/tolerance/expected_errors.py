"""Errors that the cheaper steps of a plan are expected to leave in the outputs, found before anything runs.

A tolerance is relative to the largest digital number. Where the full well or the converter cuts off most of the light,
an error that is small beside the brightest pixel of the image is large beside that number. Nodes tell the range of
their result from their parameters (`Node.expected_range`), and the errors of the plan are carried through these ranges
as `proof` carries the errors of a run through its results. A run still proves its errors from what it computed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

from neusee.nodes import TensorStats
from neusee.workflows.graph.recipe_graph import Recipe, Step, Wire, needed
from neusee.workflows.graph.run_error import RunError
from neusee.workflows.graph.step_record import StepRecord
from neusee.workflows.graph.step_shapes import forms_of, tensors_of
from neusee.workflows.tolerance.error_budget import ErrorBudget
from neusee.workflows.tolerance.error_propagation import proof, tolerance_frontier
from neusee.workflows.tolerance.zero_effect_steps import UNKNOWN


def expected_excess(recipe: Recipe, wanted: Iterable[str], used: float = 1.0) -> float:
    """Return the expected ratio of the largest error of the outputs ``wanted`` to its limit; 0 if nothing is known.

    Each cheaper step of ``recipe`` is expected to err by the share ``used`` of what it may err by.
    """
    wanted = tuple(wanted)
    order = needed(recipe, wanted)
    order = needed(recipe, tolerance_frontier(recipe, order, wanted))
    within = {each.instead: used * each.within for each in recipe.substitutions if each.instead}
    ranges = _Ranges(recipe, order)
    records = {name: _record(recipe.steps[name], within, ranges) for name in order}
    try:
        return proof(recipe, order, wanted, records.__getitem__, ranges.known.get).over(recipe)
    except RunError:  # a rule that needs more than a range
        return 0.0


def _record(step: Step, within: Mapping[str, float], ranges: _Ranges) -> StepRecord:
    """Return the record that a step is expected to have: left out, or with the error of a cheaper step."""
    bound = ranges.left_out.get(step.name)
    if bound is not None:
        return StepRecord(step.name, "left out", "", 0.0, "", bound=bound)
    error = within.get(step.name, 0.0) + sum(within.get(source, 0.0) for source in step.sources)
    told = error and step.node.hooks.approximation_error is not None
    return StepRecord(step.name, "run", "", 0.0, "", error=(error, error) if told else None)


class _Ranges:
    """Expected statistics of the results of a recipe, as far as the nodes tell them, and the steps to leave out."""

    def __init__(self, recipe: Recipe, order: Iterable[str]) -> None:
        self.known: dict[str, TensorStats] = {}
        self.left_out: dict[str, float] = {}  #: error bound, by step
        order = list(order)
        self._forms, self._budget = forms_of(recipe, order), ErrorBudget(recipe)
        for name in order:
            self._add(recipe.steps[name])

    def _add(self, step: Step) -> None:
        hooks = step.node.hooks
        if hooks.expected_range is None:
            self._budget.pass_on(step)
            return
        inputs = [self._of(step.wires.get(name)) for name in step.node.inputs]
        if hooks.skip_bound is not None and all(source in self.known for source in step.sources):
            decision = self._budget.verdict(step, step.params, self.known.get)
            if decision.left_out:
                self.known[step.name], self.left_out[step.name] = self.known[decision.instead], decision.bound
                return
        try:
            low, high = hooks.expected_range(*inputs, **step.params)
        except LookupError:
            return
        tensors = tensors_of(self._forms[step.name])
        shape = tuple(tensors[0].shape) if tensors else ()
        self.known[step.name] = TensorStats(shape, "float32", low, high, math.nan, 0, True)

    def _of(self, wire: Wire) -> Any:
        if wire is None:
            return None
        return self.known.get(wire, UNKNOWN) if isinstance(wire, str) else [self.known.get(n, UNKNOWN) for n in wire]
