"""Error propagation: upper bounds on the effect of omitted and approximated steps, from node to node.

A node computes the error of its result from the errors of its inputs (`Node.propagate_error`).
After a node without this hook no error bound is known; the errors of its inputs must meet the tolerance instead.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from neusee.nodes import ErrorBound, TensorStats
from neusee.workflows.graph.recipe_graph import Recipe, Step, Wire
from neusee.workflows.graph.run_error import RunError
from neusee.workflows.graph.step_record import StepRecord
from neusee.workflows.tolerance.skip_decision import FactsOf

_Input = ErrorBound | list[ErrorBound] | None
_EXACT = ErrorBound(0.0)


@dataclass(frozen=True, slots=True)
class ErrorBounds:
    """Upper bounds on the errors of results, each relative to the largest element of the result."""

    shares: Mapping[str, float] = field(default_factory=dict)  #: by step; infinite where a node gives no bound
    held: Mapping[str, float] = field(default_factory=dict)  #: of outputs, and of the inputs of nodes without bounds
    #: the same values with an estimate of what rounding to digital numbers adds, which the tolerance does not limit
    stated: Mapping[str, float] = field(default_factory=dict)

    def of(self, step: str) -> float | None:
        """Return the error bound of a step's result, or None if no bound is known."""
        share = self.shares.get(step, 0.0)
        return share if math.isfinite(share) else None

    @property
    def worst(self) -> float:
        """Return the largest error bound of the results that must meet the tolerance."""
        return max(self.held.values(), default=0.0)

    def over(self, recipe: Recipe) -> float:
        """Return the largest ratio of an error bound to the error limit in ``recipe``; infinity if a limit is 0."""
        shares = [(share, recipe.limit(name)) for name, share in self.held.items() if share > 0]
        return max((share / limit if limit > 0 else math.inf for share, limit in shares), default=0.0)


class ToleranceNotProven(Exception):
    """Error for a run whose error bound is ``over`` times the tolerance."""

    def __init__(self, over: float) -> None:
        super().__init__(f"the error bound is {over:.2g} times the tolerance")
        self.over = over


def tolerance_frontier(recipe: Recipe, order: Iterable[str], wanted: Iterable[str]) -> list[str]:
    """Return the approximate steps whose error bounds must meet the tolerance.

    These steps are outputs, or inputs of nodes that give no error bound.
    """
    inexact, frontier = set[str](), dict[str, None]()
    for name in order:
        step = recipe.steps[name]
        reads = [source for source in step.sources if source in inexact]
        if reads and not _bounds_its_error(step, recipe):
            frontier |= dict.fromkeys(reads)
        elif reads or _may_err(step):
            inexact.add(name)
    return list(frontier | dict.fromkeys(name for name in wanted if name in inexact))


def unbounded_steps(recipe: Recipe, order: Sequence[str]) -> frozenset[str]:
    """Return the steps whose errors reach a node that gives no bound on the error of its result."""
    unbounded = set[str]()
    for name in reversed(order):
        if name in unbounded or not _bounds_its_error(recipe.steps[name], recipe):
            unbounded.update(recipe.steps[name].sources)
    return frozenset(unbounded)


def _may_err(step: Step) -> bool:
    """Return True if the result of a step may be approximate, or left out, where its inputs are exact."""
    return step.node.hooks.approximation_error is not None or step.node.hooks.skip_bound is not None


def _bounds_its_error(step: Step, recipe: Recipe) -> bool:
    return _propagates(step, recipe) or step.node.hooks.approximation_error is not None


def _propagates(step: Step, recipe: Recipe) -> bool:
    """Return True if the node of a step tells how errors pass through it, by a bound or by an estimate in use."""
    hooks = step.node.hooks
    return hooks.propagate_error is not None and (recipe.estimates or not hooks.estimated)


