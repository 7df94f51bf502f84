"""Hyperspectral scenes: reflectance measured in many bands instead of reconstructed from RGB."""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.scene._crop_to_frame import enlarged, framed
from neusee.nodes.scene._cube_files import Layout, cube_and_wavelengths, exr_size, size_and_type, wrong_values
from neusee.nodes.spectra._spectral_tables import Table, require_range
from neusee.nodes.units import DataFile, Shape, Wavelength
from neusee.nodes.values import Bands


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

    A spectral OpenEXR carries its wavelengths; .mat (`variable`, or the only cube in the file) and .npy need `start`
    and `stop`, the first and last of evenly spaced bands. Whole numbers are scaled by their type: 65535 becomes 1.

    Shapes: -> (band, y, x) float32, the size of the file or `shape` (scaled to cover `shape`, cropped at the centre).
    Units:  reflectance, 1 = white.
    Error:  linear interpolation: h^2/8 of the curvature, some 1e-3 for paints at 10 nm; exact on the bands of the
            file. Negative values are clipped.
    Raises: ParameterError before the run where the file does not fit the parameters, is damaged, or has values that are
            complex or not finite; ValueError where `bands` leave the range of the file or values are not finite.
    Source: layout of spectral OpenEXR: Fichet, Pacanowski, Wilkie, JCGT 10(3), 2021.
    """
    cube, known = cube_and_wavelengths(file, variable, start, stop, layout)
    require_range(bands.centres, known, f"{file.name} holds")
    if wrong := int((~torch.isfinite(cube)).sum()):
        raise ValueError(f"{file.name} holds {wrong} values that are not finite: replace NaN and infinity by numbers")
    mixed = (_interpolation(known, bands.centres).float() @ cube.flatten(1)).reshape(-1, *cube.shape[1:])
    return framed(mixed, shape).clamp_min_(0).to(bands.centres.device)


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
    notes = enlarged(rows_and_columns(file, variable, layout), shape)
    if problem := wrong_values(file, variable):
        raise ParameterError("file", problem)
    return notes


def _refuse_missing_range(file: Path, start: float | None, stop: float | None) -> None:
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
    most = float(result.max())
    return [Check(f"reflectance of the scene from {float(result.min()):.3g} to {most:.3g}", most <= 1.5)]


def _interpolation(known: Tensor, wavelengths: Tensor) -> Tensor:
    """Return the matrix that interpolates spectra linearly from the ``known`` wavelengths to ``wavelengths``."""
    if len(known) == 1:
        return torch.ones(len(wavelengths), 1, dtype=torch.float64)
    return Table(known, torch.eye(len(known), dtype=torch.float64)).at(wavelengths).T
