"""Transmittance of air by the visibility: the laws of Kruse and Kim, against their published
tables.
"""

import math

import pytest

from neusee.nodes import ParameterError
from neusee.nodes.laser import air_transmittance, size_exponent


def test_clear_air_is_the_default():
    assert air_transmittance(1e4, None, 532e-9) == 1.0


@pytest.mark.parametrize("law", ["kruse", "kim"])
def test_at_the_visibility_two_per_cent_are_left_of_light_of_550_nm(law):
    assert air_transmittance(3e3, 3e3, 550e-9, law) == pytest.approx(0.02, rel=1e-4)
    assert air_transmittance(1.5e3, 3e3, 550e-9, law) == pytest.approx(math.sqrt(0.02), rel=1e-4)


@pytest.mark.parametrize(
    ("visibility", "law", "wavelength", "decibels"),
    [  # Kim, McArthur and Korevaar (2001), tables of attenuation in dB/km at 785 and 1550 nm
        (50, "kim", 785e-9, 340), (50, "kim", 1550e-9, 340), (200, "kim", 1550e-9, 85),
        (500, "kim", 785e-9, 34), (500, "kim", 1550e-9, 34), (1000, "kim", 785e-9, 14), (1000, "kim", 1550e-9, 10),
        (4000, "kim", 785e-9, 3), (4000, "kim", 1550e-9, 2), (10e3, "kim", 785e-9, 1), (10e3, "kim", 1550e-9, 0.4),
        (50, "kruse", 785e-9, 315), (50, "kruse", 1550e-9, 272), (200, "kruse", 785e-9, 75),
        (200, "kruse", 1550e-9, 60), (500, "kruse", 785e-9, 29), (500, "kruse", 1550e-9, 21),
    ],
)  # fmt: skip
def test_attenuation_is_that_of_the_published_table(visibility, law, wavelength, decibels):
    lost = -10 * math.log10(air_transmittance(100.0, visibility, wavelength, law)) * 10
    assert lost == pytest.approx(decibels, rel=0.05, abs=0.5)


@pytest.mark.parametrize(
    ("km", "q"), [(0.4, 0.0), (0.7, 0.2), (1.0, 0.5), (6.0, 1.3), (20.0, 1.3), (60.0, 1.6)]
)
def test_exponent_of_kim_is_continuous_up_to_six_kilometres(km, q):
    assert size_exponent(km * 1e3, "kim") == pytest.approx(q)


def test_the_laws_differ_tenfold_and_more_at_1550_nm_in_fog():
    kim, kruse = (air_transmittance(1e3, 150, 1550e-9, law) for law in ("kim", "kruse"))
    assert kruse / kim > 10


@pytest.mark.parametrize(
    ("distance", "visibility", "name"),
    [
        (-1.0, None, "distance"),
        (math.inf, None, "distance"),
        (1.0, 0.0, "visibility"),
        (1.0, -5.0, "visibility"),
    ],
)
def test_what_no_air_has_is_refused_by_name(distance, visibility, name):
    with pytest.raises(ParameterError) as error:
        air_transmittance(distance, visibility, 532e-9)
    assert error.value.parameter == name
