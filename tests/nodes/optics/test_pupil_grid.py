"""The grid of the pupil: areas and light of a clipped stop by quadrature, samples on the rim,
and what is refused.
"""

import math

import pytest
import torch
from scipy.integrate import quad

from neusee.nodes import ParameterError, optics
from neusee.nodes.optics import (
    clear_area,
    clear_diameter,
    gaussian_integral,
    inside_stop,
    polar_coordinates,
    pupil_grid,
)

SPAN = 8e-3  #: m, width of the grid
#: diameters of the stop over the width of the grid
WIDTHS = [0.3, 0.9, 1.0, 1.05, 1.3, 1.41, 1.42, 3.0]


def clipped(width):
    return optics.stop(samples=80, pitch=SPAN / 80, diameter=width * SPAN, aperture="clipped")


def opened(width, law):
    """Return the integral of a law (x, y) over the disc that the square cuts: four times a
    quadrant, row by row.
    """
    radius, half = width * SPAN / 2, SPAN / 2

    def row(y):
        end = min(half, math.sqrt(max(radius**2 - y**2, 0.0)))
        return quad(lambda x: law(x, y), 0, end, epsabs=0, epsrel=1e-10)[0]

    top = min(radius, half)
    corner = min(math.sqrt(max(radius**2 - half**2, 0.0)), top)
    lower = quad(row, 0, corner, epsabs=0, epsrel=1e-9)[0] if corner else 0.0
    return 4 * (lower + (quad(row, corner, top, epsabs=0, epsrel=1e-9)[0] if corner < top else 0.0))


@pytest.mark.parametrize("width", WIDTHS)
def test_the_clear_area_is_that_of_the_disc_within_the_square(width):
    assert clear_area(clipped(width)) == pytest.approx(opened(width, lambda x, y: 1.0), rel=1e-8)


@pytest.mark.parametrize("beam", [1e-3, 4e-3, 0.1])
@pytest.mark.parametrize("width", WIDTHS)
def test_a_gaussian_over_the_stop_is_its_integral_by_rows(width, beam):
    expected = opened(width, lambda x, y: math.exp(-(x * x + y * y) / beam**2))
    assert gaussian_integral(clipped(width), beam) == pytest.approx(expected, rel=1e-8)


def test_the_clear_diameter_is_cut_by_the_grid():
    assert float(clear_diameter(clipped(0.5))) == pytest.approx(0.5 * SPAN)
    assert float(clear_diameter(clipped(1.3))) == pytest.approx(SPAN)


def test_samples_on_the_rim_are_inside_and_the_axis_is_in_the_middle():
    """A disc of two pitches on 3 x 3 samples holds a cross; the corner of an even grid is half a
    pitch away.
    """
    cross = inside_stop(pupil_grid(3, 1e-3, 2e-3))
    assert cross.tolist() == [[False, True, False], [True, True, True], [False, True, False]]
    radius, azimuth = polar_coordinates(pupil_grid(4, 1e-3, 4e-3))
    assert float(radius.min()) == pytest.approx(math.sqrt(0.5) / 2)
    torch.testing.assert_close(radius, radius.flip(0).flip(1))
    assert float(azimuth[3, 3]) == pytest.approx(math.pi / 4)


@pytest.mark.parametrize(("samples", "diameter", "holds"), [(1, 1e-9, True), (5, 1e-9, True), (2, 1.41, False),
                                                            (4, 1.42, True), (4, 1.2, False)])  # fmt: skip
def test_a_stop_between_four_samples_is_refused(samples, diameter, holds):
    """The four samples about the axis of an even grid lie half a diagonal of a pitch from it."""
    if holds:
        assert bool(inside_stop(pupil_grid(samples, 1.0, diameter)).any())
        return
    with pytest.raises(ParameterError, match=r"holds no pupil sample: give 1[.]41e"):
        pupil_grid(samples, 1.0, diameter)


def test_a_wider_aperture_is_refused_with_the_samples_that_hold_it():
    assert pupil_grid(100, 1e-5, 1e-3).diameter == pytest.approx(1e-3)
    for diameter, samples in ((1.001e-3, 101), (2.5e-3, 250), (2.501e-3, 251)):
        with pytest.raises(ParameterError, match=f"give samples: {samples},"):
            pupil_grid(100, 1e-5, diameter)
        assert pupil_grid(samples, 1e-5, diameter).diameter == diameter
        stretched = pupil_grid(100, 1e-5, diameter, "stretched")
        assert (stretched.samples * stretched.pitch, stretched.diameter) == pytest.approx(
            (diameter, diameter)
        )
