"""A small family of nodes for tests of the recipe reader: it is imported as
``neusee.nodes.toy``.
"""

from pathlib import Path
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from neusee.nodes import ParameterError, node
from neusee.nodes.units import (
    Count,
    DataFile,
    Electrons,
    Fraction,
    Length,
    PositiveLength,
    Real,
    Shape,
    Wavelength,
)
from neusee.nodes.values import Stop


class Lens(NamedTuple):
    field: Tensor


class Spread(NamedTuple):
    intensity: Tensor
    peak: Tensor


@node()
def height(*, samples: Count = 4) -> Tensor:
    return torch.zeros(samples, samples)


@node()
def pupil(
    height: Tensor, dirt: Tensor | None = None, *, pitch: PositiveLength, diameter: Length = 1e-3
) -> Lens:
    return Lens(height if dirt is None else height * dirt)


@pupil.preflight
def _(*, pitch: float, diameter: float) -> list[str]:
    if diameter < 0:
        raise ParameterError("diameter", "must be positive: write 11 mm")
    if pitch > 1e-3:
        raise ValueError("one sample is wider than the aperture")
    return ["aperture 11.0 mm > pupil grid 8.08 mm: clipped"] if diameter > 10e-3 else []


@node()
def stop_of(height: Tensor) -> Stop:
    """Give the grid of a height map, which is known only during the run."""
    return Stop(torch.tensor(len(height)), torch.tensor(1e-5).double(), torch.tensor(1e-3).double())


@node()
def psf(pupil: Lens, *, shape: Shape = (4, 4), wavelength: Wavelength = 550e-9) -> Spread:
    return Spread(pupil.field, pupil.field.max())


@node()
def spot(psf: Spread, *, strength: Real, at: tuple[Length, Length] = (0.0, 0.0)) -> Tensor:
    return psf.intensity * strength


@node()
def gather(
    photons: Tensor, lasers: list[Tensor], ghosts: list[Tensor], *, share: Fraction = 1.0
) -> Tensor:
    return photons + sum(lasers) + sum(ghosts)


@node()
def add(photons: Tensor, *, amount: Real = 0.0) -> Tensor:
    return photons + amount


@node()
def digitize(
    electrons: Tensor,
    *,
    gain: Real,
    sigma: Electrons = 0.0,
    bits: Count = 16,
    rounding: Literal["nearest", "floor"] = "nearest",
) -> Tensor:
    return electrons / gain


@node()
def photograph(*, file: DataFile, white: Real | None = None) -> Tensor:
    return torch.zeros(2, 2)


@photograph.preflight
def _(*, file: Path, white: float | None) -> list[str]:
    if file.stat().st_size == 0:
        raise ParameterError("file", f"{file.name} is empty")
    return []
