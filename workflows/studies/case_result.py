"""One step in one extreme case: errors of result and gradient against float64."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from neusee.workflows.graph.recipe_graph import Step
from neusee.workflows.keys.cache_key import stream_seed
from neusee.workflows.report.study_report import Mark
from neusee.workflows.store.serialization import each_tensor, tensors_in
from neusee.workflows.studies.extreme_cases import Case, stated_words
from neusee.workflows.tolerance.error_norm import largest_error

# --- step runs ------------------------------------------------------------------------------------

# The runs of one step of the stability study: as used in a recipe, and in float64 as the reference.


SINGLE, DOUBLE = 2.0**-24, 2.0**-53  #: unit roundoff (largest relative rounding error)
HALVES = {torch.float16: 2.0**-11, torch.bfloat16: 2.0**-8}  #: unit roundoff


class Refused(Exception):
    """Error of a step that rejects its inputs with `ValueError`."""


class _CountedInSingle(TorchFunctionMode):
    """A PyTorch function mode that draws float64 Poisson counts with the mean rounded to single
    precision.
    """

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is torch.poisson and args[0].dtype == torch.float64:
            return func(args[0].float(), *args[1:], **(kwargs or {})).double()
        return func(*args, **(kwargs or {}))


def is_picture(x: Tensor) -> bool:
    return (x.is_floating_point() and x.ndim >= 2 and x.dtype != torch.float64) or x.dtype in HALVES


def pictures_in(values: Sequence[Any]) -> list[Tensor]:
    return [tensor for tensor in tensors_in(list(values)) if is_picture(tensor)]


def run(step: Step, fn: Any, inputs: Sequence[Any], seed: int, **params: Any) -> Any:
    rng = (
        {"rng": torch.Generator().manual_seed(stream_seed(seed, step.name))}
        if step.node.random
        else {}
    )
    return fn(*inputs, **{**step.params, **params}, **rng)


def as_used(step: Step, inputs: Sequence[Any], seed: int) -> Any:
    """Return the result of a step with its own parameters; raise `Refused` for a `ValueError`."""
    try:
        return run(step, step.node.fn, inputs, seed)
    except ValueError as error:
        raise Refused(str(error)) from error


def in_double(step: Step, inputs: Sequence[Any], seed: int) -> Any:
    double_inputs = each_tensor(lambda x: x.double() if x.is_floating_point() else x, list(inputs))
    precision = {"precision": "double"} if "precision" in step.params else {}
    with _CountedInSingle():
        return run(step, step.node.fn, double_inputs, seed, **precision)


def rounded(inputs: Sequence[Any], draw: int, unit: float) -> list[Any]:
    """Return a step's inputs in float64, each element changed at random by up to four times its
    rounding error ``unit``.
    """
    rng = torch.Generator().manual_seed(draw)

    def move(x: Tensor) -> Tensor:
        # from -1 to 1
        offset = 2 * torch.rand(x.shape, generator=rng, dtype=torch.float64) - 1
        return x.double() * (1 + 4 * unit * offset)

    moved_inputs: list[Any] = each_tensor(lambda x: move(x) if is_picture(x) else x, list(inputs))
    return moved_inputs


# --- gradient error -------------------------------------------------------------------------------

# The error of the gradient of one step, against the gradient of its float64 reference.


#: least divisor of a relative error, far above denormal numbers
LEAST = math.sqrt(torch.finfo(torch.float32).tiny)


def finite(value: Any) -> bool:
    return all(
        bool(tensor.isfinite().all()) for tensor in tensors_in(value) if tensor.is_floating_point()
    )


def slope_error(step: Step, inputs: list[Any], seed: int) -> float | None:
    """Return the gradient error of a weighted sum of the result, or None if the result has no
    gradient.
    """
    with torch.enable_grad():
        gradients = _slopes(inputs, lambda values: run(step, step.node.fn, values, seed))
        if gradients is None:
            return None
        true_gradients = true_slopes(step, inputs, seed)
    return _apart(gradients, true_gradients, inputs)


def moved_slopes(step: Step, inputs: list[Any], seed: int, draws: int, unit: float) -> float:
    """Return the largest change of the reference gradient when inputs are randomly rounded by up to
    four ``unit``.
    """
    with torch.enable_grad():
        true_gradients = true_slopes(step, inputs, seed)
        moved_gradients = [
            true_slopes(step, inputs, seed, moved=(draw, unit)) for draw in range(draws)
        ]
    return max(
        (
            _apart(gradients, true_gradients, inputs)
            for gradients in moved_gradients
            if gradients and finite(gradients)
        ),
        default=0.0,
    )


def _apart(usual: list[Tensor], truth: list[Tensor] | None, inputs: list[Any]) -> float:
    """Return the largest error of the gradients, of which there is one for each input picture.

    It is infinite if the reference gradient is not finite, and 0 if the reference gradient exceeds
    the range of the picture's type.
    """
    if truth is None or not finite(truth):
        return math.inf
    pictures = pictures_in(inputs)
    largest_numbers = [
        torch.finfo(torch.float32 if picture.dtype == torch.float64 else picture.dtype).max
        for picture in pictures
    ]
    if any(
        bool((true_gradient.abs() >= largest_number).any())
        for true_gradient, largest_number in zip(truth, largest_numbers, strict=True)
    ):
        return 0.0  # the gradient exceeds the range of the picture's type
    return max(
        over(gradient, true_slope, _slight(picture))
        for gradient, true_slope, picture in zip(usual, truth, pictures, strict=True)
    )


def _slight(picture: Tensor) -> float:
    """Return the least divisor of a gradient error: the gradient of a normalised mean, or the least
    normal number.
    """
    largest = float(picture.detach().double().abs().max())
    # the mean over the largest element has the gradient 1 / (count x largest)
    return max(1.0 / (picture.numel() * max(largest, LEAST)), torch.finfo(picture.dtype).tiny)


def true_slopes(
    step: Step,
    inputs: list[Any],
    seed: int,
    number: int | None = None,
    moved: tuple[int, float] | None = None,
) -> list[Tensor] | None:
    """Return the gradients of the float64 reference: of the result's tensor ``number`` or of all,
    at exact or `rounded` inputs.
    """
    double_inputs = (
        rounded(inputs, *moved)
        if moved
        else each_tensor(lambda x: x.double() if is_picture(x) else x, inputs)
    )
    # differentiate with respect to the pictures; in float64 `is_picture` no longer finds them
    leaves = [
        id(double_tensor)
        for double_tensor, tensor in zip(tensors_in(double_inputs), tensors_in(inputs), strict=True)
        if is_picture(tensor)
    ]
    reference = step.node.hooks.reference
    computations = (
        [partial(run, step, reference), partial(in_double, step)]
        if reference
        else [partial(in_double, step)]
    )

    def of(way: Any, values: list[Any]) -> Any:
        value = way(values, seed)
        return value if number is None else tensors_in(value)[number]

    # fall back to the node in float64 if its reference has no gradient
    for computation in computations:
        slopes = _slopes(double_inputs, partial(of, computation), leaves)
        if slopes:
            return slopes
    return None


def _slopes(inputs: list[Any], fn: Any, ids: list[int] | None = None) -> list[Tensor] | None:
    """Return the gradients of ``fn(inputs)`` with respect to the pictures, or to the tensors
    with these ``ids``.
    """
    pictures: list[Tensor] = []

    def leaf(x: Tensor) -> Tensor:
        if is_picture(x) if ids is None else id(x) in ids:
            pictures.append(x.detach().clone().requires_grad_())
            return pictures[-1]
        return x

    weighted_sum = _weighed(fn(each_tensor(leaf, inputs)))
    if weighted_sum is None or not pictures:
        return None
    gradients = torch.autograd.grad(weighted_sum, pictures, allow_unused=True)
    # the gradient is 0 for a picture that the result does not depend on
    return [
        torch.zeros_like(picture) if gradient is None else gradient
        for picture, gradient in zip(pictures, gradients, strict=True)
    ]


def _weighed(value: Any) -> Tensor | None:
    """Return the sum of all differentiable results, each scaled to about 1 and weighted by fixed
    random numbers.
    """
    weighted_sums = [
        (tensor.double() * _weight(tensor) / _near(tensor)).sum()
        for tensor in tensors_in(value)
        if tensor.requires_grad
    ]
    return torch.stack(weighted_sums).sum() if weighted_sums else None


def _weight(x: Tensor) -> Tensor:
    """Return random weights from 0 to 1, equal for tensors of equal shape."""
    return torch.rand(x.shape, generator=torch.Generator().manual_seed(5), dtype=torch.float32)


def _near(x: Tensor) -> float:
    """Return a power of ten near the largest element of ``x``, or 1 if ``x`` is tiny or a scalar
    below 1.

    A loss near 0 is a difference of pictures, whose gradient does not shrink with the loss. In a
    loss of 1e4, terms of 1e4 cancel where the gradient is 0, and leave their rounding.
    """
    largest = float(x.detach().double().abs().max())
    largest = largest if x.ndim else max(largest, 1.0)
    # the exponent rises at 2.4 times each power of ten
    return 10.0 ** round(math.log10(largest) + 0.123) if LEAST < largest < math.inf else 1.0


def terms(step: Step, inputs: list[Any], truth: Tensor, number: int, seed: int) -> float:
    """Return the sum of the absolute terms of a scalar result f(x), sum |x df/dx|, which sets the
    scale of its rounding error.

    Where terms cancel, f is smaller than this sum. The sum is set to 0 if it is not finite.
    ``number`` is the position of ``truth`` among the scalars that the step returns.
    """
    with torch.enable_grad():
        gradients = true_slopes(step, inputs, seed, number) or []
    sum_of_terms = sum(
        float((picture.double() * gradient).abs().sum())
        for picture, gradient in zip(pictures_in(inputs), gradients, strict=False)
    )
    # undo the weight and the scale that `true_slopes` applied to the scalar
    return (
        sum_of_terms * _near(truth) / float(_weight(truth)) if math.isfinite(sum_of_terms) else 0.0
    )


def over(a: Tensor, b: Tensor, floor: float) -> float:
    """Return the largest difference of ``a`` and ``b``, divided by the largest ``|b|`` or, if that
    is smaller, by ``floor``.
    """
    error, largest = (
        largest_error(a, b),
        float(b.detach().double().abs().max()) if b.numel() else 0.0,
    )
    # `largest_error` divides by the largest |b|: convert to division by the floor
    return error if largest >= floor else error * (largest or 1.0) / floor


# --- case result ----------------------------------------------------------------------------------

# The test of one step in one extreme case: errors of result and gradient, relative to a float64
# computation.
#
# The reference is the node's own reference, or the node's function on the same inputs in float64,
# with the same random numbers. The bound of the result is the node's ``rtol`` times the largest
# element of the reference. The bound of the gradient is 1e-4 of its largest element, or ten times
# ``rtol`` if that is more.
#
# The gradient of a largest element is ill-conditioned, which is a warning, if a change of the
# inputs by at most four roundings to single precision alone changes it by its error or more:
# rounding decides which of several elements is the largest. Another gradient is excused only where
# roundings to double precision do so: then nobody knows the reference. No other gradient and no
# result is, because roundings to single precision of a height of 10 mm hide a phase in single
# precision: a step computes its inputs as they are given.


ROUNDING = 2.0**-23  #: least error bound of a result in single precision
SLOPE = 1e-4  #: least error bound of a gradient in single precision
_NEAR = 0.5  #: share of a bound above which the mark is ``warn``
_STEEPER = 10.0  #: ratio of the bound of a gradient to the bound of the result
_DIM = 1e-3  #: elements below this fraction of the brightest element are dim
#: nodes that must preserve dim parts
_LIGHT = ("scene.", "spectra.", "optics.", "sensor.expose", "sensor.add_photons")
#: nodes whose gradient is that of the largest element
_LARGEST = ("metrics.peak_irradiance", "sensor.level")
_HUGE = 1e30  #: large number that must have the same effect as infinity
_ROUNDINGS = 10  #: number of random roundings of the inputs


@dataclass(frozen=True)
class Cell:
    """The test result of one step in one extreme case: pass, warn or fail, and errors of result
    and gradient.
    """

    mark: Mark
    note: str
    error: float | None = None  #: error of the result
    bound: float | None = None
    slope: float | None = None  #: error of the gradient
    slope_bound: float | None = None


def judge_step(step: Step, inputs: Sequence[Any], case: Case, seed: int) -> Cell | None:
    """Test a step in an extreme case, and return the test result or None if the case changes no
    input.
    """
    changed = _changed_inputs(inputs, case)
    if changed is None:
        return None
    try:
        return (
            _seen(step, inputs, changed, case, seed)
            if case.expect == "seen"
            else _compared(step, changed, case, seed)
        )
    except Refused as refused:
        return Cell("pass", f"refused: {refused}")
    except Exception as error:
        return Cell("fail", f"{type(error).__name__}: {str(error).splitlines()[0]}")


def _changed_inputs(inputs: Sequence[Any], case: Case) -> list[Any] | None:
    """Return a step's inputs with the pictures changed by an extreme case, or None if no input is a
    picture.
    """
    changed = list(inputs)
    if case.alike:
        # only steps that compare two pictures
        if len(changed) < 2 or not all(
            isinstance(tensor, Tensor) and is_picture(tensor) for tensor in changed[:2]
        ):
            return None
        changed[1] = changed[0].clone()
    if case.inputs is not None:
        if not pictures_in(changed):
            return None
        change = case.inputs
        changed = each_tensor(lambda x: change(x) if is_picture(x) else x, changed)
    return changed


# --- errors of results ----------------------------------------------------------------------------


def _compared(step: Step, inputs: list[Any], case: Case, seed: int) -> Cell:
    """Compare result and gradient of a step with its reference, and return the outcome.

    A gradient beyond its bound is accepted if rounding of the inputs alone changes it as much.
    """
    with torch.no_grad():
        value, truth = as_used(step, inputs, seed), _truth(step, inputs, seed)
    if not finite(value):
        return _overflow(truth)
    bound = max([step.node.rtol, ROUNDING, *_roundings(value)])
    error = _dim_error(value, truth) if _is_dim(step, case) else _error(value, truth)
    # a gradient is rounded like its input
    input_rounding = max(_roundings(inputs), default=0.0)
    gradient_error, gradient_bound = (
        slope_error(step, inputs, seed),
        max(SLOPE, _STEEPER * bound, 2 * input_rounding),
    )
    # scalars: take the sum of the absolute terms as the scale if terms cancel
    if error > bound and all(tensor.ndim == 0 for tensor in tensors_in(truth)):
        error = _error_beside_terms(step, inputs, value, truth, seed)
    beyond_bound = (
        gradient_error is not None and gradient_error > gradient_bound and not input_rounding
    )
    precision, unit = _input_precision(step)
    moved_by_rounding = moved_slopes(step, inputs, seed, _ROUNDINGS, unit) if beyond_bound else 0.0
    cell = _marked(error, bound, gradient_error, max(gradient_bound, moved_by_rounding))
    return (
        _ill_conditioned(cell, moved_by_rounding, precision)
        if moved_by_rounding > gradient_bound
        else cell
    )


def _input_precision(step: Step) -> tuple[str, float]:
    """Return the precision to which the inputs of a step are rounded, and its unit roundoff."""
    return ("single", SINGLE) if step.node.path in _LARGEST else ("double", DOUBLE)


def _overflow(truth: Any) -> Cell:
    """Return the outcome for a result that is not finite."""
    if _fits_single_precision(truth):
        return Cell("fail", "not finite")
    return Cell("pass", "overflows visibly, as the reference does in single precision")


def _roundings(value: Any) -> list[float]:
    """Return the unit roundoff of each tensor in half precision, and 0 for all others."""
    return [HALVES.get(tensor.dtype, 0.0) for tensor in tensors_in(value)]


def _is_dim(step: Step, case: Case) -> bool:
    """Return True if only the dim elements of the result are judged."""
    return case.expect == "dim part" and step.node.path.startswith(_LIGHT)


def _error_beside_terms(step: Step, inputs: list[Any], value: Any, truth: Any, seed: int) -> float:
    """Return the largest error of scalar results, each relative to the sum of its
    absolute terms.
    """
    errors = []
    for number, (scalar, true_scalar) in enumerate(
        zip(tensors_in(value), tensors_in(truth), strict=True)
    ):
        errors.append(
            over(scalar, true_scalar, max(LEAST, terms(step, inputs, true_scalar, number, seed)))
        )
    return max(errors)


def _ill_conditioned(cell: Cell, moved: float, precision: str) -> Cell:
    """Return the outcome for a step whose gradient changes with the rounding of its inputs."""
    if cell.mark == "fail":
        return cell
    changes = (
        f"four roundings of the inputs in {precision} precision alone change the gradient by"
        f" {moved:.1e}"
    )
    return replace(cell, mark="warn", note=f"ill-conditioned: {changes}")


def _truth(step: Step, inputs: list[Any], seed: int) -> Any:
    """Return the result of the node's reference, or without one of the node in float64."""
    reference = step.node.hooks.reference
    return run(step, reference, inputs, seed) if reference else in_double(step, inputs, seed)


