"""A frame of a real camera, from a file, and signs in the file that a tone curve was applied."""

import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.file_headers import exr_needs, npy_needs, tiff_needs
from neusee.nodes.input_files import (
    bytes_of,
    head_of,
    needs,
    once_per_version,
    refuse_large_array,
    refuse_large_picture,
    refuse_other_than_file,
)
from neusee.nodes.sensor._digitization import Bits
from neusee.nodes.units import DataFile, Shape

# --- tone curve -----------------------------------------------------------------------------------

# Signs in a file that a tone curve was applied: 8 bits, a stated gamma or colour profile, or 8 bits
# stretched to 16.


_DISPLAY_BITS = 8  #: bits of pictures for displays, which have a tone curve
_LINEAR_GAMMA = 100_000  #: value of the gAMA chunk of a PNG whose numbers are linear in the light
#: code point of a linear transfer characteristic in the chunk cICP (ITU-T H.273)
_LINEAR_TRANSFER = 8
#: factor by which numbers of 8 bits become numbers of 16
_SIXTEEN_BIT_FACTORS = {257: "stretched", 256: "shifted"}
_ICC_PROFILE = 34675  #: tag of a colour profile in a TIFF file
_MOST_ENTRIES = 4096  #: largest number of entries of a TIFF directory that are read


def tone_curve_sign(file: Path, values: NDArray[Any], depth: int | None, bits: int) -> str:
    """Return the sign of a tone curve in a picture file as the end of a sentence, or an empty text
    if there is none.

    ``depth`` is the number of bits in the file, None if unknown; ``bits`` is that of the sensor.
    """
    if _DISPLAY_BITS in (depth, bits) or values.dtype.itemsize == 1:
        return "has 8 bits, as pictures with a tone curve (sRGB, gamma 2.2) have"
    if values.dtype.kind in "ui" and values.any():
        for factor, change in _SIXTEEN_BIT_FACTORS.items():
            if not (values % factor).any():
                return f"has only multiples of {factor}: numbers of 8 bits that were {change} to 16"
    with suppress(OSError, struct.error):
        if file.suffix.lower() == ".png":
            return _png_sign(bytes_of(file))
        if file.suffix.lower() in (".tif", ".tiff"):
            return _tiff_sign(bytes_of(file))
    return ""


def _png_sign(content: bytes) -> str:
    """Return the sign of a tone curve in the chunks of a PNG file (sRGB, gAMA, cICP, iCCP), or an
    empty text.
    """
    for kind, data in _png_chunks(content):
        if kind == b"sRGB":
            return "says of itself that it is sRGB encoded, which is a tone curve"
        if kind == b"gAMA" and (gamma := struct.unpack(">I", data[:4])[0]) != _LINEAR_GAMMA:
            return f"states a tone curve with the gamma {_LINEAR_GAMMA / max(gamma, 1):.3g}"
        if kind == b"cICP" and data[1] != _LINEAR_TRANSFER:
            return (
                f"states the transfer characteristic {data[1]} of ITU-T H.273, which is a tone"
                " curve"
            )
        if kind == b"iCCP" and b"linear" not in (name := data.split(b"\0")[0]).lower():
            return f"has the colour profile {name.decode('latin-1')}, which has a tone curve"
    return ""


