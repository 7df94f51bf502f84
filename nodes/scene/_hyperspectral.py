"""Hyperspectral scenes from files of spectral cubes."""

from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.file_headers import mat_needs, npy_needs
from neusee.nodes.input_files import not_finite, once_per_version, refuse_large_array
from neusee.nodes.scene._exr import exr_header, read_spectral, spectral_channels
from neusee.nodes.scene._picture_changes import enlargement_notes, framed_scene
from neusee.nodes.spectra._cie_tables import Table, require_range
from neusee.nodes.units import DataFile, Shape, Wavelength
from neusee.nodes.values import Bands

# --- cube files -----------------------------------------------------------------------------------

# Reading of spectral cubes from .mat, .npy and spectral OpenEXR files.


Layout = Literal["y x band", "band y x"]
_NUMPY_TYPES = {
    "double": "float64",
    "single": "float32",
    "logical": "bool",
    "char": "str",
    "cell": "O",
    "struct": "O",
}
_NUMBER_BYTES = 4  #: bytes of a number of the resulting cube (float32)


def cube_and_wavelengths(
    file: Path, variable: str | None, start: float | None, stop: float | None, layout: Layout
) -> tuple[Tensor, Tensor]:
    """Read a spectral cube (band, y, x) float32 and its wavelengths in m from a file."""
    if file.suffix == ".exr":
        cube, wavelengths, _ = read_spectral(file)
        return cube, wavelengths
    if start is None or stop is None:
        raise ValueError(
            f"{file.name} has no wavelengths: give the first and the last wavelength in start and"
            " stop"
        )
    values = (
        _npy_values(file)
        if file.suffix == ".npy"
        else _mat_values(file, _cube_name(file, variable))
    )
    # unsigned integers are scaled so that the largest number of their type becomes 1
    scale = float(np.iinfo(values.dtype).max) if values.dtype.kind == "u" else 1.0
    band_first = np.moveaxis(values, -1, 0) if layout == "y x band" else values
    cube = torch.from_numpy(np.ascontiguousarray(band_first, dtype=np.float32)) / scale
    return cube, torch.linspace(start, stop, len(cube), dtype=torch.float64)


def size_and_type(file: Path, variable: str | None) -> tuple[tuple[int, ...], str]:
    """Read the shape and the data type of a spectral cube from the header of a file."""
    if file.suffix == ".npy":
        size, kind = _numpy_header(file)
    elif file.suffix == ".mat":
        size, kind = _mat_variables(file)[_cube_name(file, variable)]
    else:
        raise ParameterError(
            "file", f"{file.name} is not a .mat, .npy or .exr file: save the cube in such a file"
        )
    if len(size) != 3:
        raise ParameterError(
            "file", f"{file.name} holds an array of shape {size}: save a cube with three axes"
        )
    if np.dtype(kind).kind not in "uf":
        fix = "save the cube as float, uint8 or uint16"
        raise ParameterError(
            "file", f"{file.name} holds values of type {kind}, not real numbers of light: {fix}"
        )
    refuse_large_array(file, size)
    return size, kind


@once_per_version
def wrong_values(file: Path, variable: str | None) -> str:
    """Return a message for a cube that cannot be read or has values that are not finite, otherwise
    an empty text.
    """
    try:
        if file.suffix == ".exr":
            values: Any = read_spectral(file)[0].numpy()
        else:
            values = (
                _npy_values(file)
                if file.suffix == ".npy"
                else _mat_values(file, _cube_name(file, variable))
            )
    except ParameterError:
        raise
    except Exception as error:  # scipy raises many kinds of errors for damaged bytes
        return f"{file.name} cannot be read to its end ({error}): copy or save the file again"
    if np.iscomplexobj(values):
        return f"{file.name} holds complex values: save the cube as real numbers of light"
    return not_finite(file, int(np.count_nonzero(~np.isfinite(values))))


def _numpy_header(file: Path) -> tuple[tuple[int, ...], str]:
    """Return the shape and the data type in the header of a .npy file, whose data must be as
    long as stated.
    """
    npy_needs(file, 1.0, _NUMBER_BYTES)
    try:
        array = np.load(file, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError, SyntaxError) as error:
        raise ParameterError(
            "file", f"{file.name} cannot be read as .npy ({error}): save the cube again"
        ) from None
    return array.shape, str(array.dtype)


def exr_size(file: Path) -> tuple[int, int]:
    """Read the numbers of rows and columns of a cube from the header of a spectral OpenEXR file."""
    _, names, size = exr_header(file)
    if not spectral_channels(names):
        raise ParameterError(
            "file",
            f"{file.name} has the channels {', '.join(names)}: none is spectral, such as T.550,0nm",
        )
    refuse_large_array(file, (len(names), *size))
    return size


def _mat_variables(file: Path) -> dict[str, tuple[tuple[int, ...], str]]:
    """Return the shape and the data type of each variable in a .mat file."""
    from scipy.io import whosmat

    mat_needs(file)
    try:
        return {name: (size, _NUMPY_TYPES.get(kind, kind)) for name, size, kind in whosmat(file)}
    except Exception:  # scipy raises many kinds of errors for foreign bytes
        raise ParameterError(
            "file",
            f"{file.name} is not a .mat file of version 7 or older: save the cube in MATLAB"
            " with -v7",
        ) from None


