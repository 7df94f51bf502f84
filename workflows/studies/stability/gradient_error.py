"""The error of the gradient of one step, against the gradient of its float64 reference."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import torch
from torch import Tensor

from neusee.workflows.graph.recipe_graph import Step
from neusee.workflows.store.serialization import each_tensor, tensors_in
from neusee.workflows.studies.stability.step_runs import in_double, is_picture, pictures_in, rounded, run
from neusee.workflows.tolerance.error_norm import largest_error

LEAST = math.sqrt(torch.finfo(torch.float32).tiny)  #: the least scale of an error, far above denormal numbers


def finite(value: Any) -> bool:
    return all(bool(x.isfinite().all()) for x in tensors_in(value) if x.is_floating_point())


def slope_error(step: Step, inputs: list[Any], seed: int) -> float | None:
    """Return the error of the gradient of a weighted sum of the result, or None if the result has no gradient."""
    with torch.enable_grad():
        usual = _slopes(inputs, lambda given: run(step, step.node.fn, given, seed))
        if usual is None:
            return None
        truth = true_slopes(step, inputs, seed)
    return _apart(usual, truth, inputs)


def moved_slopes(step: Step, inputs: list[Any], seed: int, draws: int, unit: float) -> float:
    """Return the largest change of the reference gradient by random roundings of the inputs by up to four ``unit``."""
    with torch.enable_grad():
        truth = true_slopes(step, inputs, seed)
        each = [true_slopes(step, inputs, seed, moved=(draw, unit)) for draw in range(draws)]
    return max((_apart(slopes, truth, inputs) for slopes in each if slopes and finite(slopes)), default=0.0)


def _apart(usual: list[Tensor], truth: list[Tensor] | None, inputs: list[Any]) -> float:
    """Return the largest error of gradients by each picture, or infinity if the reference gradient is not finite."""
    if truth is None or not finite(truth):
        return math.inf
    pictures = pictures_in(inputs)
    tops = [torch.finfo(torch.float32 if x.dtype == torch.float64 else x.dtype).max for x in pictures]
    if any(bool((g.abs() >= top).any()) for g, top in zip(truth, tops, strict=True)):
        return 0.0  # the gradient exceeds the range of the picture's type
    return max(over(a, b, _slight(x)) for a, b, x in zip(usual, truth, pictures, strict=True))


def _slight(picture: Tensor) -> float:
    """Return the least divisor of a gradient error: the gradient of a normalised mean, or the least normal number."""
    top = float(picture.detach().double().abs().max())
    return max(1.0 / (picture.numel() * max(top, LEAST)), torch.finfo(picture.dtype).tiny)


def true_slopes(
    step: Step, inputs: list[Any], seed: int, part: int | None = None, moved: tuple[int, float] | None = None
) -> list[Tensor] | None:
    """Return the gradients of the reference in float64: of a ``part`` of the result, at inputs that `rounded` moved."""
    wide = rounded(inputs, *moved) if moved else each_tensor(lambda x: x.double() if is_picture(x) else x, inputs)
    leaves = [id(w) for w, x in zip(tensors_in(wide), tensors_in(inputs), strict=True) if is_picture(x)]
    reference = step.node.hooks.reference
    ways = [partial(run, step, reference), partial(in_double, step)] if reference else [partial(in_double, step)]

    def of(way: Any, given: list[Any]) -> Any:
        value = way(given, seed)
        return value if part is None else tensors_in(value)[part]

    return next((slopes for way in ways if (slopes := _slopes(wide, partial(of, way), leaves))), None)


def _slopes(inputs: list[Any], fn: Any, ids: list[int] | None = None) -> list[Tensor] | None:
    """Return the gradients of ``fn(inputs)`` with respect to the pictures, or to the tensors with these ``ids``."""
    leaves: list[Tensor] = []

    def leaf(x: Tensor) -> Tensor:
        if is_picture(x) if ids is None else id(x) in ids:
            leaves.append(x.detach().clone().requires_grad_())
            return leaves[-1]
        return x

    total = _weighed(fn(each_tensor(leaf, inputs)))
    if total is None or not leaves:
        return None
    grads = torch.autograd.grad(total, leaves, allow_unused=True)
    return [torch.zeros_like(x) if g is None else g for x, g in zip(leaves, grads, strict=True)]


def _weighed(value: Any) -> Tensor | None:
    """Return the sum of all differentiable results, each scaled to about 1 and multiplied by fixed random weights."""
    parts = [(x.double() * _weight(x) / _near(x)).sum() for x in tensors_in(value) if x.requires_grad]
    return torch.stack(parts).sum() if parts else None


def _weight(x: Tensor) -> Tensor:
    return torch.rand(x.shape, generator=torch.Generator().manual_seed(5), dtype=torch.float32)


def _near(x: Tensor) -> float:
    """Return a power of ten near the largest element of ``x``, or 1 if ``x`` is tiny or a scalar below 1.

    A loss near 0 is a difference of pictures, whose gradient does not shrink with the loss. In a loss of 1e4, terms of
    1e4 cancel where the gradient is 0, and leave their rounding.
    """
    top = float(x.detach().double().abs().max())
    top = top if x.ndim else max(top, 1.0)
    return 10.0 ** round(math.log10(top) + 0.123) if LEAST < top < math.inf else 1.0


def terms(step: Step, inputs: list[Any], truth: Tensor, part: int, seed: int) -> float:
    """Return the sum of the terms of a scalar result f(x), sum |x df/dx|, beside which their rounding counts.

    Where terms cancel, f is smaller than this sum, which is 0 if it is not finite. ``part`` is the position of
    ``truth`` among the scalars that the step returns.
    """
    with torch.enable_grad():
        slopes = true_slopes(step, inputs, seed, part) or []
    moved = sum(float((x.double() * g).abs().sum()) for x, g in zip(pictures_in(inputs), slopes, strict=False))
    return moved * _near(truth) / float(_weight(truth)) if math.isfinite(moved) else 0.0


def over(a: Tensor, b: Tensor, floor: float) -> float:
    """Return the largest difference of ``a`` and ``b``, divided by the larger of the largest ``|b|`` and ``floor``."""
    error, top = largest_error(a, b), float(b.detach().double().abs().max()) if b.numel() else 0.0
    return error if top >= floor else error * (top or 1.0) / floor
