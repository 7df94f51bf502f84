"""Helpers of nodes under `torch.func`: whether one of its transforms is at work, and `vmap` by
repeated calls.
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor


def transformed() -> bool:
    """Return True inside a transform of `torch.func`, which follows tensors whose
    `requires_grad` is False.
    """
    return torch._C._are_functorch_transforms_active()


def plain(constant: Tensor) -> Tensor:
    """Return a constant without the wrapper that a transform of `torch.func` gives to every new
    tensor.
    """
    while torch._C._functorch.is_functorch_wrapped_tensor(constant):
        constant = torch._C._functorch.get_unwrapped(constant)
    return constant


def one_by_one(
    call: Callable[..., Any], count: int, in_dims: Sequence[int | None], inputs: Sequence[Any]
) -> Any:
    """Call a function ``count`` times with parts of the batched inputs; return the stacked results
    and their dimension.

    ``in_dims`` has the batched dimension of each input, or None for an input that is the same in
    every call.
    """
    results = []
    for i in range(count):
        parts = [
            x if dim is None else x.select(dim, i) for x, dim in zip(inputs, in_dims, strict=True)
        ]
        results.append(call(*parts))
    if isinstance(results[0], tuple):
        return tuple(torch.stack(parts) for parts in zip(*results, strict=True)), (0,) * len(
            results[0]
        )
    return torch.stack(results), 0