def _marked(error: float, bound: float, slope: float | None, steeper: float) -> Cell:
    """Return the outcome of a test: pass up to half of the bounds, warn up to the bounds, else
    fail.
    """
    error_over_bound = [error / bound] if slope is None else [error / bound, slope / steeper]
    within = all(share <= 1.0 for share in error_over_bound)  # NaN is not within its bound
    near_bound = within and max(error_over_bound) > _NEAR
    mark: Mark = "pass" if within else "fail"
    if near_bound:
        mark = "warn"
    return Cell(
        mark, "near its bound" * near_bound, error, bound, slope, None if slope is None else steeper
    )


def _error(value: Any, truth: Any) -> float:
    """Return the largest difference of a result from the reference, relative to the largest element
    of the reference.
    """
    results_and_truths = list(zip(tensors_in(value), tensors_in(truth), strict=True))
    return max(
        (over(tensor, true_tensor, LEAST) for tensor, true_tensor in results_and_truths),
        default=0.0,
    )


def _dim_error(value: Any, truth: Any) -> float:
    """Return the largest error of the dim elements of a result, relative to the brightest dim
    element.
    """
    largest_dim_error = 0.0
    for tensor, true_tensor in zip(tensors_in(value), tensors_in(truth), strict=True):
        dim = (
            true_tensor.abs() < _DIM * true_tensor.abs().max()
            if true_tensor.is_floating_point() and true_tensor.ndim >= 2
            else None
        )
        if dim is not None and bool(dim.any()):
            largest_dim_error = max(largest_dim_error, largest_error(tensor[dim], true_tensor[dim]))
    return largest_dim_error


