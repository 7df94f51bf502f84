"""Decision whether a step is left out: the bound on the effect of the step is compared with the tolerance."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from neusee.nodes import TensorStats
from neusee.workflows.graph.recipe_graph import Step
from neusee.workflows.graph.run_error import RunError

FactsOf = Callable[[str], TensorStats | None]
_NO_BOUND = float("inf")


@dataclass(frozen=True, slots=True)
class SkipDecision:
    """Decision whether a step is left out, with the bound on its effect, the reason, and the step to use instead."""

    bound: float
    left_out: bool
    why: str
    instead: str  #: the step at the first input, whose result replaces the result of the step


class _Later:
    """Statistics of a result, obtained only when the calculation of an error bound reads one of these statistics."""

    __slots__ = ("_find", "_seen")

    def __init__(self, find: Callable[[], TensorStats | None], seen: list[TensorStats]) -> None:
        self._find, self._seen = find, seen

    def __getattr__(self, name: str) -> Any:
        facts = self._find()
        if facts is not None:
            self._seen.append(facts)
        return getattr(facts, name)


def judge(step: Step, params: Mapping[str, Any], facts_of: FactsOf, tolerance: float) -> SkipDecision:
    """Decide whether ``step`` may be left out; ``facts_of`` returns the statistics of the result of a named step."""
    node, first = step.node, step.wires.get(step.node.inputs[0])
    if node.hooks.skip_bound is None or not isinstance(first, str):
        return SkipDecision(_NO_BOUND, False, "the step has no input that could replace its result", "")
    seen: list[TensorStats] = []
    facts = [_facts(step.wires.get(name), facts_of, seen) for name in node.inputs]
    try:
        bound = float(node.hooks.skip_bound(*facts, **{name: _number(value) for name, value in params.items()}))
    except RunError:
        raise
    except Exception as error:
        raise RunError(step, [], error) from error
    if not all(f.finite for f in seen):
        return SkipDecision(_NO_BOUND, False, "its input is not finite, so its effect has no bound", first)
    known = bound < _NO_BOUND
    why = f"changes at most {bound:.2g}, tolerance {tolerance:.2g}" if known else "its effect has no bound"
    return SkipDecision(bound, bound <= tolerance, why, first)


def _facts(wire: str | tuple[str, ...] | None, facts_of: FactsOf, seen: list[TensorStats]) -> Any:
    if wire is None:
        return None
    if isinstance(wire, str):
        return _Later(lambda: facts_of(wire), seen)
    return [_facts(name, facts_of, seen) for name in wire]


def _number(value: Any) -> Any:
    return value.item() if isinstance(value, Tensor) and value.numel() == 1 else value
