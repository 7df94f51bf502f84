"""The grid on which the pupil is sampled: the coordinates of the samples, and the samples inside the stop."""

import math
from collections.abc import Iterator
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from neusee.nodes import ParameterError
from neusee.nodes.values import Stop

_ALL = slice(None)
_STRIPE = 1 << 16  #: samples of the pupil worked on at a time
Aperture = Literal["inscribed", "clipped", "stretched"]


class PupilGrid(NamedTuple):
    """The pupil grid of a `Stop` as Python numbers instead of tensors: samples, pitch and diameter."""

    samples: int  #: number of samples along each axis
    pitch: float  #: m between samples
    diameter: float  #: m, of the clear aperture


def grid_of(stop: Stop) -> PupilGrid:
    """Return the pupil grid of a stop as Python numbers instead of tensors."""
    return PupilGrid(int(stop.samples), float(stop.pitch), float(stop.diameter))


def pupil_grid(samples: int, pitch: float, diameter: float, aperture: Aperture = "inscribed") -> PupilGrid:
    """Return the pupil grid, with the diameter or the pitch adjusted if the aperture is wider than the grid.

    `inscribed` narrows the disc to the grid, `clipped` lets the square grid cut the disc, `stretched` widens the pitch.

    Raises: ParameterError where no sample lies inside the aperture.
    """
    if aperture == "stretched":
        return PupilGrid(samples, diameter / samples, diameter)
    nearest = 0.0 if samples % 2 else pitch * math.sqrt(0.5)
    if diameter < 2 * nearest:
        needed = f"{2 * nearest * 1e6:.3g} um"
        raise ParameterError(
            "diameter", f"{diameter * 1e6:.3g} um holds no pupil sample: give {needed} or more, or a finer pitch"
        )
    return PupilGrid(samples, pitch, diameter if aperture == "clipped" else min(diameter, samples * pitch))


def clear_area(stop: Stop) -> float:
    """Return the area of the clear pupil in m2: a disc, cut by the square of the grid where the disc is wider."""
    radius, half = float(stop.diameter) / 2, float(stop.samples * stop.pitch) / 2
    if half >= radius:
        return math.pi * radius**2
    if half <= radius * math.sqrt(0.5):
        return 4 * half**2
    angle = math.acos(half / radius)
    return math.pi * radius**2 - 4 * (radius**2 * angle - half * math.sqrt(radius**2 - half**2))


def axes(grid: PupilGrid, device: torch.device | None = None) -> tuple[Tensor, Tensor]:
    """Return the coordinates v (samples, 1) and u (1, samples) in units of the stop's radius, float64."""
    steps = torch.arange(grid.samples, dtype=torch.float64, device=device) - (grid.samples - 1) / 2
    line = steps * (2 * grid.pitch / grid.diameter)
    return line[:, None], line[None, :]


def polar(grid: PupilGrid, device: torch.device | None = None) -> tuple[Tensor, Tensor]:
    """Return the radius in units of the stop's radius, and the azimuth from +u towards +v, both float64 (v, u)."""
    v, u = axes(grid, device)
    return torch.hypot(v, u), torch.atan2(v.expand(grid.samples, -1), u.expand(grid.samples, -1))


def inside(grid: PupilGrid, device: torch.device | None = None, rows: slice = _ALL) -> Tensor:
    """Return True for each sample whose centre lies inside the stop, bool (v, u); ``rows`` selects some rows."""
    v, u = axes(grid, device)
    return v[rows].square() + u.square() <= 1


def opening(grid: PupilGrid, dtype: torch.dtype, device: torch.device | None = None) -> Tensor:
    """Return the transmission (v, u) of the stop: 1 inside, 0 outside."""
    clear = torch.empty(grid.samples, grid.samples, dtype=dtype, device=device)
    for rows in stripes(grid):
        clear[rows] = inside(grid, device, rows)
    return clear


def stripes(grid: PupilGrid) -> Iterator[slice]:
    """Yield slices of a few pupil rows, short enough that float64 temporaries fit in the CPU's cache."""
    step = max(1, _STRIPE // grid.samples)
    return (slice(first, first + step) for first in range(0, grid.samples, step))


def refuse_other_grid(height: Tensor, grid: PupilGrid) -> None:
    """Raise ValueError unless the height map has the shape of the pupil grid."""
    wanted = (grid.samples, grid.samples)
    if tuple(height.shape) != wanted:
        raise ValueError(
            f"height is {tuple(height.shape)}, not the square pupil grid {wanted} of `stop`: resample the height, "
            "or compute the height from the same `stop` step"
        )
