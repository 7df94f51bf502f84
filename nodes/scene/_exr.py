"""OpenEXR files: writing line by line, reading and writing of spectral files, and reading of
scene-linear pictures as linear sRGB.
"""

import math
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from functools import partial
from io import StringIO
from itertools import accumulate, repeat
from pathlib import Path
from typing import IO, Annotated, Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes._colour_science import colour_science
from neusee.nodes.constants import SPEED_OF_LIGHT
from neusee.nodes.file_headers import exr_needs
from neusee.nodes.input_files import not_finite, once_per_version, refuse_large_picture
from neusee.nodes.scene._picture_changes import Decoding, enlargement_notes, linear_light, row_bands
from neusee.nodes.units import DataFile, Shape

# --- plain exr ------------------------------------------------------------------------------------

# Uncompressed OpenEXR files of one part, written line by line in a few megabytes of memory beside
# the planes.
#
# Noise and the tails of a PSF do not compress: ZIP saves 0.7 % of a stack of PSFs, and takes ten
# times as long as a copy. The layout is that of OpenEXR 2 (OpenEXR file layout, 2013, scan line
# images): a header, the table of the offsets of the lines, and for each line its number, its size,
# and the pixels of one channel after another.


_MAGIC, _VERSION, _LONG_NAMES = 20000630, 2, 0x400
_HALF, _FLOAT = 1, 2  #: numbers of the types of a channel
_LARGEST_HALF = 65504.0
_BYTES_AT_A_TIME = 1 << 23  #: bytes of lines that are written together


def write_lines(
    path: Path | str, names: Sequence[str], cube: Tensor, header: Mapping[str, Any], half: bool
) -> None:
    """Write planes (channel, y, x) as float32, or with ``half`` as float16, under the channel names
    ``names``.

    ``header`` has texts and numbers. Raises: ValueError for ``half`` and a value beyond the range
    of float16.
    """
    # an OpenEXR file has its channels in alphabetical order
    channel_order = sorted(range(len(names)), key=lambda i: names[i].encode())
    planes = [cube[i].detach().cpu().float().numpy() for i in channel_order]
    if half and any(
        np.abs(plane).max(initial=0.0, where=np.isfinite(plane)) > _LARGEST_HALF for plane in planes
    ):
        raise ValueError(
            f"values beyond {_LARGEST_HALF:.0f} cannot be written as half floats: write float32"
        )
    height, width = cube.shape[-2:]
    number_type = np.dtype("<f2") if half else np.dtype("<f4")
    line_bytes = len(names) * width * number_type.itemsize
    header_bytes = _header_bytes([names[i] for i in channel_order], (height, width), header, half)
    # each line begins with its number and its size, 4 bytes each; the table of offsets has 8 bytes
    # per line
    offsets = accumulate(repeat(8 + line_bytes, height - 1), initial=len(header_bytes) + 8 * height)
    with open(path, "wb") as file:
        file.write(header_bytes + np.fromiter(offsets, "<u8", height).tobytes())
        _write_pixels(file, planes, line_bytes, number_type)


