"""Data files of a run: spectral OpenEXR, RGB OpenEXR, PNG of 16 bits and safetensors.

Each file is written once, piece by piece, directly at its final place. Stacks of planes are not
compressed, because noise and the wings of PSFs hardly compress.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neusee.nodes.scene import write_spectral
from neusee.nodes.values import Bands, Psf
from neusee.workflows.engine.runner import Result
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.report import contents
from neusee.workflows.report.figures.style import encoded
from neusee.workflows.report.run_pictures import DerivedFile, files_of
from neusee.workflows.store.derived_files import DerivedFiles
from neusee.workflows.store.serialization import bytes_of, tensor_kind

_VERSION = 2  #: version of the file formats; to be increased when a file is written differently
_COPIED = ("spectral", "safetensors")  #: formats without compression
_AT_ONCE = 1 << 22  #: values of an image that are encoded together


def exports(result: Result, shelf: DerivedFiles) -> tuple[dict[str, Path], dict[str, str]]:
    """Write the data files of a run; return the paths of the files, and the reason for each file
    that is missing.
    """
    return files_of(data_files(result.recipe), result, shelf)


def data_files(recipe: Recipe) -> Iterator[DerivedFile]:
    """Yield the data files that a recipe requests."""
    for name, (file_format, needs) in contents.files_of(recipe).items():
        in_16_bits = recipe.exports is not None and recipe.exports[name]
        kind = ("file", file_format, _VERSION, *(["half"] if in_16_bits else []))
        write = partial(_WRITERS[file_format], half=True) if in_16_bits else _WRITERS[file_format]
        yield DerivedFile(
            name, Path(name).suffix, kind, needs, write, copied=file_format in _COPIED
        )


def spectral(path: Path, /, *, cube: Tensor | Psf, bands: Bands, half: bool = False) -> None:
    """Write a spectral cube as OpenEXR in the layout of Fichet et al., JCGT 2021, with ``half`` in
    16 bits per value.
    """
    values = cube.intensity if isinstance(cube, Psf) else cube
    write_spectral(path, values, bands.centres, half=half)


def safetensors(path: Path, /, **values: Any) -> None:
    """Write the tensors of each step as safetensors; the name of a tensor is ``step`` or
    ``step.field``.
    """
    tensors: dict[str, Tensor] = {}
    for name, value in values.items():
        fields = value._asdict() if hasattr(value, "_asdict") else {"": value}
        tensors |= {
            f"{name}.{field_name}".rstrip("."): field_value
            for field_name, field_value in fields.items()
            if isinstance(field_value, Tensor)
        }
    header, offset = dict[str, Any](), 0
    for name, tensor in tensors.items():
        header[name] = {
            "dtype": tensor_kind(tensor),
            "shape": list(tensor.shape),
            "data_offsets": [offset, offset + tensor.nbytes],
        }
        offset += tensor.nbytes
    header_text = json.dumps(header, separators=(",", ":")).encode()
    # the data begin at a multiple of 8 bytes
    header_text += b" " * (-len(header_text) % 8)
    with path.open("wb") as file:
        # length of the header in 8 bytes, header, then the data
        file.write(len(header_text).to_bytes(8, "little") + header_text)
        for tensor in tensors.values():
            file.write(bytes_of(tensor))


def exr(path: Path, /, *, image: Tensor, half: bool = False) -> None:
    """Write an RGB image (3, y, x) as an OpenEXR file, or a grey image (1, y, x) with the one
    channel Y.

    Pixels are float32, or float16 with ``half``. Raises ValueError for ``half`` and a value beyond
    float16.
    """
    import OpenEXR

    if half and float(image.detach().abs().max()) > torch.finfo(torch.float16).max:
        raise ValueError("values beyond 65504 cannot be written as half floats: write float32")
    values = (
        image.detach()
        .cpu()
        .to(torch.float16 if half else torch.float32)
        .permute(1, 2, 0)
        .contiguous()
        .numpy()
    )
    pixels = {"Y": values[..., 0].copy()} if len(image) == 1 else {"RGB": values}
    header = {"compression": OpenEXR.PIZ_COMPRESSION, "type": OpenEXR.scanlineimage}
    try:
        OpenEXR.File(header, pixels).write(str(path))
    except RuntimeError as error:  # such as a full disk
        raise OSError(str(error)) from error


def png16(path: Path, /, *, image: Tensor) -> None:
    """Write an image of integers in [0, 65535] as a lossless 16-bit PNG: RGB for (3, y, x), grey
    for (1, y, x).
    """
    path.write_bytes(_png16(image))


def _png16(image: Tensor) -> bytes:
    """Return an image as the bytes of a PNG of 16 bits; raise `ValueError` for an unsuitable image.

    A PNG is a signature and chunks: header (IHDR), compressed lines (IDAT) and end (IEND).
    """
    smallest, largest = (float(limit) for limit in image.aminmax()) if image.numel() else (0.0, 0.0)
    if (
        image.ndim != 3
        or image.shape[0] not in (1, 3)
        or not (smallest >= 0 and round(largest) <= 65535)
    ):
        raise ValueError(
            "a 16-bit PNG needs shape (3, y, x) or (1, y, x) and values in [0, 65535]; this image"
            f" has shape {tuple(image.shape)}"
        )
    height, width = image.shape[1:]
    # size, 16 bits, colour type 2 (RGB) or 0 (grey), and the usual methods
    header = struct.pack(">IIBBBBB", width, height, 16, 2 if len(image) == 3 else 0, 0, 0, 0)
    chunks = (
        (b"IHDR", header),
        (b"IDAT", b"".join(_compressed(image.detach().cpu()))),
        (b"IEND", b""),
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(*chunk) for chunk in chunks)


def _compressed(image: Tensor) -> Iterator[bytes]:
    """Yield the compressed lines of a PNG of 16 bits, each as differences from the pixel at the
    left.

    For a picture with noise the differences compress better than the pixels. Run lengths and code
    lengths alone take a third of the time of a full search for repetitions, and no more bytes.
    """
    import numpy as np

    # level 6, largest window and memory, runs only
    compressor, (planes, height, width) = (
        zlib.compressobj(6, zlib.DEFLATED, 15, 9, zlib.Z_RLE),
        image.shape,
    )
    rows = max(1, _AT_ONCE // (planes * width))
    for first_row in range(0, height, rows):
        # PNG has two bytes a value, the higher one first
        big_endian_rows = (
            image[:, first_row : first_row + rows]
            .double()
            .round()
            .permute(1, 2, 0)
            .to(torch.int32)
            .contiguous()
            .numpy()
            .astype(">u2")
        )
        bytes_of_pixels = big_endian_rows.view(np.uint8).reshape(
            len(big_endian_rows), width, 2 * planes
        )
        # 1: difference from the left
        filtered_lines = np.ones((len(big_endian_rows), 1 + 2 * planes * width), np.uint8)
        filtered_lines[:, 1:] = np.diff(bytes_of_pixels, axis=1, prepend=np.uint8(0)).reshape(
            len(big_endian_rows), -1
        )
        yield compressor.compress(filtered_lines.data)
    yield compressor.flush()


def srgb(path: Path, /, *, image: Tensor, source: Path, draws: int) -> None:
    """Write a restored picture in linear sRGB, white 1, as an sRGB PNG of 16 bits that names the
    frame.
    """
    codes = torch.from_numpy(encoded(image)).permute(2, 0, 1) * 65535.0
    path.write_bytes(_named(_png16(codes), source, draws, _chunk(b"sRGB", b"\0")))


def marked(path: Path, /, *, marked: Tensor, source: Path, draws: int) -> None:
    """Write the pixels with a marked channel as white on black, as a PNG that names the frame."""
    path.write_bytes(_named(_png16(marked.any(0, keepdim=True) * 65535.0), source, draws))


def _named(png: bytes, source: Path, draws: int, coding: bytes = b"") -> bytes:
    """Return a PNG with text chunks that name the frame, and the number of draws for the interval
    beside it.

    ``coding`` is a chunk that states how the numbers are encoded.
    """
    # signature, and the chunk IHDR: 12 bytes around its 13
    header_end = 8 + 12 + 13
    texts = {
        b"Source": source.name,
        b"Comment": f"restored by neusee; interval of each pixel from {draws} draws",
    }
    chunks = (
        _chunk(b"tEXt", name + b"\0" + text.encode("latin-1", "replace"))
        for name, text in texts.items()
    )
    return png[:header_end] + coding + b"".join(chunks) + png[header_end:]


def _chunk(name: bytes, body: bytes) -> bytes:
    """Return a chunk of a PNG: length, name, body, and the checksum of name and body."""
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


_WRITERS: dict[str, Callable[..., None]] = {
    "spectral": spectral,
    "exr": exr,
    "png16": png16,
    "srgb": srgb,
    "marked": marked,
    "safetensors": safetensors,
}
