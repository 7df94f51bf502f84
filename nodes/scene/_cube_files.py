"""Functions that read spectral cubes from .mat, .npy and spectral OpenEXR files."""

from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neusee.nodes import ParameterError
from neusee.nodes.array_bytes import mat_needs, npy_needs
from neusee.nodes.input_files import not_finite, once_per_version, refuse_large_array
from neusee.nodes.scene._spectral_exr import exr_header, read_spectral, spectral_channels

Layout = Literal["y x band", "band y x"]
_TYPES = {"double": "float64", "single": "float32", "logical": "bool", "char": "str", "cell": "O", "struct": "O"}
_SINGLE = 4  #: bytes of a number of the cube that is made


def cube_and_wavelengths(
    file: Path, variable: str | None, start: float | None, stop: float | None, layout: Layout
) -> tuple[Tensor, Tensor]:
    """Read a spectral cube (band, y, x) float32 and its wavelengths in m from a file."""
    if file.suffix == ".exr":
        cube, known, _ = read_spectral(file)
        return cube, known
    if start is None or stop is None:
        raise ValueError(f"{file.name} has no wavelengths: give the first and the last wavelength in start and stop")
    values = _npy(file) if file.suffix == ".npy" else _mat(file, _cube_name(file, variable))
    scale = float(np.iinfo(values.dtype).max) if values.dtype.kind == "u" else 1.0
    first = np.moveaxis(values, -1, 0) if layout == "y x band" else values
    cube = torch.from_numpy(np.ascontiguousarray(first, dtype=np.float32)) / scale
    return cube, torch.linspace(start, stop, len(cube), dtype=torch.float64)


def size_and_type(file: Path, variable: str | None) -> tuple[tuple[int, ...], str]:
    """Read the shape and the data type of a spectral cube from the header of a file."""
    if file.suffix == ".npy":
        size, kind = _numpy_header(file)
    elif file.suffix == ".mat":
        size, kind = _listed(file)[_cube_name(file, variable)]
    else:
        raise ParameterError("file", f"{file.name} is not a .mat, .npy or .exr file: save the cube in such a file")
    if len(size) != 3:
        raise ParameterError("file", f"{file.name} holds an array of shape {size}: save a cube with three axes")
    if np.dtype(kind).kind not in "uf":
        fix = "save the cube as float, uint8 or uint16"
        raise ParameterError("file", f"{file.name} holds values of type {kind}, not real numbers of light: {fix}")
    refuse_large_array(file, size)
    return size, kind


@once_per_version
def wrong_values(file: Path, variable: str | None) -> str:
    """Return a message for a cube that cannot be read or has values that are not finite, else an empty text."""
    try:
        if file.suffix == ".exr":
            values: Any = read_spectral(file)[0].numpy()
        else:
            values = _npy(file) if file.suffix == ".npy" else _mat(file, _cube_name(file, variable))
    except ParameterError:
        raise
    except Exception as error:  # scipy raises many kinds of errors for damaged bytes
        return f"{file.name} cannot be read to its end ({error}): copy or save the file again"
    if np.iscomplexobj(values):
        return f"{file.name} holds complex values: save the cube as real numbers of light"
    return not_finite(file, int(np.count_nonzero(~np.isfinite(values))))


def _numpy_header(file: Path) -> tuple[tuple[int, ...], str]:
    """Return the shape and the data type in the header of a .npy file, whose data must be as long as stated."""
    npy_needs(file, 1.0, _SINGLE)
    try:
        head = np.load(file, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError, SyntaxError) as error:
        raise ParameterError("file", f"{file.name} cannot be read as .npy ({error}): save the cube again") from None
    return head.shape, str(head.dtype)


def exr_size(file: Path) -> tuple[int, int]:
    """Read the numbers of rows and columns of a cube from the header of a spectral OpenEXR file."""
    _, names, size = exr_header(file)
    if not spectral_channels(names):
        raise ParameterError(
            "file", f"{file.name} has the channels {', '.join(names)}: none is spectral, such as T.550,0nm"
        )
    refuse_large_array(file, (len(names), *size))
    return size


def _listed(file: Path) -> dict[str, tuple[tuple[int, ...], str]]:
    """Return the shape and the data type of each variable in a .mat file."""
    from scipy.io import whosmat

    mat_needs(file)
    try:
        return {name: (size, _TYPES.get(kind, kind)) for name, size, kind in whosmat(file)}
    except Exception:  # scipy raises many kinds of errors for foreign bytes
        raise ParameterError(
            "file", f"{file.name} is not a .mat file of version 7 or older: save the cube in MATLAB with -v7"
        ) from None


def _cube_name(file: Path, variable: str | None) -> str:
    """Return the name of the variable of a .mat file that holds the cube: ``variable``, or the only cube."""
    variables = _listed(file)
    cubes = [name for name, (size, _) in variables.items() if len(size) == 3]
    if variable in variables:
        return str(variable)
    if variable is None and len(cubes) == 1:
        return cubes[0]
    problem = f"has no variable {variable!r}" if variable is not None else f"holds {len(cubes)} cubes"
    raise ParameterError("variable", f"{file.name} {problem}: set variable to one of {', '.join(variables)}")


def _npy(file: Path) -> NDArray[Any]:
    npy_needs(file, 1.0, _SINGLE)
    values: NDArray[Any] = np.load(file, allow_pickle=False)
    return values


def _mat(file: Path, variable: str) -> NDArray[Any]:
    from scipy.io import loadmat

    mat_needs(file)
    values: NDArray[Any] = loadmat(file, variable_names=[variable])[variable]
    return values