def _png_chunks(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield the kind and the data of each chunk of a PNG before its pixels."""
    # 8: after the signature; a chunk is length, kind, data, and a checksum of 4 bytes
    offset = 8
    while offset + 8 <= len(content):
        length, kind = struct.unpack(">I4s", content[offset : offset + 8])
        if kind == b"IDAT":
            return
        yield kind, content[offset + 8 : offset + 8 + length]
        offset += length + 12


def _tiff_sign(content: bytes) -> str:
    """Return the sign of a tone curve in the first directory of a TIFF file, its colour profile,
    or an empty text.
    """
    byte_order = {b"II": "<", b"MM": ">"}.get(content[:2])
    # 42 is the magic number of TIFF
    if byte_order is None or struct.unpack(f"{byte_order}H", content[2:4])[0] != 42:
        return ""
    (directory_offset,) = struct.unpack(f"{byte_order}I", content[4:8])
    (entry_count,) = struct.unpack(
        f"{byte_order}H", content[directory_offset : directory_offset + 2]
    )
    for entry_number in range(min(entry_count, _MOST_ENTRIES)):
        # the directory: number of entries (2 bytes), then entries of 12 bytes
        entry = content[
            directory_offset + 2 + 12 * entry_number : directory_offset + 14 + 12 * entry_number
        ]
        tag, _, data_length, data_offset = struct.unpack(f"{byte_order}HHII", entry)
        if (
            tag == _ICC_PROFILE
            and b"linear" not in content[data_offset : data_offset + data_length].lower()
        ):
            return "has a colour profile, which has a tone curve"
    return ""


# --- frame file -----------------------------------------------------------------------------------

# A frame of a real camera, read from a file as digital numbers.


#: the user's statement that the numbers of a file with a sign of a tone curve are linear
Curve = Literal["linear"]
_DAMAGED = "{name} is damaged or no picture ({error}): copy the file again"
_CURVE_STATEMENT = "frame.curve=linear"
_PNG_CHANNELS = {0: 1, 2: 3}  #: number of channels of a PNG for each colour type
_NUMBER_BYTES = 4  #: bytes of a number of the resulting frame (float32)
_ARRAY_SHAPES = "(y, x), (y, x, 3) or (3, y, x)"


@node(rtol=0.0)
def frame(
    responses: Tensor, *, file: DataFile, shape: Shape, bits: Bits = 16, curve: Curve | None = None
) -> Tensor:
    """Read a frame that a camera took: the digital numbers of each channel, unchanged.

    The file is a PNG or TIFF of 8 or 16 bits, an OpenEXR picture, or a NumPy array. No tone curve
    is undone: the numbers must be those of the converter, from 0 to 2**bits - 1, so that
    `restore.electrons` can divide them by the gain and subtract the offset of the sensor. A file
    with a sign of a tone curve (8 bits, a stated gamma, a colour profile, 8 bits stretched to 16)
    is refused, unless ``curve`` states that its numbers are linear in the light.

    Shapes: responses (channel, band), of which only the number of channels counts -> (channel, y,
            x) float32.
    Units:  DN.
    Error:  none: whole numbers are exact. An orientation in EXIF is ignored, as the sensor does not
            turn.
    Raises: ParameterError before the run for a file that is damaged or of another format, and for a
            size, channels, depth or numbers that do not fit the sensor, and for a sign of a tone
            curve without a statement.
    Source: EMVA Standard 1288, release 4.0 (digital numbers of a camera).
    """
    if problem := frame_problem(file, len(responses), tuple(shape), bits, curve):
        raise ParameterError("file", problem)
    return torch.from_numpy(np.ascontiguousarray(read_frame(file).values, dtype=np.float32))


@frame.preflight
def _(
    *,
    responses: Tensor | None = None,
    file: Path,
    shape: Shape,
    bits: int = 16,
    curve: Curve | None = None,
) -> list[str]:
    channels = None if responses is None else len(responses)
    if problem := frame_problem(file, channels, tuple(shape), bits, curve):
        raise ParameterError("file", problem)
    return []


@frame.check
def _(result: Tensor, *inputs: Any, bits: int = 16, **params: Any) -> list[Check]:
    low, high, top = float(result.min()), float(result.max()), 2**bits - 1
    return [
        Check(
            f"numbers from {low:.0f} to {high:.0f} of {top} DN, mean {float(result.mean()):.4g}",
            high > low,
        )
    ]


class FrameNumbers(NamedTuple):
    values: NDArray[Any]  #: (channel, y, x)
    depth: int | None  #: bits of the numbers in the file; None for a file of floating-point numbers


@once_per_version
def frame_problem(
    file: Path, channels: int | None, shape: tuple[int, int], bits: int, curve: Curve | None = None
) -> str:
    """Return in one sentence why a file is not a frame of this sensor, or an empty text."""
    try:
        values, depth = read_frame(file)
    except ParameterError as error:
        return str(error)
    name, size_of_frame = file.name, values.shape[1:]
    if channels is not None and len(values) != channels:
        return _channels_problem(name, len(values), channels)
    if size_of_frame != shape:
        size = f"[{size_of_frame[0]}, {size_of_frame[1]}]"
        return (
            f"{name} has {size_of_frame[0]} x {size_of_frame[1]} pixels (y, x), but sensor.shape"
            f" is {list(shape)}: give the whole "
            f'frame of this sensor, or "sensor.shape={size}" if this window around its centre was'
            " read out"
        )
    return (
        _depth_problem(name, depth, bits, curve)
        or _numbers_problem(name, values, bits)
        or (
            ""
            if curve == "linear"
            else _tone_curve_problem(name, tone_curve_sign(file, values, depth, bits))
        )
    )


def _channels_problem(name: str, frame_channels: int, channels: int) -> str:
    """Return why a frame with ``frame_channels`` channels does not fit a camera with ``channels``
    channels.
    """
    if frame_channels == 1:
        return (
            f"{name} has one channel, but the camera has {channels}: it may be a raw colour filter"
            " array, which is not handled yet; develop it to three channels without a tone curve,"
            " or name a sensor.camera of one channel"
        )
    return (
        f"{name} has {frame_channels} channels, but the camera has {channels}: give a frame of the"
        " channels of sensor.camera"
    )


def _depth_problem(name: str, depth: int | None, bits: int, curve: Curve | None) -> str:
    """Return why a frame of 8 bits does not fit a sensor of more bits, or an empty text.

    ``depth`` are the bits of the file, None if it does not state them.
    """
    if depth is not None and depth < bits and depth == 8:
        curve_text = (
            ""
            if curve == "linear"
            else f" and {_CURVE_STATEMENT}, if they have no tone curve (sRGB, gamma)"
        )
        return (
            f"{name} has 8 bits, but sensor.bits is {bits}: save the raw numbers of the camera in"
            f" 16 bits, or give sensor.bits=8 with the gain of these numbers{curve_text}"
        )
    return ""


def _tone_curve_problem(name: str, sign: str) -> str:
    """Return why a frame with the ``sign`` of a tone curve is refused, or an empty text for no
    sign.
    """
    if not sign:
        return ""
    return (
        f"{name} {sign}, but a restoration needs numbers in proportion to the light: save the raw"
        " numbers of the camera, without tone curve and white balance; or state"
        f" {_CURVE_STATEMENT}, if these numbers are linear in the light"
    )


def _numbers_problem(name: str, values: NDArray[Any], bits: int) -> str:
    """Return why the numbers of a frame are not digital numbers of a converter of ``bits`` bits,
    or an empty text: they must be finite, whole, from 0 to 2^bits - 1, and not all the same.
    """
    largest = 2**bits - 1
    if values.dtype.kind == "f":
        if count := int((~np.isfinite(values)).sum()):
            return (
                f"{name} holds {count} values that are not finite (NaN or infinity): give the"
                " numbers of the camera"
            )
        broken = values != np.round(values)
        if broken.any():
            return (
                f"{name} holds {values[broken][0]:g}, no whole number: give the digital numbers of"
                f" the camera, from 0 to {largest}, without a tone curve and without scaling"
            )
    lowest, highest = int(values.min()), int(values.max())
    if lowest < 0:
        return (
            f"{name} holds {lowest}, below 0: give the numbers of the camera with its offset, not"
            " subtracted"
        )
    if highest > largest:
        return (
            f"{name} holds {highest} DN, but {bits} bits end at {largest}: set sensor.bits to the"
            " depth of the converter, or shift the numbers down if the camera moved them to the"
            " upper bits"
        )
    if highest == lowest:
        return f"{name} has the same number, {highest}, in every pixel: there is no picture in it"
    return ""


# --- files ----------------------------------------------------------------------------------------


def read_frame(file: Path) -> FrameNumbers:
    """Read a frame; raise ParameterError for a file that cannot be read or has another form than
    a frame.
    """
    reader = _READERS.get(file.suffix.lower())
    if reader is None:
        suffixes = ", ".join(_READERS)
        raise ParameterError("file", f"{file.name} is no frame that can be read: give {suffixes}")
    refuse_other_than_file(file)
    try:
        return reader(file)
    except ParameterError:
        raise
    except Exception as error:  # the readers of kornia-rs raise no class of their own
        text = str(error).partition("\n")[0] or type(error).__name__
        raise ParameterError("file", _DAMAGED.format(name=file.name, error=text)) from None


def _png(file: Path) -> FrameNumbers:
    """Read a frame from a PNG file of 8 or 16 bits, grey or RGB; raise ParameterError for another
    file.
    """
    from kornia_rs import io
    from PIL import Image

    header = head_of(file, 26)
    if not header.startswith(b"\x89PNG") or len(header) < 26:
        raise ParameterError(
            "file", f"{file.name} is no PNG file, whatever its name says: save the frame as PNG"
        )
    # header: columns in bytes 16 to 19, rows in 20 to 23, bits in 24, colour type in 25
    depth, channels = header[24], _PNG_CHANNELS.get(header[25], 0)
    if not channels or depth not in (8, 16):
        text = (
            f"{file.name} has a palette, transparency or {depth} bits: save raw numbers of 8 or 16"
            " bits"
        )
        raise ParameterError("file", text)
    rows, columns = int.from_bytes(header[20:24]), int.from_bytes(header[16:20])
    refuse_large_picture(file, rows, columns)
    needs(
        # bytes of a number in the file, and of the float32 number
        rows * columns * channels * (depth // 8 + _NUMBER_BYTES),
        file,
        f"{columns} x {rows} pixels in {channels} channels",
    )
    # verifies the checksums, which the reader below does not check
    with Image.open(file) as image:
        image.verify()
    reader = io.read_image_png_u16 if depth == 16 else io.read_image_png_u8
    mode = "rgb" if channels == 3 else "mono"
    return FrameNumbers(_channel_first(np.asarray(reader(str(file), mode))), depth)


def _tiff(file: Path) -> FrameNumbers:
    """Read a frame from a TIFF file of 8 or 16 bits or of float numbers, grey or RGB; raise
    ParameterError for another file.
    """
    from kornia_rs import io

    readers = (
        (io.read_image_tiff_u16, 16),
        (io.read_image_tiff_u8, 8),
        (io.read_image_tiff_f32, None),
    )
    # memory: the file once, and three float32 numbers per pixel
    tiff_needs(file, 1.0, 3 * _NUMBER_BYTES, first=True)
    reason = ""
    for reader, depth in readers:
        for mode in ("rgb", "mono"):
            try:  # each reader looks at the kind of pixels first
                return FrameNumbers(_channel_first(np.asarray(reader(str(file), mode))), depth)
            except Exception as error:  # another kind of pixels, or a damaged file
                reason = str(error).partition("\n")[0]
    text = (
        f"{file.name} cannot be read as grey or RGB of 8 or 16 bits ({reason}): save it so, without"
        " compression"
    )
    raise ParameterError("file", text)


def _exr(file: Path) -> FrameNumbers:
    """Read a frame from an OpenEXR file, with the channels R, G and B or one channel; raise
    ParameterError for other channels.
    """
    import OpenEXR

    exr_needs(file, 4 * _NUMBER_BYTES)
    with OpenEXR.File(str(file), separate_channels=True) as picture:
        channels = {name: np.array(channel.pixels) for name, channel in picture.channels().items()}
    channel_names = ["R", "G", "B"] if {"R", "G", "B"} <= channels.keys() else list(channels)
    if len(channel_names) not in (1, 3):
        text = (
            f"{file.name} has the channels {', '.join(channels)}: save R, G and B, or one channel"
            " alone"
        )
        raise ParameterError("file", text)
    return FrameNumbers(
        np.stack([channels[name].astype(np.float64) for name in channel_names]), None
    )


def _npy(file: Path) -> FrameNumbers:
    """Read a frame from a NumPy array (y, x), (y, x, channel) or (channel, y, x); raise
    ParameterError for another array.
    """
    npy_needs(file, 1.0, _NUMBER_BYTES)
    array = np.load(file, mmap_mode="r", allow_pickle=False)
    refuse_large_array(file, array.shape)
    if array.dtype.kind not in "uif" or array.ndim not in (2, 3) or not array.size:
        text = (
            f"{file.name} is {array.dtype} of shape {array.shape}: give numbers of shape"
            f" {_ARRAY_SHAPES}"
        )
        raise ParameterError("file", text)
    if array.ndim == 3 and array.shape[0] in (1, 3):
        return FrameNumbers(np.array(array), None)
    return FrameNumbers(_channel_first(np.array(array)), None)


def _channel_first(pixels: NDArray[Any]) -> NDArray[Any]:
    """Return pixels (y, x) or (y, x, channel) with the channel first."""
    return pixels[None] if pixels.ndim == 2 else pixels.transpose(2, 0, 1)


_READERS: dict[str, Callable[[Path], FrameNumbers]] = {
    ".png": _png,
    ".tif": _tiff,
    ".tiff": _tiff,
    ".exr": _exr,
    ".npy": _npy,
}
FRAME_SUFFIXES = tuple(_READERS)  #: suffixes of files that `frame` reads
