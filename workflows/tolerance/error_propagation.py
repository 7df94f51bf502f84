"""Error propagation: upper bounds on the effect of omitted and approximated steps, from node to node.

A node computes the error of its result from the errors of its inputs (`Node.propagate_error`).
Behind a node without this hook nothing is known, and its inputs are held to the tolerance instead.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from neusee.nodes import ErrorBound, TensorStats
from neusee.workflows.graph.recipe_graph import Recipe, Step, Wire
from neusee.workflows.graph.run_error import RunError
from neusee.workflows.graph.step_record import StepRecord

FactsOf = Callable[[str], TensorStats | None]
_EXACT = ErrorBound(0.0)


@dataclass(frozen=True, slots=True)
class ErrorBounds:
    """Upper bounds, each relative to the largest element of a result."""

    shares: Mapping[str, float] = field(default_factory=dict)  #: by step; infinite where a node gives no bound
    held: Mapping[str, float] = field(default_factory=dict)  #: of outputs, and of what feeds nodes without bounds

    def of(self, step: str) -> float | None:
        """Return the bound of a step; None where no bound is known."""
        share = self.shares.get(step, 0.0)
        return share if math.isfinite(share) else None

    @property
    def worst(self) -> float:
        """Return the greatest bound among the steps held to the tolerance."""
        return max(self.held.values(), default=0.0)

    def over(self, recipe: Recipe) -> float:
        """Return the greatest ratio of a bound to its limit; infinite where the limit is 0."""
        shares = [(share, recipe.limit(name)) for name, share in self.held.items() if share > 0]
        return max((share / limit if limit > 0 else math.inf for share, limit in shares), default=0.0)


class ToleranceNotProven(Exception):
    """Error of a run whose bounds exceed the tolerance ``over`` times."""

    def __init__(self, over: float) -> None:
        super().__init__(f"the error bound is {over:.2g} times the tolerance")
        self.over = over


def proof(
    recipe: Recipe, order: Iterable[str], wanted: Iterable[str], done: Callable[[str], StepRecord], facts_of: FactsOf
) -> ErrorBounds:
    """Return the bounds of a run, carried from step to step in running order; nothing is computed."""
    found: dict[str, ErrorBound] = {}
    held: dict[str, float] = {}
    for name in order:
        step = recipe.steps[name]
        inputs = [_gathered(step.wires.get(i), found) for i in step.node.inputs]
        own = _own(step, done(name), facts_of)
        if own is None and not any(d.rms for part in inputs for d in _each(part)):
            continue  # exact, like almost every step
        carried, facts = _carried(step, inputs, facts_of(name)), facts_of(name)
        if math.isinf(carried):
            told = {source: found[source].share for source in step.sources if source in found}
            held |= {source: share for source, share in told.items() if math.isfinite(share)}
        error = done(name).error
        found[name] = ErrorBound(carried + (own or 0.0), facts, error[1] if error else None)
    shares = {name: deviation.share for name, deviation in found.items()}
    held |= {name: shares[name] for name in wanted if math.isfinite(shares.get(name, math.inf))}
    return ErrorBounds(shares, held)


def _own(step: Step, done: StepRecord, facts_of: FactsOf) -> float | None:
    """Return the error that a step itself adds, in the unit of its result: by approximation or by omission."""
    share = done.bound if done.state == "left out" else done.error and done.error[0]
    facts = facts_of(done.step)
    if not share or facts is None:
        return None
    largest = max(abs(facts.min), abs(facts.max))
    if done.state == "left out" and step.node.hooks.skip_scale is not None:
        largest = step.node.hooks.skip_scale(facts, **step.params)
    return share * largest / max(1.0 - share, 1e-3)


def _carried(step: Step, inputs: list[ErrorBound | list[ErrorBound] | None], result: TensorStats | None) -> float:
    if not any(d.rms for part in inputs for d in _each(part)):
        return 0.0
    if step.node.hooks.approximation_error is not None:
        return 0.0  # the hook covers all errors of the result
    if (
        step.node.hooks.propagate_error is None
        or result is None
        or any(math.isinf(d.rms) for part in inputs for d in _each(part))
    ):
        return math.inf
    try:
        return float(step.node.hooks.propagate_error(*inputs, result=result, **step.params))
    except Exception as error:
        raise RunError(step, [], error) from error


def _gathered(wire: Wire, found: Mapping[str, ErrorBound]) -> ErrorBound | list[ErrorBound] | None:
    if wire is None or isinstance(wire, str):
        return None if wire is None else found.get(wire, _EXACT)
    return [found.get(name, _EXACT) for name in wire]


def _each(part: ErrorBound | list[ErrorBound] | None) -> list[ErrorBound]:
    return part if isinstance(part, list) else [part] if part else []
