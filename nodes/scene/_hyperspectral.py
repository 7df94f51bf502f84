"""A hyperspectral scene: measured reflectance, not reflectance lifted from three channels."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.scene._crop_to_frame import enlarged, framed
from neusee.nodes.scene._cube_files import Layout, cube_and_wavelengths, exr_size, size_and_type
from neusee.nodes.units import DataFile, Shape, Wavelength
from neusee.nodes.values import Bands

_ROUNDING = 1e-12  #: m


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
    """Read a spectral cube and interpolate the cube linearly in wavelength to `bands`.

    A spectral OpenEXR carries its wavelengths; .mat (`variable`, or the only cube in the file) and .npy need `start`
    and `stop`, the first and last of evenly spaced bands. Whole numbers are scaled by their type: 65535 becomes 1.

    Shapes: -> (band, y, x) float32, the size of the file or `shape` (scaled to cover `shape`, cropped at the centre).
    Units:  reflectance, 1 = white.
    Error:  linear interpolation: h^2/8 of the curvature, some 1e-3 for paints at 10 nm; exact on the bands of the
            file. Negative values are clipped.
    Raises: ParameterError before the run where the file does not fit the parameters; ValueError where `bands` leave
            the range of the file or values are not finite.
    Source: layout of spectral OpenEXR: Fichet, Pacanowski, Wilkie, JCGT 10(3), 2021.
    """
    cube, known = cube_and_wavelengths(file, variable, start, stop, layout)
    wanted = bands.centres.cpu().double()
    below, above = float(wanted.min()), float(wanted.max())
    first, last = float(known[0]), float(known[-1])
    if below < first - _ROUNDING or above > last + _ROUNDING:
        raise ValueError(
            f"bands from {below * 1e9:.4g} to {above * 1e9:.4g} nm, but {file.name} holds {first * 1e9:.4g} to "
            f"{last * 1e9:.4g} nm: choose bands inside that range"
        )
    if not bool(torch.isfinite(cube).all()):
        raise ValueError(
            f"{file.name} holds {int((~torch.isfinite(cube)).sum())} values that are not finite: replace them"
        )
    mixed = (_between(known, wanted).float() @ cube.flatten(1)).reshape(-1, *cube.shape[1:])
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
    if file.suffix == ".exr":
        return enlarged(exr_size(file), shape)
    if start is None or stop is None or not start < stop:
        name = "stop" if start is not None else "start"
        raise ParameterError(
            name, f"{file.name} carries no wavelengths: give start below stop, such as 400 nm and 700 nm"
        )
    size, kind = size_and_type(file, variable)
    if np.dtype(kind).kind not in "uf":
        raise ParameterError("file", f"{file.name} holds {kind}: save it as float, uint8 or uint16")
    pixels = size[:2] if layout == "y x band" else size[1:]
    return enlarged((pixels[0], pixels[1]), shape)


@hyperspectral.check
def _(result: Tensor, bands: Bands, **params: Any) -> list[Check]:
    most = float(result.max())
    return [Check(f"reflectance {float(result.min()):.3g} to {most:.3g}", most <= 1.5)]


def _between(known: Tensor, wanted: Tensor) -> Tensor:
    """Return the matrix (wanted, known) of linear interpolation."""
    right = torch.searchsorted(known, wanted).clamp(1, max(len(known) - 1, 1))
    if len(known) == 1:
        return torch.ones(len(wanted), 1, dtype=torch.float64)
    share = ((wanted - known[right - 1]) / (known[right] - known[right - 1])).clamp(0, 1)
    matrix = torch.zeros(len(wanted), len(known), dtype=torch.float64)
    matrix.scatter_(1, right[:, None], share[:, None])
    return matrix.scatter_(1, right[:, None] - 1, 1 - share[:, None])
