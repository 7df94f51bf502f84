"""Account of the numerical errors that a run accepts within its tolerance: omitted and cheaper steps, error bounds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from neusee.workflows.engine.cost_laws import sizes_of
from neusee.workflows.engine.cost_model import Costs
from neusee.workflows.engine.placement_inputs import past_costs
from neusee.workflows.engine.resolve_keys import resolve
from neusee.workflows.engine.runner import Result
from neusee.workflows.graph.recipe_graph import Recipe, Substitution, dependents, needed
from neusee.workflows.graph.run_error import RunError
from neusee.workflows.graph.step_record import StepRecord
from neusee.workflows.tolerance.error_norm import error_of

NORM = "root mean square over the largest element"


def spent(result: Result) -> dict[str, Any]:
    """Return the tolerance of a run, with the omitted and the cheaper steps and their errors, as JSON values.

    ``bounds`` has the error bound of each output, and of each input of a step without an error bound.
    ``estimated`` names those of them that count errors which are estimated and not proved. ``rounded`` has those bounds
    that are larger with an estimate of what rounding to digital numbers adds.
    ``measured`` has the error of each output relative to a run with ``--exact``, if the store has its results.
    """
    estimated = _estimated(result)
    costs = (
        past_costs(result.store, sizes_of(result.recipe, needed(result.recipe, result.recipe.steps)))
        if result.recipe.substitutions or _left_out(result)
        else Costs([])
    )
    return {
        "tolerance": result.recipe.tolerance,
        "norm": NORM,
        "held": min(map(result.recipe.limit, result.proof.held), default=result.recipe.tolerance),
        "strict": result.recipe.tolerance_scale,
        "exact": result.recipe.exact,
        "bounds": {name: share for name, share in result.proof.held.items() if share > 0},
        "estimated": [name for name, share in result.proof.held.items() if share > 0 and name in estimated],
        "rounded": {name: share for name, share in result.proof.stated.items() if share > result.proof.held[name]},
        "unbounded": [name for name in result.recipe.outputs if result.proof.of(name) is None],
        "measured": _measured(result),
        "economies": [_economy(result, costs, each, each.instead in estimated) for each in result.recipe.substitutions],
        "left_out": [
            {
                "step": done.step,
                "bound": done.bound,
                "why": done.why,
                "full_seconds": _seconds(result, costs, done.step),
            }
            for done in _left_out(result)
        ],
    }


def said_of_economies(account: Mapping[str, Any]) -> str:
    """Return one line of text with the steps that a run replaced or omitted to save time, and the resulting errors."""
    summed = [
        f"{e['step']} ({_within(e['bound'], e['estimated'])})"
        for e in account["economies"]
        if e["instead"] and e["bound"] != 0
    ]
    nothing = [f"{e['step']} (no error)" for e in account["economies"] if not e["instead"]]
    worst = max(account["bounds"].values(), default=0.0)
    found = max(account["measured"].values(), default=None)
    measured = f", measured {found:.1e}" if found is not None else ""
    names = ", ".join([*summed, *nothing])
    most = f"{worst:.1e} in all, in part estimated" if account["estimated"] else f"at most {worst:.1e} in all"
    rounded = max(account["rounded"].values(), default=0.0)
    most += f", about {rounded:.1e} with rounding to digital numbers" if rounded > worst else ""
    return f"cheaper  {names}: error {most}{measured}; tolerance {account['tolerance']:g}"


def _within(bound: float | None, estimated: bool) -> str:
    return "error unknown" if bound is None else f"{'estimated' if estimated else 'at most'} {bound:.1e}"


def _estimated(result: Result) -> set[str]:
    """Return the steps whose errors are estimated, and not proved, somewhere on the way."""
    recipe = result.recipe
    order = needed(recipe, recipe.outputs)
    roots = [name for name in order if recipe.steps[name].node.hooks.estimated and result.proof.of(name)]
    return dependents(recipe, roots, order)


def _left_out(result: Result) -> list[StepRecord]:
    return [done for done in result.done.values() if done.state == "left out"]


def _economy(result: Result, costs: Costs, each: Substitution, estimated: bool) -> dict[str, Any]:
    done = result.done.get(each.instead) if each.instead else None
    about = result.store.about(done.key) if done else None
    return {
        "step": each.step,
        "instead": each.instead,
        "why": each.why,
        "seconds": _spent_on(result, each) if done and done.state == "run" else about["seconds"] if about else None,
        "estimated": estimated,
        "full_seconds": _seconds(result, costs, each.step),
        "bound": done.error[0] if done and done.error else None,
        "what": "; ".join(check.text for check in done.checks) if done else "",
    }


def _spent_on(result: Result, each: Substitution) -> float:
    """Return the time in s of all steps that replace a step: the cheaper one, and those that choose and check it."""
    return sum(done.seconds for name, done in result.done.items() if name.startswith(f"{each.step}."))


def _seconds(result: Result, costs: Costs, step: str) -> float | None:
    """Return the predicted time in s of a step that this run replaced or left out, or None if the step never ran."""
    estimate = costs.of(result.recipe.steps[step], ["cpu"])
    return estimate.seconds["cpu"] if estimate.known else None


def _measured(result: Result) -> dict[str, float]:
    """Return the error of each output of a run relative to an exact run, if the store has results of an exact run."""
    recipe = result.recipe
    if recipe.exact or not (recipe.substitutions or _left_out(result)):
        return {}
    full, found = _full_keys(result), {}
    for name in recipe.outputs:
        if name in full and full[name] != result.keys[name] and result.store.has(full[name]):
            try:
                found[name] = error_of(result.value(name), result.store.get(full[name]))
            except (KeyError, ValueError):
                continue  # another process has removed the result
    same = {name: 0.0 for name in recipe.outputs if full.get(name) == result.keys[name]} if found else {}
    return {name: {**same, **found}[name] for name in recipe.outputs if name in same or name in found}


def _full_keys(result: Result) -> dict[str, str]:
    whole: Recipe = replace(result.recipe.unsubstituted or result.recipe, exact=True, substitutions=())
    try:
        return resolve(whole, needed(whole, whole.outputs), result.store, result.device).keys
    except (OSError, LookupError, RunError):
        return {}
