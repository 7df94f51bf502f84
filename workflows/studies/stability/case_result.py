"""The test of one step in one extreme case: errors of result and gradient, relative to a float64 computation.

The reference is the node's own reference, or the node's function on the same inputs in float64, with the same random
numbers. The bound of the result is the node's ``rtol`` times the largest element of the reference. The bound of the
gradient is 1e-4 of its largest element, or ten times ``rtol`` if that is more.

The gradient of a largest element is ill-conditioned, which is a warning, if a change of the inputs by at most four
roundings to single precision alone changes it by its error or more: rounding decides which of several elements is the
largest. Another gradient is excused only where roundings to double precision do so: then nobody knows the reference.
No other gradient and no result is, because roundings to single precision of a height of 10 mm hide a phase in single
precision: a step computes its inputs as they are given.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from neusee.workflows.graph.recipe_graph import Step
from neusee.workflows.report.study_page import Mark
from neusee.workflows.store.serialization import each_tensor, tensors_in
from neusee.workflows.studies.stability.extreme_cases import Case, stated_words
from neusee.workflows.studies.stability.gradient_error import LEAST, finite, moved_slopes, over, slope_error, terms
from neusee.workflows.studies.stability.step_runs import (
    DOUBLE,
    HALVES,
    SINGLE,
    Refused,
    as_used,
    in_double,
    is_picture,
    pictures_in,
    run,
)
from neusee.workflows.tolerance.error_norm import largest_error

ROUNDING = 2.0**-23  #: the least bound of a result in single precision
SLOPE = 1e-4  #: the least bound of a gradient in single precision
_NEAR = 0.5  #: share of a bound above which the mark is ``warn``
_STEEPER = 10.0  #: ratio of the bound of a gradient to the bound of the result
_DIM = 1e-3  #: share of the brightest element below which an element is dim
_LIGHT = ("scene.", "spectra.", "optics.", "sensor.expose", "sensor.add_photons")  #: nodes that must keep dim parts
_LARGEST = ("metrics.peak_irradiance", "sensor.level")  #: nodes whose gradient is that of a largest element
_HUGE = 1e30  #: the large number with which infinity is compared
_ROUNDINGS = 10  #: random roundings of the inputs that are tried


@dataclass(frozen=True)
class Cell:
    """The test result of one step in one extreme case: pass, warn or fail, and errors of result and gradient."""

    mark: Mark
    note: str
    error: float | None = None  #: of the result
    bound: float | None = None
    slope: float | None = None  #: error of the gradient
    slope_bound: float | None = None


def judge_step(step: Step, inputs: Sequence[Any], case: Case, seed: int) -> Cell | None:
    """Test a step in an extreme case and return the test result, or None if the case changes no input of the step."""
    given = _changed_inputs(inputs, case)
    if given is None:
        return None
    try:
        return _seen(step, inputs, given, case, seed) if case.expect == "seen" else _compared(step, given, case, seed)
    except Refused as refused:
        return Cell("pass", f"refused: {refused}")
    except Exception as error:
        return Cell("fail", f"{type(error).__name__}: {str(error).splitlines()[0]}")


def _changed_inputs(inputs: Sequence[Any], case: Case) -> list[Any] | None:
    """Return a step's inputs with the pictures changed for an extreme case, or None if no input is a picture."""
    given = list(inputs)
    if case.alike:
        if len(given) < 2 or not all(isinstance(x, Tensor) and is_picture(x) for x in given[:2]):
            return None
        given[1] = given[0].clone()
    if case.inputs is not None:
        if not pictures_in(given):
            return None
        change = case.inputs
        given = each_tensor(lambda x: change(x) if is_picture(x) else x, given)
    return given


# --- errors of results ------------------------------------------------------------------------------------------------


