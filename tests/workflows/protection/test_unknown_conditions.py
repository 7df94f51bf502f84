"""The conditions of an attack are drawn from their laws, and the same seed draws the same."""

import dataclasses

import numpy as np
import pytest

from neusee.workflows.protection.protection_camera import (
    UnknownLaws,
    draw_conditions,
    usual_condition,
)


def test_draws_follow_their_laws():
    drawn = draw_conditions(4000, 3)
    wavelengths = np.array([one.wavelength for one in drawn])
    assert wavelengths.min() >= 400e-9
    assert wavelengths.max() <= 700e-9
    assert wavelengths.mean() == pytest.approx(550e-9, rel=0.01)
    assert np.std([one.defocus for one in drawn]) == pytest.approx(0.25, rel=0.05)
    assert np.median([one.scatter for one in drawn]) == pytest.approx(0.005, rel=0.1)
    assert np.std(np.log([one.scatter for one in drawn])) == pytest.approx(np.log(2), rel=0.05)
    directions = np.array([one.direction for one in drawn])
    assert abs(directions).max() <= 0.25
    assert abs(np.corrcoef(directions.T)[0, 1]) < 0.06
    assert abs(np.corrcoef(wavelengths, directions[:, 0])[0, 1]) < 0.06


def test_a_longer_list_begins_with_the_shorter_one_and_another_seed_draws_others():
    assert draw_conditions(9, 5)[:4] == draw_conditions(4, 5)
    assert draw_conditions(1, 5) != draw_conditions(1, 6)


def test_the_usual_condition_is_the_median_with_a_clean_window():
    usual = usual_condition()
    assert usual.wavelength == pytest.approx(550e-9)
    assert (usual.defocus, usual.grease, usual.direction) == (0.0, 0.0, (0.0, 0.0))
    assert usual.scatter == pytest.approx(0.005)


def test_a_law_that_is_no_distribution_is_refused():
    with pytest.raises(ValueError, match="write kind"):
        draw_conditions(1, 0, dataclasses.replace(UnknownLaws(), defocus="0.3 waves"))


def test_the_draw_of_an_iteration_is_that_of_the_list():
    assert draw_conditions(3, 5, first=7) == draw_conditions(10, 5)[7:]


def test_the_surface_of_a_draw_scatters_its_share_of_the_light():
    """The closed form of the total integrated scatter, with l = 0.01 and s = -1.5."""
    (one,) = draw_conditions(1, 5)
    (surface,) = one.surfaces.values()
    beta = (np.arange(200_000) + 0.5) / 200_000
    density = surface["b0"] * (1 + (beta / surface["l"]) ** 2) ** (surface["s"] / 2)
    assert (2 * np.pi * beta * density).mean() == pytest.approx(one.scatter, rel=1e-5)
