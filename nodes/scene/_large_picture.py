"""Linear light of a picture; a large picture is converted and scaled in bands of rows, which need little memory."""

import math
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neusee.nodes.scene._crop_to_frame import covering, framed
from neusee.nodes.units import Shape

_LARGE = 4_000_000  #: pixels above which a picture is converted and scaled in bands
_BAND = 1 << 20  #: pixels of a band
_SMALL_BAND = 1 << 17  #: pixels of a band beside a whole picture, so that its conversion adds little to the peak memory


class Codes(Protocol):
    """Code values (y, x, channel) of a picture: an array, or what reads rows of one when they are asked for."""

    @property
    def shape(self) -> tuple[int, ...]: ...
    def __getitem__(self, rows: slice, /) -> NDArray[Any]: ...


Linear = Callable[[NDArray[Any]], Tensor]  #: from code values (y, x, channel) to linear light (channel, y, x)


def linear_light(codes: Codes, linear: Linear, shape: Shape | None) -> Tensor:
    """Return linear light (3, y, x) of the code values (y, x, channel) of a picture, scaled and cropped by `framed`.

    For a large picture the result equals that of `framed` within the round-off of float32.
    """
    if is_large(codes.shape[0] * codes.shape[1]):
        return _in_bands(codes, linear, shape)
    return framed(linear(codes[:]), shape)


def is_large(pixels: float) -> bool:
    """Return True for a picture that is converted and scaled in bands of rows."""
    return pixels > _LARGE


def _in_bands(codes: Codes, linear: Linear, shape: Shape | None) -> Tensor:
    size = (codes.shape[0], codes.shape[1])
    if shape is None or size == tuple(shape):
        whole = torch.empty(3, *size)
        for rows in bands_of(size, _SMALL_BAND):
            whole[:, rows] = linear(codes[rows])
        return whole
    scaled = covering(size, shape)
    antialias = max(old / new for old, new in zip(size, scaled, strict=True)) > 1
    down, across = (
        resampling(old, new, antialias)[(new - kept) // 2 :][:kept]
        for old, new, kept in zip(size, scaled, shape, strict=True)
    )
    result = np.zeros((3, *shape), np.float32)
    for rows in bands_of(size):
        block = down[:, rows]
        reached = np.flatnonzero(np.diff(block.indptr))
        if len(reached):
            lines = slice(reached[0], reached[-1] + 1)
            for channel, light in zip(result, linear(codes[rows]).double().numpy(), strict=True):
                channel[lines] += block[lines] @ (across @ light.T).T
    return torch.from_numpy(result)


def bands_of(size: tuple[int, int], pixels: int | None = None) -> list[slice]:
    """Return the rows of each band of a picture of ``size`` rows and columns, of at most ``pixels`` pixels a band."""
    step = max(1, (pixels or _BAND) // size[1])
    return [slice(start, start + step) for start in range(0, size[0], step)]


def resampling(old: int, new: int, antialias: bool) -> Any:
    """Return the sparse matrix (new, old) of kornia's bilinear resampling of one axis, float64.

    With ``antialias`` a Gaussian precedes it, mirrored at the edges, of 4 standard deviations in all.
    """
    from scipy import sparse

    centres = ((np.arange(new) + 0.5) * (old / new) - 0.5).clip(0, old - 1)
    low = np.floor(centres).astype(np.int64)
    share = centres - low
    taps = np.zeros(1, np.int64)
    weights = np.ones(1)
    if antialias and old > 1:
        sigma = max((old / new - 1.0) / 2.0, 0.001)
        half = math.floor(max(4.0 * sigma, 3)) // 2
        taps = np.arange(-half, half + 1)
        weights = np.exp(-((taps / sigma) ** 2) / 2)
        weights /= weights.sum()
    places = np.stack([low, np.minimum(low + 1, old - 1)])[..., None] + taps
    values = np.stack([1 - share, share])[..., None] * weights
    mirrored = (old - 1) - np.abs((old - 1) - np.abs(places))
    lines = np.broadcast_to(np.arange(new)[:, None], places.shape)
    return sparse.coo_matrix((values.ravel(), (lines.ravel(), mirrored.ravel())), (new, old)).tocsr()
