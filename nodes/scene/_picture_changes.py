"""Changes of a picture: scaling and cropping to the frame of a scene, augmentation for training,
and luminance as a grey picture.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.precision import single
from neusee.nodes.resampling import resize
from neusee.nodes.units import Shape

# --- crop to frame --------------------------------------------------------------------------------

# Scaling and central cropping of a scene to the picture size in a recipe.


_POSITION_STREAM = 1  #: random stream of a seed for the position of a crop
_WholeNumber = Annotated[int, Field(ge=0, lt=2**63)]
DrawnCrop = tuple[_WholeNumber, _WholeNumber]  #: seed and number of a scene


def framed_scene(scene: Tensor, shape: Shape | None) -> Tensor:
    """Scale a scene (band, y, x) with equal aspect ratio until the scene covers `shape`, and crop
    the centre.

    Kornia's antialiased bilinear resampling has no overshoot, so that no value becomes negative.
    Kornia's `center_crop` would interpolate between pixels where the number of rows or columns to
    remove is odd.
    """
    from kornia.geometry.transform import resize as antialiased

    if shape is None or tuple(scene.shape[-2:]) == tuple(shape):
        return scene
    size = covering_size((scene.shape[-2], scene.shape[-1]), shape)
    scaled = (
        antialiased(scene, size, interpolation="bilinear", antialias=True)
        if size != scene.shape[-2:]
        else scene
    )
    top, left = (size[0] - shape[0]) // 2, (size[1] - shape[1]) // 2
    return scaled[..., top : top + shape[0], left : left + shape[1]].contiguous()


def covering_size(size: tuple[int, int], shape: Shape) -> tuple[int, int]:
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
        size = covering_size(size, shape)
        picture = resize(picture, *size).clamp_min(0.0)
    indices = [index] if isinstance(index, int) else list(index)
    rng = np.random.default_rng([seed, _POSITION_STREAM, *indices])
    top, left = (int(rng.integers(0, old - new + 1)) for old, new in zip(size, shape, strict=True))
    return picture[:, top : top + shape[0], left : left + shape[1]].contiguous()


def enlargement_notes(size: tuple[int, int], shape: Shape | None) -> list[str]:
    """Return a note for the user if a scene of this size must be enlarged to cover `shape`,
    otherwise an empty list.
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

# Linear light of a picture. A large picture is converted and scaled in bands of rows, to save
# memory.


_LARGE_PIXELS = 4_000_000  #: pixels above which a picture is converted and scaled in bands
_BAND_PIXELS = 1 << 20  #: largest number of pixels of a band
#: the same if the whole picture is in memory too, so that the band adds little to the peak
_SMALL_BAND_PIXELS = 1 << 17


class Codes(Protocol):
    """Code values (y, x, channel) of a picture: an array, or an object that reads only the rows of
    a slice.
    """

    @property
    def shape(self) -> tuple[int, ...]: ...
    def __getitem__(self, rows: slice, /) -> NDArray[Any]: ...


#: from code values (y, x, channel) to linear light (channel, y, x)
Decoding = Callable[[NDArray[Any]], Tensor]


def linear_light(codes: Codes, linear: Decoding, shape: Shape | None) -> Tensor:
    """Return linear light (3, y, x) of the code values (y, x, channel) of a picture, scaled and
    cropped by `framed_scene`.

    For a large picture the result equals that of `framed_scene` within the round-off of float32.
    """
    if is_large(codes.shape[0] * codes.shape[1]):
        return _in_bands(codes, linear, shape)
    return framed_scene(linear(codes[:]), shape)


def is_large(pixels: float) -> bool:
    """Return True for a picture that is converted and scaled in bands of rows."""
    return pixels > _LARGE_PIXELS