def _fits_single_precision(truth: Any) -> bool:
    """Return True if all numbers of a result are below the largest number in single precision."""
    largest_number = torch.finfo(torch.float32).max
    return all(
        bool((tensor.abs() < largest_number).all())
        for tensor in tensors_in(truth)
        if tensor.is_floating_point()
    )


# --- NaN and infinity -----------------------------------------------------------------------------


def _seen(step: Step, inputs: Sequence[Any], changed: list[Any], case: Case, seed: int) -> Cell:
    """Return a test result that fails if the step's result does not show NaN or infinity in an
    input picture.
    """
    notes = [
        _one_seen(step, _with_one_changed(number, inputs, changed), seed)
        for number in range(len(pictures_in(inputs)))
    ]
    hidden = [note for note in notes if note.startswith("hidden")]
    documented = stated_words(step.node, case.name)
    if hidden and documented is None:
        return Cell("fail", hidden[0])
    return Cell("pass", f"as stated: {documented}" if hidden else "; ".join(dict.fromkeys(notes)))


def _one_seen(step: Step, inputs: list[Any], seed: int) -> str:
    """Return how a step treats NaN or infinity in an input: refused, seen in the result, like a
    large number, or hidden.
    """
    with torch.no_grad():
        try:
            value = as_used(step, inputs, seed)
        except Refused as refused:
            return f"refused: {refused}"
        if not finite(value):
            return "seen"
        not_finite = next(
            float(tensor[~tensor.isfinite()][0])
            for tensor in pictures_in(inputs)
            if not finite(tensor)
        )
        if math.isnan(not_finite):
            return "hidden: a finite result in spite of NaN"
        large_inputs = each_tensor(lambda x: x.nan_to_num(posinf=_HUGE, neginf=-_HUGE), inputs)
        with_large_number = run(step, step.node.fn, large_inputs, seed)
        like_large_number = finite(with_large_number) and largest_error(
            value, with_large_number
        ) <= max(step.node.rtol, ROUNDING)
        return (
            "like a large number"
            if like_large_number
            else "hidden: another result than for a large number"
        )


def _with_one_changed(which: int, inputs: Sequence[Any], changed: Sequence[Any]) -> list[Any]:
    """Return the inputs with only the picture number ``which`` changed as in the case."""
    replacement = {id(pictures_in(inputs)[which]): pictures_in(changed)[which]}
    with_one: list[Any] = each_tensor(lambda x: replacement.get(id(x), x), list(inputs))
    return with_one
