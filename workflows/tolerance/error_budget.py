"""Error budget: the part of the tolerance that omitted steps have used up, for each step of a recipe."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import replace
from typing import Any

from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.tolerance.skip_decision import FactsOf, SkipDecision, judge

CHANNELS = 0.25  #: share of the tolerance for the channels of an image; the scene level may depend on a second image


def skip_share(recipe: Recipe) -> float:
    """Return the share of the tolerance that omitted steps may use, beside the cheaper steps of a recipe."""
    return 1.0 - 2 * CHANNELS if any(each.within for each in recipe.substitutions) else 1.0


class ErrorBudget:
    """Error bounds of omitted steps, summed for each later step; the sum reduces the tolerance of the later step.

    Steps are added in running order, each with `pass_on` or `verdict`.
    """

    def __init__(self, recipe: Recipe) -> None:
        self._recipe, self._share = recipe, skip_share(recipe)
        self._spent: dict[str, dict[str, float]] = {}  # by step: bound by omitted step; equal dicts are one object

    def copy(self) -> ErrorBudget:
        """Return an independent copy of the error budget."""
        twin = copy(self)
        twin._spent = dict(self._spent)
        return twin

    def verdict(self, step: Step, params: Mapping[str, Any], facts_of: FactsOf) -> SkipDecision:
        """Decide whether a step is left out of the run; with ``--exact`` no step is left out."""
        spent = self.pass_on(step)
        if self._recipe.exact:
            return SkipDecision(float("inf"), False, "the recipe is exact", "")
        if step.node.hooks.skip_estimated and not self._recipe.estimates:
            return self._without_estimate(step, params, facts_of)
        decision = judge(step, params, facts_of, self._recipe.allowed(step.name) * self._share - sum(spent.values()))
        if decision.left_out:
            self.leave_out(step, decision.bound)
        return decision

    def _without_estimate(self, step: Step, params: Mapping[str, Any], facts_of: FactsOf) -> SkipDecision:
        """Decide whether a step changes nothing; any other effect of the step is only estimated."""
        decision = judge(step, params, facts_of, 0.0)
        return decision if decision.left_out else replace(decision, why="its effect is estimated, and not proved")

    def leave_out(self, step: Step, bound: float) -> None:
        """Add the error bound of an omitted step to the error budget."""
        if bound > 0:
            self._spent[step.name] = {**self._spent.get(step.name, {}), step.name: bound}

    def pass_on(self, step: Step) -> dict[str, float]:
        """Return the error bound of each omitted step on which ``step`` depends, by the name of the omitted step."""
        parts = [spent for name in dict.fromkeys(step.sources) if (spent := self._spent.get(name))]
        if not parts:
            return {}
        first, *others = parts
        if any(other is not first for other in others):
            first = {omitted: bound for part in parts for omitted, bound in part.items()}
        self._spent[step.name] = first
        return first
