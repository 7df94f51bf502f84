"""The stop and its grid: the only place that decides pitch and diameter of the pupil."""

import math
from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from neusee.nodes import ParameterError

_ALL = slice(None)
_STRIPE = 1 << 16  #: samples of the pupil worked on at a time
Aperture = Literal["inscribed", "clipped", "stretched"]


class Stop(NamedTuple):
    """The geometry of a round stop on a square grid whose sample j lies at (j - (samples - 1) / 2) * pitch."""

    samples: int  #: number along each axis
    pitch: float  #: m
    diameter: float  #: m, of the clear aperture


def stop(samples: int, pitch: float, diameter: float, aperture: Aperture = "inscribed") -> Stop:
    """Return the stop with pitch and diameter decided, also where the aperture is wider than its grid.

    `inscribed` narrows the disc to the grid, `clipped` lets the square grid cut the disc, `stretched` widens the pitch.

    Raises: ParameterError where no sample lies inside the aperture.
    """
    if aperture == "stretched":
        return Stop(samples, diameter / samples, diameter)
    nearest = 0.0 if samples % 2 else pitch * math.sqrt(0.5)
    if diameter < 2 * nearest:
        needed = f"{2 * nearest * 1e6:.3g} um"
        raise ParameterError(
            "diameter", f"{diameter * 1e6:.3g} um holds no pupil sample: give {needed} or more, or a finer pitch"
        )
    return Stop(samples, pitch, diameter if aperture == "clipped" else min(diameter, samples * pitch))


def axes(grid: Stop, device: torch.device | None = None) -> tuple[Tensor, Tensor]:
    """Return coordinates in units of the stop's radius, float64: v (samples, 1) and u (1, samples)."""
    steps = torch.arange(grid.samples, dtype=torch.float64, device=device) - (grid.samples - 1) / 2
    line = steps * (2 * grid.pitch / grid.diameter)
    return line[:, None], line[None, :]


def polar(grid: Stop, device: torch.device | None = None) -> tuple[Tensor, Tensor]:
    """Return radius in units of the stop's radius and azimuth from +u towards +v, both float64 (v, u)."""
    v, u = axes(grid, device)
    return torch.hypot(v, u), torch.atan2(v.expand(grid.samples, -1), u.expand(grid.samples, -1))


def inside(grid: Stop, device: torch.device | None = None, rows: slice = _ALL) -> Tensor:
    """Return True for each sample whose centre lies inside the stop, bool (v, u); ``rows`` selects some rows."""
    v, u = axes(grid, device)
    return v[rows].square() + u.square() <= 1


def opening(grid: Stop, dtype: torch.dtype, device: torch.device | None = None) -> Tensor:
    """Return the stop as numbers (v, u): 1 inside, 0 outside."""
    clear = torch.empty(grid.samples, grid.samples, dtype=dtype, device=device)
    for rows in stripes(grid):
        clear[rows] = inside(grid, device, rows)
    return clear


def stripes(grid: Stop) -> Iterator[slice]:
    """Yield slices of a few pupil rows, so that float64 temporaries of each slice fit in the cache."""
    step = max(1, _STRIPE // grid.samples)
    return (slice(first, first + step) for first in range(0, grid.samples, step))


def grid_notes(*, samples: int, pitch: float, diameter: float, aperture: Aperture, **_: Any) -> list[str]:
    """Return notes for a preflight on how an aperture that does not fit its grid is changed."""
    grid = stop(samples, pitch, diameter, aperture)
    wanted, span = f"{diameter * 1e3:#.3g} mm", f"{samples * pitch * 1e3:#.3g} mm"
    if aperture != "stretched" and diameter > samples * pitch * (1 + 1e-9):
        open_ = f"a disc of {span}" if aperture == "inscribed" else "a disc cut square"
        return [f"aperture {wanted} > pupil grid {span}: {aperture}, {open_}; see reading.aperture"]
    if not math.isclose(grid.pitch, pitch):
        change = f"{pitch * 1e6:#.3g} -> {grid.pitch * 1e6:#.3g} um"
        return [f"aperture {wanted} over pupil grid {span}: pitch stretched {change}, see reading.aperture"]
    return []
