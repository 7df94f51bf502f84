"""The expected numbers of the recipes, by code of its own: python -m
tests.workflows.simulation.averaged_anchors.

The transfer function of a pupil, multiplied by that of a square pixel of 2.9 um, gives the share of
the light in each pixel without any line of the nodes. Masks have a path in waves of 550 nm at the
rim.
"""

import math

import numpy as np
from scipy import special

from tests.nodes.optics import own_pixel_average as own
from tests.workflows.simulation import radiometry

SAMPLES, WINDOW, FOCAL, PIXEL = 540, 512, 0.11, 2.9e-6
PITCH = 14.96e-6
WAVELENGTHS = (400e-9, 500e-9, 550e-9, 600e-9, 700e-9)


def index(wavelength):
    """Of fused silica minus that of air: Malitson, J. Opt. Soc. Am. 55, 1205 (1965), and n_air =
    1.
    """
    square = (wavelength * 1e6) ** 2
    terms = ((0.6961663, 0.0684043), (0.4079426, 0.1162414), (0.8974794, 9.896161))
    return math.sqrt(1 + sum(b * square / (square - c**2) for b, c in terms)) - 1


def polar():
    """Radius in units of the rim, and azimuth from +u towards +v."""
    at = (np.arange(SAMPLES) - (SAMPLES - 1) / 2) / (SAMPLES / 2)
    return np.hypot(at[:, None], at), np.arctan2(at[:, None], at[None, :])


def suppression(height, wavelength):
    """The brightest pixel behind a mask of ``height`` in m, over the pixel on the axis of the
    clear lens.
    """
    alpha = PITCH * PIXEL / (wavelength * FOCAL)
    clear = own.disc(SAMPLES)
    light = clear.sum()
    on_axis = own.averaged(clear + 0j, light, alpha, (1, 1))[0, 0]
    field = clear * np.exp(2j * np.pi * index(wavelength) * height / wavelength)
    return own.averaged(field, light, alpha, (WINDOW, WINDOW)).max() / on_axis, on_axis


def depth(waves):
    """Height in m of a path in waves of 550 nm."""
    return np.asarray(waves) * 550e-9 / index(550e-9)


def half_rings(slopes):
    """Annuli of equal area, each a slope times the radius, of opposite sign on both halves and
    in every second one.
    """
    radius, azimuth = polar()
    ring = np.minimum((radius**2 * len(slopes)).astype(int), len(slopes) - 1)
    side = np.where(np.cos(azimuth) >= 0, 1.0, -1.0) * np.where(ring % 2, -1.0, 1.0)
    return depth(np.asarray(slopes)[ring] * radius * side) * (radius <= 1)


def axicon(waves):
    """A slope times the radius."""
    radius, _ = polar()
    return depth(waves * radius) * (radius <= 1)


def pointer_photons():
    """Photons of the mean response over the pixel of the spot, over those at its middle."""
    laser = {
        "wavelength": 532e-9,
        "fwhm": 1e-9,
        "power": 5e-3,
        "divergence": 1e-3,
        "distance": 100.0,
    }
    node, weight = special.roots_legendre(8)
    places = np.array([0.0, *(node / 2)])
    y, x = places + 346 - 384 + 0.11 * 1e-3 / PIXEL, places + 430 - 384 - 0.11 * 1.2e-3 / PIXEL
    away = np.hypot(y[:, None], x).ravel() * PIXEL
    found = radiometry.electrons(laser, away, 5e-3, lambda nm: 1.0).reshape(9, 9)
    return found[0, 0], weight / 2 @ found[1:, 1:] @ weight / 2


if __name__ == "__main__":
    masks = {
        "five half-rings": half_rings((12, 18, 24, 30, 36)),
        "half-ring": half_rings((20,)),
        "axicon": axicon(20),
    }
    for name, height in masks.items():
        for wavelength in WAVELENGTHS if name.startswith("five") else (550e-9,):
            lowest, on_axis = suppression(height, wavelength)
            print(f"{name}, {wavelength * 1e9:.0f} nm: LSR {lowest:.4e}, on axis {on_axis:.5f}")
    middle, mean = pointer_photons()
    print(
        f"pointer: mean over middle {mean / middle:.6f}, {4.10728e10 * mean / middle:.6g} photons"
    )
