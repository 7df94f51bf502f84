"""Spots of a tapered and defocused beam behind a round lens, by quadrature, without a line of the
project.

The field in the lens is exp(-x s + 2 pi i W s) over s, the square of the radius over that of the
rim, with the taper x = (D / 2 w)^2 and W waves of defocus. At v = pi D r / (lambda f) the light is
|U|^2, with

    U(v) = integral over s from 0 to 1 of exp(-x s + 2 pi i W s) J0(v sqrt(s))
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.special import ellipk, erf, j0

Floats = NDArray[np.float64]
# of the quadrature; beyond, the wave from the rim and a Gaussian spot
MOST_WAVES, MOST_TAPER = 36.0, 30.0
TABLE_WAVES = 15.5  # of a table, unless it begins at stronger defocus
STEP = 0.12  # of v


@dataclass(frozen=True)
class Spots:
    """Peak, heat of the hottest point and brightest pixel, each over the envelope of the axis."""

    peak: Floats
    heat: Floats
    pixel: Floats


def envelope(fill: Floats, waves: Floats) -> Floats:
    """Return an upper bound of the light on the axis that goes smoothly over the defocus."""
    square = np.maximum(fill**2 + (2 * math.pi * waves) ** 2, 1e-30)
    return (
        np.expm1(-fill) ** 2 + 4 * np.exp(-fill) * np.minimum(1, (math.pi * waves) ** 2)
    ) / square


def light(fill: Floats, waves: Floats, reach: Floats) -> Floats:
    """Return |U|^2 (spot, reach): by quadrature, or for strong defocus or taper by the wave from
    the rim.
    """
    kappa = fill - 2j * math.pi * waves
    if waves.max() > MOST_WAVES or fill.max() > MOST_TAPER:
        inside = (reach < 4 * math.pi * waves[:, None]) | (fill[:, None] > MOST_TAPER)
        straight = np.exp(-(reach**2) / (4 * kappa[:, None])) * inside
        return np.abs((straight - np.exp(-kappa)[:, None] * j0(reach)) / kappa[:, None]) ** 2
    nodes, weights = np.polynomial.legendre.leggauss(40 + int(3 * waves.max() + reach[-1] / 2))
    radius = (nodes + 1) / 2
    bessel = j0(np.outer(reach, radius)) * (weights * radius)
    field = np.exp(-np.outer(radius**2, kappa))
    return np.asarray((bessel @ field.real).T ** 2 + (bessel @ field.imag).T ** 2)


def grouped(fill: Floats, waves: Floats) -> list[NDArray[np.intp]]:
    """Return groups of spots of about equal extent."""
    far = (waves > MOST_WAVES) | (fill > MOST_TAPER)
    group = np.where(far, 99, np.searchsorted([0.5, 2.0, 6.0, 16.0], waves))
    places = [np.flatnonzero(group == name) for name in np.unique(group)]
    return [part for place in places for part in np.array_split(place, math.ceil(len(place) / 300))]


def spots_of(fill: Floats, waves: Floats, half: float, damage: bool) -> Spots:
    """Return the spots for pairs of taper and defocus; ``half`` a pixel is in units of v. The
    other kind is 0.
    """
    fill = np.maximum(fill, 1e-3)
    peak, heat, pixel = np.zeros_like(fill), np.zeros_like(fill), np.zeros_like(fill)
    for group in grouped(fill, waves):
        x, w = fill[group], waves[group]
        far = w.max() > MOST_WAVES or x.max() > MOST_TAPER
        extent = 30.0 if far else 4 * math.pi * w.max() + 24 + 2 * math.sqrt(x.max())
        reach = np.arange(STEP / 2, extent + (0 if damage else 3 * half), STEP)
        found = light(x, w, np.concatenate([[0.0], reach]))
        if damage:
            peak[group] = found.max(1)
            heat[group] = (
                geometric_heat(x, w)
                if far
                else hottest(found[:, 1:], reach, 4 * math.pi * w.max() + 3)
            )
        else:
            pixel[group] = brightest_pixel(found, np.concatenate([[0.0], reach]), half)
    bound = envelope(fill, waves)
    return Spots(peak / bound, heat / bound, pixel / bound)


def geometric_heat(fill: Floats, waves: Floats) -> Floats:
    """Return the heat in the middle of a spot of straight rays: a Gaussian that the rim of the
    lens cuts.
    """
    square = fill**2 + (2 * math.pi * waves) ** 2
    rim = np.where(fill > MOST_TAPER, np.inf, 4 * math.pi * waves)
    rate = np.sqrt(fill / (2 * square))
    return np.asarray(math.sqrt(math.pi) / 2 / rate * erf(rate * rim) / square)


def hottest(found: Floats, reach: Floats, edge: float) -> Floats:
    """Return the integral of E / (2 pi distance) where it is largest; the wings fall as the
    third power.
    """
    radii = np.concatenate(
        [[0.0], np.unique(np.round(np.linspace(0, edge, 24)[1:] / STEP) * STEP)]
    )[:, None]
    parameter = np.minimum(4 * radii * reach / (radii + reach) ** 2, 1 - 1e-12)
    kernel = 2 / math.pi * ellipk(parameter) * reach / (radii + reach) * STEP
    return np.asarray((found @ kernel.T).max(1) + found[:, -30:].mean(1) * reach[-1] / 2)


def brightest_pixel(found: Floats, reach: Floats, half: float) -> Floats:
    """Return the largest mean over a square pixel; the axis is in the middle of one."""
    nodes, weights = np.polynomial.legendre.leggauss(6 + 2 * int(half))
    weight = np.outer(weights, weights).ravel() / 4
    rows = max(1, int(reach[-1] / (2 * half)) - 1)
    best = np.zeros(len(found)) if rows <= 8 else found[:, reach > 14 * half].max(1)
    for row in range(min(8, rows)):
        for column in range(row + 1):
            y, x = (2 * row + nodes)[:, None] * half, (2 * column + nodes)[None, :] * half
            at = np.minimum(np.hypot(y, x).ravel(), reach[-1])
            slot = np.clip(np.searchsorted(reach, at) - 1, 0, len(reach) - 2)
            share = (at - reach[slot]) / (reach[slot + 1] - reach[slot])
            spread = np.bincount(slot, weight * (1 - share), len(reach))
            spread += np.bincount(slot + 1, weight * share, len(reach))
            best = np.maximum(best, found @ spread)
    return best


def gaussian_pixel(fill: Floats, waves: Floats, half: float) -> Floats:
    """Return the mean over the pixel of a Gaussian spot over its peak."""
    side = half * np.sqrt(fill / (2 * (fill**2 + (2 * math.pi * waves) ** 2)))
    return np.asarray((math.sqrt(math.pi) / 2 * erf(side) / side) ** 2)


def table_of(
    fill: Floats, waves: Floats, half: float, damage: bool
) -> Callable[[Floats, Floats], Spots]:
    """Return a function like `spots_of` that interpolates between the extremes of arrays of any
    shape.

    Beyond the quadrature the bright moments of a spot count, which are less than 1/16 of the
    distance apart.
    """
    ends = np.log(np.clip([fill.min() * 0.999, fill.max() * 1.001], 1e-3, MOST_TAPER) * [0.999, 1])
    most = min(max(TABLE_WAVES, waves.min() + 6), MOST_WAVES - 0.5)
    low, high = np.clip([waves.min() * 0.999, waves.max() * 1.001 + 1e-6], [0, 1e-6], most)
    low = min(low, high - 1e-6)
    taper = np.linspace(*ends, 2 + int((ends[1] - ends[0]) / 0.25))
    defocus = np.linspace(low, high, 3 + int((high - low) / 0.05))
    pairs = np.meshgrid(np.exp(taper), defocus, indexing="ij")
    known = spots_of(pairs[0].ravel(), pairs[1].ravel(), half, damage)
    shape = len(taper), len(defocus)
    parts = (known.peak, known.heat, known.pixel)
    tables = [RegularGridInterpolator((taper, defocus), part.reshape(shape)) for part in parts]

    def interpolated(fill: Floats, waves: Floats) -> Spots:
        at = (np.clip(np.log(np.maximum(fill, 1e-3)), *ends), np.clip(waves, low, high))
        peak, heat, pixel = (table(at) for table in tables)
        far, narrow = (waves > most) | (fill > MOST_TAPER), fill > MOST_TAPER
        heat = np.where(far, geometric_heat(fill, waves) / envelope(fill, waves), heat)
        return Spots(peak, heat, np.where(narrow, gaussian_pixel(fill, waves, half), pixel))

    return interpolated
