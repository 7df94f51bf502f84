"""The light of a scene that stays in the field of view, computed without an image.

Each PSF sample moves a box of the scene into the field of view.
"""

import torch
from torch import Tensor

from neusee.nodes.optics._imaging._band_image import reach
from neusee.nodes.values import LowRankCube

_ROWS = 32  #: rows of the PSF at a time; these rows of 31 bands fit in the cache


def light_in_field(intensity: Tensor, radiance: Tensor | LowRankCube) -> tuple[Tensor, Tensor]:
    """Return the light of a scene (..., band, y, x) that its PSF leaves in the field, and all light of the scene.

    Both are sums over pixels, (..., band) float64. No light enters from outside the field. Raises ValueError if scene
    and PSF (band, any, any) have different bands.
    """
    shape = _shape(radiance)
    if len(shape) < 3 or shape[-3] != len(intensity):
        raise ValueError(
            f"radiance {shape} and PSF {tuple(intensity.shape)} must have the same bands: "
            "compute both from the same `bands` step"
        )
    kernel, size = reach(reach(intensity, -2, shape[-2]), -1, shape[-1]), (shape[-2], shape[-1])
    if isinstance(radiance, LowRankCube):
        planes, kernel = _alike(radiance.planes, kernel)
        basis = radiance.basis.detach().to(kernel.device)
        return _low_rank(planes, kernel, basis, size), basis @ planes.sum((1, 2), dtype=torch.float64)
    scene, kernel = _alike(radiance, kernel)
    pairs = [pair for each in scene.reshape(-1, *shape[-3:]) for pair in zip(each, kernel, strict=True)]
    kept = [(_boxes(plane, band.shape, size) * band).sum(-1).sum(-1, dtype=torch.float64) for plane, band in pairs]
    return torch.stack(kept).reshape(shape[:-2]), scene.sum(-1).sum(-1, dtype=torch.float64)


def _shape(radiance: Tensor | LowRankCube) -> tuple[int, ...]:
    if isinstance(radiance, LowRankCube):
        return (len(radiance.basis), *radiance.planes.shape[1:])
    return tuple(radiance.shape)


def _alike(scene: Tensor, kernel: Tensor) -> tuple[Tensor, Tensor]:
    """Return scene and PSF in the more precise of their types, at least float32."""
    dtype = torch.promote_types(torch.promote_types(scene.dtype, kernel.dtype), torch.float32)
    return scene.to(dtype), kernel.to(dtype)


def _low_rank(planes: Tensor, intensity: Tensor, basis: Tensor, size: tuple[int, int]) -> Tensor:
    """Return the light (band,) float64 that stays in the field of ``size``, of a scene with ``planes`` and ``basis``.

    PSF sample p moves a box of each plane (k, y, x) into the field. The light of a band is therefore the product of its
    PSF with the sums over these boxes, one for each plane and weighted by ``basis`` (band, k).
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
    """Return sums over the boxes along the axis ``dim``, each of which starts or ends at an edge of the scene."""
    before = kernel // 2
    first = sums.narrow(dim, size - before - 1, before + 1)
    return torch.cat([first, sums.narrow(dim, -1, 1) - sums.narrow(dim, 0, kernel - before - 1)], dim)
