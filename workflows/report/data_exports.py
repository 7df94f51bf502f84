"""Data files of a run: spectral OpenEXR, RGB OpenEXR, PNG of 16 bits and safetensors."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from torch import Tensor

from neusee.nodes.values import Bands, Psf
from neusee.workflows.engine.runner import Result
from neusee.workflows.report.contents import FILES
from neusee.workflows.report.run_pictures import DerivedFile, files_of
from neusee.workflows.store.derived_files import DerivedFiles

_VERSION = 1  #: version of the file formats; to be increased when a file is written differently


def exports(result: Result, shelf: DerivedFiles) -> tuple[dict[str, Path], dict[str, str]]:
    """Write the data files of a run; return the paths of the files, and the reason for each file that is missing."""
    outputs = {step: step for step in result.recipe.outputs}
    contents = {**FILES, "outputs.safetensors": ("safetensors", outputs)}
    files = (
        DerivedFile(name, Path(name).suffix, ("file", form, _VERSION), needs, _WRITERS[form])
        for name, (form, needs) in contents.items()
    )
    return files_of(files, result, shelf)


def spectral(cube: Tensor | Psf, bands: Bands) -> bytes:
    """Encode a spectral cube as OpenEXR in the layout of Fichet et al., JCGT 2021."""
    from neusee.nodes.scene import write_spectral

    values = cube.intensity if isinstance(cube, Psf) else cube
    return _written(".exr", lambda path: write_spectral(path, values.detach().cpu().float(), bands.centres))


def safetensors(**values: Any) -> bytes:
    """Encode the tensors of each step as safetensors; the name of a tensor is ``step`` or ``step.field``."""
    from safetensors.torch import save

    tensors: dict[str, Tensor] = {}
    for name, value in values.items():
        fields = value._asdict() if hasattr(value, "_asdict") else {"": value}
        found = {f"{name}.{k}".rstrip("."): v for k, v in fields.items() if isinstance(v, Tensor)}
        tensors |= {k: v.detach().cpu().clone(memory_format=torch.contiguous_format) for k, v in found.items()}
    return save(tensors)


def exr(image: Tensor) -> bytes:
    """Encode an RGB image (3, y, x) as a float32 OpenEXR file, or a grey image (1, y, x) with the one channel Y."""
    import OpenEXR

    values = image.detach().cpu().float().permute(1, 2, 0).contiguous().numpy()
    pixels = {"Y": values[..., 0].copy()} if len(image) == 1 else {"RGB": values}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    return _written(".exr", lambda path: OpenEXR.File(header, pixels).write(str(path)))


def png16(image: Tensor) -> bytes:
    """Encode an image of integers in [0, 65535] as a lossless 16-bit PNG: RGB for (3, y, x), grey for (1, y, x)."""
    words = image.detach().cpu().double().round()
    if image.ndim != 3 or image.shape[0] not in (1, 3) or float(words.min()) < 0 or float(words.max()) > 65535:
        raise ValueError(
            "a 16-bit PNG needs shape (3, y, x) or (1, y, x) and values in [0, 65535]; this image has shape "
            f"{tuple(image.shape)}"
        )
    height, width = image.shape[1:]
    big = words.permute(1, 2, 0).to(torch.int32).numpy().astype(">u2").reshape(height, -1)
    lines = b"".join(b"\0" + row.tobytes() for row in big)
    head = struct.pack(">IIBBBBB", width, height, 16, 2 if len(image) == 3 else 0, 0, 0, 0)
    chunks = ((b"IHDR", head), (b"IDAT", zlib.compress(lines, 6)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(*c) for c in chunks)


def srgb(image: Tensor, source: Path, draws: int) -> bytes:
    """Encode a restored picture in linear sRGB, white 1, as an sRGB PNG of 16 bits that names the frame."""
    from neusee.workflows.report.figures.style import encoded

    codes = torch.from_numpy(encoded(image)).permute(2, 0, 1) * 65535.0
    return _named(png16(codes), source, draws)


def marked(marked: Tensor, source: Path, draws: int) -> bytes:
    """Encode the pixels with a marked channel as white on black, as a PNG that names the frame."""
    return _named(png16(marked.any(0, keepdim=True) * 65535.0), source, draws)


def _named(png: bytes, source: Path, draws: int) -> bytes:
    """Return a PNG with text chunks that name the frame, and the number of draws of the interval beside it."""
    header = 8 + 12 + 13
    texts = {b"Source": source.name, b"Comment": f"restored by neusee; interval of each pixel from {draws} draws"}
    chunks = (_chunk(b"tEXt", name + b"\0" + text.encode("latin-1", "replace")) for name, text in texts.items())
    return png[:header] + b"".join(chunks) + png[header:]


def _chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


def _written(suffix: str, write: Callable[[Path], Any]) -> bytes:
    """Let the function ``write`` write a temporary file, and return the bytes of this file."""
    with TemporaryDirectory(prefix="neusee-") as folder:
        path = Path(folder) / f"file{suffix}"
        write(path)
        return path.read_bytes()


_WRITERS: dict[str, Callable[..., bytes]] = {
    "spectral": spectral,
    "exr": exr,
    "png16": png16,
    "srgb": srgb,
    "marked": marked,
    "safetensors": safetensors,
}
