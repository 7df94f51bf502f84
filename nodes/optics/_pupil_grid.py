"""The stop of the lens, and the grid on which the pupil is sampled."""

import math
from collections.abc import Iterator
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.units import Diameter, PupilPitch
from neusee.nodes.values import Stop

# --- pupil grid -----------------------------------------------------------------------------------

# The grid on which the pupil is sampled: the coordinates of the samples, and the samples inside the
# stop.


_ALL = slice(None)
_STRIPE_SAMPLES = 1 << 16  #: number of pupil samples that are processed at a time
_ROUNDED_LENGTH = 1e-9  #: largest relative difference of two lengths that counts as rounding
Aperture = Literal["held", "stretched", "inscribed", "clipped"]
Number = TypeVar("Number", float, Tensor)


class PupilGrid(NamedTuple):
    """The pupil grid of a `Stop` as Python numbers instead of tensors: samples, pitch and
    diameter.
    """

    samples: int  #: number of samples along each axis
    pitch: float  #: m between samples
    diameter: float  #: m, of the clear aperture


def grid_of(stop: Stop) -> PupilGrid:
    """Return the pupil grid of a stop as Python numbers instead of tensors."""
    return PupilGrid(int(stop.samples), float(stop.pitch), float(stop.diameter))


def pupil_grid(
    samples: int, pitch: float | None, diameter: float, aperture: Aperture = "held"
) -> PupilGrid:
    """Return the pupil grid of an aperture; without a ``pitch`` the grid is as wide as the
    aperture.

    ``aperture`` selects what happens if grid and aperture differ in width. `held`: a wider aperture
    is refused. `stretched`: the pitch is changed so that the grid is as wide as the aperture.
    `inscribed`: a wider aperture is narrowed to the grid. `clipped`: the square grid cuts a wider
    aperture.

    Raises: ParameterError where no sample lies inside the aperture, and for `held` where the
            aperture is wider than the grid.
    """
    if pitch is None or (
        aperture == "stretched"
        and not math.isclose(samples * pitch, diameter, rel_tol=_ROUNDED_LENGTH)
    ):
        return PupilGrid(samples, diameter / samples, diameter)
    grid_width = samples * pitch
    # distance of the nearest sample from the axis: 0 for an odd grid, half a diagonal for an even
    nearest_sample = 0.0 if samples % 2 else pitch * math.sqrt(0.5)
    if diameter < 2 * nearest_sample:
        needed = f"{2 * nearest_sample * 1e6:.3g} um"
        raise ParameterError(
            "diameter",
            f"{diameter * 1e6:.3g} um holds no pupil sample: give {needed} or more, or a finer"
            " pitch",
        )
    if aperture == "held" and is_wider(diameter, grid_width):
        text = (
            f"{millimetres(diameter)} is wider than the pupil grid of {samples} x"
            f" {pitch * 1e6:.4g} um"
        )
        samples_across = math.ceil(diameter / pitch * (1 - _ROUNDED_LENGTH))
        remedy = f"give samples: {samples_across}, leave the pitch out, or choose"
        raise ParameterError(
            "diameter", f"{text} = {millimetres(grid_width)}: {remedy} aperture: stretched"
        )
    if aperture != "clipped":
        diameter = min(diameter, grid_width)
    return PupilGrid(samples, pitch, diameter)


def is_wider(diameter: float, span: float) -> bool:
    """Return True if an aperture is wider than a grid by more than rounding."""
    return diameter > span * (1 + _ROUNDED_LENGTH)


def millimetres(length: float) -> str:
    """Return a length as text in mm with four digits."""
    return f"{length * 1e3:.4g} mm"


def clear_diameter(stop: Stop) -> Tensor:
    """Return the diameter of the clear aperture along v and u, limited by the width of the grid: ()
    float64, m.
    """
    return torch.minimum(stop.diameter.double(), stop.samples * stop.pitch.double())


