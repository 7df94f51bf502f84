"""Padding of a picture with its mirror image."""

import torch
from torch import Tensor


def mirrored(x: Tensor, down: int, right: int) -> Tensor:
    """Pad a picture with its mirror image below and to the right; wide padding mirrors the picture repeatedly."""
    if down == right == 0:
        return x
    rows, columns = (_indices(n, n + add, x.device) for n, add in zip(x.shape[-2:], (down, right), strict=True))
    return x[..., rows, :][..., columns]


def _indices(size: int, padded: int, device: torch.device) -> Tensor:
    period = max(2 * size - 2, 1)
    index = torch.arange(padded, device=device) % period
    return torch.minimum(index, period - index).clamp_max(size - 1)
