"""Scene-linear OpenEXR pictures, converted to linear sRGB."""

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes._colour_science import colour_science
from neusee.nodes.input_files import not_finite, once_per_version, refuse_large_picture
from neusee.nodes.scene._picture_scaling import Linear, bands_of, enlarged, linear_light
from neusee.nodes.scene._spectral_exr import PartHeader, exr_parts, part_headers
from neusee.nodes.units import DataFile, Shape

White = Annotated[float, Field(ge=1e-30, le=1e30)]
#: of a file whose header has no primaries
_REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)


@node(rtol=1e-5)
def exr(
    *,
    file: DataFile,
    shape: Shape | None = None,
    white: White | None = None,
    negatives: Literal["clip", "keep"] = "clip",
    part: str | None = None,
) -> Tensor:
    """Read a scene-linear OpenEXR picture and convert it to linear sRGB.

    The channels are R, G and B with the primaries in the header, or CIE X, Y and Z, or Y alone for
    a grey picture. Bradford adaptation is used where the white points differ; X, Y and Z without
    `adoptedNeutral` and without `chromaticities` have the white point D65. ``part`` names the part
    to read if several parts hold a picture.

    Shapes: -> (3, y, x) float32, the size of the file or `shape` (scaled to cover `shape`, cropped
            at the centre).
    Units:  linear sRGB, 1 = `white` in the values of the file (with null the values stay unscaled);
            no upper limit.
    Error:  half floats resolve 5e-4. Negative light, from noise or colours outside sRGB, is clipped
            unless kept.
    Raises: ParameterError before the run for other channels, for a part that does not exist or is
            not named, for a damaged file, for values that are not finite, and for more than 64
            million pixels.
    Source: OpenEXR technical introduction (chromaticities, adoptedNeutral); matrices of
            colour-science.
    """
    scene = linear_light(*_linear_pixels(file, part), shape) / (white or 1.0)
    return scene.clamp_min(0) if negatives == "clip" else scene


@exr.preflight
def _(
    *, file: Path, shape: Shape | None = None, part: str | None = None, **params: Any
) -> list[str]:
    _, header, channels = _chosen(file, part)
    refuse_large_picture(file, *header.size)
    if problem := _damage(file, part):
        raise ParameterError("file", problem)
    notes = [f"{file.name}: only luminance; the picture is grey"] if channels == ["Y"] else []
    ratio = float(header.header.get("pixelAspectRatio", 1.0))
    if abs(ratio - 1) > 1e-3:
        notes += [f"{file.name}: pixels are not square ({ratio:.3f}), but are read as square"]
    return notes + enlarged(header.size, shape)


@exr.check
def _(result: Tensor, *, file: Path, part: str | None = None, **params: Any) -> list[Check]:
    pixels, linear = _linear_pixels(file, part)
    negative_count, lowest = 0, math.inf
    for rows in bands_of(pixels.shape[:2]):
        light = linear(pixels[rows])
        negative_count, lowest = (
            negative_count + int((light < 0).sum()),
            min(lowest, float(light.min())),
        )
    text = f"peak {float(result.max()):.4g}, mean {float(result.mean()):.3g}"
    values = 3 * pixels.shape[0] * pixels.shape[1]
    return [
        Check(
            text
            + (
                f"; {negative_count} of {values} values were negative, down to {lowest:.2g}"
                if negative_count
                else ""
            )
        )
    ]


def picture_size(file: Path, part_name: str | None) -> tuple[int, int]:
    """Return the numbers of rows and columns of the picture in an OpenEXR file, from the header
    of its part.
    """
    return _chosen(file, part_name)[1].size


def _chosen(file: Path, part_name: str | None) -> tuple[int, PartHeader, list[str]]:
    """Return (number of the part, its header, names of the channels to read) of the one part of a
    file that holds a picture.

    ``part_name`` names the part where several hold a picture. Raises ParameterError for a name that
    no part has, for several pictures without a name, and for no picture.
    """
    parts = part_headers(file)
    candidates = [(i, header) for i, header in enumerate(parts) if part_name in (None, header.name)]
    if part_name is not None and not candidates:
        names = _joined_names(parts)
        raise ParameterError("part", f"{file.name} has no part {part_name!r}: name one of {names}")
    parts_with_picture = _with_picture(candidates)
    if len(parts_with_picture) > 1:
        names_of_parts = _joined_names([header for _, header, _ in parts_with_picture])
        raise ParameterError(
            "file",
            f"{file.name} has a picture in the parts {names_of_parts}: set part to one of them",
        )
    if not parts_with_picture:
        channel_names = "; ".join(", ".join(header.channels) for _, header in candidates)
        remedy = "but R, G and B, or X, Y and Z, or Y alone, are needed: save the picture as RGB"
        raise ParameterError("file", f"{file} has the channels {channel_names}, {remedy}")
    return parts_with_picture[0]


def _with_picture(
    parts: Sequence[tuple[int, PartHeader]],
) -> list[tuple[int, PartHeader, list[str]]]:
    """Return the numbered parts that have a picture, and the names of its channels."""
    pictures = []
    for number, header in parts:
        channels = _colour_channels(header.channels)
        if channels:
            pictures.append((number, header, channels))
    return pictures