def clear_area(stop: Stop) -> float:
    """Return the area of the clear pupil in m2: a disc, cut by the square of the grid if the disc
    is wider.
    """
    radius, half_width = float(stop.diameter) / 2, float(stop.samples * stop.pitch) / 2
    if half_width >= radius:
        return math.pi * radius**2
    # the disc covers the whole square
    if half_width <= radius * math.sqrt(0.5):
        return 4 * half_width**2
    segment_half_angle = math.acos(half_width / radius)
    # the disc without the four segments beyond the sides
    return math.pi * radius**2 - 4 * (
        radius**2 * segment_half_angle - half_width * math.sqrt(radius**2 - half_width**2)
    )


def gaussian_integral(stop: Stop, width: Number) -> Number:
    """Return the integral of exp(-(r / width)^2) over the clear pupil in m2, with r from the axis.

    The pupil is the disc of the stop, cut by the square of the grid if the disc is wider. The
    integral over r is in closed form, the integral over one eighth of the azimuth by Gauss-Legendre
    quadrature, to 1e-13. The gradient flows to ``width`` if it is a tensor.
    """
    radius, half_width = float(stop.diameter) / 2, float(stop.samples * stop.pitch) / 2
    if half_width >= radius:
        return math.pi * width**2 * _share_within(radius, width)
    # in one eighth of the pupil: up to this angle, the side of the square limits the pupil
    half_side_angle = min(math.acos(half_width / radius), math.pi / 4)
    straight_part = (
        half_side_angle
        / 2
        * sum(
            weight * _share_within(edge, width)
            for edge, weight in _edge_distances(half_width, half_side_angle)
        )
    )
    curved_part = (math.pi / 4 - half_side_angle) * _share_within(radius, width)
    integral: Number = 4 * width**2 * (straight_part + curved_part)
    return integral


def _share_within(radius: float, width: Number) -> Number:
    """Return 1 - exp(-(radius / width)^2), precise for small values."""
    square = (radius / width) ** 2
    share: Number = -torch.expm1(-square) if isinstance(square, Tensor) else -math.expm1(-square)
    return share


def _edge_distances(half: float, corner: float) -> list[tuple[float, float]]:
    """Return the distances of a straight edge of the grid from the axis at Gauss-Legendre nodes of
    the azimuth from 0 to ``corner``, with their weights.
    """
    import numpy as np

    nodes, weights = np.polynomial.legendre.leggauss(40)
    return list(
        # the side lies at half / cos(angle), for angles from 0 to the corner
        zip((half / np.cos(corner * (nodes + 1) / 2)).tolist(), weights.tolist(), strict=True)
    )


def pupil_axes(grid: PupilGrid, device: torch.device | None = None) -> tuple[Tensor, Tensor]:
    """Return the coordinates v (samples, 1) and u (1, samples) in units of the stop's radius,
    float64.
    """
    steps = torch.arange(grid.samples, dtype=torch.float64, device=device) - (grid.samples - 1) / 2
    line = steps * (2 * grid.pitch / grid.diameter)
    return line[:, None], line[None, :]


def polar_coordinates(grid: PupilGrid, device: torch.device | None = None) -> tuple[Tensor, Tensor]:
    """Return the radius in units of the stop's radius, and the azimuth from +u towards +v, both
    float64 (v, u).
    """
    v, u = pupil_axes(grid, device)
    return torch.hypot(v, u), torch.atan2(v.expand(grid.samples, -1), u.expand(grid.samples, -1))


def inside_stop(grid: PupilGrid, device: torch.device | None = None, rows: slice = _ALL) -> Tensor:
    """Return True for each sample whose centre lies inside the stop, bool (v, u); ``rows``
    selects some rows.
    """
    v, u = pupil_axes(grid, device)
    return v[rows].square() + u.square() <= 1


def stop_transmission(
    grid: PupilGrid, dtype: torch.dtype, device: torch.device | None = None
) -> Tensor:
    """Return the transmission (v, u) of the stop: 1 inside, 0 outside."""
    clear = torch.empty(grid.samples, grid.samples, dtype=dtype, device=device)
    v, u = (line.square() for line in pupil_axes(grid, device))
    for rows in row_stripes(grid):
        clear[rows] = v[rows] + u <= 1
    return clear


