"""What a recipe need not compute, one by one: each as a change of the recipe that does everything in full.

There are three kinds. A step whose node bounds what it changes is left out, and its first input handed on. Light or
dirt whose largest element is bounded is not added. Sums over bands stand in for an image of all bands. Whether the
engine chose so is one thing; each can be tried alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal

from torch import Tensor

from neusee.nodes import TensorStats
from neusee.workflows.engine.runner import Result
from neusee.workflows.graph.recipe_graph import Recipe, Step, Wire, in_order, needed
from neusee.workflows.graph.run_error import RunError
from neusee.workflows.tolerance.cheaper_steps import with_substitutions
from neusee.workflows.tolerance.skip_decision import judge
from neusee.workflows.tolerance.zero_effect_steps import without

Kind = Literal["handed on", "not added", "stands in"]
FactsOf = Callable[[str], TensorStats | None]


@dataclass(frozen=True)
class Omission:
    """Steps that may be left out, or replaced by cheaper ones."""

    name: str
    kind: Kind
    exchange: Mapping[str, str]  #: step -> what stands in for it; empty where nothing does
    bound: float  #: what it changes at most, as a share of the largest element there; nan where only a run tells
    why: str
    taken: bool  #: whether the recipe's own run does so
    at: tuple[str, ...]  #: where the change is looked at: the step itself, or what reads it
    beside: tuple[Step, ...] = ()  #: steps that stand in and are not in the recipe

    def made(self, recipe: Recipe) -> Recipe:
        """``recipe`` with this; everything else as it is there."""
        readers = set(recipe.steps) if self.kind != "stands in" else set(self.at)
        steps = {**recipe.steps, **{step.name: step for step in self.beside}}
        for name in readers & recipe.steps.keys():
            steps[name] = replace(recipe.steps[name], wires=self._wires(recipe.steps[name]))
        outputs = tuple(self.value_of(name) for name in recipe.outputs)
        order = in_order({name: step.sources for name, step in steps.items()}, steps)
        return replace(recipe, steps={name: steps[name] for name in order}, outputs=outputs)

    def value_of(self, step: str) -> str:
        """The step that gives the value of ``step`` in a recipe that was made so."""
        return self.exchange.get(step, step) if self.kind == "handed on" else step

    def _wires(self, reader: Step) -> Mapping[str, Wire]:
        if self.kind == "not added":
            return without(reader, dict.fromkeys(self.exchange))
        return {i: _exchanged(wire, self.exchange) for i, wire in reader.wires.items()}


def _exchanged(wire: Wire, exchange: Mapping[str, str]) -> Wire:
    if isinstance(wire, tuple):
        return tuple(exchange.get(name, name) for name in wire)
    return wire and exchange.get(wire, wire)


def omissions(full: Recipe, chosen: Result, facts_of: FactsOf) -> Iterator[Omission]:
    """All that the outputs of ``full`` could do without, as far as a bound says what that changes."""
    order = needed(full, full.outputs)
    yield from _stand_ins(full, order, chosen)
    for name in order:
        done = chosen.done.get(name)
        why = done.why if done is not None and done.state == "left out" else ""
        taken = done is None or bool(why)
        for found in (_handed_on(full.steps[name], facts_of), _not_added(full, order, name, facts_of)):
            if found is not None and math.isfinite(found.bound):
                yield replace(found, taken=taken, why=why or found.why)


def _handed_on(step: Step, facts_of: FactsOf) -> Omission | None:
    if step.node.hooks.skip_bound is None:
        return None
    verdict = judge(step, step.params, facts_of, math.inf)
    why = f"changes at most {verdict.bound:.2g}"
    return Omission(step.name, "handed on", {step.name: verdict.instead}, verdict.bound, why, False, (step.name,))


def _not_added(recipe: Recipe, order: list[str], name: str, facts_of: FactsOf) -> Omission | None:
    step = recipe.steps[name]
    at = _adding(recipe, order, name) if step.node.hooks.zero_bound is not None else ()
    if not at:
        return None
    largest = _largest(step, facts_of)
    why = f"no element above {largest:.2g}"
    return Omission(name, "not added", {name: ""}, _share(largest, recipe, at, facts_of), why, False, at)


def _stand_ins(full: Recipe, order: list[str], chosen: Result) -> Iterator[Omission]:
    """All images of a recipe together, for what compares two must get both in one form."""
    sparse = with_substitutions(replace(full, exact=False), full.outputs)
    exchange = {economy.step: economy.instead for economy in sparse.substitutions if economy.instead}
    if not exchange:
        return
    beside = tuple(step for name, step in sparse.steps.items() if name not in full.steps)
    at = tuple(n for n in order if not set(exchange.values()).isdisjoint(sparse.steps[n].sources))
    taken = {economy.step for economy in chosen.recipe.substitutions} >= exchange.keys()
    why = next(economy.why for economy in sparse.substitutions if economy.instead)
    yield Omission(", ".join(exchange), "stands in", exchange, math.nan, why, taken, at, beside)


def _adding(recipe: Recipe, order: list[str], name: str) -> tuple[str, ...]:
    """The steps that a result is added to, if every reader can do without it."""
    readers = [recipe.steps[n] for n in order if name in recipe.steps[n].sources]
    return tuple(reader.name for reader in readers) if all(_spares(reader, name) for reader in readers) else ()


def _spares(reader: Step, name: str) -> bool:
    """Whether a step reads a result only to add it."""
    read = {i for i, wire in reader.wires.items() if name == wire or (isinstance(wire, tuple) and name in wire)}
    return read <= {light for light, *_ in reader.node.additive_inputs}


def _largest(step: Step, facts_of: FactsOf) -> float:
    """The bound of a step's largest element, by its node, from what was computed of its inputs."""
    assert step.node.hooks.zero_bound is not None
    facts = [_facts(step.wires.get(name), facts_of) for name in step.node.inputs]
    try:
        return float(step.node.hooks.zero_bound(*facts, **step.params))
    except Exception as error:
        raise RunError(step, [], error) from error


def _facts(wire: Wire, facts_of: FactsOf) -> TensorStats | list[TensorStats | None] | None:
    return [facts_of(name) for name in wire] if isinstance(wire, tuple) else wire and facts_of(wire)  # type: ignore[return-value]


def _share(largest: float, recipe: Recipe, at: tuple[str, ...], facts_of: FactsOf) -> float:
    """The bound over the largest element of what it is added to; of what is not a plain tensor, only 0 is told."""
    if largest == 0:
        return 0.0
    if any(recipe.steps[name].node.hints.get("return") is not Tensor for name in at):
        return math.inf
    tops = [max(abs(f.min), abs(f.max)) if (f := facts_of(name)) else 0.0 for name in at]
    return largest / min(tops) if min(tops) > 0 else math.inf
