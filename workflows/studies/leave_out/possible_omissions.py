"""The ways to leave out steps of a recipe, each as a change of the recipe that computes every step.

There are three kinds. ``handed on``: a step whose node bounds its effect is left out, and the first input of the step
takes the place of its result. ``not added``: light or dirt whose largest element is bounded is not added. ``stands
in``: sums over bands replace an image of all bands. Each omission can be measured alone, even if the engine does not
choose it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal

from torch import Tensor

from neusee.nodes import TensorStats
from neusee.workflows.engine.runner import Result
from neusee.workflows.graph.recipe_graph import Recipe, Step, Wire, in_order, needed
from neusee.workflows.graph.run_error import RunError
from neusee.workflows.tolerance.cheaper_steps import with_substitutions
from neusee.workflows.tolerance.skip_decision import FactsOf, judge
from neusee.workflows.tolerance.zero_effect_steps import without

Kind = Literal["handed on", "not added", "stands in"]


@dataclass(frozen=True)
class Omission:
    """One way to save run time: steps of a recipe that can be left out or replaced by cheaper steps."""

    name: str
    kind: Kind
    exchange: Mapping[str, str]  #: for each omitted step, the step that replaces it, or an empty text
    bound: float  #: largest relative change at the compared steps; NaN if only a run can determine the bound
    why: str
    taken: bool  #: whether the recipe's own run has this omission
    at: tuple[str, ...]  #: the steps whose results are compared: the step itself, or the steps that read it
    beside: tuple[Step, ...] = ()  #: replacing steps that are not in the recipe

    def applied_to(self, recipe: Recipe) -> Recipe:
        """Return ``recipe`` with this omission of steps and no other change."""
        readers = set(recipe.steps) if self.kind != "stands in" else set(self.at)
        steps = {**recipe.steps, **{step.name: step for step in self.beside}}
        for name in readers & recipe.steps.keys():
            steps[name] = replace(recipe.steps[name], wires=self._wires(recipe.steps[name]))
        outputs = tuple(self.value_of(name) for name in recipe.outputs)
        order = in_order({name: step.sources for name, step in steps.items()}, steps)
        return replace(recipe, steps={name: steps[name] for name in order}, outputs=outputs)

    def value_of(self, step: str) -> str:
        """Return the name of the step whose result replaces the result of ``step`` after this omission of steps."""
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
    """Yield each way to leave out steps of the full computation ``full`` for which the error has a bound."""
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
    decision = judge(step, step.params, facts_of, math.inf)
    why = f"changes at most {decision.bound:.2g}"
    return Omission(step.name, "handed on", {step.name: decision.instead}, decision.bound, why, False, (step.name,))


def _not_added(recipe: Recipe, order: list[str], name: str, facts_of: FactsOf) -> Omission | None:
    step = recipe.steps[name]
    at = _adding(recipe, order, name) if step.node.hooks.zero_bound is not None else ()
    if not at:
        return None
    largest = _largest(step, facts_of)
    why = f"no element above {largest:.2g}"
    return Omission(name, "not added", {name: ""}, _share(largest, recipe, at, facts_of), why, False, at)


def _stand_ins(full: Recipe, order: list[str], chosen: Result) -> Iterator[Omission]:
    """Yield the `Omission` that computes sums over spectral bands instead of images of all bands.

    All images are replaced together, because two images that a step compares must be computed in the same way.
    """
    sparse = with_substitutions(replace(full, exact=False, estimates=False), full.outputs)
    exchange = {economy.step: economy.instead for economy in sparse.substitutions if economy.instead}
    if not exchange:
        return
    beside = tuple(step for name, step in sparse.steps.items() if name not in full.steps)
    at = tuple(n for n in order if not set(exchange.values()).isdisjoint(sparse.steps[n].sources))
    taken = {economy.step for economy in chosen.recipe.substitutions} >= exchange.keys()
    why = next(economy.why for economy in sparse.substitutions if economy.instead)
    yield Omission(", ".join(exchange), "stands in", exchange, math.nan, why, taken, at, beside)


def _adding(recipe: Recipe, order: list[str], name: str) -> tuple[str, ...]:
    """Return the steps that read the result of step ``name`` if all of these steps only add the result, else none."""
    readers = [recipe.steps[n] for n in order if name in recipe.steps[n].sources]
    return tuple(reader.name for reader in readers) if all(_only_adds(reader, name) for reader in readers) else ()


def _only_adds(reader: Step, name: str) -> bool:
    read = {i for i, wire in reader.wires.items() if name == wire or (isinstance(wire, tuple) and name in wire)}
    return read <= {light for light, *_ in reader.node.additive_inputs}


def _largest(step: Step, facts_of: FactsOf) -> float:
    """Return an upper bound of the largest element of a step's result, from statistics of the step's inputs."""
    assert step.node.hooks.zero_bound is not None
    facts = [_facts(step.wires.get(name), facts_of) for name in step.node.inputs]
    try:
        return float(step.node.hooks.zero_bound(*facts, **step.params))
    except Exception as error:
        raise RunError(step, [], error) from error


def _facts(wire: Wire, facts_of: FactsOf) -> TensorStats | list[TensorStats | None] | None:
    return [facts_of(name) for name in wire] if isinstance(wire, tuple) else wire and facts_of(wire)  # type: ignore[return-value]


def _share(largest: float, recipe: Recipe, at: tuple[str, ...], facts_of: FactsOf) -> float:
    """Return ``largest`` over the largest element in the results of steps ``at``, or infinity if not tensors."""
    if largest == 0:
        return 0.0
    if any(recipe.steps[name].node.hints.get("return") is not Tensor for name in at):
        return math.inf
    tops = [max(abs(f.min), abs(f.max)) if (f := facts_of(name)) else 0.0 for name in at]
    return largest / min(tops) if min(tops) > 0 else math.inf