def row_stripes(grid: PupilGrid) -> Iterator[slice]:
    """Yield slices of a few pupil rows, short enough that float64 temporaries fit in the CPU's
    cache.
    """
    step = max(1, _STRIPE_SAMPLES // grid.samples)
    return (slice(first, first + step) for first in range(0, grid.samples, step))


def refuse_other_grid(height: Tensor, grid: PupilGrid) -> None:
    """Raise ValueError unless the height map has the shape of the pupil grid."""
    grid_shape = (grid.samples, grid.samples)
    if tuple(height.shape) != grid_shape:
        raise ValueError(
            f"height is {tuple(height.shape)}, not the square pupil grid {grid_shape} of `stop`:"
            " resample the height, or compute the height from the same `stop` step"
        )


# --- stop -----------------------------------------------------------------------------------------

# The stop of the lens and the grid on which the pupil is sampled.


#: relative difference of grid and aperture without a note, as from a pitch written with four digits
_WORTHLESS_DIFFERENCE = 1e-3


#: samples of the pupil along an axis; fewer than four cannot represent a round aperture
Samples = Annotated[int, Field(ge=4, le=100_000)]


@node(rtol=1e-12, before_run=True)
def stop(
    *,
    samples: Samples,
    pitch: PupilPitch | None = None,
    diameter: Diameter,
    aperture: Aperture = "held",
) -> Stop:
    """Place the round stop of the lens on the square grid of the pupil.

    Without a ``pitch`` the grid is as wide as the aperture. ``aperture`` says what happens where
    the two differ:

    - `held`: an aperture that is wider than the grid is refused;
    - `stretched`: the pitch is changed so that the grid is as wide as the aperture;
    - `inscribed`: a wider aperture is narrowed to the grid;
    - `clipped`: the square grid cuts a wider aperture.

    Shapes: -> samples, pitch, diameter, each ().
    Units:  pitch and diameter m; samples along each axis.
    Error:  exact.
    Raises: ParameterError before the run where no sample lies inside the aperture, and for `held`
            where the aperture is wider than the grid.
    Source: by definition.
    """
    grid = pupil_grid(samples, pitch, diameter, aperture)
    pitch_and_diameter = (torch.tensor(length, dtype=torch.float64) for length in grid[1:])
    return Stop(torch.tensor(grid.samples), *pitch_and_diameter)


@stop.preflight
def _(
    *,
    samples: int,
    pitch: float | None = None,
    diameter: float,
    aperture: Aperture = "held",
    **_: Any,
) -> list[str]:
    grid = pupil_grid(samples, pitch, diameter, aperture)
    if pitch is None or math.isclose(samples * pitch, diameter, rel_tol=_WORTHLESS_DIFFERENCE):
        return []
    grid_width = samples * pitch
    grid_text = f"{samples} x {pitch * 1e6:.4g} um = {millimetres(grid_width)}"
    if aperture == "stretched":
        fit_text = (
            f"the pitch becomes {grid.pitch * 1e6:.4g} um, so that {samples} samples span the"
            " aperture"
        )
        return [f"aperture {millimetres(diameter)}, pupil grid {grid_text}: {fit_text}"]
    if is_wider(diameter, grid_width):
        clear = (
            f"a disc of {millimetres(grid_width)}"
            if aperture == "inscribed"
            else "a disc cut by the square grid"
        )
        return [
            f"aperture {millimetres(diameter)} > pupil grid {grid_text}: {aperture}, {clear}; see"
            " reading.aperture"
        ]
    return []


@stop.check
def _(result: Stop, *, diameter: float, aperture: Aperture = "held", **_: Any) -> list[Check]:
    samples, pitch, clear = grid_of(result)
    grid_width = samples * pitch
    narrowed = (
        f", {aperture} instead of the requested {millimetres(diameter)}"
        if is_wider(diameter, grid_width)
        else ""
    )
    return [
        Check(
            f"clear pupil {millimetres(min(grid_width, clear))}{narrowed}, {samples} samples across"
        )
    ]
