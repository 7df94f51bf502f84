"""Scaling and cropping of a scene to its frame, in bands of rows if it is large."""

import math
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor

from neusee.nodes.resampling import resize
from neusee.nodes.units import Shape

# --- crop to frame --------------------------------------------------------------------------------

# Scaling and central cropping of a scene to the picture size in a recipe.


_PART = 1  #: random stream of a seed, for the position of a part of a picture
_Whole = Annotated[int, Field(ge=0, lt=2**63)]
DrawnCrop = tuple[_Whole, _Whole]  #: seed and number of a scene


def framed(scene: Tensor, shape: Shape | None) -> Tensor:
    """Scale a scene (band, y, x) with equal aspect ratio until the scene covers `shape`, and crop
    the centre.

    Kornia's antialiased bilinear resampling has no overshoot, so that no value becomes negative.
    Kornia's `center_crop` would interpolate between pixels where the number of rows or columns to
    remove is odd.
    """
    from kornia.geometry.transform import resize as antialiased

    if shape is None or tuple(scene.shape[-2:]) == tuple(shape):
        return scene
    size = covering((scene.shape[-2], scene.shape[-1]), shape)
    scaled = (
        antialiased(scene, size, interpolation="bilinear", antialias=True)
        if size != scene.shape[-2:]
        else scene
    )
    top, left = (size[0] - shape[0]) // 2, (size[1] - shape[1]) // 2
    return scaled[..., top : top + shape[0], left : left + shape[1]].contiguous()


def covering(size: tuple[int, int], shape: Shape) -> tuple[int, int]:
    """Return the smallest picture size that covers `shape` and has the same aspect ratio as
    `size`.
    """
    scale = max(shape[0] / size[0], shape[1] / size[1])
    y, x = (max(n, math.floor(k * scale + 0.5)) for k, n in zip(size, shape, strict=True))
    return y, x


def drawn_crop(
    picture: Tensor, shape: tuple[int, int], seed: int, index: int | Sequence[int]
) -> Tensor:
    """Crop a picture (band, y, x) at a position that depends only on the seed and the index.

    A smaller picture is first enlarged by the bicubic kernel in linear light until it just covers
    ``shape``; negative results of the kernel become black.
    """
    size = (picture.shape[-2], picture.shape[-1])
    if any(old < new for old, new in zip(size, shape, strict=True)):
        size = covering(size, shape)
        picture = resize(picture, *size).clamp_min(0.0)
    indices = [index] if isinstance(index, int) else list(index)
    rng = np.random.default_rng([seed, _PART, *indices])
    top, left = (int(rng.integers(0, old - new + 1)) for old, new in zip(size, shape, strict=True))
    return picture[:, top : top + shape[0], left : left + shape[1]].contiguous()


def enlarged(size: tuple[int, int], shape: Shape | None) -> list[str]:
    """Return a note for the user if a scene of the given size must be enlarged to cover `shape`,
    else an empty list.
    """
    if shape is None:
        return []
    scale = max(shape[0] / size[0], shape[1] / size[1])
    text = (
        f"scene enlarged {scale:.2f} times, from {size[0]}x{size[1]} to cover"
        f" {shape[0]}x{shape[1]}: no new detail"
    )
    return [text] if scale > 1 else []


# --- large picture --------------------------------------------------------------------------------

# Linear light of a picture; a large picture is converted and scaled in bands of rows, which need
# little memory.


_LARGE = 4_000_000  #: pixels above which a picture is converted and scaled in bands
_BAND = 1 << 20  #: pixels of a band
#: pixels of a band beside a whole picture, so that its conversion adds little to the peak memory
_SMALL_BAND = 1 << 17


class Codes(Protocol):
    """Code values (y, x, channel) of a picture: an array, or what reads rows of one when they
    are asked for.
    """

    @property
    def shape(self) -> tuple[int, ...]: ...
    def __getitem__(self, rows: slice, /) -> NDArray[Any]: ...


#: from code values (y, x, channel) to linear light (channel, y, x)
Linear = Callable[[NDArray[Any]], Tensor]


