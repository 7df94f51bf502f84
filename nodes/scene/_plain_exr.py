"""Uncompressed OpenEXR files of one part, written line by line in a few megabytes of memory beside the planes.

Noise and the tails of a PSF do not compress: ZIP saves 0.7 % of a stack of PSFs, and takes ten times as long as a copy.
The layout is that of OpenEXR 2 (OpenEXR file layout, 2013, scan line images): a header, the table of the offsets of the
lines, and for each line its number, its size, and the pixels of one channel after another.
"""

import struct
from collections.abc import Mapping, Sequence
from itertools import accumulate, repeat
from pathlib import Path
from typing import IO, Any

import numpy as np
from torch import Tensor

_MAGIC, _VERSION, _LONG_NAMES = 20000630, 2, 0x400
_HALF, _FLOAT = 1, 2  #: numbers of the types of a channel
_LARGEST_HALF = 65504.0
_AT_ONCE = 1 << 23  #: bytes of lines that are written together


def write_lines(path: Path | str, names: Sequence[str], cube: Tensor, header: Mapping[str, Any], half: bool) -> None:
    """Write planes (channel, y, x) as float32, or with ``half`` as float16, under the channel names ``names``.

    ``header`` has texts and numbers. Raises: ValueError for ``half`` and a value beyond the range of float16.
    """
    order = sorted(range(len(names)), key=lambda i: names[i].encode())
    planes = [cube[i].detach().cpu().float().numpy() for i in order]
    if half and any(np.abs(plane).max(initial=0.0, where=np.isfinite(plane)) > _LARGEST_HALF for plane in planes):
        raise ValueError(f"values beyond {_LARGEST_HALF:.0f} cannot be written as half floats: write float32")
    height, width = cube.shape[-2:]
    kind = np.dtype("<f2" if half else "<f4")
    size = len(names) * width * kind.itemsize
    start = _head([names[i] for i in order], (height, width), header, half)
    offsets = accumulate(repeat(8 + size, height - 1), initial=len(start) + 8 * height)
    with open(path, "wb") as file:
        file.write(start + np.fromiter(offsets, "<u8", height).tobytes())
        _write_pixels(file, planes, size, kind)


def _write_pixels(file: IO[bytes], planes: Sequence[Any], size: int, kind: Any) -> None:
    """Write the lines of the planes, each after its number and its size in bytes."""
    height, width = planes[0].shape
    rows = max(1, min(height, _AT_ONCE // (8 + size)))
    lines = np.empty((rows, 8 + size), np.uint8)
    numbers, pixels = lines[:, :8].view("<i4"), lines[:, 8:].view(kind).reshape(rows, len(planes), width)
    numbers[:, 1] = size
    for top in range(0, height, rows):
        count = min(rows, height - top)
        numbers[:count, 0] = np.arange(top, top + count)
        for i, plane in enumerate(planes):
            pixels[:count, i] = plane[top : top + count]
        file.write(lines[:count].data)


def _head(names: Sequence[str], shape: tuple[int, int], header: Mapping[str, Any], half: bool) -> bytes:
    """Return the bytes of an OpenEXR file before its table of offsets."""
    kind, (height, width) = _HALF if half else _FLOAT, shape
    listed = b"".join(name.encode() + b"\0" + struct.pack("<i4xii", kind, 1, 1) for name in names) + b"\0"
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    parts = {
        "channels": ("chlist", listed),
        "compression": ("compression", b"\0"),
        "dataWindow": ("box2i", window),
        "displayWindow": ("box2i", window),
        "lineOrder": ("lineOrder", b"\0"),
        "pixelAspectRatio": ("float", struct.pack("<f", 1.0)),
        "screenWindowCenter": ("v2f", struct.pack("<2f", 0.0, 0.0)),
        "screenWindowWidth": ("float", struct.pack("<f", 1.0)),
        **{name: _attribute(value) for name, value in header.items()},
    }
    longest = max(len(name.encode()) for name in (*names, *parts))
    flags = _VERSION | (_LONG_NAMES if longest > 31 else 0)
    texts = (f"{name}\0{form}\0".encode() + struct.pack("<i", len(raw)) + raw for name, (form, raw) in parts.items())
    return struct.pack("<2i", _MAGIC, flags) + b"".join(texts) + b"\0"


def _attribute(value: Any) -> tuple[str, bytes]:
    """Return the type and the bytes of an attribute of the header."""
    return ("float", struct.pack("<f", value)) if isinstance(value, float) else ("string", str(value).encode())