def _compared(step: Step, inputs: list[Any], case: Case, seed: int) -> Cell:
    with torch.no_grad():
        value, truth = as_used(step, inputs, seed), _truth(step, inputs, seed)
    if not finite(value):
        overflows = Cell("pass", "overflows visibly, as the reference does in single precision")
        return Cell("fail", "not finite") if _fits_single_precision(truth) else overflows
    bound = max([step.node.rtol, ROUNDING, *(HALVES.get(x.dtype, 0.0) for x in tensors_in(value))])
    coarse = max((HALVES.get(x.dtype, 0.0) for x in tensors_in(inputs)), default=0.0)  # of a gradient, as of its input
    slope_bound, moved = max(SLOPE, _STEEPER * bound, 2 * coarse), 0.0
    dim = case.expect == "dim part" and step.node.path.startswith(_LIGHT)
    error, slope = _dim_error(value, truth) if dim else _error(value, truth), slope_error(step, inputs, seed)
    if error > bound and all(x.ndim == 0 for x in tensors_in(truth)):
        scalars = enumerate(zip(tensors_in(value), tensors_in(truth), strict=True))
        error = max(over(a, b, max(LEAST, terms(step, inputs, b, i, seed))) for i, (a, b) in scalars)
    precision, unit = ("single", SINGLE) if step.node.path in _LARGEST else ("double", DOUBLE)
    if slope is not None and slope > slope_bound and not coarse:
        moved = moved_slopes(step, inputs, seed, _ROUNDINGS, unit)
    cell = _marked(error, bound, slope, max(slope_bound, moved))
    if moved > slope_bound and cell.mark != "fail":
        changes = f"four roundings of the inputs in {precision} precision alone change the gradient by {moved:.1e}"
        return replace(cell, mark="warn", note=f"ill-conditioned: {changes}")
    return cell


def _truth(step: Step, inputs: list[Any], seed: int) -> Any:
    reference = step.node.hooks.reference
    return run(step, reference, inputs, seed) if reference else in_double(step, inputs, seed)


def _marked(error: float, bound: float, slope: float | None, steeper: float) -> Cell:
    """Return the outcome of a test: pass if errors are below half of their bounds, warn up to the bounds, else fail."""
    used = [error / bound] if slope is None else [error / bound, slope / steeper]
    within = all(share <= 1.0 for share in used)  # NaN is not within its bound
    near = within and max(used) > _NEAR
    mark: Mark = "warn" if near else "pass" if within else "fail"
    return Cell(mark, "near its bound" * near, error, bound, slope, None if slope is None else steeper)


def _error(value: Any, truth: Any) -> float:
    """Return the largest difference of a result from the reference, relative to the reference's largest element."""
    pairs = list(zip(tensors_in(value), tensors_in(truth), strict=True))
    return max((over(a, b, LEAST) for a, b in pairs), default=0.0)


def _dim_error(value: Any, truth: Any) -> float:
    """Return the largest error of the dim elements of a result, relative to the brightest dim element."""
    worst = 0.0
    for a, b in zip(tensors_in(value), tensors_in(truth), strict=True):
        dim = b.abs() < _DIM * b.abs().max() if b.is_floating_point() and b.ndim >= 2 else None
        if dim is not None and bool(dim.any()):
            worst = max(worst, largest_error(a[dim], b[dim]))
    return worst


def _fits_single_precision(truth: Any) -> bool:
    top = torch.finfo(torch.float32).max
    return all(bool((x.abs() < top).all()) for x in tensors_in(truth) if x.is_floating_point())


# --- NaN and infinity ------------------------------------------------------------------------------------------------


def _seen(step: Step, inputs: Sequence[Any], given: list[Any], case: Case, seed: int) -> Cell:
    """Return a test result that fails if a step's result does not show NaN or infinity of an input picture."""
    notes = [_one_seen(step, _with_one_changed(i, inputs, given), seed) for i in range(len(pictures_in(inputs)))]
    hidden = [note for note in notes if note.startswith("hidden")]
    stated = stated_words(step.node, case.name)
    if hidden and stated is None:
        return Cell("fail", hidden[0])
    return Cell("pass", f"as stated: {stated}" if hidden else "; ".join(dict.fromkeys(notes)))


def _one_seen(step: Step, given: list[Any], seed: int) -> str:
    """Return how a step treats NaN or infinity in an input: refused, seen in the result, as a large number, hidden."""
    with torch.no_grad():
        try:
            value = as_used(step, given, seed)
        except Refused as refused:
            return f"refused: {refused}"
        if not finite(value):
            return "seen"
        bad = next(float(x[~x.isfinite()][0]) for x in pictures_in(given) if not finite(x))
        if math.isnan(bad):
            return "hidden: a finite result in spite of NaN"
        large = each_tensor(lambda x: x.nan_to_num(posinf=_HUGE, neginf=-_HUGE), given)
        limit = run(step, step.node.fn, large, seed)
        same = finite(limit) and largest_error(value, limit) <= max(step.node.rtol, ROUNDING)
        return "like a large number" if same else "hidden: another result than for a large number"


def _with_one_changed(which: int, inputs: Sequence[Any], given: Sequence[Any]) -> list[Any]:
    swap = {id(pictures_in(inputs)[which]): pictures_in(given)[which]}
    only: list[Any] = each_tensor(lambda x: swap.get(id(x), x), list(inputs))
    return only
