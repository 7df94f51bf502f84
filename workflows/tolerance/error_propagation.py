"""What all that was left out, or computed more cheaply, may change at every step: carried along the graph by the nodes.

A node says how far its result may be off where its inputs are (`Node.propagate_error`). Where one does
not, nothing is known behind it, and its inputs are what is held to the tolerance.
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
    """Bounds as shares of the largest element of each result."""

    shares: Mapping[str, float] = field(default_factory=dict)  #: by step; infinite where no node tells
    held: Mapping[str, float] = field(default_factory=dict)  #: of outputs, or what feeds a node that does not tell

    def of(self, step: str) -> float | None:
        """The bound of a step; None where nothing is known of it."""
        share = self.shares.get(step, 0.0)
        return share if math.isfinite(share) else None

    @property
    def worst(self) -> float:
        """The greatest bound of what is held to the tolerance."""
        return max(self.held.values(), default=0.0)

    def over(self, recipe: Recipe) -> float:
        """The greatest bound over what it is held to; infinite where nothing is allowed."""
        shares = [(share, recipe.limit(name)) for name, share in self.held.items() if share > 0]
        return max((share / limit if limit > 0 else math.inf for share, limit in shares), default=0.0)


class ToleranceNotProven(Exception):
    """What was left out may have changed so many times what is allowed."""

    def __init__(self, over: float) -> None:
        super().__init__(f"changes at most {over:.2g} times what the tolerance allows")
        self.over = over


def proof(
    recipe: Recipe, order: Iterable[str], wanted: Iterable[str], done: Callable[[str], StepRecord], facts_of: FactsOf
) -> ErrorBounds:
    """Carry the bounds of a run from step to step, in running order; nothing is computed."""
    found: dict[str, ErrorBound] = {}
    held: dict[str, float] = {}
    for name in order:
        step = recipe.steps[name]
        inputs = [_gathered(step.wires.get(i), found) for i in step.node.inputs]
        own = _own(step, done(name), facts_of)
        if own is None and not any(d.rms for part in inputs for d in _each(part)):
            continue  # exact, as almost every step is
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
    """What a step itself adds, in the unit of its result: as a cheaper form, or by being left out."""
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
        return 0.0  # it tells of all that it lacks
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
