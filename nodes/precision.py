"""Precision of tensors: half precision is converted or refused, and convolutions do not use TF32.

Also support for `torch.func`: a test for active transforms, and `vmap` by repeated calls.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.backends import cudnn

# --- half precision -------------------------------------------------------------------------------

# Conversion and rejection of half-precision tensors, because float16 cannot hold more than 65504
# photons.


HALVES = (torch.float16, torch.bfloat16)


def single(x: Tensor) -> Tensor:
    """Convert a half-precision tensor to float32, and return other tensors unchanged.

    The gradient has the type of ``x``.
    """
    return x.float() if x.dtype in HALVES else x


def refuse_half(**lengths: Tensor) -> None:
    """Raise ValueError for lengths in half precision: 1 µm in m is only 17 times the smallest
    positive float16 number.
    """
    for name, x in lengths.items():
        if x.dtype in HALVES:
            kind = str(x.dtype).removeprefix("torch.")
            raise ValueError(
                f"{name} is {kind}, which is too coarse for a phase: give float32 or float64"
            )


def refuse_not_finite(why: str, **values: Tensor | float) -> None:
    """Raise ValueError if a value is NaN or infinite; ``why`` states the consequence in the
    message.
    """
    for name, x in values.items():
        is_finite = bool(x.isfinite().all()) if isinstance(x, Tensor) else math.isfinite(x)
        if not is_finite:
            raise ValueError(f"{name} holds values that are not finite: {why}")


# --- exact convolution ----------------------------------------------------------------------------

# Convolutions on CUDA in full float32: cuDNN may round to TF32, and its setting applies to the
# process, not to a thread.
#
# A lock lets only one thread change the setting at a time. Otherwise two threads could each restore
# the other's temporary setting, which would remain: with other digits on CUDA, and other cache keys
# everywhere.


_TF32_LOCK = threading.RLock()


@contextmanager
def exact_convolutions(picture: Tensor, deterministic: bool = False) -> Iterator[None]:
    """Context manager: convolutions in the ``with`` block do not use TF32 if ``picture`` is on
    CUDA; on the CPU it does nothing.

    ``deterministic``: use only cuDNN algorithms with bit-reproducible results.
    """
    if not picture.is_cuda:
        yield
        return
    with (
        _TF32_LOCK,
        cudnn.flags(enabled=True, benchmark=False, deterministic=deterministic, allow_tf32=False),
    ):
        yield


def tf32_setting() -> bool:
    """Return True if the process allows TF32 outside `exact_convolutions`."""
    with _TF32_LOCK:
        return bool(torch.backends.cudnn.allow_tf32)


def transformed() -> bool:
    """Return True inside a transform of `torch.func`, which tracks tensors even if `requires_grad`
    is False.
    """
    return torch._C._are_functorch_transforms_active()


def plain(constant: Tensor) -> Tensor:
    """Return a constant without the wrapper that transforms of `torch.func` add to every new
    tensor.
    """
    while torch._C._functorch.is_functorch_wrapped_tensor(constant):
        constant = torch._C._functorch.get_unwrapped(constant)
    return constant


def one_by_one(
    call: Callable[..., Any], count: int, in_dims: Sequence[int | None], inputs: Sequence[Any]
) -> Any:
    """Call a function ``count`` times, once for each index of the batched dimension; return the
    stacked results and their batched dimension.

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