def _write_pixels(file: IO[bytes], planes: Sequence[Any], size: int, kind: Any) -> None:
    """Write the lines of the planes, each after its number and its size in bytes.

    ``size`` is the bytes of a line's pixels, ``kind`` the number type. Many lines are written at
    once.
    """
    height, width = planes[0].shape
    rows = max(1, min(height, _BYTES_AT_A_TIME // (8 + size)))
    lines = np.empty((rows, 8 + size), np.uint8)
    line_headers, pixels = (
        lines[:, :8].view("<i4"),
        lines[:, 8:].view(kind).reshape(rows, len(planes), width),
    )
    # column 0: number of the line, column 1: its size in bytes
    line_headers[:, 1] = size
    for top in range(0, height, rows):
        count = min(rows, height - top)
        line_headers[:count, 0] = np.arange(top, top + count)
        for i, plane in enumerate(planes):
            pixels[:count, i] = plane[top : top + count]
        file.write(lines[:count].data)


def _header_bytes(
    names: Sequence[str], shape: tuple[int, int], header: Mapping[str, Any], half: bool
) -> bytes:
    """Return the bytes of an OpenEXR file before its table of offsets."""
    pixel_type, (height, width) = _HALF if half else _FLOAT, shape
    # per channel: name, type, three unused and a linear flag, sampling along x and y
    channel_list = (
        b"".join(name.encode() + b"\0" + struct.pack("<i4xii", pixel_type, 1, 1) for name in names)
        + b"\0"
    )
    window_bytes = struct.pack("<4i", 0, 0, width - 1, height - 1)
    attributes = {
        "channels": ("chlist", channel_list),
        "compression": ("compression", b"\0"),
        "dataWindow": ("box2i", window_bytes),
        "displayWindow": ("box2i", window_bytes),
        "lineOrder": ("lineOrder", b"\0"),
        "pixelAspectRatio": ("float", struct.pack("<f", 1.0)),
        "screenWindowCenter": ("v2f", struct.pack("<2f", 0.0, 0.0)),
        "screenWindowWidth": ("float", struct.pack("<f", 1.0)),
        **{name: _attribute(value) for name, value in header.items()},
    }
    longest = max(len(name.encode()) for name in (*names, *attributes))
    flags = _VERSION | (_LONG_NAMES if longest > 31 else 0)
    attribute_bytes = (
        f"{name}\0{type_name}\0".encode() + struct.pack("<i", len(value_bytes)) + value_bytes
        for name, (type_name, value_bytes) in attributes.items()
    )
    return struct.pack("<2i", _MAGIC, flags) + b"".join(attribute_bytes) + b"\0"


def _attribute(value: Any) -> tuple[str, bytes]:
    """Return the type and the bytes of an attribute of the header."""
    return (
        ("float", struct.pack("<f", value))
        if isinstance(value, float)
        else ("string", str(value).encode())
    )


# --- spectral exr ---------------------------------------------------------------------------------

# Spectral OpenEXR files: one channel per wavelength, named as in Fichet et al. (JCGT 10(3), 2021).
#
# Emitted light is ``S0.550,0nm``, reflectance is ``T.550,0nm``. The decimal mark is a comma because
# a point separates layers. Colour-science reads and writes such files only with OpenImageIO, and
# its import alone takes a second.


_CHANNEL_NAME = re.compile(
    r"(S0|T)\.(\d*,?\d*(?:[eE][-+]?\d+)?)(Y|Z|E|P|T|G|M|k|h|da|d|c|m|u|n|p)?(m|Hz)"
)
_PREFIX_EXPONENTS = {
    "": 0, "p": -12, "n": -9, "u": -6, "m": -3, "c": -2, "d": -1, "da": 1, "h": 2, "k": 3,
    "M": 6, "G": 9, "T": 12, "P": 15, "E": 18, "Z": 21, "Y": 24,
}  # fmt: skip


@contextmanager
def exr_parts(file: Path | str) -> Iterator[Any]:
    """Open an OpenEXR file with its pixels; raise ValueError if a part cannot be read to its end.

    For a truncated file, OpenEXR prints a warning to stdout, which would mix with the output of a
    command, and leaves the part out.
    """
    import OpenEXR

    exr_needs(file)
    with OpenEXR.File(str(file), header_only=True) as opened_file:
        part_count = len(opened_file.parts)
    # the library prints a warning for a truncated file
    with redirect_stdout(StringIO()):
        opened_file = OpenEXR.File(str(file), separate_channels=True)
    with opened_file:
        if len(opened_file.parts) < part_count:
            raise ValueError("the pixels end earlier than the header says")
        yield opened_file


class PartHeader(NamedTuple):
    """The header of one part of an OpenEXR file."""

    name: str
    header: dict[str, Any]
    channels: list[str]
    size: tuple[int, int]  #: rows and columns


def part_headers(file: Path) -> list[PartHeader]:
    """Read the header of each part of an OpenEXR file, whose pixels must have room in memory."""
    import OpenEXR

    exr_needs(file)
    try:
        with OpenEXR.File(str(file), header_only=True) as opened:
            headers = [dict(exr_part.header) for exr_part in opened.parts]
    except (RuntimeError, OSError, ValueError) as why:
        text = f"{file} cannot be read as OpenEXR ({str(why).strip()}): give an .exr file"
        raise ParameterError("file", text) from None
    return [_part(header) for header in headers]


def _part(header: dict[str, Any]) -> PartHeader:
    """Return name, header, channel names and size of a part of an OpenEXR file from its header."""
    lower_corner, upper_corner = ([int(edge) for edge in corner] for corner in header["dataWindow"])
    names = [channel.name for channel in header["channels"]]
    # corners are (x, y), and both are inside the window
    return PartHeader(
        str(header.get("name", "")),
        header,
        names,
        (upper_corner[1] - lower_corner[1] + 1, upper_corner[0] - lower_corner[0] + 1),
    )


def exr_header(file: Path) -> tuple[dict[str, Any], list[str], tuple[int, int]]:
    """Read the header, the channel names, and the numbers of rows and columns of an OpenEXR file
    with one part.
    """
    parts = part_headers(file)
    if len(parts) > 1:
        names = ", ".join(exr_part.name for exr_part in parts)
        raise ParameterError(
            "file", f"{file.name} has {len(parts)} parts ({names}): save one part alone"
        )
    return parts[0].header, parts[0].channels, parts[0].size


def write_spectral(
    path: Path | str,
    cube: Tensor,
    centres: Tensor | Sequence[float],
    *,
    kind: Literal["emissive", "reflective"] = "emissive",
    header: Mapping[str, Any] | None = None,
    half: bool = False,
) -> None:
    """Write a spectral cube (band, y, x) with its wavelengths in m to an uncompressed OpenEXR file,
    as float32.

    With ``half`` the file has float16, half as many bytes, in which values below 6e-8 become zero.
    Raises: ValueError where cube and wavelengths differ in number, where two bands would get the
            same name, and where a
    value is beyond the range of float16.
    """
    wavelengths = [float(w) for w in centres]
    if cube.ndim != 3 or len(wavelengths) != len(cube):
        raise ValueError(
            f"cube has shape {tuple(cube.shape)}, not (band, y, x) with {len(wavelengths)} bands: "
            "give one wavelength for each band"
        )
    quantity = "S0" if kind == "emissive" else "T"
    # the decimal mark is a comma, because a point separates layers
    names = [quantity + "." + f"{w * 1e9:.6f}nm".replace(".", ",") for w in wavelengths]
    if len(set(names)) < len(names):
        raise ValueError(f"bands closer than 1e-6 nm would have equal channel names: {names}")
    layout_attributes = {
        "spectralLayoutVersion": "1.0",
        **({"emissiveUnits": "W.m^-2"} if kind == "emissive" else {}),
    }
    write_lines(path, names, cube, {**layout_attributes, **(header or {})}, half)


def read_spectral(path: Path | str) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Read a spectral OpenEXR file: the cube (band, y, x), the rising wavelengths (band,) in m, and
    the header.

    The cube is float32, the wavelengths float64. Only the emission is read from a file with both
    emission and reflectance.
    Raises: ValueError, which lists the channels of the file, where no channel is spectral.
    """
    with exr_parts(path) as opened:
        header, channels = dict(opened.header()), opened.channels()
        spectral = spectral_channels(list(channels))
        if not spectral:
            raise ValueError(
                f"{path} has the channels {', '.join(channels)}: none has a name such as S0.550,0nm"
                " or T.550,0nm"
            )
        planes = [np.asarray(channels[name].pixels, dtype=np.float32) for name in spectral.values()]
    return (
        torch.from_numpy(np.stack(planes)),
        torch.tensor(list(spectral), dtype=torch.float64),
        header,
    )


def spectral_channels(names: Sequence[str]) -> dict[float, str]:
    """Return the channel name for each wavelength in m of a spectral OpenEXR file, in rising order
    of wavelength.

    Reflectance channels are used only if the file has no emission channels.
    """
    matches = [match for match in map(_CHANNEL_NAME.fullmatch, names) if match]
    # names without a number are skipped: they have no wavelength
    spectral = [match for match in matches if match[2] not in ("", ",")]
    for kind in ("S0", "T"):
        channels_of_kind = [match for match in spectral if match[1] == kind]
        if channels_of_kind:
            return dict(sorted((_wavelength(match), match[0]) for match in channels_of_kind))
    return {}


def _wavelength(match: re.Match[str]) -> float:
    """Return the wavelength in m of a matched channel name: its number with the prefix of its
    unit, m or Hz.
    """
    exponent = _PREFIX_EXPONENTS[match[3] or ""]
    number = float(match[2].replace(",", "."))
    # a division converts nanometres, so that 550,0nm gives the same float64 as 550 / 1e9
    metres_or_hertz = number / 10.0**-exponent if exponent < 0 else number * 10.0**exponent
    return metres_or_hertz if match[4] == "m" else SPEED_OF_LIGHT / metres_or_hertz


# --- picture --------------------------------------------------------------------------------------

# Scene-linear OpenEXR pictures, converted to linear sRGB.

White = Annotated[float, Field(ge=1e-30, le=1e30)]
#: chromaticities of a file whose header has no primaries
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
    _, header, channels = _picture_part(file, part)
    refuse_large_picture(file, *header.size)
    if problem := _damage(file, part):
        raise ParameterError("file", problem)
    notes = [f"{file.name}: only luminance; the picture is grey"] if channels == ["Y"] else []
    ratio = float(header.header.get("pixelAspectRatio", 1.0))
    if abs(ratio - 1) > 1e-3:
        notes += [f"{file.name}: pixels are not square ({ratio:.3f}), but are read as square"]
    return notes + enlargement_notes(header.size, shape)


@exr.check
def _(result: Tensor, *, file: Path, part: str | None = None, **params: Any) -> list[Check]:
    pixels, linear = _linear_pixels(file, part)
    negative_count, lowest = 0, math.inf
    for rows in row_bands(pixels.shape[:2]):
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
    return _picture_part(file, part_name)[1].size


def _picture_part(file: Path, part_name: str | None) -> tuple[int, PartHeader, list[str]]:
    """Return (number of the part, its header, names of the channels to read) for the only part of a
    file with a picture.

    ``part_name`` names the part where several hold a picture. Raises ParameterError for a name that
    no part has, for several pictures without a name, and for no picture.
    """
    parts = part_headers(file)
    candidates = [(i, header) for i, header in enumerate(parts) if part_name in (None, header.name)]
    if part_name is not None and not candidates:
        names = _joined_names(parts)
        raise ParameterError("part", f"{file.name} has no part {part_name!r}: name one of {names}")
    parts_with_picture = _parts_with_picture(candidates)
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


def _parts_with_picture(
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
    # with RY and BY (colour at half resolution), Y is not a grey picture
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
    """Return a message for a file that cannot be read to its end or has values that are not finite,
    or an empty text.
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
    number, _, names = _picture_part(file, part_name)
    with exr_parts(file) as opened_file:
        header, channels = dict(opened_file.header(number)), opened_file.channels(number)
        return (
            header,
            names,
            np.stack([np.asarray(channels[name].pixels, dtype=np.float32) for name in names]),
        )


def _linear_pixels(file: Path, part_name: str | None) -> tuple[NDArray[np.float32], Decoding]:
    """Read the values (y, x, channel) of an OpenEXR file; return them and their conversion to
    linear sRGB (3, y, x).
    """
    header, names, pixels = _pixels(file, part_name)
    if problem := not_finite(file, int((~np.isfinite(pixels)).sum())):
        raise ValueError(problem)
    if names == ["Y"]:
        matrix = None
    else:
        to_srgb = _xyz_to_srgb(header) if names == ["X", "Y", "Z"] else _rgb_to_srgb(header)
        matrix = torch.from_numpy(to_srgb).to(torch.float32)
    return pixels.transpose(1, 2, 0), partial(_linear_srgb, matrix)


def _linear_srgb(matrix: Tensor | None, values: NDArray[Any]) -> Tensor:
    """Return the values (y, x, channel) of a picture as linear sRGB (3, y, x).

    Without a matrix, its only channel is grey.
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
    # chromaticities: the last two numbers are the white point (x, y)
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


def _rgb_to_srgb(header: dict[str, Any]) -> NDArray[np.float64]:
    """Return the matrix from the primaries of an OpenEXR header to linear sRGB.

    Bradford adaptation maps the neutral of the header to D65.
    """
    colour = colour_science()

    chromaticities = np.asarray(header.get("chromaticities", _REC709), dtype=np.float64)
    if np.allclose(chromaticities, _REC709, atol=1e-4) and "adoptedNeutral" not in header:
        return np.eye(3)
    # chromaticities: six numbers for the primaries, then two for the white point
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
