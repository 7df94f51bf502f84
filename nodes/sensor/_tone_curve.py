"""Signs in a file that a tone curve was applied: 8 bits, a stated gamma or colour profile, stretched numbers."""

import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from neusee.nodes.input_size import bytes_of

_BYTE = 8  #: bits of the pictures of displays, whose numbers have a tone curve
_LINEAR_GAMMA = 100_000  #: value of the chunk gAMA of a PNG that is proportional to the light
_LINEAR_TRANSFER = 8  #: code point of a linear transfer characteristic in the chunk cICP (ITU-T H.273)
_TO_SIXTEEN = {257: "stretched", 256: "shifted"}  #: factor by which numbers of 8 bits become numbers of 16
_ICC_PROFILE = 34675  #: tag of a TIFF file
_FIRST_DIRECTORY = 4096  #: entries of a TIFF directory that are looked at, at most


def tone_curve_sign(file: Path, values: NDArray[Any], depth: int | None, bits: int) -> str:
    """Return the sign of a tone curve in a picture file as the end of a sentence, or an empty text for none.

    ``depth`` are the bits of the numbers in the file, or None if it does not state them; ``bits`` those of the sensor.
    """
    if _BYTE in (depth, bits) or values.dtype.itemsize == 1:
        return "has 8 bits, as pictures with a tone curve (sRGB, gamma 2.2) have"
    if values.dtype.kind in "ui" and values.any():
        for factor, done in _TO_SIXTEEN.items():
            if not (values % factor).any():
                return f"has only multiples of {factor}: numbers of 8 bits that were {done} to 16"
    with suppress(OSError, struct.error):
        if file.suffix.lower() == ".png":
            return _png_sign(bytes_of(file))
        if file.suffix.lower() in (".tif", ".tiff"):
            return _tiff_sign(bytes_of(file))
    return ""


def _png_sign(content: bytes) -> str:
    for kind, data in _chunks(content):
        if kind == b"sRGB":
            return "says of itself that it is sRGB encoded, which is a tone curve"
        if kind == b"gAMA" and (gamma := struct.unpack(">I", data[:4])[0]) != _LINEAR_GAMMA:
            return f"states a tone curve with the gamma {_LINEAR_GAMMA / max(gamma, 1):.3g}"
        if kind == b"cICP" and data[1] != _LINEAR_TRANSFER:
            return f"states the transfer characteristic {data[1]} of ITU-T H.273, which is a tone curve"
        if kind == b"iCCP" and b"linear" not in (name := data.split(b"\0")[0]).lower():
            return f"has the colour profile {name.decode('latin-1')}, which has a tone curve"
    return ""


def _chunks(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield the kind and the data of each chunk of a PNG before its pixels."""
    place = 8
    while place + 8 <= len(content):
        length, kind = struct.unpack(">I4s", content[place : place + 8])
        if kind == b"IDAT":
            return
        yield kind, content[place + 8 : place + 8 + length]
        place += length + 12


def _tiff_sign(content: bytes) -> str:
    order = {b"II": "<", b"MM": ">"}.get(content[:2])
    if order is None or struct.unpack(f"{order}H", content[2:4])[0] != 42:
        return ""
    (first,) = struct.unpack(f"{order}I", content[4:8])
    (count,) = struct.unpack(f"{order}H", content[first : first + 2])
    for number in range(min(count, _FIRST_DIRECTORY)):
        entry = content[first + 2 + 12 * number : first + 14 + 12 * number]
        tag, _, length, place = struct.unpack(f"{order}HHII", entry)
        if tag == _ICC_PROFILE and b"linear" not in content[place : place + length].lower():
            return "has a colour profile, which has a tone curve"
    return ""
