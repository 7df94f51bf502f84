"""Reusable buffers: the page faults of a new 100 MB buffer take longer than the transform that fills the buffer."""

import contextlib
import threading
from collections.abc import Iterator
from math import prod

import torch
from torch import Tensor

__depends__ = ("unaffected:_idle",)
_IDLE_AT_MOST = 2
_idle: list["Workspace"] = []
_lock = threading.Lock()


class Workspace:
    """Named buffers for one thread at a time; each name returns the same memory, enlarged for larger requests."""

    def __init__(self, dtype: torch.dtype, device: torch.device) -> None:
        self.dtype, self.device = dtype, device
        self._flat: dict[tuple[str, torch.dtype], Tensor] = {}

    def take(self, name: str, *shape: int, dtype: torch.dtype | None = None) -> Tensor:
        """Return an uninitialised buffer; an earlier buffer of the same name and type is overwritten."""
        key = (name, dtype or self.dtype)
        flat, size = self._flat.get(key), prod(shape)
        if flat is None or flat.numel() < size:
            self._flat.pop(key, None)
            flat = self._flat[key] = torch.empty(size, dtype=key[1], device=self.device)
        return flat[:size].view(shape)


@contextlib.contextmanager
def borrowed(dtype: torch.dtype, device: torch.device) -> Iterator[Workspace]:
    """Yield a workspace that no other thread uses; at most two idle workspaces are kept."""
    with _lock:
        fits = [w for w in _idle if (w.dtype, w.device) == (dtype, device)]
        work = fits[-1] if fits else Workspace(dtype, device)
        if fits:
            _idle.remove(work)
    try:
        yield work
    finally:
        with _lock:
            _idle.append(work)
            del _idle[:-_IDLE_AT_MOST]
