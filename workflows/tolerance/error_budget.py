"""Error budget: the share of the tolerance that the omitted steps before each step may have used."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from typing import Any

from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.tolerance.cheaper_steps import CHANNELS
from neusee.workflows.tolerance.skip_decision import FactsOf, SkipDecision, judge

_NOTHING: dict[str, float] = {}


class ErrorBudget:
    """Bounds by decision, summed along the graph: an omission upstream leaves less for the steps after it.

    Steps are added in running order, each with `pass_on` or `verdict`.
    """

    def __init__(self, recipe: Recipe) -> None:
        share = 1.0 - 2 * CHANNELS if any(e.within for e in recipe.substitutions) else 1.0
        self._recipe, self._share = recipe, share
        self._spent: dict[str, dict[str, float]] = {}  # by step: decision -> its bound; shared where equal

    def copy(self) -> ErrorBudget:
        """Return an independent copy of the budget."""
        found = copy(self)
        found._spent = dict(self._spent)
        return found

    def verdict(self, step: Step, params: Mapping[str, Any], facts_of: FactsOf) -> SkipDecision:
        """Return the decision whether a step with a bound is left out; with `Recipe.exact` no step is."""
        spent = self.pass_on(step)
        if self._recipe.exact:
            return SkipDecision(float("inf"), False, "the recipe is exact", "")
        found = judge(step, params, facts_of, self._recipe.allowed(step.name) * self._share - sum(spent.values()))
        if found.left_out:
            self.leave_out(step, found.bound)
        return found

    def leave_out(self, step: Step, bound: float) -> None:
        """Add the bound of a step that is left out."""
        if bound > 0:
            self._spent[step.name] = {**self._spent.get(step.name, _NOTHING), step.name: bound}

    def pass_on(self, step: Step) -> dict[str, float]:
        """Return the bounds used on the way to a step, by decision."""
        parts = [spent for name in dict.fromkeys(step.sources) if (spent := self._spent.get(name))]
        if not parts:
            return _NOTHING
        first, *others = parts
        if any(other is not first for other in others):
            first = {decision: bound for part in parts for decision, bound in part.items()}
        self._spent[step.name] = first
        return first
