"""The flux of an image, computed without the image from the light that each PSF sample moves into the field of view."""

import torch
from torch import Tensor

_ROWS = 32  #: rows of the PSF at a time; these rows of 31 bands fit in the cache


def flux(planes: Tensor, intensity: Tensor, basis: Tensor, size: tuple[int, int]) -> Tensor:
    """Return the flux of each band of an image, which is the sum over all pixels: (band,) float64.

    ``planes`` (k, y, x) include their border where the border reflects. ``intensity`` (band, m, n) is no wider than the
    scene of ``size`` can receive; ``basis`` is (band, k). Sample p of the PSF moves a box of each plane into the field,
    so the flux of a band is the product of its PSF with the sums over these boxes.
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
    """Return, for each PSF sample, the sum (m, n) of a plane over the box that the sample moves into the field of view.

    The plane is rotated by 180 degrees, so that its boxes follow the order of the samples. The sums are in float64, a
    few rows at a time, because allocating whole float64 planes takes longer than the sums.
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
    """Return sums over moving windows along the axis ``dim``, as differences of cumulative sums."""
    before = kernel // 2
    if sums.shape[dim] == size:  # zeros about the scene: each box starts or ends at the scene's edge
        first = sums.narrow(dim, size - before - 1, before + 1)
        return torch.cat([first, sums.narrow(dim, -1, 1) - sums.narrow(dim, 0, kernel - before - 1)], dim)
    first = sums.narrow(dim, size - 1, 1)
    rest = sums.narrow(dim, size, kernel - 1) - sums.narrow(dim, 0, kernel - 1)
    return torch.cat([first, rest], dim)
