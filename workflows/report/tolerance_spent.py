"""Account of the numerical errors of a run: within its tolerance, and by its bands."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

from neusee.workflows.engine.cost_model import Costs, sizes_of
from neusee.workflows.engine.placement_inputs import past_costs
from neusee.workflows.engine.resolve_keys import resolve
from neusee.workflows.engine.runner import Result
from neusee.workflows.engine.wanted_steps import SPECTRAL, spectral_steps
from neusee.workflows.graph.errors import RunError
from neusee.workflows.graph.recipe_graph import Recipe, StepRecord, Substitution, dependents, needed
from neusee.workflows.tolerance.error_norm import error_of
from neusee.workflows.tolerance.error_propagation import COVERAGE

# --- tolerance spent ------------------------------------------------------------------------------

# Account of the numerical errors that a run accepts within its tolerance: omitted and cheaper
# steps, error bounds.


NORM = "root mean square over the largest element"


def spent(result: Result) -> dict[str, Any]:
    """Return the tolerance of a run, with the omitted and the cheaper steps and their errors, as
    JSON values.

    ``outputs`` has the error that the run states for each output, its kind (proved, estimated,
    exact or unknown), and the error measured against a run with ``--exact``, if the store has the
    results of this run: the numbers of the terminal, of the page and of ``study leave-out``.
    ``bounds`` has the errors that the tolerance limits: of each output, and of each input of a step
    without an error bound, before one draw of the noise and rounding add to them. ``estimated``
    names those of them that count errors which are estimated and not proved.
    """
    recipe, measured, costs = result.recipe, _measured(result), _costs(result)
    estimated = dependents(recipe, _estimated_roots(result), needed(recipe, recipe.outputs))
    bounds = {name: share for name, share in result.proof.held.items() if share > 0}
    return {
        "tolerance": recipe.tolerance,
        "norm": NORM,
        "held": min(map(recipe.limit, result.proof.held), default=recipe.tolerance),
        "strict": recipe.tolerance_scale,
        "exact": recipe.exact,
        "bounds": bounds,
        "estimated": [name for name in bounds if name in estimated],
        "outputs": [_output(result, name, measured.get(name)) for name in recipe.outputs],
        "coverage": COVERAGE,
        "economies": [
            _economy(result, costs, substitution, substitution.instead in estimated)
            for substitution in recipe.substitutions
        ],
        "left_out": [_omission(result, costs, done) for done in _left_out(result)],
    }


def _costs(result: Result) -> Costs:
    """Return the costs of steps in earlier runs, if this run left steps out or replaced them."""
    recipe = result.recipe
    if recipe.substitutions or _left_out(result):
        return past_costs(result.store, sizes_of(recipe, needed(recipe, recipe.steps)))
    return Costs([])


def _omission(result: Result, costs: Costs, done: StepRecord) -> dict[str, Any]:
    """Return a step that was left out, with its bound and the time that it would take, as JSON
    values.
    """
    return {
        "step": done.step,
        "bound": done.bound,
        "estimated": _is_estimated(result, done),
        "why": done.why,
        "full_seconds": _seconds(result, costs, done.step),
    }


def _is_estimated(result: Result, done: StepRecord) -> bool:
    """Return True for a step that was left out by a bound which is an estimate."""
    return bool(done.bound) and result.recipe.steps[done.step].node.hooks.skip_estimated


def said_of_economies(account: Mapping[str, Any]) -> str:
    """Return one line of text with the steps that a run replaced or omitted to save time, and
    the resulting errors.
    """
    # no cheaper step takes the place of a step that has no effect
    with_error = [
        f"{economy['step']} ({_within(economy['bound'], economy['estimated'])})"
        for economy in account["economies"]
        if economy["instead"] and economy["bound"] != 0
    ]
    without_error = [
        f"{economy['step']} (no error)"
        for economy in account["economies"]
        if not economy["instead"]
    ]
    names = ", ".join([*with_error, *without_error])
    return f"cheaper  {names}; tolerance {account['tolerance']:g}"


def said_of_errors(account: Mapping[str, Any]) -> str:
    """Return one line of text with the errors that a run states for its outputs, by kind, and
    the measured errors.
    """
    rows = account["outputs"]
    of_kind: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        of_kind.setdefault(row["kind"], []).append(row)
    parts = []
    if "proved" in of_kind:
        parts.append(f"{_worst(of_kind['proved'], 'error')} at most, proved")
    if "estimated" in of_kind:
        parts.append(
            f"{_worst(of_kind['estimated'], 'error')}, an estimate that"
            f" {account['coverage']:.0%} of errors do not exceed"
        )
    if "unknown" in of_kind:
        parts.append(f"unknown in {', '.join(row['output'] for row in of_kind['unknown'])}")
    if not parts:
        return "error    none in the outputs"
    return f"error    {'; '.join(parts)}{_said_of_measured(rows)}"


def _said_of_measured(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the largest error that was measured against a run with ``--exact``, and the outputs
    without a measurement.
    """
    measured = [row for row in rows if row["measured"] is not None]
    if not measured:
        return ""
    text = f"; measured beside --exact: {_worst(measured, 'measured')}"
    unmeasured_outputs = [row["output"] for row in rows if row["measured"] is None]
    return f"{text}; not measured: {', '.join(unmeasured_outputs)}" if unmeasured_outputs else text


def _worst(rows: Sequence[Mapping[str, Any]], column: str) -> str:
    """Return the largest value of a column with the output that it belongs to, as text."""
    worst_row = max(rows, key=lambda row: float(row[column]))
    return f"{worst_row[column]:.1e} in {worst_row['output']}"


def _output(result: Result, name: str, measured: float | None) -> dict[str, Any]:
    """Return the stated and the measured error of an output as JSON values."""
    error, kind = result.proof.stated_of(name), result.proof.kind_of(name)
    return {"output": name, "error": error, "kind": kind, "measured": measured}


