"""Scaling and central cropping of a scene to the picture size in a recipe."""

import math
from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import Field
from torch import Tensor

from neusee.nodes.bicubic_resize import resize
from neusee.nodes.units import Shape

_PART = 1  #: random stream of a seed, for the position of a part of a picture
_Whole = Annotated[int, Field(ge=0, lt=2**63)]
DrawnCrop = tuple[_Whole, _Whole]  #: seed and number of a scene


def framed(scene: Tensor, shape: Shape | None) -> Tensor:
    """Scale a scene (band, y, x) with equal aspect ratio until the scene covers `shape`, and crop the centre.

    Kornia's antialiased bilinear resampling has no overshoot, so that no value becomes negative. Kornia's `center_crop`
    would interpolate between pixels where the number of rows or columns to remove is odd.
    """
    from kornia.geometry.transform import resize as antialiased

    if shape is None or tuple(scene.shape[-2:]) == tuple(shape):
        return scene
    size = covering((scene.shape[-2], scene.shape[-1]), shape)
    scaled = antialiased(scene, size, interpolation="bilinear", antialias=True) if size != scene.shape[-2:] else scene
    top, left = (size[0] - shape[0]) // 2, (size[1] - shape[1]) // 2
    return scaled[..., top : top + shape[0], left : left + shape[1]].contiguous()


def covering(size: tuple[int, int], shape: Shape) -> tuple[int, int]:
    """Return the smallest picture size that covers `shape` and has the same aspect ratio as `size`."""
    scale = max(shape[0] / size[0], shape[1] / size[1])
    y, x = (max(n, math.floor(k * scale + 0.5)) for k, n in zip(size, shape, strict=True))
    return y, x


def drawn_crop(picture: Tensor, shape: tuple[int, int], seed: int, index: int | Sequence[int]) -> Tensor:
    """Crop a picture (band, y, x) at a position that depends only on the seed and the index.

    A smaller picture is first enlarged by the bicubic kernel in linear light until it just covers ``shape``; negative
    results of the kernel become black.
    """
    size = (picture.shape[-2], picture.shape[-1])
    if any(have < want for have, want in zip(size, shape, strict=True)):
        size = covering(size, shape)
        picture = resize(picture, *size).clamp_min(0.0)
    indices = [index] if isinstance(index, int) else list(index)
    draw = np.random.default_rng([seed, _PART, *indices])
    top, left = (int(draw.integers(0, have - want + 1)) for have, want in zip(size, shape, strict=True))
    return picture[:, top : top + shape[0], left : left + shape[1]].contiguous()


def enlarged(size: tuple[int, int], shape: Shape | None) -> list[str]:
    """Return a note for the user if a scene of the given size must be enlarged to cover `shape`, else an empty list."""
    if shape is None:
        return []
    scale = max(shape[0] / size[0], shape[1] / size[1])
    text = f"scene enlarged {scale:.2f} times, from {size[0]}x{size[1]} to cover {shape[0]}x{shape[1]}: no new detail"
    return [text] if scale > 1 else []