def linear_light(codes: Codes, linear: Linear, shape: Shape | None) -> Tensor:
    """Return linear light (3, y, x) of the code values (y, x, channel) of a picture, scaled and
    cropped by `framed`.

    For a large picture the result equals that of `framed` within the round-off of float32.
    """
    if is_large(codes.shape[0] * codes.shape[1]):
        return _in_bands(codes, linear, shape)
    return framed(linear(codes[:]), shape)


def is_large(pixels: float) -> bool:
    """Return True for a picture that is converted and scaled in bands of rows."""
    return pixels > _LARGE


def _in_bands(codes: Codes, linear: Linear, shape: Shape | None) -> Tensor:
    """Return what `linear_light` returns, for a large picture: band after band of its rows is
    converted, and added to the rows of the result that it reaches.
    """
    size = (codes.shape[0], codes.shape[1])
    if shape is None or size == tuple(shape):
        picture = torch.empty(3, *size)
        for rows in bands_of(size, _SMALL_BAND):
            picture[:, rows] = linear(codes[rows])
        return picture
    scaled = covering(size, shape)
    antialias = max(old / new for old, new in zip(size, scaled, strict=True)) > 1
    # matrices of resampling, of which only the lines of the central crop are needed
    row_matrix, column_matrix = (
        resampling(old, new, antialias)[(new - size_of_cut) // 2 :][:size_of_cut]
        for old, new, size_of_cut in zip(size, scaled, shape, strict=True)
    )
    result = np.zeros((3, *shape), np.float32)
    for rows in bands_of(size):
        band_matrix = row_matrix[:, rows]
        # lines of a sparse matrix that are not empty
        reached_lines = np.flatnonzero(np.diff(band_matrix.indptr))
        if len(reached_lines):
            lines = slice(reached_lines[0], reached_lines[-1] + 1)
            for channel, light in zip(result, linear(codes[rows]).double().numpy(), strict=True):
                channel[lines] += band_matrix[lines] @ (column_matrix @ light.T).T
    return torch.from_numpy(result)


def bands_of(size: tuple[int, int], pixels: int | None = None) -> list[slice]:
    """Return the rows of each band of a picture of ``size`` rows and columns, of at most
    ``pixels`` pixels a band.
    """
    step = max(1, (pixels or _BAND) // size[1])
    return [slice(start, start + step) for start in range(0, size[0], step)]


def resampling(old: int, new: int, antialias: bool) -> Any:
    """Return the sparse matrix (new, old) of kornia's bilinear resampling of one axis, float64.

    With ``antialias`` a Gaussian precedes it, mirrored at the edges, of 4 standard deviations in
    all.
    """
    from scipy import sparse

    # middle of a new sample, counted in old samples; beyond the last ones they are repeated
    centres = ((np.arange(new) + 0.5) * (old / new) - 0.5).clip(0, old - 1)
    lower_sample = np.floor(centres).astype(np.int64)
    share = centres - lower_sample
    offsets = np.zeros(1, np.int64)
    weights = np.ones(1)
    if antialias and old > 1:
        sigma = max((old / new - 1.0) / 2.0, 0.001)
        # kornia's rule: 4 sigma, at least 3 samples, half to each side
        half_width = math.floor(max(4.0 * sigma, 3)) // 2
        offsets = np.arange(-half_width, half_width + 1)
        weights = np.exp(-((offsets / sigma) ** 2) / 2)
        weights /= weights.sum()
    positions = np.stack([lower_sample, np.minimum(lower_sample + 1, old - 1)])[..., None] + offsets
    sample_weights = np.stack([1 - share, share])[..., None] * weights
    # mirrored at the first and at the last sample
    mirrored = (old - 1) - np.abs((old - 1) - np.abs(positions))
    row_numbers = np.broadcast_to(np.arange(new)[:, None], positions.shape)
    return sparse.coo_matrix(
        (sample_weights.ravel(), (row_numbers.ravel(), mirrored.ravel())), (new, old)
    ).tocsr()