def _within(bound: float | None, estimated: bool) -> str:
    """Return a bound of an error as text."""
    return (
        "error unknown"
        if bound is None
        else f"{'estimated' if estimated else 'at most'} {bound:.1e}"
    )


def _estimated_roots(result: Result) -> list[str]:
    """Return the steps that add an error which is estimated, and not proved."""
    recipe = result.recipe
    estimated_steps = []
    for name in needed(recipe, recipe.outputs):
        hooks, record = recipe.steps[name].node.hooks, result.done.get(name)
        omitted = record is not None and record.state == "left out" and bool(record.bound)
        # left out by an estimate, or with an error of its own that is an estimate
        if (hooks.skip_estimated and omitted) or (
            hooks.estimated and result.proof.shares.get(name)
        ):
            estimated_steps.append(name)
    return estimated_steps


def _left_out(result: Result) -> list[StepRecord]:
    """Return the records of the steps that a run left out."""
    return [done for done in result.done.values() if done.state == "left out"]


def _economy(
    result: Result, costs: Costs, substitution: Substitution, estimated: bool
) -> dict[str, Any]:
    """Return a step that a cheaper one replaced, with times and bound, as JSON values."""
    cheaper_record = result.done.get(substitution.instead) if substitution.instead else None
    return {
        "step": substitution.step,
        "instead": substitution.instead,
        "why": substitution.why,
        "seconds": _spent_on(result, substitution) if cheaper_record else None,
        "estimated": estimated,
        "full_seconds": _seconds(result, costs, substitution.step),
        "bound": cheaper_record.error[0] if cheaper_record and cheaper_record.error else None,
        "what": "; ".join(check.text for check in cheaper_record.checks) if cheaper_record else "",
    }


def _spent_on(result: Result, substitution: Substitution) -> float | None:
    """Return the time in s of all steps that replace a step: the cheaper step, and the steps that
    choose and check it.

    A stored result counts with the time in which it was computed; None if the store has lost a
    time.
    """
    seconds = [
        _made_in(result, done)
        # names of the steps that replace ``psf`` begin with ``psf.``
        for name, done in result.done.items()
        if name.startswith(f"{substitution.step}.")
    ]
    known_seconds = [time for time in seconds if time is not None]
    return sum(known_seconds) if len(known_seconds) == len(seconds) else None


def _made_in(result: Result, done: StepRecord) -> float | None:
    """Return the time in s in which a result was computed, now or in an earlier run; None if
    unknown.
    """
    if done.state == "run":
        return done.seconds
    metadata = result.store.about(done.key)
    return metadata["seconds"] if metadata else None


def _seconds(result: Result, costs: Costs, step: str) -> float | None:
    """Return the predicted time in s of a step that this run replaced or left out, or None if
    the step never ran.
    """
    estimate = costs.of(result.recipe.steps[step], ["cpu"])
    return estimate.seconds["cpu"] if estimate.known else None


def _measured(result: Result) -> dict[str, float]:
    """Return the error of each output of a run relative to an exact run, if the store has
    results of an exact run.
    """
    recipe = result.recipe
    if recipe.exact or not (recipe.substitutions or _left_out(result)):
        return {}
    exact_keys = _full_keys(result)
    errors: dict[str, float] = {}
    is_compared = False
    for name in recipe.outputs:
        if name not in exact_keys:
            continue
        if exact_keys[name] == result.keys[name]:
            errors[name] = 0.0
        elif result.store.has(exact_keys[name]):
            with suppress(KeyError, ValueError):  # another process has removed the result
                errors[name] = error_of(result.value(name), result.store.get(exact_keys[name]))
                is_compared = True
    # equal keys alone are no measurement
    return errors if is_compared else {}


def _full_keys(result: Result) -> dict[str, str]:
    """Return the keys of the outputs and steps of the same run with ``--exact``;
    none if unknown.
    """
    exact_recipe: Recipe = replace(
        result.recipe.unsubstituted or result.recipe, exact=True, substitutions=()
    )
    try:
        return resolve(
            exact_recipe, needed(exact_recipe, exact_recipe.outputs), result.store, result.device
        ).keys
    except (OSError, LookupError, RunError):
        return {}


# --- spectral sampling ----------------------------------------------------------------------------

# Account of the error by the number of spectral bands, which the tolerance of a run does not
# include.


def spectral_error(
    recipe: Recipe, keys: Mapping[str, str], value: Callable[[str], Any]
) -> dict[str, Any]:
    """Return the largest error over the channels due to the finite number of bands, by affected
    quantity; empty if unknown.
    """
    errors: dict[str, float] = {}
    for name in spectral_steps(recipe):
        if name in keys:
            cause = SPECTRAL[name.partition("[")[0]]
            errors[cause] = max(errors.get(cause, 0.0), float(value(name).max()))
    if not errors:
        return {}
    exceeds_tolerance = max(errors.values()) > recipe.tolerance
    return {
        "errors": errors,
        "larger": exceeds_tolerance,
        "said": _said(errors, recipe.tolerance, exceeds_tolerance),
    }


def _said(errors: Mapping[str, float], tolerance: float, larger: bool) -> str:
    """Return one sentence with the errors due to the number of bands, and a warning if one exceeds
    the tolerance.
    """
    listed = ", ".join(f"{error:.1e} {cause}" for cause, error in errors.items())
    beside = f"tolerance {tolerance:g}, which is relative to the bands of the recipe"
    if not larger:
        return f"bands    error by the number of bands: {listed}; {beside}"
    return (
        f"bands    LOOK: error by the number of bands: {listed}, larger than the {beside}: set more"
        " bands"
    )