def proof(
    recipe: Recipe, order: Iterable[str], wanted: Iterable[str], done: Callable[[str], StepRecord], facts_of: FactsOf
) -> ErrorBounds:
    """Return the error bounds of all results of a run, derived from known statistics without computing a step."""
    bounds: dict[str, ErrorBound] = {}
    held: dict[str, float] = {}
    for name in order:
        step = recipe.steps[name]
        if not _may_err(step) and bounds.keys().isdisjoint(step.sources):
            continue  # exact, like almost every step
        bound = _bound(step, bounds, done(name), facts_of, recipe)
        if bound is None:
            continue
        if math.isinf(bound.rms):
            shares = {source: bounds[source].share for source in step.sources if source in bounds}
            held |= {source: share for source, share in shares.items() if math.isfinite(share)}
        bounds[name] = bound
    shares = {name: bound.share for name, bound in bounds.items()}
    held |= {name: shares[name] for name in wanted if math.isfinite(shares.get(name, math.inf))}
    rounded = _rounded(recipe, bounds, done, facts_of)
    return ErrorBounds(shares, held, {name: (rounded.get(name) or bounds[name]).share for name in held})


def _bound(
    step: Step, known: Mapping[str, ErrorBound], done: StepRecord, facts_of: FactsOf, recipe: Recipe
) -> ErrorBound | None:
    """Return the error bound of a step's result from the ``known`` bounds of its inputs, or None if it is exact."""
    own = _own(step, done, facts_of)
    if own is None and not any(known[source].rms for source in step.sources if source in known):
        return None
    inputs = [_gathered(step.wires.get(i), known) for i in step.node.inputs]
    facts, error = facts_of(step.name), done.error
    carried = _carried(step, inputs, facts, _propagates(step, recipe))
    return ErrorBound(carried + (own or 0.0), facts, error[1] if error else None)


def _rounded(
    recipe: Recipe, bounds: Mapping[str, ErrorBound], done: Callable[[str], StepRecord], facts_of: FactsOf
) -> dict[str, ErrorBound]:
    """Return the error bounds of the results of ``bounds`` to which rounding to digital numbers adds something."""
    found: dict[str, ErrorBound] = {}
    for name, before in bounds.items():
        step, bound = recipe.steps[name], before
        rounding = step.node.hooks.rounding_error
        if not found.keys().isdisjoint(step.sources):
            bound = _bound(step, {**bounds, **found}, done(name), facts_of, recipe) or before
        elif rounding is None:
            continue
        if (
            rounding is not None
            and bound.stats is not None
            and math.isfinite(bound.rms)
            and done(name).state != "left out"
        ):
            bound = replace(bound, rms=float(rounding(bound.rms, result=bound.stats, **step.params)))
        found[name] = bound
    return found


def _own(step: Step, done: StepRecord, facts_of: FactsOf) -> float | None:
    """Return the error that a step adds by its own approximation or omission, in the unit of its result."""
    share = done.bound if done.state == "left out" else done.error and done.error[0]
    if not share or (facts := facts_of(done.step)) is None:
        return None
    largest = max(abs(facts.min), abs(facts.max))
    if done.state == "left out" and step.node.hooks.skip_scale is not None:
        largest = step.node.hooks.skip_scale(facts, **step.params)
    return share * largest / max(1.0 - share, 1e-3)


def _carried(step: Step, inputs: list[_Input], result: TensorStats | None, known: bool) -> float:
    """Return the error of a step's result that comes from errors of its inputs, or infinity if no bound is known."""
    errors, hooks = [bound.rms for bound in _flat(inputs)], step.node.hooks
    if not any(errors) or hooks.approximation_error is not None:  # this hook covers all errors of the result
        return 0.0
    if hooks.propagate_error is None or not known or result is None or math.inf in errors:
        return math.inf
    try:
        return float(hooks.propagate_error(*inputs, result=result, **step.params))
    except Exception as error:
        raise RunError(step, [], error) from error


def _gathered(wire: Wire, bounds: Mapping[str, ErrorBound]) -> _Input:
    if wire is None or isinstance(wire, str):
        return None if wire is None else bounds.get(wire, _EXACT)
    return [bounds.get(name, _EXACT) for name in wire]


def _flat(inputs: Iterable[_Input]) -> Iterator[ErrorBound]:
    for part in inputs:
        yield from part if isinstance(part, list) else [part] if part else []
