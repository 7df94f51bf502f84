"""Half precision is for storing pictures, not for computing with light: 65504 photons are less than two full wells."""

import torch
from torch import Tensor

HALVES = (torch.float16, torch.bfloat16)


def single(x: Tensor) -> Tensor:
    """The same in single precision where it came in half; a gradient goes back in the type that came."""
    return x.float() if x.dtype in HALVES else x


def refuse_half(**lengths: Tensor) -> None:
    """Refuse lengths in half precision: a micrometre is 17 steps of float16, a wave 2 of 256 in bfloat16."""
    for name, x in lengths.items():
        if x.dtype in HALVES:
            kind = str(x.dtype).removeprefix("torch.")
            raise ValueError(f"{name} is {kind}, which cannot hold a phase: give float32 or float64")


def refuse_not_finite(why: str, **values: Tensor | float) -> None:
    """Refuse a value, or the sum of one, that is not finite; ``why`` says what would come of it."""
    for name, x in values.items():
        if not bool(torch.as_tensor(x).isfinite().all()):
            raise ValueError(f"{name} holds values that are not finite: {why}")
