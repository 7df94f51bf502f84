"""The light of a scene that stays in the field of view, computed without an image.

Each PSF sample moves a box of the scene into the field of view.
"""

import torch
from torch import Tensor

from neusee.nodes.optics._imaging._band_image import reach

_ROWS = 32  #: rows of the scene whose sums are in float64 at a time


def light_in_field(intensity: Tensor, radiance: Tensor) -> tuple[Tensor, Tensor]:
    """Return the light of a scene (..., band, y, x) that its PSF leaves in the field, and all light of the scene.

    Both are sums over pixels, (..., band) float64. No light enters from outside the field. Raises ValueError if scene
    and PSF (band, any, any) have different bands.
    """
    shape = tuple(radiance.shape)
    if len(shape) < 3 or shape[-3] != len(intensity):
        raise ValueError(
            f"radiance {shape} and PSF {tuple(intensity.shape)} must have the same bands: "
            "compute both from the same `bands` step"
        )
    kernel, size = reach(reach(intensity, -2, shape[-2]), -1, shape[-1]), (shape[-2], shape[-1])
    scene, kernel = _alike(radiance, kernel)
    pairs = [pair for each in scene.reshape(-1, *shape[-3:]) for pair in zip(each, kernel, strict=True)]
    kept = [(_boxes(plane, band.shape, size) * band).sum(-1).sum(-1, dtype=torch.float64) for plane, band in pairs]
    return torch.stack(kept).reshape(shape[:-2]), scene.sum(-1).sum(-1, dtype=torch.float64)


def _alike(scene: Tensor, kernel: Tensor) -> tuple[Tensor, Tensor]:
    """Return scene and PSF in the more precise of their types, at least float32."""
    dtype = torch.promote_types(torch.promote_types(scene.dtype, kernel.dtype), torch.float32)
    return scene.to(dtype), kernel.to(dtype)


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
