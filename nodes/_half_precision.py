"""Guards against half precision, which can store pictures but not light: 65504 photons are less than two full wells."""

import torch
from torch import Tensor

HALVES = (torch.float16, torch.bfloat16)


def single(x: Tensor) -> Tensor:
    """Return ``x`` in single precision where ``x`` is in half precision; the gradient keeps the type of ``x``."""
    return x.float() if x.dtype in HALVES else x


def refuse_half(**lengths: Tensor) -> None:
    """Raise ValueError for lengths in half precision: 1 µm is 17 steps of float16, a wave 2 of 256 in bfloat16."""
    for name, x in lengths.items():
        if x.dtype in HALVES:
            kind = str(x.dtype).removeprefix("torch.")
            raise ValueError(f"{name} is {kind}, which cannot hold a phase: give float32 or float64")


def refuse_not_finite(why: str, **values: Tensor | float) -> None:
    """Raise ValueError for a value, or the sum of a value, that is not finite; ``why`` states the consequence."""
    for name, x in values.items():
        if not bool(torch.as_tensor(x).isfinite().all()):
            raise ValueError(f"{name} holds values that are not finite: {why}")
