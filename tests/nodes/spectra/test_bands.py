"""Bands of a scene and of a laser line."""

import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.nodes import ParameterError
from neusee.nodes.spectra import bands, filters, line, mean_wavelength
from neusee.nodes.values import Bands

NM = 1e-9


def test_31_bands_have_both_ends_as_centres():
    result = bands(start=400 * NM, stop=700 * NM, count=31)
    expected = torch.arange(400, 701, 10, dtype=torch.float64) * NM
    torch.testing.assert_close(result.centres, expected, atol=1e-18, rtol=0)
    torch.testing.assert_close(
        result.widths, torch.full((31,), 10 * NM, dtype=torch.float64), atol=1e-18, rtol=0
    )
    assert torch.equal(result.weights, torch.ones(31, dtype=torch.float64))


def test_one_band_is_the_middle():
    result = bands(start=500 * NM, stop=600 * NM, count=1)
    assert float(result.centres[0]) == pytest.approx(550 * NM)
    assert float(result.widths[0]) == pytest.approx(100 * NM)


def test_refuses_exchanged_ends():
    with pytest.raises(ParameterError, match=r"700 nm.*400 nm"):
        bands.hooks.preflight(start=700 * NM, stop=400 * NM, count=31)


def test_filters_are_the_bands_of_their_list():
    result = filters(centres=(500 * NM, 450 * NM, 633 * NM), widths=(10 * NM, 25 * NM, 1 * NM))
    assert result.centres.tolist() == [500 * NM, 450 * NM, 633 * NM]
    assert result.widths.tolist() == [10 * NM, 25 * NM, 1 * NM]
    assert result.weights.tolist() == [1, 1, 1]
    assert filters.hooks.check(result)[0].text == "3 filters with centres from 450 to 633 nm"


def test_one_width_is_that_of_all_filters():
    assert filters(centres=(500 * NM, 450 * NM), widths=(10 * NM,)).widths.tolist() == [10 * NM] * 2


def test_refuses_widths_that_belong_to_no_filter():
    with pytest.raises(ParameterError, match="2 widths for 3 centres"):
        filters.hooks.preflight(centres=(500 * NM,) * 3, widths=(10 * NM,) * 2)
    assert filters.hooks.preflight(centres=(500 * NM,) * 2, widths=(10 * NM,) * 2) == []


def test_filters_are_read_from_a_recipe():
    read = filters.params(centres=["500 nm", "0.45 um"], widths=["10 nm"])
    assert read.centres == pytest.approx((500 * NM, 450 * NM))
    for wrong in (
        {"centres": [], "widths": ["10 nm"]},
        {"centres": ["500 nm"], "widths": ["0 nm"]},
    ):
        with pytest.raises(ValueError, match=r"at least|greater than"):
            filters.params(**wrong)


def test_line_weights_are_the_error_function():
    result = line(wavelength=532 * NM, floor=0.0)
    sigma = 10 / math.sqrt(8 * math.log(2))
    edges = [-15, -9, -3, 3, 9, 15]
    below = [0.5 * math.erf(e / sigma / math.sqrt(2)) for e in edges]
    inside = torch.tensor([b - a for a, b in itertools.pairwise(below)], dtype=torch.float64)
    torch.testing.assert_close(result.weights, inside / inside.sum(), rtol=1e-12, atol=0)
    assert (result.centres / NM).round(decimals=6).tolist() == [520, 526, 532, 538, 544]


def test_floor_is_a_share_of_the_peak():
    """Its energy is floor x span over the area of the line, 1.0645 fwhm x peak."""
    without, with_floor = line(wavelength=532 * NM, floor=0.0), line(wavelength=532 * NM, floor=0.1)
    share = 0.1 * 30 / (10 * math.sqrt(math.pi / math.log(2)) / 2)
    kept = math.erf(15 / (10 / math.sqrt(8 * math.log(2))) / math.sqrt(2))
    expected = (without.weights * kept + share / 5) / (kept + share)
    torch.testing.assert_close(with_floor.weights, expected, rtol=1e-12, atol=0)


@settings(max_examples=60, deadline=None)
@given(
    at=st.floats(200, 2000),
    fwhm=st.floats(0.01, 50),
    count=st.integers(1, 15),
    floor=st.floats(0, 1),
    span=st.floats(0.01, 90),
)
def test_line_keeps_its_energy_and_place(at, fwhm, count, floor, span):
    result = line(wavelength=at * NM, fwhm=fwhm * NM, count=count, span=span * NM, floor=floor)
    assert float(result.weights.sum()) == pytest.approx(1, rel=1e-12)
    assert float(result.weights.min()) >= 0
    assert float((result.weights * result.centres).sum()) == pytest.approx(at * NM, rel=1e-9)
    assert float(result.widths.sum()) == pytest.approx(span * NM, rel=1e-9)


@pytest.mark.parametrize(("at", "energy"), [(530, 1.057), (535, 0.943)])
def test_points_show_the_error_of_the_printed_grid(at, energy):
    result = line(wavelength=at * NM, floor=0.0, sampling="point")
    assert float(result.weights.sum()) == pytest.approx(energy, abs=5e-4)
    rest = (result.centres / NM) % 10
    assert float(torch.minimum(rest, 10 - rest).max()) < 1e-6
    assert not line.hooks.check(result, wavelength=at * NM)[0].ok
    assert "5.7 %" in line.hooks.preflight(wavelength=at * NM, sampling="point")[0]


@given(at=st.floats(200, 2000), count=st.integers(1, 9))
def test_points_are_the_nearest_of_the_grid(at, count):
    result = line(wavelength=at * NM, count=count, sampling="point")
    assert len(result.centres) == count
    assert float((result.centres - at * NM).abs().max()) <= (count / 2 * 10 + 1e-6) * NM


def test_refuses_bands_below_100_nm():
    with pytest.raises(ParameterError, match="100 nm") as error:
        line.hooks.preflight(wavelength=110 * NM)
    assert error.value.parameter == "fwhm"
    assert line.hooks.preflight(wavelength=400 * NM) == []


def test_the_mean_of_a_line_counts_its_bands_by_their_energy():
    sampled = Bands(
        torch.tensor([500 * NM, 510 * NM]), torch.full((2,), 10 * NM), torch.tensor([3.0, 1.0])
    )
    assert mean_wavelength(sampled) == pytest.approx(502.5 * NM, rel=1e-6)
