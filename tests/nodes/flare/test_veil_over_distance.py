"""The veil of a lens over the distance from the spot, against SciPy's integral of Harvey and
Shack's law.
"""

import math

import pytest
import torch
from scipy.integrate import dblquad, quad

from neusee.nodes.flare import surface_of, veil_at

LENS = {"focal_length": 0.05, "pixel_pitch": 3.45e-6, "diameter": 12e-3}
ONE = {"front": {"b0": 0.442, "l": 0.01, "s": -1.5}}
TWO = {
    "front": {"b0": 0.5, "l": 0.02, "s": -1.5},
    "inner": {"b0": 600.0, "l": 4e-4, "s": -2.2, "radius": 2e-3},
}


def scale_of(surface):
    """Direction cosine per pixel: the numerical aperture times the pitch over the radius of the
    beam.
    """
    return 6e-3 / 0.05 * 3.45e-6 / surface.get("radius", 6e-3)


def scattered(surface):
    b0, l, s = (surface[name] for name in ("b0", "l", "s"))  # noqa: E741
    return quad(
        lambda v: 2 * math.pi * b0 * (1 + (math.exp(v) / l) ** 2) ** (s / 2) * math.exp(2 * v),
        -30,
        0,
    )[0]


def over_pixel(surface, distance):
    """Light of one surface in the pixel at a distance along a row."""
    b0, l, s, scale = (*(surface[name] for name in ("b0", "l", "s")), scale_of(surface))  # noqa: E741
    law = lambda y, x: b0 * (1 + scale**2 * (x * x + y * y) / l**2) ** (s / 2) * scale**2  # noqa: E731
    return dblquad(law, distance - 0.5, distance + 0.5, -0.5, 0.5, epsrel=1e-9)[0]


@pytest.mark.parametrize("surfaces", [ONE, TWO], ids=["one", "two"])
@pytest.mark.parametrize(
    ("distance", "rel"), [(0, 1e-6), (1, 1e-6), (6, 1e-6), (17, 1e-5), (80, 1e-6), (900, 1e-6)]
)
def test_the_veil_is_the_integral_of_the_law_over_the_pixel(surfaces, distance, rel):
    expected, left = 0.0, 1.0
    for surface in surfaces.values():
        expected += left * over_pixel(surface, distance)
        left *= 1 - scattered(surface)
    veil, total = veil_at(torch.tensor([float(distance)]), surfaces=surfaces, **LENS)
    assert float(veil[0]) == pytest.approx(expected, rel=rel)
    assert float(total) == pytest.approx(1 - left, rel=1e-6)


def test_the_veil_of_all_rings_is_the_light_that_is_scattered():
    """It ends where the direction cosine is 1, at 14,493 pixels, and has nothing beyond."""
    radius = torch.arange(0.5, 16_000, dtype=torch.float64)
    veil, total = veil_at(radius, surfaces=ONE, **LENS)
    assert float((veil * 2 * math.pi * radius).sum()) == pytest.approx(float(total), rel=1e-3)
    end = 1 / scale_of(ONE["front"])
    ends, _ = veil_at(torch.tensor([end - 2, end + 2]), surfaces=ONE, **LENS)
    assert ends[0] > 0
    assert ends[1] == 0


@pytest.mark.parametrize(("l", "s"), [(0.01, -1.5), (0.003, -2.0), (0.2, -3.1)])
def test_a_surface_of_a_share_scatters_it_and_its_veil_is_proportional(l, s):  # noqa: E741
    few, many = (surface_of(share, l, s) for share in (0.002, 0.03))
    assert scattered(few) == pytest.approx(0.002, rel=1e-6)
    at = torch.tensor([0.0, 3.0, 40.0])
    veils = [veil_at(at, surfaces={"lens": surface}, **LENS)[0] for surface in (few, many)]
    torch.testing.assert_close(
        veils[1] / veils[0], torch.full((3,), 15.0, dtype=torch.float64), rtol=1e-9, atol=0.0
    )
