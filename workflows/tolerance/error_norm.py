"""Error norm: the distance of a result from its reference that every tolerance and every study uses.

The norm is the root mean square of the difference over the reference's largest element; 1e-3 is a
peak signal-to-noise ratio of 60 dB. Every bound of a node bounds the largest difference, and
therefore also this norm.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

Norm = Callable[["Sums"], float]
_PART = 1 << 22  #: elements that are compared at once in float64


@dataclass(slots=True)
class Sums:
    """Sums over the differences between two tensors."""

    count: int
    squares: float = 0.0
    largest: float = 0.0


def error_of(value: Any, reference: Any) -> float:
    """Return the root mean square of ``value - reference`` over the largest ``|reference|``.

    For tuples, lists and mappings the worst member counts. Where the reference is 0 everywhere, the
    root mean square itself is returned. Elements that are the same infinity, or both NaN, agree; an
    element that is not finite where the other is finite makes the error infinite. Raises
    `ValueError` where the two values differ in kind or shape.
    """
    return worst(value, reference, _rms)


def largest_error(value: Any, reference: Any) -> float:
    """Return the largest difference over the largest ``|reference|``; otherwise like `error_of`."""
    return worst(value, reference, _largest)


def worst(value: Any, reference: Any, norm: Norm) -> float:
    """Return the greatest ``norm`` of any pair of tensors or numbers."""
    pairs, found = [(value, reference)], 0.0
    while pairs:
        a, b = pairs.pop()
        if isinstance(b, dict) and isinstance(a, dict) and a.keys() == b.keys():
            pairs += [(a[name], b[name]) for name in b]
        elif isinstance(b, tuple | list) and isinstance(a, tuple | list) and len(a) == len(b):
            pairs += list(zip(a, b, strict=True))
        elif isinstance(b, Tensor | int | float) and isinstance(a, Tensor | int | float):
            found = max(found, _over_the_largest(torch.as_tensor(a), torch.as_tensor(b), norm))
        elif a is not b:
            raise ValueError(f"cannot compare {_kind(a)} with {_kind(b)}")
    return found


def _over_the_largest(a: Tensor, b: Tensor, norm: Norm) -> float:
    if a.shape != b.shape:
        raise ValueError(f"cannot compare {_kind(a)} with {_kind(b)}")
    if a.numel() == 0:
        return 0.0
    top, sums = 0.0, Sums(a.numel())
    for one, other in zip(_parts(a), _parts(b), strict=True):
        wide = torch.complex128 if one.is_complex() or other.is_complex() else torch.float64
        x, y = one.to(wide).cpu(), other.to(wide).cpu()
        same = (x == y) | (x.isnan() & y.isnan())
        off = (x - y).abs().where(~same, 0.0)
        if not bool(off.isfinite().all()):
            return math.inf
        finite = y.abs().where(y.isfinite(), 0.0)
        top = max(top, float(finite.max()))
        sums.squares += float(off.square().sum())
        sums.largest = max(sums.largest, float(off.max()))
    error = norm(sums)
    return error / top if top > 0 else error


def _rms(sums: Sums) -> float:
    return math.sqrt(sums.squares / sums.count)


def _largest(sums: Sums) -> float:
    return sums.largest


def _kind(x: Any) -> str:
    return f"a tensor of {tuple(x.shape)}" if isinstance(x, Tensor) else f"a {type(x).__name__}"


def _parts(x: Tensor) -> tuple[Tensor, ...]:
    parts: tuple[Tensor, ...] = torch.split(x.detach().reshape(-1), _PART)
    return parts
