"""The light of an image, without the image: what of each plane every sample of the PSF brings into the field."""

import torch
from torch import Tensor

_ROWS = 32  #: of the PSF at a time: those of 31 bands stay in the cache


def flux(planes: Tensor, intensity: Tensor, basis: Tensor, size: tuple[int, int]) -> Tensor:
    """Sum over the pixels of each band's image: (band,) float64.

    Planes (k, y, x) as they are convolved, with their border where that is reflected; ``intensity`` (band, m, n) no
    wider than the scene of ``size`` reaches; ``basis`` (band, k). Sample p of the PSF brings in a box of the plane, so
    that the flux of a band is the product of its PSF with the sums over those boxes.
    """
    boxes = torch.stack([_boxes(plane, intensity.shape[1:], size) for plane in planes]).to(intensity.dtype)
    if torch.is_grad_enabled() and (planes.requires_grad or intensity.requires_grad):
        brought = torch.einsum("byx,kyx->bk", intensity, boxes).double()
    else:
        brought = basis.new_zeros(len(intensity), len(planes), device=intensity.device)
        for y in range(0, intensity.shape[1], _ROWS):
            brought += intensity[:, y : y + _ROWS].flatten(1) @ boxes[:, y : y + _ROWS].flatten(1).T
    return (brought * basis.to(brought)).sum(1)


def _boxes(plane: Tensor, kernel: torch.Size, size: tuple[int, int]) -> Tensor:
    """By sample of the PSF, the sum of the plane over what that sample brings into the field: (m, n) float64."""
    found = plane.double()
    for dim in (1, 0):
        low, high = _ends(kernel[dim], size[dim], plane.shape[dim], plane.device)
        sums = torch.cat([torch.zeros_like(found.narrow(dim, 0, 1)), found.cumsum(dim)], dim)
        found = sums.index_select(dim, high) - sums.index_select(dim, low)
    return found


def _ends(kernel: int, size: int, length: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Where each box begins and ends, along one axis."""
    at = torch.arange(kernel, device=device)
    if length != size:  # the scene has its border about it
        return kernel - 1 - at, kernel - 1 - at + size
    low = kernel // 2 - at
    return low.clamp_min(0), (low + size).clamp_max(size)
