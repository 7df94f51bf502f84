"""Decision whether a step is left out, and the part of the tolerance that omitted steps use up."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from neusee.nodes import TensorStats
from neusee.workflows.graph.errors import RunError
from neusee.workflows.graph.recipe_graph import Recipe, Step, Substitution, Wire

# --- zero effect steps ----------------------------------------------------------------------------

# Removal of steps with zero effect, such as a laser without power, ghosts without energy or a clean
# window.
#
# Such steps are found from parameters alone, before the run: a step whose node bounds its result by
# 0 (`Node.zero_bound`) is removed from the inputs that would only add 0.


#: statistics of a result that is 0 everywhere
_DARK = TensorStats((), "float32", 0.0, 0.0, 0.0, 0, True)


class _Unknown:
    """Statistics of a step that has not run yet: reading any attribute raises `LookupError`."""

    def __getattr__(self, name: str) -> Any:
        raise LookupError(name)


UNKNOWN = _Unknown()


def without_nothing(recipe: Recipe, order: Iterable[str]) -> Recipe:
    """Return the recipe with those steps disconnected whose result must be 0; ``order`` lists each
    step after its inputs.
    """
    zero_steps: dict[str, None] = {}
    rewired_steps: dict[str, Step] = {}
    for name in order:
        step = recipe.steps[name]
        # the result is 0 because of the step's parameters, or because its inputs are 0
        if _nothing(step, zero_steps):
            zero_steps[name] = None
        elif step.node.additive_inputs and not zero_steps.keys().isdisjoint(step.sources):
            rewired_steps[name] = replace(step, wires=without(step, zero_steps))
    if not rewired_steps:
        return recipe
    removed_before = {substitution.step for substitution in recipe.substitutions}
    reason = "its parameters make its result 0"
    # substitutions of a step by nothing, with an error of 0
    new_substitutions = tuple(
        Substitution(name, "", 0.0, reason) for name in zero_steps if name not in removed_before
    )
    steps, unsubstituted = {**recipe.steps, **rewired_steps}, recipe.unsubstituted or recipe
    return replace(
        recipe,
        steps=steps,
        substitutions=(*recipe.substitutions, *new_substitutions),
        unsubstituted=unsubstituted,
    )


def _nothing(step: Step, dark: Mapping[str, None]) -> bool:
    """Return True if the result of a step must be 0 when the results of the steps in ``dark``
    are 0.
    """
    if step.node.hooks.zero_bound is None:
        return False
    input_stats = [_known(step.wires.get(name), dark) for name in step.node.inputs]
    try:
        return float(step.node.hooks.zero_bound(*input_stats, **step.params)) == 0.0
    # the bound needs statistics that only a run provides
    except LookupError:
        return False


def _known(wire: Wire, dark: Mapping[str, None]) -> Any:
    """Return statistics of 0 for a step in ``dark``, and unknown statistics for any other step."""
    if wire is None:
        return None
    if isinstance(wire, str):
        return _DARK if wire in dark else UNKNOWN
    return [_known(name, dark) for name in wire]


def without(step: Step, dark: Mapping[str, None]) -> dict[str, Wire]:
    """Return the inputs of a step without the inputs from the steps ``dark``, whose results are 0.

    The other inputs of the same group are removed, too.
    """
    wires = dict(step.wires)
    for group in step.node.additive_inputs:
        wire = wires.get(group[0])
        if isinstance(wire, str) and wire in dark:
            # disconnect the whole group of inputs
            wires |= dict.fromkeys(group)
        elif isinstance(wire, tuple):
            remaining = [i for i, name in enumerate(wire) if name not in dark]
            for name in group:
                group_wire = wires.get(name)
                wires[name] = (
                    tuple(group_wire[i] for i in remaining)
                    if isinstance(group_wire, tuple)
                    else group_wire
                )
    return wires


# --- skip decision --------------------------------------------------------------------------------

# Decision whether a step is left out: the bound on the effect of the step is compared with the
# tolerance.


FactsOf = Callable[[str], TensorStats | None]
_NO_BOUND = float("inf")


@dataclass(frozen=True, slots=True)
class SkipDecision:
    """Decision whether a step is left out, with the bound on its effect, the reason, and the
    step to use instead.
    """

    bound: float
    left_out: bool
    why: str
    instead: str  #: the step at the first input, whose result replaces the result of the step


class _Later:
    """Statistics of a result, obtained only when an error bound reads one of them."""

    __slots__ = ("_find", "_seen")

    def __init__(self, find: Callable[[], TensorStats | None], asked: list[TensorStats]) -> None:
        self._find, self._seen = find, asked

    def __getattr__(self, name: str) -> Any:
        facts = self._find()
        if facts is not None:
            self._seen.append(facts)
        return getattr(facts, name)


def judge(
    step: Step, params: Mapping[str, Any], facts_of: FactsOf, tolerance: float
) -> SkipDecision:
    """Decide whether ``step`` may be left out; ``facts_of`` returns the statistics of the result
    of a named step.
    """
    node, first_wire = step.node, step.wires.get(step.node.inputs[0])
    if node.hooks.skip_bound is None or not isinstance(first_wire, str):
        return SkipDecision(
            _NO_BOUND, False, "the step has no input that could replace its result", ""
        )
    stats_read: list[TensorStats] = []
    input_stats = [_facts(step.wires.get(name), facts_of, stats_read) for name in node.inputs]
    try:
        bound = float(
            node.hooks.skip_bound(
                *input_stats, **{name: _number(value) for name, value in params.items()}
            )
        )
    except RunError:
        raise
    except Exception as error:
        raise RunError(step, [], error) from error
    # only statistics that the bound has read count
    if not all(stats.finite for stats in stats_read):
        return SkipDecision(
            _NO_BOUND, False, "its input is not finite, so its effect has no bound", first_wire
        )
    has_bound = bound < _NO_BOUND
    reason = (
        f"changes at most {bound:.2g}, tolerance {tolerance:.2g}"
        if has_bound
        else "its effect has no bound"
    )
    return SkipDecision(bound, bound <= tolerance, reason, first_wire)


def _facts(wire: str | tuple[str, ...] | None, facts_of: FactsOf, asked: list[TensorStats]) -> Any:
    """Return the statistics of the result that an input is connected to, obtained when they are
    read, and then noted in ``asked``; a list for a list of steps.
    """
    if wire is None:
        return None
    if isinstance(wire, str):
        return _Later(lambda: facts_of(wire), asked)
    return [_facts(name, facts_of, asked) for name in wire]


def _number(value: Any) -> Any:
    """Return the number in a tensor of one element; return any other value unchanged."""
    return value.item() if isinstance(value, Tensor) and value.numel() == 1 else value


# --- error budget ---------------------------------------------------------------------------------

# Error budget: the part of the tolerance that omitted steps have used up, for each step of a
# recipe.


#: share of the tolerance for the channels of an image; the scene level may depend on a second image
CHANNELS = 0.25


def skip_share(recipe: Recipe) -> float:
    """Return the share of the tolerance that omitted steps may use, beside the cheaper steps of
    a recipe.
    """
    return (
        1.0 - 2 * CHANNELS
        if any(substitution.within for substitution in recipe.substitutions)
        else 1.0
    )


class ErrorBudget:
    """Error bounds of omitted steps, summed for each later step; the sum reduces the tolerance of
    the later step.

    Steps are added in running order, each with `pass_on` or `verdict`.
    """

    def __init__(self, recipe: Recipe) -> None:
        # the share of the tolerance that omitted steps may use
        self._recipe, self._share = recipe, skip_share(recipe)
        # for each step, the error bound of each omitted step upstream; equal dicts are the same
        # object
        self._spent: dict[str, dict[str, float]] = {}

    def copy(self) -> ErrorBudget:
        """Return an independent copy of the error budget."""
        budget = copy(self)
        budget._spent = dict(self._spent)
        return budget

    def verdict(self, step: Step, params: Mapping[str, Any], facts_of: FactsOf) -> SkipDecision:
        """Decide whether a step is left out of the run; with ``--exact`` no step is left out."""
        spent_bounds = self.pass_on(step)
        if self._recipe.exact:
            return SkipDecision(float("inf"), False, "the recipe is exact", "")
        if step.node.hooks.skip_estimated and not self._recipe.estimates:
            return self._without_estimate(step, params, facts_of)
        decision = judge(
            step,
            params,
            facts_of,
            self._recipe.allowed(step.name) * self._share - sum(spent_bounds.values()),
        )
        if decision.left_out:
            self.leave_out(step, decision.bound)
        return decision

    def _without_estimate(
        self, step: Step, params: Mapping[str, Any], facts_of: FactsOf
    ) -> SkipDecision:
        """Decide whether a step certainly changes nothing; other effects are only estimated, and
        estimates are not allowed.
        """
        decision = judge(step, params, facts_of, 0.0)
        return (
            decision
            if decision.left_out
            else replace(decision, why="its effect is estimated, and not proved")
        )

    def leave_out(self, step: Step, bound: float) -> None:
        """Add the error bound of an omitted step to the error budget."""
        if bound > 0:
            self._spent[step.name] = {**self._spent.get(step.name, {}), step.name: bound}

    def pass_on(self, step: Step) -> dict[str, float]:
        """Return the error bound of each omitted step on which ``step`` depends, by the name of
        the omitted step.
        """
        bounds_of_sources = list(filter(None, map(self._spent.get, dict.fromkeys(step.sources))))
        if not bounds_of_sources:
            return {}
        joined_bounds, *other_bounds = bounds_of_sources
        # equal dicts are the same object, to save memory
        if any(bounds_of_other is not joined_bounds for bounds_of_other in other_bounds):
            joined_bounds = {}
            for bounds in bounds_of_sources:
                joined_bounds.update(bounds)
        self._spent[step.name] = joined_bounds
        return joined_bounds