def _cube_name(file: Path, variable: str | None) -> str:
    """Return the name of the variable of a .mat file that holds the cube: ``variable``, or the
    only cube.
    """
    variables = _mat_variables(file)
    # candidates: arrays with three axes
    cubes = [name for name, (size, _) in variables.items() if len(size) == 3]
    if variable in variables:
        return str(variable)
    if variable is None and len(cubes) == 1:
        return cubes[0]
    problem = (
        f"has no variable {variable!r}" if variable is not None else f"holds {len(cubes)} cubes"
    )
    raise ParameterError(
        "variable", f"{file.name} {problem}: set variable to one of {', '.join(variables)}"
    )


def _npy_values(file: Path) -> NDArray[Any]:
    npy_needs(file, 1.0, _NUMBER_BYTES)
    values: NDArray[Any] = np.load(file, allow_pickle=False)
    return values


def _mat_values(file: Path, variable: str) -> NDArray[Any]:
    from scipy.io import loadmat

    mat_needs(file)
    values: NDArray[Any] = loadmat(file, variable_names=[variable])[variable]
    return values


# --- hyperspectral --------------------------------------------------------------------------------

# Hyperspectral scenes: reflectance measured in many bands instead of reconstructed from RGB.


@node(rtol=1e-5)
def hyperspectral(
    bands: Bands,
    *,
    file: DataFile,
    variable: str | None = None,
    start: Wavelength | None = None,
    stop: Wavelength | None = None,
    layout: Layout = "y x band",
    shape: Shape | None = None,
) -> Tensor:
    """Read a spectral cube and interpolate its spectra linearly to the wavelengths of `bands`.

    A spectral OpenEXR carries its wavelengths; .mat (`variable`, or the only cube in the file) and
    .npy need `start` and `stop`, the first and last of evenly spaced bands. Whole numbers are
    scaled by their type: 65535 becomes 1.

    Shapes: -> (band, y, x) float32, the size of the file or `shape` (scaled to cover `shape`,
            cropped at the centre).
    Units:  reflectance, 1 = white.
    Error:  linear interpolation: h^2/8 of the curvature, some 1e-3 for paints at 10 nm; exact on
            the bands of the file. Negative values are clipped.
    Raises: ParameterError before the run where the file does not fit the parameters, is damaged, or
            has values that are complex or not finite; ValueError where `bands` leave the range of
            the file or values are not finite.
    Source: layout of spectral OpenEXR: Fichet, Pacanowski, Wilkie, JCGT 10(3), 2021.
    """
    cube, wavelengths = cube_and_wavelengths(file, variable, start, stop, layout)
    require_range(bands.centres, wavelengths, f"{file.name} holds")
    if count := int((~torch.isfinite(cube)).sum()):
        raise ValueError(
            f"{file.name} holds {count} values that are not finite: replace NaN and infinity by"
            " numbers"
        )
    # one matrix product for all pixels
    interpolated = (_interpolation(wavelengths, bands.centres).float() @ cube.flatten(1)).reshape(
        -1, *cube.shape[1:]
    )
    return framed_scene(interpolated, shape).clamp_min_(0).to(bands.centres.device)


@hyperspectral.preflight
def _(
    *,
    file: Path,
    variable: str | None = None,
    start: float | None = None,
    stop: float | None = None,
    layout: Layout = "y x band",
    shape: Shape | None = None,
) -> list[str]:
    if file.suffix != ".exr":
        _refuse_missing_range(file, start, stop)
    notes = enlargement_notes(rows_and_columns(file, variable, layout), shape)
    if problem := wrong_values(file, variable):
        raise ParameterError("file", problem)
    return notes


def _refuse_missing_range(file: Path, start: float | None, stop: float | None) -> None:
    """Raise ParameterError unless the first wavelength is given and below the last one."""
    if start is None or stop is None or not start < stop:
        name = "stop" if start is not None else "start"
        text = f"{file.name} has no wavelengths: give start below stop, such as 400 nm and 700 nm"
        raise ParameterError(name, text)


def rows_and_columns(file: Path, variable: str | None, layout: Layout) -> tuple[int, int]:
    """Return the numbers of rows and columns of a cube, from the header of its file."""
    if file.suffix == ".exr":
        return exr_size(file)
    size, _ = size_and_type(file, variable)
    return (size[0], size[1]) if layout == "y x band" else (size[1], size[2])


@hyperspectral.check
def _(result: Tensor, bands: Bands, **params: Any) -> list[Check]:
    highest = float(result.max())
    return [
        Check(
            f"reflectance of the scene from {float(result.min()):.3g} to {highest:.3g}",
            highest <= 1.5,
        )
    ]


def _interpolation(own: Tensor, wavelengths: Tensor) -> Tensor:
    """Return the matrix (new band, band of the file) that interpolates spectra linearly from the
    ``own`` wavelengths to ``wavelengths``.
    """
    if len(own) == 1:
        return torch.ones(len(wavelengths), 1, dtype=torch.float64)
    # interpolation of the unit vectors gives the matrix
    return Table(own, torch.eye(len(own), dtype=torch.float64)).at(wavelengths).T