def _in_bands(codes: Codes, linear: Decoding, shape: Shape | None) -> Tensor:
    """Return the result of `linear_light` for a large picture.

    Each band of rows is converted, resampled, and added to the rows of the result that it affects.
    """
    size = (codes.shape[0], codes.shape[1])
    if shape is None or size == tuple(shape):
        picture = torch.empty(3, *size)
        for rows in row_bands(size, _SMALL_BAND_PIXELS):
            picture[:, rows] = linear(codes[rows])
        return picture
    scaled = covering_size(size, shape)
    antialias = max(old / new for old, new in zip(size, scaled, strict=True)) > 1
    # resampling matrices; only their rows for the central crop are needed
    row_matrix, column_matrix = (
        resampling_matrix(old, new, antialias)[(new - size_of_cut) // 2 :][:size_of_cut]
        for old, new, size_of_cut in zip(size, scaled, shape, strict=True)
    )
    result = np.zeros((3, *shape), np.float32)
    for rows in row_bands(size):
        band_matrix = row_matrix[:, rows]
        # rows of the sparse matrix with nonzero elements
        reached_lines = np.flatnonzero(np.diff(band_matrix.indptr))
        if len(reached_lines):
            lines = slice(reached_lines[0], reached_lines[-1] + 1)
            for channel, light in zip(result, linear(codes[rows]).double().numpy(), strict=True):
                channel[lines] += band_matrix[lines] @ (column_matrix @ light.T).T
    return torch.from_numpy(result)


def row_bands(size: tuple[int, int], pixels: int | None = None) -> list[slice]:
    """Return the rows of each band of a picture of ``size`` rows and columns; a band has at most
    ``pixels`` pixels, or one row.
    """
    step = max(1, (pixels or _BAND_PIXELS) // size[1])
    return [slice(start, start + step) for start in range(0, size[0], step)]


def resampling_matrix(old: int, new: int, antialias: bool) -> Any:
    """Return the sparse matrix (new, old) of kornia's bilinear resampling of one axis, float64.

    With ``antialias``, a Gaussian filter is applied first; it is 4 standard deviations wide in
    total, and the picture is mirrored at its edges.
    """
    from scipy import sparse

    # centre of each new sample in units of old samples; end samples are repeated beyond the ends
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


# --- augmentation ---------------------------------------------------------------------------------

# Augmentation of photographs for training: symmetries of the square, sharpness, exposure and
# colour.


@dataclass(frozen=True)
class Change:
    """One drawn change of a photograph; the default changes nothing."""

    quarters: int = 0  #: quarter turns, counter-clockwise
    stops: float = 0.0  #: the light is multiplied by 2**stops
    saturation: float = 1.0  #: factor of the saturation of the colours; 0 is grey
    #: factor by which a part of the photograph is enlarged, so that it becomes less sharp
    enlarged: float = 1.0

    @classmethod
    def drawn(
        cls,
        seed: tuple[int, ...],
        turned: bool,
        darker: float,
        colour: float,
        enlarged: float = 1.0,
    ) -> Change:
        """Return a random change for a seed: up to ``darker`` stops darker, with a saturation of 1
        ± ``colour``.

        The enlargement is log-uniform from 1 to ``enlarged``. With ``turned``, the number of
        quarter turns is random from 0 to 3; with mirroring, these are the eight symmetries.
        """
        rng = np.random.default_rng(seed)
        quarters, stops, saturation = (
            int(rng.integers(4)),
            -float(rng.random()),
            2.0 * float(rng.random()) - 1.0,
        )
        factor = enlarged ** float(rng.random())
        if not turned:
            quarters = 0
        return cls(quarters, darker * stops, 1.0 + colour * saturation, factor)

    def frame(self, shape: tuple[int, int]) -> tuple[int, int]:
        """Return the rows and columns of a photograph that this change turns into a picture of
        ``shape``.
        """
        rows, columns = (max(1, round(side / self.enlarged)) for side in shape)
        # an odd number of quarter turns exchanges rows and columns
        return (columns, rows) if self.quarters % 2 else (rows, columns)

    def of(self, picture: Tensor, shape: tuple[int, int]) -> Tensor:
        """Return the changed picture: colours, light, orientation and size.

        ``picture`` (3, y, x) is in linear sRGB from 0 to 1 and has the size of `frame`. The result
        has the rows and columns ``shape``, by bicubic interpolation; negative values become 0. The
        saturation is that of kornia: each encoded colour moves along the line to the grey of its
        luma (ITU-R BT.601), and is clipped to the range from 0 to 1. The random augmentations of
        kornia are not used, because they draw from the global random stream of torch.
        """
        if self.saturation != 1.0:
            picture = _saturated(picture, self.saturation)
        if self.stops:
            picture = picture * 2.0**self.stops
        picture = picture.rot90(self.quarters, (-2, -1)).contiguous() if self.quarters else picture
        return picture if picture.shape[-2:] == shape else resize(picture, *shape).clamp_min(0.0)


def _saturated(picture: Tensor, factor: float) -> Tensor:
    """Return a picture (3, y, x) in linear sRGB with the saturation of its colours multiplied by
    ``factor``.
    """
    from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
    from kornia.enhance import adjust_saturation_with_gray_subtraction

    # the saturation of kornia is defined for encoded sRGB
    saturated: Tensor = rgb_to_linear_rgb(
        adjust_saturation_with_gray_subtraction(linear_rgb_to_rgb(picture), factor)
    )
    return saturated


def symmetry(pictures: Tensor, seed: tuple[int, ...]) -> Tensor:
    """Return pictures (..., y, x), turned and mirrored by a random symmetry for a seed: one of
    eight, or of four if y is not x.
    """
    rng = np.random.default_rng(seed)
    quarters, mirrored = int(rng.integers(4)), bool(rng.integers(2))
    if pictures.shape[-1] != pictures.shape[-2]:
        # only half turns keep the shape of a picture that is not square
        quarters -= quarters % 2
    turned = pictures.rot90(quarters, (-2, -1))
    return (turned.flip(-1) if mirrored else turned).contiguous()


# --- grey picture ---------------------------------------------------------------------------------

# The luminance of a colour picture, as a grey picture for the comparison with a monochrome camera.

_LUMINANCE = (0.2126, 0.7152, 0.0722)  #: weights of linear red, green and blue of sRGB


def luminance(rgb: Tensor, axis: int) -> Tensor:
    """Return the luminance of linear sRGB; the axis ``axis`` of the three channels then has length
    1.
    """
    red, green, blue = (share * rgb.narrow(axis, i, 1) for i, share in enumerate(_LUMINANCE))
    return red + green + blue


@node(rtol=1e-6)
def grey(picture: Tensor) -> Tensor:
    """Replace the colour of each pixel by its luminance, equal in red, green and blue.

    Shapes: picture (..., 3, y, x) -> the same.
    Units:  linear sRGB.
    Error:  float32: 2e-7 of the brightest channel.
    Raises: ValueError for a number of channels other than three.
    Source: IEC 61966-2-1:1999 (sRGB), luminance of the primaries of ITU-R BT.709.
    """
    if picture.ndim < 3 or picture.shape[-3] != 3:
        raise ValueError(
            f"a picture {tuple(picture.shape)} is not a colour picture: give (3, y, x)"
        )
    light = single(picture)
    return luminance(light, light.ndim - 3).expand_as(light).clone()


@grey.reference
def _(picture: Tensor) -> Tensor:
    shares = torch.tensor(_LUMINANCE, dtype=torch.float64, device=picture.device)
    return torch.einsum("c,...cyx->...yx", shares, picture.double())[..., None, :, :].expand_as(
        picture
    )


@grey.check
def _(result: Tensor, picture: Tensor) -> list[Check]:
    return [Check(f"luminance from {float(result.min()):.3g} to {float(result.max()):.3g}")]