def _joined_names(parts: Sequence[PartHeader]) -> str:
    """Return the names of parts of a file, separated by commas."""
    return ", ".join(header.name or "unnamed" for header in parts)


def _colour_channels(names: list[str]) -> list[str]:
    """Return the channels of a picture among ``names``: R, G and B, or X, Y and Z, or Y alone; an
    empty list if there is no picture.
    """
    # RY and BY are colours at half resolution: Y is not alone then
    if {"RY", "BY"} & set(names):
        return []
    return next(
        (
            colours
            for colours in (["R", "G", "B"], ["X", "Y", "Z"], ["Y"])
            if set(colours) <= set(names)
        ),
        [],
    )


@once_per_version
def _damage(file: Path, part_name: str | None) -> str:
    """Return a message for a file that cannot be read to its end or has values that are not
    finite, or nothing.
    """
    try:
        pixels = _pixels(file, part_name)[2]
    except (RuntimeError, OSError, ValueError) as error:
        return f"{file.name} is damaged ({error}): copy or save the file again"
    return not_finite(file, int((~np.isfinite(pixels)).sum()))


def _pixels(
    file: Path, part_name: str | None
) -> tuple[dict[str, Any], list[str], NDArray[np.float32]]:
    """Read (header, channel names, values (channel, y, x)) of the picture in an OpenEXR file."""
    number, _, names = _chosen(file, part_name)
    with exr_parts(file) as opened_file:
        header, channels = dict(opened_file.header(number)), opened_file.channels(number)
        return (
            header,
            names,
            np.stack([np.asarray(channels[name].pixels, dtype=np.float32) for name in names]),
        )


def _linear_pixels(file: Path, part_name: str | None) -> tuple[NDArray[np.float32], Linear]:
    """Read the values (y, x, channel) of an OpenEXR file; return them and their conversion to
    linear sRGB (3, y, x).
    """
    header, names, pixels = _pixels(file, part_name)
    if problem := not_finite(file, int((~np.isfinite(pixels)).sum())):
        raise ValueError(problem)
    if names == ["Y"]:
        matrix = None
    else:
        to_srgb = _xyz_to_srgb(header) if names == ["X", "Y", "Z"] else _to_srgb(header)
        matrix = torch.from_numpy(to_srgb).to(torch.float32)
    return pixels.transpose(1, 2, 0), partial(_converted, matrix)


def _converted(matrix: Tensor | None, values: NDArray[Any]) -> Tensor:
    """Return linear sRGB (3, y, x) of the values (y, x, channel) of a picture; without a matrix
    its one channel is grey.
    """
    planes = torch.from_numpy(np.ascontiguousarray(values.transpose(2, 0, 1)))
    if matrix is None:
        return planes.expand(3, -1, -1).clone()
    return (matrix @ planes.flatten(1)).reshape(planes.shape)


def _xyz_to_srgb(header: dict[str, Any]) -> NDArray[np.float64]:
    """Return the matrix from CIE X, Y and Z to linear sRGB, with Bradford adaptation of the
    header's white to D65.
    """
    colour = colour_science()

    srgb = colour.RGB_COLOURSPACES["sRGB"]
    # the last two numbers of the chromaticities are the white point (x, y)
    file_white = np.asarray(header.get("chromaticities", _REC709), dtype=np.float64)[6:]
    white = np.asarray(header.get("adoptedNeutral", file_white), dtype=np.float64)
    if np.allclose(white, srgb.whitepoint, atol=1e-4):
        matrix: NDArray[np.float64] = srgb.matrix_XYZ_to_RGB
        return matrix
    white_points = colour.xy_to_XYZ(white), colour.xy_to_XYZ(srgb.whitepoint)
    adaptation: NDArray[np.float64] = colour.adaptation.matrix_chromatic_adaptation_VonKries(
        *white_points, "Bradford"
    )
    return np.asarray(srgb.matrix_XYZ_to_RGB @ adaptation, dtype=np.float64)


def _to_srgb(header: dict[str, Any]) -> NDArray[np.float64]:
    """Return the matrix from the primaries of an OpenEXR header to linear sRGB.

    Bradford adaptation maps the neutral of the header to D65.
    """
    colour = colour_science()

    chromaticities = np.asarray(header.get("chromaticities", _REC709), dtype=np.float64)
    if np.allclose(chromaticities, _REC709, atol=1e-4) and "adoptedNeutral" not in header:
        return np.eye(3)
    # six numbers of the primaries, two of the white point
    white = chromaticities[6:]
    neutral = np.asarray(header.get("adoptedNeutral", white), dtype=np.float64)
    rgb_to_xyz = colour.models.normalised_primary_matrix(chromaticities[:6].reshape(3, 2), white)
    space = colour.RGB_Colourspace(
        "file", chromaticities[:6], neutral, matrix_RGB_to_XYZ=rgb_to_xyz
    )
    matrix: NDArray[np.float64] = colour.matrix_RGB_to_RGB(
        space, colour.RGB_COLOURSPACES["sRGB"], "Bradford"
    )
    return matrix
