"""Padding of a picture with its own mirror image."""

import torch
from torch import Tensor


def mirrored(x: Tensor, down: int, right: int) -> Tensor:
    """Mirror a picture at its lower and right edges; a picture narrower than the padding is mirrored repeatedly."""
    if down == right == 0:
        return x
    rows, columns = (_places(n, n + add, x.device) for n, add in zip(x.shape[-2:], (down, right), strict=True))
    return x[..., rows, :][..., columns]


def _places(size: int, wanted: int, device: torch.device) -> Tensor:
    period = max(2 * size - 2, 1)
    place = torch.arange(wanted, device=device) % period
    return torch.minimum(place, period - place).clamp_max(size - 1) if size > 1 else place * 0
