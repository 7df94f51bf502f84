"""Precision of tensors: half precision is refused, and convolutions never use TF32."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

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
    """Raise ValueError for lengths in half precision: 1 µm is only 17 times the smallest
    positive float16 number.
    """
    for name, x in lengths.items():
        if x.dtype in HALVES:
            kind = str(x.dtype).removeprefix("torch.")
            raise ValueError(
                f"{name} is {kind}, which is too coarse for a phase: give float32 or float64"
            )


def refuse_not_finite(why: str, **values: Tensor | float) -> None:
    """Raise ValueError if a value or a sum of values is NaN or infinite; ``why`` tells the user
    the consequence.
    """
    for name, x in values.items():
        if not bool(torch.as_tensor(x).isfinite().all()):
            raise ValueError(f"{name} holds values that are not finite: {why}")


# --- exact convolution ----------------------------------------------------------------------------

# Convolutions on CUDA in full float32: cuDNN may round to TF32, and its setting belongs to the
# process, not a thread.
#
# One thread at a time changes the setting. Otherwise two threads could each restore what the other
# had set, and the setting would stay changed: with other digits on CUDA, and with other cache keys
# everywhere.


_GUARD = threading.RLock()


@contextmanager
def exact_convolutions(picture: Tensor, deterministic: bool = False) -> Iterator[None]:
    """Convolve without TF32 during a ``with`` block if ``picture`` is on CUDA; the CPU has no such
    setting.

    ``deterministic``: use only algorithms of cuDNN that give the same bits each time.
    """
    if not picture.is_cuda:
        yield
        return
    with (
        _GUARD,
        cudnn.flags(enabled=True, benchmark=False, deterministic=deterministic, allow_tf32=False),
    ):
        yield


def tf32_setting() -> bool:
    """Return True if the process allows TF32 outside `exact_convolutions`."""
    with _GUARD:
        return bool(torch.backends.cudnn.allow_tf32)
