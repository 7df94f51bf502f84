"""Tensors with a shape but without values, by which the check of a recipe knows a result before the run."""

import math
from typing import Any

import torch
from torch import Tensor

_MOST = 2**60  #: bytes of a tensor; more than any machine has, and torch cannot count much further


def without_values(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """Return a tensor of a shape that has no values and takes no memory; raise ValueError above 2**60 bytes."""
    if math.prod(shape) * dtype.itemsize > _MOST:
        raise ValueError(f"a result of {' x '.join(map(str, shape))} values exceeds 2**60 bytes: choose smaller sizes")
    return torch.empty(shape, dtype=dtype, device="meta")


def same_shape(first: Tensor | None, *others: Any, **params: Any) -> Tensor | None:
    """Return a tensor without values in the shape of the first input, for a node that keeps the shape."""
    return None if first is None else without_values(*first.shape)
