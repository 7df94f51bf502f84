"""Cache keys of the steps of a recipe, determined without computing a step."""

from __future__ import annotations

from collections.abc import Iterable

from neusee.nodes import TensorStats
from neusee.workflows.engine.node_call import place
from neusee.workflows.engine.provenance import facts_in
from neusee.workflows.engine.resolved_keys import Resolved
from neusee.workflows.graph.errors import RunError
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import key_of
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.store.result_store import Store
from neusee.workflows.tolerance.skip_decision import ErrorBudget


def resolve(
    recipe: Recipe,
    order: Iterable[str],
    store: Store,
    device: str = "cpu",
    code: Code | None = None,
) -> Resolved:
    """Return the cache key of each step for a run on ``device``; ``order`` lists each step after
    its inputs.

    ``code``: digests of nodes that were just computed, if any.
    """
    resolved, code, ledger = Resolved(), code or Code(store.code_memo), ErrorBudget(recipe)

    def facts_of(name: str) -> TensorStats | None:
        facts = facts_in(store.about(resolved.keys[name]))
        if facts is None:
            raise LookupError(name)
        return facts

    for name in order:
        step = recipe.steps[name]
        if step.node.hooks.skip_bound is not None:
            try:
                resolved.verdicts[name] = ledger.verdict(step, step.params, facts_of)
            # statistics of an input are missing: only a run can decide
            except RunError:
                resolved.verdicts[name] = None
        else:
            ledger.pass_on(step)
        # None for a step that is never left out
        verdict = resolved.verdicts.get(name)
        if verdict is not None and verdict.left_out:
            resolved.keys[name] = resolved.keys[verdict.instead]
            continue
        key, origin = key_of(step, resolved.keys, recipe.seed, code, place(step, device))
        resolved.keys[name], resolved.origins[key] = key, origin
        # the first of several steps with the same key computes the value
        resolved.makers.setdefault(key, name)
    code.save()
    return resolved
