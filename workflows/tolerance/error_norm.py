"""Error norm: the measure of the error of a result that all tolerances and studies use.

The norm is the root mean square of the difference between result and reference, divided by the
largest element of the reference; 1e-3 is a peak signal-to-noise ratio of 60 dB. Every error bound
of a node bounds the largest difference, and therefore also this norm.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

_PART = 1 << 22  #: number of elements that are compared at once in float64


def error_of(value: Any, reference: Any) -> float:
    """Return the root mean square of ``value - reference``, divided by the largest ``|reference|``.

    For tuples, lists and mappings the largest error of a member counts. If the reference is 0
    everywhere, the root mean square itself is returned. Elements that are the same infinity, or
    both NaN, agree; an element that is not finite makes the error infinite if the other element is
    finite. Raises `ValueError` if the values differ in kind or shape.
    """
    return _errors(value, reference)[0]


def largest_error(value: Any, reference: Any) -> float:
    """Return the largest ``|value - reference|``, divided by the largest ``|reference|``."""
    return _errors(value, reference)[1]


def _errors(value: Any, reference: Any) -> tuple[float, float]:
    """Return the root mean square error and the largest error, each as the maximum over all
    pairs of tensors.
    """
    pairs, largest_rms, largest = [(value, reference)], 0.0, 0.0
    while pairs:
        actual, expected = pairs.pop()
        inner_pairs = _inner_pairs(actual, expected)
        if inner_pairs is not None:
            pairs += inner_pairs
        elif isinstance(expected, Tensor | int | float) and isinstance(
            actual, Tensor | int | float
        ):
            errors = _tensor_errors(torch.as_tensor(actual), torch.as_tensor(expected))
            largest_rms, largest = max(largest_rms, errors[0]), max(largest, errors[1])
        elif actual is not expected:
            raise ValueError(f"cannot compare {_kind(actual)} with {_kind(expected)}")
    return largest_rms, largest


def _inner_pairs(a: Any, b: Any) -> list[tuple[Any, Any]] | None:
    """Return the pairs of values in two dictionaries or sequences of one form, or None."""
    if isinstance(b, dict) and isinstance(a, dict) and a.keys() == b.keys():
        return [(a[name], b[name]) for name in b]
    if isinstance(b, tuple | list) and isinstance(a, tuple | list) and len(a) == len(b):
        return list(zip(a, b, strict=True))
    return None


def _tensor_errors(a: Tensor, b: Tensor) -> tuple[float, float]:
    """Return the root mean square error and the largest error of a tensor ``a`` relative to the
    largest element of ``b``.
    """
    if a.shape != b.shape:
        raise ValueError(f"cannot compare {_kind(a)} with {_kind(b)}")
    if a.numel() == 0:
        return 0.0, 0.0
    largest_expected, sum_of_squares, largest = 0.0, 0.0, 0.0
    double_type = torch.complex128 if a.is_complex() or b.is_complex() else torch.float64
    for actual_part, expected_part in zip(_parts(a), _parts(b), strict=True):
        x, y = actual_part.to(double_type).cpu(), expected_part.to(double_type).cpu()
        is_same = (x == y) | (x.isnan() & y.isnan())
        # equal infinities count as no difference
        difference = (x - y).abs().where(~is_same, 0.0)
        if not bool(difference.isfinite().all()):
            return math.inf, math.inf
        largest_expected = max(largest_expected, float(y.abs().where(y.isfinite(), 0.0).max()))
        sum_of_squares += float(difference.square().sum())
        largest = max(largest, float(difference.max()))
    # if the reference is 0 everywhere, the absolute error counts
    scale = largest_expected if largest_expected > 0 else 1.0
    return math.sqrt(sum_of_squares / a.numel()) / scale, largest / scale


def _kind(x: Any) -> str:
    """Return a description of a value for an error message."""
    return (
        f"a tensor of shape {tuple(x.shape)}" if isinstance(x, Tensor) else f"a {type(x).__name__}"
    )


def _parts(x: Tensor) -> tuple[Tensor, ...]:
    """Return the elements of a tensor in parts of at most `_PART` elements, to limit the memory in
    float64.
    """
    parts: tuple[Tensor, ...] = torch.split(x.detach().reshape(-1), _PART)
    return parts
