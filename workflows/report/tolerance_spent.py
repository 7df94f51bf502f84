"""Account of the numerical errors that a run accepts within its tolerance: omitted and cheaper steps, error bounds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
from neusee.workflows.tolerance.error_propagation import COVERAGE

NORM = "root mean square over the largest element"


def spent(result: Result) -> dict[str, Any]:
    """Return the tolerance of a run, with the omitted and the cheaper steps and their errors, as JSON values.

    ``outputs`` has the error that the run states for each output, its kind (proved, estimated, exact or unknown), and
    the error measured against a run with ``--exact``, if the store has the results of this run: the numbers of the
    terminal, of the page and of ``study leave-out``. ``bounds`` has the errors that the tolerance limits: of each
    output, and of each input of a step without an error bound, before one draw of the noise and rounding add to them.
    ``estimated`` names those of them that count errors which are estimated and not proved.
    """
    recipe, measured = result.recipe, _measured(result)
    estimated = dependents(recipe, _estimated_roots(result), needed(recipe, recipe.outputs))
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
        "outputs": [_output(result, name, measured.get(name)) for name in recipe.outputs],
        "coverage": COVERAGE,
        "economies": [_economy(result, costs, each, each.instead in estimated) for each in result.recipe.substitutions],
        "left_out": [
            {
                "step": done.step,
                "bound": done.bound,
                "estimated": bool(done.bound) and result.recipe.steps[done.step].node.hooks.skip_estimated,
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
    names = ", ".join([*summed, *nothing])
    return f"cheaper  {names}; tolerance {account['tolerance']:g}"


def said_of_errors(account: Mapping[str, Any]) -> str:
    """Return one line of text with the errors that a run states for its outputs, by kind, and the measured errors."""
    rows = account["outputs"]
    parts = []
    if proved := [row for row in rows if row["kind"] == "proved"]:
        parts.append(f"{_worst(proved, 'error')} at most, proved")
    if estimated := [row for row in rows if row["kind"] == "estimated"]:
        parts.append(
            f"{_worst(estimated, 'error')}, an estimate that {account['coverage']:.0%} of errors do not exceed"
        )
    if unknown := [row["output"] for row in rows if row["kind"] == "unknown"]:
        parts.append(f"unknown in {', '.join(unknown)}")
    if not parts:
        return "error    none in the outputs"
    return f"error    {'; '.join(parts)}{_said_of_measured(rows)}"


def _said_of_measured(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the largest error that was measured beside ``--exact``, and in which outputs, if not in all."""
    measured = [row for row in rows if row["measured"] is not None]
    if not measured:
        return ""
    text = f"; measured beside --exact: {_worst(measured, 'measured')}"
    others = [row["output"] for row in rows if row["measured"] is None]
    return f"{text}; not measured: {', '.join(others)}" if others else text


def _worst(rows: Sequence[Mapping[str, Any]], column: str) -> str:
    row = max(rows, key=lambda row: float(row[column]))
    return f"{row[column]:.1e} in {row['output']}"


def _output(result: Result, name: str, measured: float | None) -> dict[str, Any]:
    error, kind = result.proof.stated_of(name), result.proof.kind_of(name)
    return {"output": name, "error": error, "kind": kind, "measured": measured}


def _within(bound: float | None, estimated: bool) -> str:
    return "error unknown" if bound is None else f"{'estimated' if estimated else 'at most'} {bound:.1e}"


def _estimated_roots(result: Result) -> list[str]:
    """Return the steps that add an error which is estimated, and not proved."""
    recipe = result.recipe
    found = []
    for name in needed(recipe, recipe.outputs):
        hooks, record = recipe.steps[name].node.hooks, result.done.get(name)
        omitted = record is not None and record.state == "left out" and bool(record.bound)
        if (hooks.skip_estimated and omitted) or (hooks.estimated and result.proof.shares.get(name)):
            found.append(name)
    return found


def _left_out(result: Result) -> list[StepRecord]:
    return [done for done in result.done.values() if done.state == "left out"]


def _economy(result: Result, costs: Costs, each: Substitution, estimated: bool) -> dict[str, Any]:
    done = result.done.get(each.instead) if each.instead else None
    return {
        "step": each.step,
        "instead": each.instead,
        "why": each.why,
        "seconds": _spent_on(result, each) if done else None,
        "estimated": estimated,
        "full_seconds": _seconds(result, costs, each.step),
        "bound": done.error[0] if done and done.error else None,
        "what": "; ".join(check.text for check in done.checks) if done else "",
    }


def _spent_on(result: Result, each: Substitution) -> float | None:
    """Return the time in s of all steps that replace a step: the cheaper one, and those that choose and check it.

    A stored result counts with the time in which it was computed; None if the store no longer knows that.
    """
    seconds = [_made_in(result, done) for name, done in result.done.items() if name.startswith(f"{each.step}.")]
    known = [each for each in seconds if each is not None]
    return sum(known) if len(known) == len(seconds) else None


def _made_in(result: Result, done: StepRecord) -> float | None:
    if done.state == "run":
        return done.seconds
    about = result.store.about(done.key)
    return about["seconds"] if about else None


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
