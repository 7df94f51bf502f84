"""The three-parameter Harvey-Shack model of scatter by a surface, and its light on the pixels of a
sensor.

Lengths are in pixels. With the direction cosine beta of a scattered ray, measured from the ray that
is not scattered, the surface scatters the share BSDF(beta) d2beta into d2beta, BSDF = b0 (1 + (beta
/ l)**2)**(s / 2). A beam of radius a on the surface has the marginal ray NA at the image, and the
optical invariant gives r NA = a beta: the pixel at the distance r receives (NA / a)**2 BSDF(NA r /
a) per area, and r ends at a / NA, where beta is 1.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor

#: pixels about the source, along each axis and direction, over which the light is integrated
#: exactly
NEAR = 16
_NODES = 96  #: Gauss-Legendre nodes of one edge: 1e-13 for any width of the scatter
#: pixels between an edge of a pixel and the source; a smaller distance is replaced by this one
_CLOSEST = 1e-6
#: argument below which a series replaces (exp(z) - 1) / z, whose derivatives would cancel
_SERIES = 1e-3


class Lobe(NamedTuple):
    """The scattered light of a surface on the sensor: peak (1 + (r / width)**2)**(s / 2) up to
    ``end``; scalars.
    """

    peak: Tensor  #: share of the light per pixel
    width: Tensor  #: pixels
    slope: Tensor  #: s
    end: Tensor  #: pixels, where the direction cosine is 1


def lobe(b0: Tensor, l: Tensor, s: Tensor, scale: Tensor) -> Lobe:  # noqa: E741 (the symbol of the literature)
    """Return the scattered light of a surface on the sensor; ``scale`` is the direction cosine
    per pixel, NA p / a.
    """
    return Lobe(b0 * scale.square(), l / scale, s, 1 / scale)


def scattered_share(b0: Tensor, l: Tensor, s: Tensor) -> Tensor:  # noqa: E741
    """Return the total integrated scatter (TIS) of a surface.

    TIS = 2 pi b0 ((l**2 + 1)**((s + 2) / 2) - l**(s + 2)) / (l**s (s + 2)), and its limit pi b0
    l**2 ln(1 + l**-2) for s = -2; near s = -2 nothing cancels.
    """
    return 2 * torch.pi * b0 * _enclosed(l, s, torch.ones_like(l))


def surface_of(share: float, l: float = 0.01, s: float = -1.5) -> dict[str, float]:  # noqa: E741
    """Return b0, l and s of a surface that scatters a share of the light; the share is
    proportional to b0.
    """
    unit = scattered_share(*(torch.tensor(x, dtype=torch.float64) for x in (1.0, l, s)))
    return {"b0": share / float(unit), "l": l, "s": s}


def light_within(light: Lobe, radius: Tensor) -> Tensor:
    """Return the share of the light that a surface scatters to less than ``radius`` pixels from
    the source.
    """
    inside = torch.minimum(radius, light.end)
    return 2 * torch.pi * light.peak * _enclosed(light.width, light.slope, inside)


def on_pixels(light: Lobe, centre: tuple[float, float], shape: tuple[int, int]) -> Tensor:
    """Return the share of the light that a surface scatters into each pixel (y, x), float64.

    ``centre`` is the position (y, x) of the source, counted from the middle of the first pixel.
    Pixels up to 16 from the source are integrated exactly: the boundary of each pixel, by the
    divergence theorem, so that a peak far narrower than a pixel loses nothing. Farther away the
    value in the middle of the pixel and its second derivatives give the integral, to 3e-6 of the
    pixel.
    """
    y, x = (torch.arange(n, dtype=torch.float64) - c for n, c in zip(shape, centre, strict=True))
    window = _far(light, y[:, None], x[None])
    rows, columns = (_near(c, n) for c, n in zip(centre, shape, strict=True))
    if rows.stop > rows.start and columns.stop > columns.start:
        window = window.clone()
        window[rows, columns] = _exact(light, _edges(rows, centre[0]), _edges(columns, centre[1]))
    return window


def _near(centre: float, size: int) -> slice:
    """Return the pixels along one axis within ``NEAR`` of the source that lie inside the window."""
    middle = round(centre)
    return slice(min(max(middle - NEAR, 0), size), max(min(middle + NEAR + 1, size), 0))


def _edges(pixels: slice, centre: float) -> Tensor:
    """Return the positions of the edges of a row of pixels along one axis, counted from the
    source.
    """
    return torch.arange(pixels.start, pixels.stop + 1, dtype=torch.float64) - 0.5 - centre


def on_far_pixels(light: Lobe, square: Tensor) -> Tensor:
    """Return the light of pixels at squared distances from the source: value in the middle, and
    Laplacian / 24.

    The error is below 3e-6 of a pixel at 16 pixels from the source, and does not include the end of
    the light.
    """
    q = square / light.width.square()
    laplacian = (
        light.slope / (light.width.square() * (1 + q)) * (2 + (light.slope - 2) * q / (1 + q))
    )
    return light.peak * torch.exp(light.slope / 2 * torch.log1p(q)) * (1 + laplacian / 24)


def _far(light: Lobe, y: Tensor, x: Tensor) -> Tensor:
    """Return the light of pixels at the distances ``y`` and ``x`` from the source along both axes,
    0 beyond the end of the light.
    """
    squared_distance = y.square() + x.square()
    light_of_pixels = on_far_pixels(light, squared_distance)
    if float(light.end.detach()) > float(squared_distance.max().sqrt()) + 1:
        return light_of_pixels
    # a pixel across the end has a part of it
    return light_of_pixels * (light.end - squared_distance.sqrt() + 0.5).clamp(0, 1)


def _exact(light: Lobe, y: Tensor, x: Tensor) -> Tensor:
    """Return the light of each pixel between the edges ``y`` and ``x``: second differences of the
    light in the rectangles from the source to the corners.
    """
    distance_y, distance_x = (edge.abs().clamp_min(_CLOSEST) for edge in (y, x))
    corner_y, corner_x = torch.meshgrid(distance_y, distance_x, indexing="ij")
    # two right triangles, on each side of the diagonal
    rectangle = _triangle(light, corner_y, corner_x) + _triangle(light, corner_x, corner_y)
    signed_rectangle = torch.sign(y)[:, None] * torch.sign(x)[None] * rectangle
    return signed_rectangle.diff(dim=0).diff(dim=1)


def _triangle(light: Lobe, near: Tensor, across: Tensor) -> Tensor:
    """Return the light in the right triangle between the source, the foot of a perpendicular and a
    corner, with the legs ``near`` (to the foot) and ``across``.

    The light within the hypotenuse at the angle phi is integrated over phi. With tan(phi) = sinh(u)
    the integrand is smooth on the scale of 1, however narrow the scatter is.
    """
    nodes, weights = _gauss()
    largest_u = torch.asinh(across / near)[..., None]
    stretch = torch.cosh(largest_u * nodes)
    # light up to the far leg, at the distance near / cos(phi) = near cosh(u), per angle
    enclosed = light.peak * _enclosed(light.width, light.slope, near[..., None] * stretch)
    # dphi = du / cosh(u)
    return (weights * largest_u * enclosed / stretch).sum(-1)


@cache
def _gauss() -> tuple[Tensor, Tensor]:
    """Return Gauss-Legendre nodes and weights on [0, 1]."""
    import numpy as np

    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    return torch.from_numpy((nodes + 1) / 2), torch.from_numpy(weights / 2)


def _enclosed(width: Tensor, slope: Tensor, radius: Tensor) -> Tensor:
    """Return the integral of r (1 + (r / width)**2)**(slope / 2) over r from 0 to ``radius``."""
    # with z = ln(1 + (r / width)^2): width^2 / 2 times the integral of exp((slope + 2) / 2 z) over
    # z
    log_term = torch.log1p((radius / width).square())
    return width.square() / 2 * log_term * _growth((slope + 2) / 2 * log_term)


def _growth(z: Tensor) -> Tensor:
    """Return (exp(z) - 1) / z, which is 1 at z = 0, with exact derivatives there."""
    is_small = z.abs() < _SERIES
    safe_z = torch.where(is_small, 1.0, z)
    series = 1 + z / 2 * (1 + z / 3 * (1 + z / 4 * (1 + z / 5)))
    return torch.where(is_small, series, torch.expm1(safe_z) / safe_z)
