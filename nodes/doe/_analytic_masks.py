"""Masks whose phase is given by a formula.

Radius r and coordinates u, v are in units of the stop's radius, slopes in waves at the rim.
"""

import math
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import node
from neusee.nodes.doe._refractive_index import (
    AnyGlass,
    Glass,
    height_checks,
    height_from_phase,
    refuse_material,
)
from neusee.nodes.optics._pupil import zernike_surface
from neusee.nodes.optics._pupil_grid import PupilGrid, grid_of, polar_coordinates, pupil_axes
from neusee.nodes.units import Angle, Charge, Count, Height, Slope, Wavelength
from neusee.nodes.values import Stop


@node()
def flat(stop: Stop) -> Tensor:
    """Return the height map of a lens without a mask: 0 everywhere.

    Shapes: stop -> (v, u).
    Units:  m.
    Error:  exact.
    Source: by definition.
    """
    return torch.zeros(int(stop.samples), int(stop.samples))


@node()
def vortex(
    stop: Stop, *, charge: Charge, wavelength: Wavelength = 550e-9, material: Glass = "fused silica"
) -> Tensor:
    """Return the height map of a vortex, phi = charge * theta, whose phase ramp has its step on the
    -u axis.

    Shapes: stop -> (v, u).
    Units:  m.
    Error:  1e-7 of the height (float32).
    Source: Watnik, Ruane, Swartzlander, Opt. Eng. 55, 123102 (2016).
    """
    grid = grid_of(stop)
    return height_from_phase(charge * polar_coordinates(grid)[1], grid, wavelength, material)


@node()
def axicon(
    stop: Stop, *, waves: Slope, wavelength: Wavelength = 550e-9, material: Glass = "fused silica"
) -> Tensor:
    """Return the height map of an axicon, phi = 2 pi waves r, which turns the focal spot into a
    ring.

    Shapes: stop -> (v, u).
    Units:  waves at the rim; result m.
    Error:  1e-7 of the height (float32).
    Source: Watnik, Ruane, Swartzlander, Opt. Eng. 55, 123102 (2016).
    """
    grid = grid_of(stop)
    return height_from_phase(
        2 * math.pi * waves * polar_coordinates(grid)[0], grid, wavelength, material
    )


@node()
def spiral_axicon(
    stop: Stop,
    *,
    waves: Slope,
    charge: Charge,
    wavelength: Wavelength = 550e-9,
    material: Glass = "fused silica",
) -> Tensor:
    """Return the height map of an axicon with a vortex: phi = 2 pi waves r + charge * theta.

    Shapes: stop -> (v, u).
    Units:  waves at the rim; result m.
    Error:  1e-7 of the height (float32).
    Source: Luo et al., Curr. Opt. Photon. 8, 355 (2024).
    """
    grid = grid_of(stop)
    radius, azimuth = polar_coordinates(grid)
    return height_from_phase(
        2 * math.pi * waves * radius + charge * azimuth, grid, wavelength, material
    )


@node()
def cubic(
    stop: Stop, *, waves: Slope, wavelength: Wavelength = 550e-9, material: Glass = "fused silica"
) -> Tensor:
    """Return the height map of phi = 2 pi waves (u**3 + v**3), which gives an MTF without zeros
    over a long focus.

    Shapes: stop -> (v, u).
    Units:  waves at the rim on an axis; result m.
    Error:  1e-7 of the height (float32).
    Source: Dowski, Cathey, Appl. Opt. 34, 1859 (1995).
    """
    grid = grid_of(stop)
    v, u = pupil_axes(grid)
    return height_from_phase(2 * math.pi * waves * (u**3 + v**3), grid, wavelength, material)


def _half_rings(
    grid: PupilGrid, waves: tuple[float, ...], alternate: bool, orientation: float
) -> Tensor:
    """Return the phase (v, u) of the half-ring mask in rad: 2 pi a r, with opposite signs on the
    two sides of the axis.
    """
    v, u = pupil_axes(grid)
    squared_radius = v.square() + u.square()
    # annuli of equal area are equally spaced in the squared radius
    annulus = (squared_radius * len(waves)).floor_().to(torch.int32).clamp_(max=len(waves) - 1)
    signed = [-slope if alternate and index % 2 else slope for index, slope in enumerate(waves)]
    slopes = 2 * math.pi * torch.tensor(signed, dtype=torch.float64, device=v.device)
    side_sign = (u * math.cos(orientation) + v * math.sin(orientation)).sign_()
    return (
        slopes.index_select(0, annulus.flatten())
        .view_as(squared_radius)
        .mul_(squared_radius.sqrt_())
        .mul_(side_sign)
    )


@node()
def half_rings(
    stop: Stop,
    *,
    waves: Annotated[tuple[Slope, ...], Field(min_length=1)],
    alternate: bool = True,
    orientation: Angle = 0.0,
    wavelength: Wavelength = 550e-9,
    material: Glass = "fused silica",
) -> Tensor:
    """Return the height map that focuses each annulus to half a ring: phi = 2 pi a r sgn(cos(theta
    - orientation)).

    Each annulus of equal area has one slope a, from the axis outwards; ``alternate`` flips the side
    of every second annulus. The phase is odd about the axis, so the amplitude of the point-spread
    function is real.

    Shapes: stop -> (v, u).
    Units:  waves at the rim; orientation rad; result m.
    Error:  1e-7 of the height (float32).
    Source: our reading of Wirth et al., Opt. Lett. 45, 2179 (2020), whose formula we could not
            consult.
    """
    grid = grid_of(stop)
    return height_from_phase(
        _half_rings(grid, waves, alternate, orientation), grid, wavelength, material
    )


@node()
def zernike(
    stop: Stop,
    *,
    coefficients: dict[Count, Height],
    wavelength: Wavelength = 550e-9,
    material: Glass = "fused silica",
) -> Tensor:
    """Return the height map of a sum of Zernike polynomials, given root mean square optical paths
    by Noll number.

    Shapes: stop -> (v, u).
    Units:  m of optical path at ``wavelength``; result m of height.
    Error:  1e-7 of the height (float32) up to radial order 20.
    Source: Noll, J. Opt. Soc. Am. 66, 207 (1976).
    """
    grid = grid_of(stop)
    phase = zernike_surface(coefficients, grid) * (2 * math.pi / wavelength)
    return height_from_phase(phase, grid, wavelength, material)


def _refuse_wavelength(
    *, wavelength: float = 550e-9, material: AnyGlass = "fused silica", **params: Any
) -> list[str]:
    return refuse_material("wavelength", material, torch.tensor([wavelength], dtype=torch.float64))


for _mask in (flat, vortex, axicon, spiral_axicon, cubic, half_rings, zernike):
    _mask.check(height_checks)
for _mask in (vortex, axicon, spiral_axicon, cubic, half_rings, zernike):
    _mask.preflight(_refuse_wavelength)
