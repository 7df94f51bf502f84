"""Convolutions on CUDA in full float32: cuDNN may round to TF32, and its setting belongs to the process, not a thread.

One thread at a time changes the setting. Otherwise two threads could each restore what the other had set, and the
setting would stay changed: with other digits on CUDA, and with other cache keys everywhere.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor
from torch.backends import cudnn

_GUARD = threading.RLock()


@contextmanager
def exact_convolutions(picture: Tensor, deterministic: bool = False) -> Iterator[None]:
    """Convolve without TF32 during a ``with`` block if ``picture`` is on CUDA; the CPU has no such setting.

    ``deterministic``: use only algorithms of cuDNN that give the same bits each time.
    """
    if not picture.is_cuda:
        yield
        return
    with _GUARD, cudnn.flags(enabled=True, benchmark=False, deterministic=deterministic, allow_tf32=False):
        yield


def tf32_setting() -> bool:
    """Return True if the process allows TF32 outside `exact_convolutions`."""
    with _GUARD:
        return bool(torch.backends.cudnn.allow_tf32)
