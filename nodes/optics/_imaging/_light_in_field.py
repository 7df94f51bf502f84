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
        brought = basis.new_zeros(len(planes), len(intensity), device=intensity.device)
        for y in range(0, intensity.shape[1], _ROWS):
            brought += boxes[:, y : y + _ROWS].flatten(1) @ intensity[:, y : y + _ROWS].flatten(1).T
        brought = brought.T
    return (brought * basis.to(brought)).sum(1)


def _boxes(plane: Tensor, kernel: torch.Size, size: tuple[int, int]) -> Tensor:
    """By sample of the PSF, the sum of the plane over what that sample brings into the field: (m, n).

    Turned by half a turn, the plane has its boxes in the order of the samples. It is summed in float64, some rows at a
    time: in whole planes of it, fresh memory takes longer than the sums.
    """
    above = torch.ones(_ROWS, _ROWS, dtype=torch.float64, device=plane.device).tril()
    down, parts = plane.new_zeros(kernel[1], dtype=torch.float64), []
    for end in range(len(plane), 0, -_ROWS):
        rows = plane[max(0, end - _ROWS) : end].flip(0, 1).cumsum(1, dtype=torch.float64)
        sums = above[: len(rows), : len(rows)] @ _along(rows, 1, kernel[1], size[1]) + down
        down = sums[-1]
        parts.append(sums.to(plane.dtype))
    return _along(torch.cat(parts), 0, kernel[0], size[0])


def _along(sums: Tensor, dim: int, kernel: int, size: int) -> Tensor:
    """From the sums up to and with each sample, those over each box."""
    before = kernel // 2
    if sums.shape[dim] == size:  # zeros about the scene: a box ends with it, or begins with it
        first = sums.narrow(dim, size - before - 1, before + 1)
        return torch.cat([first, sums.narrow(dim, -1, 1) - sums.narrow(dim, 0, kernel - before - 1)], dim)
    first = sums.narrow(dim, size - 1, 1)
    rest = sums.narrow(dim, size, kernel - 1) - sums.narrow(dim, 0, kernel - 1)
    return torch.cat([first, rest], dim)
