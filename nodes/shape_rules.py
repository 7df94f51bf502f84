"""Rules for the shape and data type of results, with tensors on the device ``meta``, which have no
values.

A rule has the arguments of its node; an unknown input is None, and a rule that needs it fails.
Files ``_result_shapes.py`` attach the rules to the nodes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

#: largest size of a tensor in bytes; beyond any machine, and near the limit of torch's counters
_LARGEST_TENSOR = 2**60


def blank(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """Return a tensor without values, on the device ``meta``; raise OverflowError above 2**60
    bytes.
    """
    if math.prod(shape) * dtype.itemsize > _LARGEST_TENSOR:
        raise OverflowError(
            f"a result of {' x '.join(map(str, shape))} values exceeds 2**60 bytes: choose smaller"
            " sizes"
        )
    return torch.empty(shape, dtype=dtype, device="meta")


def double(*shape: int) -> Tensor:
    """Return a float64 tensor without values, on the device ``meta``."""
    return blank(*shape, dtype=torch.float64)


def at_least_single(*tensors: Tensor) -> torch.dtype:
    """Return the data type of a result that is computed in float32, or in the widest type of
    ``tensors`` if that is wider.
    """
    dtype = torch.float32
    for x in tensors:
        dtype = torch.promote_types(dtype, x.dtype)
    return dtype


def like_first(first: Tensor, *inputs: Any, **params: Any) -> Tensor:
    """Return a tensor without values in the shape of the first input, in float32 or a wider type of
    it.
    """
    return blank(*first.shape, dtype=at_least_single(first))


def scalars(kind: type) -> Callable[..., Any]:
    """Return the rule for results that are a named tuple ``kind`` of float64 scalars."""
    return lambda *inputs, **params: kind(*(double() for _ in getattr(kind, "_fields", ())))


def transform_operations(*sizes: int) -> float:
    """Return the approximate number of operations of a fast Fourier transform of an array with
    these sizes: N log2 N.
    """
    count = math.prod(sizes)
    return count * math.log2(count + 1)


def known(x: Tensor) -> bool:
    """Return True if a tensor has values, so that it is not on the device ``meta``."""
    return x.device.type != "meta"
