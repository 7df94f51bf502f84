"""Files with the height map of a mask: .npy, .safetensors, grey .png, .exr and .mat.

In addition to the heights, a file other than .npy may state three lengths, each as a text with a
unit, such as ``1 um``: ``unit``, the height of the value 1; ``depth``, the height of white in a
.png; and ``pitch``, the distance between samples. They are read from the metadata of .safetensors,
text chunks of .png, the header of .exr and variables of .mat.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neusee.nodes import ParameterError
from neusee.nodes.file_headers import mat_needs, npy_needs, picture_needs, safetensors_need
from neusee.nodes.input_files import (
    head_of,
    once_per_version,
    refuse_large_array,
    refuse_other_than_file,
)
from neusee.nodes.scene._exr import exr_header, exr_parts
from neusee.nodes.units import read_quantity

if TYPE_CHECKING:
    from PIL.Image import Image

#: grey level of white, by Pillow mode
_WHITE_LEVELS = {"L": 255, "I;16": 65535, "I;16B": 65535, "I": 65535}
#: lengths that a file may state in addition to the heights
_STATED_LENGTHS = ("unit", "depth", "pitch")
_HALF_TYPES = ("float16", "F16", "BF16")  #: names of data types with only 8 or 11 bits of precision
_BYTES_OF_HEIGHT = 4  #: bytes of a height in float32
_MAT_73 = b"MATLAB 7.3 MAT-file"
_REAL_MAT_TYPES = {
    "double",
    "single",
    "int8",
    "int16",
    "int32",
    "int64",
    "uint8",
    "uint16",
    "uint32",
    "uint64",
    "logical",
}


class MapHeader(NamedTuple):
    """The size of a height map in a file, and the lengths in m that the file states."""

    shape: tuple[int, ...]
    stated: dict[str, float]  #: some of ``unit``, ``depth`` and ``pitch``


def size_metadata(pitch: float) -> dict[str, str]:
    """Return the metadata, for `map_header`, of a .safetensors file whose samples are ``pitch`` m
    apart.
    """
    return {"pitch": f"{pitch * 1e6:.12g} um"}


@once_per_version
def map_header(file: Path) -> MapHeader:
    """Return the header of a height map in a file without reading the heights."""
    from safetensors import SafetensorError

    suffix = file.suffix.lower()
    if suffix not in _HEADERS:
        raise ParameterError(
            "file",
            f"{file.name}: a height map is read from .exr, .mat, .npy, .safetensors or grey .png",
        )
    refuse_other_than_file(file)
    try:
        header: MapHeader = _HEADERS[suffix](file)
    except ParameterError:
        raise
    except (SafetensorError, OSError, ValueError, EOFError, SyntaxError, RuntimeError) as error:
        raise ParameterError(
            "file", f"{file.name} cannot be read as a height map: {error}"
        ) from error
    refuse_large_array(file, header.shape)
    return header


def read_height_map(file: Path, depth: float, unit: float = 1.0) -> Tensor:
    """Read a height map in m, float32, from a file.

    ``depth`` is the height of white in a picture, and ``unit`` the height of the value 1 in any
    other file.
    """
    suffix = file.suffix.lower()
    if suffix == ".png":
        with _grey_picture(file) as picture:
            levels = torch.from_numpy(np.asarray(picture, dtype=np.float64))
            return (levels * (depth / _WHITE_LEVELS[picture.mode])).to(torch.float32)
    values = _numbers_of_file(file, suffix)
    return values.to(torch.float32) if unit == 1.0 else (values.double() * unit).to(torch.float32)


def _numbers_of_file(file: Path, suffix: str) -> Tensor:
    """Return the values of a height map in a file other than .png, in the data type of the file."""
    if suffix == ".safetensors":
        from safetensors.torch import load_file

        safetensors_need(file, 2.0)
        tensors = load_file(file)
        return tensors[_height_name(file, list(tensors))]
    if suffix == ".exr":
        with exr_parts(file) as opened:
            channels = opened.channels()
            return torch.from_numpy(np.array(channels[_height_name(file, list(channels))].pixels))
    if suffix == ".mat":
        values = _mat_value(file, _mat_name(file))
    else:
        npy_needs(file, 1.0, _BYTES_OF_HEIGHT)
        values = np.load(file, allow_pickle=False)
    return torch.from_numpy(np.ascontiguousarray(_as_torch_needs(values)))


def _stated_lengths(file: Path, header: dict[str, Any]) -> dict[str, float]:
    """Return the lengths, in m, that the header of a file states as texts with a unit."""
    lengths = {}
    for word in _STATED_LENGTHS:
        if word in header:
            try:
                lengths[word] = read_quantity(header[word], "m")
            except ValueError as error:
                raise ParameterError(
                    "file", f"{file.name}: {word} = {header[word]} in the header {error}"
                ) from None
            if lengths[word] <= 0:
                raise ParameterError(
                    "file", f"{file.name}: {word} = {header[word]} in the header must be above 0"
                )
    return lengths


def _npy_header(file: Path) -> MapHeader:
    """Return the header of a .npy file."""
    npy_needs(file, 1.0, _BYTES_OF_HEIGHT)
    header_array = np.load(file, mmap_mode="r", allow_pickle=False)
    _refuse_other_than_numbers(file, str(header_array.dtype), header_array.dtype.kind in "fiu")
    return MapHeader(tuple(header_array.shape), {})


def _safetensors_header(file: Path) -> MapHeader:
    """Return the header of a .safetensors file."""
    from safetensors import safe_open

    safetensors_need(file, 2.0)
    with safe_open(file, framework="pt") as tensors:
        heights = tensors.get_slice(_height_name(file, list(tensors.keys())))
        number_type = str(heights.get_dtype())
        _refuse_other_than_numbers(file, number_type, number_type.startswith(("F", "BF", "I", "U")))
        return MapHeader(
            tuple(heights.get_shape()), _stated_lengths(file, tensors.metadata() or {})
        )


def _png_header(file: Path) -> MapHeader:
    """Return the header of a grey .png file, whose text chunks may state lengths."""
    with _grey_picture(file) as picture:
        return MapHeader(
            (picture.height, picture.width),
            _stated_lengths(file, {str(word): text for word, text in picture.info.items()}),
        )


def _exr_header(file: Path) -> MapHeader:
    """Return the header of an .exr file; its values are read to determine their data type."""
    header, _, size = exr_header(file)
    refuse_large_array(file, size)
    _refuse_other_than_numbers(
        file, str(_numbers_of_file(file, ".exr").dtype).removeprefix("torch."), real=True
    )
    return MapHeader(size, _stated_lengths(file, header))


def _mat_header(file: Path) -> MapHeader:
    """Return the header of a .mat file."""
    name = _mat_name(file)
    size, number_type = _mat_variables(file)[name]
    _refuse_other_than_numbers(file, number_type, number_type in _REAL_MAT_TYPES)
    # the header of a .mat file does not tell complex values from real ones
    if np.iscomplexobj(_mat_value(file, name)):
        _refuse_other_than_numbers(file, "complex", real=False)
    words = {
        word: _mat_value(file, word) for word in _STATED_LENGTHS if word in _mat_variables(file)
    }
    return MapHeader(
        size,
        _stated_lengths(
            file, {word: " ".join(map(str, np.ravel(text))) for word, text in words.items()}
        ),
    )


_HEADERS = {
    ".npy": _npy_header,
    ".safetensors": _safetensors_header,
    ".png": _png_header,
    ".exr": _exr_header,
    ".mat": _mat_header,
}


def _refuse_other_than_numbers(file: Path, kind: str, real: bool) -> None:
    """Raise ParameterError for a data type that is not real, or too coarse for heights."""
    if not real:
        text = f"{file.name} holds values of type {kind}: save the heights as real numbers, in m"
        raise ParameterError("file", text)
    if kind in _HALF_TYPES:
        resolution_text = "which resolve 1/2000 of a height, and no height below 0.06 um in m"
        raise ParameterError(
            "file",
            f"{file.name} holds 16-bit floats ({kind}), {resolution_text}: save 32-bit floats",
        )


def _grey_picture(file: Path) -> "Image":
    """Open a greyscale picture file; raise ParameterError for a picture that is not greyscale."""
    from PIL import Image

    refuse_other_than_file(file)
    picture = Image.open(file)
    if picture.mode not in _WHITE_LEVELS:
        picture.close()
        raise ParameterError(
            "file",
            f"{file.name} is {picture.mode}, not grey: store one grey level per sample, in 8 or 16"
            " bits",
        )
    picture_needs(
        file, picture, 8 + 8 + _BYTES_OF_HEIGHT
    )  # bytes per pixel: levels and heights in float64, and the result
    return picture


def _height_name(file: Path, names: list[str]) -> str:
    """Return the name of the height map among the arrays of a file: `height`, or the name of the
    only array.
    """
    if "height" in names or len(names) == 1:
        return "height" if "height" in names else names[0]
    tensors = ", ".join(sorted(names)) or "nothing"
    raise ParameterError(
        "file", f"{file.name} holds {tensors}: name the tensor of the height map 'height'"
    )


def _mat_variables(file: Path) -> dict[str, tuple[tuple[int, ...], str]]:
    """Return the shape and the type of each variable of a .mat file."""
    from scipy.io import whosmat

    if head_of(file, len(_MAT_73)) == _MAT_73:
        fix = f"save it in MATLAB by save('{file.name}', 'height', '-v7')"
        raise ParameterError(
            "file", f"{file.name} is a .mat file of version 7.3, which is HDF5: {fix}"
        )
    mat_needs(file)
    try:
        return {name: (tuple(size), kind) for name, size, kind in whosmat(file)}
    except Exception as error:  # scipy raises many kinds of errors for foreign bytes
        raise ParameterError(
            "file", f"{file.name} cannot be read as a .mat file: {error}"
        ) from None


def _mat_name(file: Path) -> str:
    """Return the name of the height map among the variables of a .mat file, texts with lengths
    aside.
    """
    return _height_name(
        file,
        [
            name
            for name, (_, kind) in _mat_variables(file).items()
            if name not in _STATED_LENGTHS or kind != "char"
        ],
    )


def _mat_value(file: Path, name: str) -> NDArray[Any]:
    """Return the values of one variable of a .mat file."""
    from scipy.io import loadmat

    mat_needs(file)
    values: NDArray[Any] = loadmat(file, variable_names=[name])[name]
    return values


def _as_torch_needs(values: NDArray[Any]) -> NDArray[Any]:
    """Return values as torch needs them: in native byte order, with at most 64 bits."""
    if values.dtype.kind == "f" and values.dtype.itemsize > 8:
        return values.astype(np.float64)
    return values.astype(values.dtype.newbyteorder("="), copy=False)
