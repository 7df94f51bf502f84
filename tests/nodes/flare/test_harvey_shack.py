"""Harvey-Shack scatter: its total, its light in a window of pixels to 1e-8, and its derivatives,
against SciPy.
"""

import math

import pytest
import torch
from scipy.integrate import dblquad, quad

from neusee.nodes.flare import light_within, lobe, on_pixels, scattered_share

CASES = [
    (1e-2, -1.5),
    (1e-6, -1.5),
    (1e-4, -2.0),
    (3e-3, -3.0),
    (1e-9, -2.5),
    (1.0, -1.0),
    (1e-3, -2 + 1e-10),
]


def number(x):
    return torch.tensor(float(x), dtype=torch.float64)


def bsdf(beta, b0, l, s):  # noqa: E741
    return b0 * (1 + (beta / l) ** 2) ** (s / 2)


def scattered_below(beta, b0, l, s):  # noqa: E741
    """Integrate a BSDF over the directions within ``beta``, over the logarithm of the distance,
    by SciPy.
    """

    def ring(v):
        return bsdf(math.exp(v), b0, l, s) * math.exp(2 * v)

    low, top = math.log(l) - 16, math.log(beta)
    kinks = [x for x in (math.log(l),) if low < x < top]
    return 2 * math.pi * quad(ring, low, top, epsrel=1e-11, epsabs=0, limit=400, points=kinks)[0]


def scattered_into(edges, b0, l, s):  # noqa: E741
    """Integrate a BSDF over a rectangle of directions (y0, y1, x0, x1) around the source, in
    polar coordinates.
    """
    y0, y1, x0, x1 = edges
    angles = sorted(math.atan2(y, x) for y in (y0, y1) for x in (x0, x1))

    def reach(phi):
        along, up = math.cos(phi), math.sin(phi)
        return min(
            [(x1 if along > 0 else x0) / along] * (along != 0)
            + [(y1 if up > 0 else y0) / up] * (up != 0)
        )

    def sector(phi):
        return scattered_below(reach(phi), b0, l, s) / (2 * math.pi)

    pairs = zip(angles, [*angles[1:], angles[0] + 2 * math.pi], strict=True)
    return sum(quad(sector, a, b, epsrel=1e-9, epsabs=0)[0] for a, b in pairs)


@pytest.mark.parametrize(("l", "s"), CASES)
def test_total_scatter_is_the_integral_of_the_bsdf(l, s):  # noqa: E741
    assert float(scattered_share(number(0.3), number(l), number(s))) == pytest.approx(
        scattered_below(1.0, 0.3, l, s), rel=1e-9
    )


def test_total_scatter_has_the_published_closed_form():
    b0, l, s = 0.44, 0.01, -1.5  # noqa: E741
    printed = 2 * math.pi * b0 * ((l**2 + 1) ** ((s + 2) / 2) - l ** (s + 2)) / (l**s * (s + 2))
    assert float(scattered_share(number(b0), number(l), number(s))) == pytest.approx(
        printed, rel=1e-13
    )


@pytest.mark.parametrize(("l", "s"), CASES)
def test_light_in_a_window_is_exact_for_any_width_of_the_scatter(l, s):  # noqa: E741
    """The source lies off the middle of a pixel, and the scatter is as narrow as 4e-5 of a
    pixel.
    """
    scale, y, x, size = 2.9e-6 / 0.11, 19.3, 31.7, (40, 60)
    b0 = 0.01 / scattered_below(1.0, 1.0, l, s)
    found = on_pixels(lobe(*map(number, (b0, l, s, scale))), (y, x), size)
    edges = [scale * e for e in (-0.5 - y, size[0] - 0.5 - y, -0.5 - x, size[1] - 0.5 - x)]
    assert float(found.sum()) == pytest.approx(scattered_into(edges, b0, l, s), abs=1e-8 * 0.01)
    assert float(found.min()) > 0


@pytest.mark.parametrize(("row", "column"), [(0, 0), (3, 30), (20, 31), (19, 32), (25, 51)])
def test_each_pixel_is_the_integral_over_its_square(row, column):
    """Beside the source, at 16 pixels where the method changes, and far away."""
    light = lobe(*map(number, (2.0, 5e-5, -1.7, 2.6e-5)))
    found = on_pixels(light, (19.3, 31.7), (40, 60))[row, column]
    (top, left), scale = (row - 0.5 - 19.3, column - 0.5 - 31.7), 2.6e-5
    truth = dblquad(
        lambda x, y: scale**2 * bsdf(scale * math.hypot(y, x), 2.0, 5e-5, -1.7),
        top,
        top + 1,
        left,
        left + 1,
        epsabs=1e-14,
        epsrel=1e-9,
    )[0]
    assert float(found) == pytest.approx(truth, rel=1e-6)


def test_light_ends_where_a_ray_leaves_the_hemisphere():
    """A beam of few pixels: all scattered light lies in the window, and nothing beyond a
    direction cosine of 1.
    """
    light = lobe(*map(number, (0.05, 0.1, -1.5, 1 / 60)))
    found = on_pixels(light, (70.2, 69.8), (140, 140))
    assert float(found.sum()) == pytest.approx(scattered_below(1.0, 0.05, 0.1, -1.5), rel=5e-5)
    assert float(found[0].sum()) == 0
    assert float(light_within(light, number(1e6))) == pytest.approx(
        scattered_below(1.0, 0.05, 0.1, -1.5), rel=1e-9
    )


def test_light_within_a_radius():
    light = lobe(*map(number, (0.4, 1e-3, -2.0, 2.6e-5)))
    assert float(light_within(light, number(80))) == pytest.approx(
        scattered_below(80 * 2.6e-5, 0.4, 1e-3, -2.0), rel=1e-9
    )


@pytest.mark.parametrize("s", [-1.5, -2.0, -2.0 + 1e-7])
@pytest.mark.parametrize("centre", [(3.2, 4.6), (-30.0, 4.0)])
def test_gradients_by_each_parameter(s, centre):
    values = [number(x).requires_grad_() for x in (0.4, 3e-4, s, 2.6e-5 * 50)]

    def window(b0, l, s, scale):  # noqa: E741
        return on_pixels(lobe(b0, l, s, scale), centre, (7, 9)) * 1e3

    torch.autograd.gradcheck(window, values, eps=1e-8, atol=1e-4, rtol=1e-5)
    torch.autograd.gradcheck(scattered_share, values[:3], eps=1e-8, atol=1e-9, rtol=1e-5)
