"""Conversion and rejection of half-precision tensors, because float16 cannot hold more than 65504 photons."""

import torch
from torch import Tensor

HALVES = (torch.float16, torch.bfloat16)


def single(x: Tensor) -> Tensor:
    """Convert a half-precision tensor to float32, and return other tensors unchanged.

    The gradient has the type of ``x``.
    """
    return x.float() if x.dtype in HALVES else x


def refuse_half(**lengths: Tensor) -> None:
    """Raise ValueError for lengths in half precision: 1 µm is only 17 times the smallest positive float16 number."""
    for name, x in lengths.items():
        if x.dtype in HALVES:
            kind = str(x.dtype).removeprefix("torch.")
            raise ValueError(f"{name} is {kind}, which is too coarse for a phase: give float32 or float64")


def refuse_not_finite(why: str, **values: Tensor | float) -> None:
    """Raise ValueError if a value or a sum of values is NaN or infinite; ``why`` tells the user the consequence."""
    for name, x in values.items():
        if not bool(torch.as_tensor(x).isfinite().all()):
            raise ValueError(f"{name} holds values that are not finite: {why}")
